"""Two-pose ambiguity of a single visible tag.

Chooses which of its two poses to use, and how certain that choice is.

A flat tag has two poses that nearly explain it, tilted one way or the other. Both are fitted; the one that was assumed
stays unless the other is clearly better over several frames, and as far as the other is possible the covariance reaches
over to it.

The other is fitted for nothing where two cameras that see it leave no ambiguity, and costs as much as the first. So
while the same cameras see the same tag, and the other was out of the question when it was fitted last, it is taken to
be as bad for the next frames (`_UNLOOKED`). What is published then differs by less than numbers are exact.
"""

from dataclasses import dataclass, replace

import numpy as np

from common.arrays import Float
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import matrix_to_rotation_vector
from master.objects.association import Association, sighted_now
from master.objects.features import Features
from master.objects.fit import Fitted, PoseFit
from master.objects.motion import Motion
from master.objects.start import two_poses
from master.objects.window import Window

_FLIP_RAD = np.radians(8.0)  # poses of a tag nearer than this are one


@dataclass(slots=True)
class _Clear:
    """A tag whose other pose is ruled out.

    Which cameras saw it, how much better the other pose is, and for how many more frames this holds.
    """

    seen_by: tuple[int, ...]
    better: float
    frames: int


class SingleTag:
    """Resolver of the two-pose ambiguity of a single tag.

    Push machine. Holds how much better the other pose has been of late, and what was ruled out when it was fitted.
    """

    def __init__(self, features: Features, cameras: tuple[CameraModel, ...], fit: PoseFit) -> None:
        """Set up for an object's features, the rig's cameras and the pose fit.

        `fit` fits the features to what the cameras saw.
        """
        self._features, self._cameras, self._fit = features, cameras, fit
        self._log_odds = 0.0
        self._clear: _Clear | None = None

    def forget(self) -> None:
        """Begin anew: what is seen is another thing."""
        self._log_odds, self._clear = 0.0, None

    def of_two(self, window: Window, seen: Association, fitted: Fitted, *, begins: bool) -> Fitted:
        """Return the pose to use, its covariance widened by the alternative pose.

        The fit is returned unchanged where more than one tag is seen.

        Args:
            window: The observations.
            seen: What was fitted.
            fitted: The pose.
            begins: There is no pose before it: the better one is taken at once.
        """
        features = np.unique(seen.feature[fitted.used])
        forget = 0.8  # of that sum, from frame to frame
        if len(features) != 1 or features[0] < self._features.beads:
            self._log_odds *= forget
            self._clear = None
            return fitted
        feature = int(features[0])
        who = (feature, *np.unique(seen.seen.camera[fitted.used]).tolist())
        clear = self._clear
        if clear is not None and clear.seen_by == who and clear.frames > 0 and not begins:
            clear.frames -= 1
            self._log_odds = forget * (self._log_odds + clear.better)
            return fitted
        self._clear = None
        other = self._other(window, seen, fitted, feature)
        if other is None:
            self._log_odds *= forget
            return fitted
        better = 0.5 * (fitted.cost - other.cost)
        self._log_odds = forget * self._log_odds + 2.0 * better * (1.0 - forget) * 2.0
        # chi square, summed over frames, by which the other pose of a tag must be better
        # chi square of the other pose's being better at which it is out of the question: exp(-30) is nothing
        if begins:
            if better > 0.0:
                fitted, other, better = other, fitted, -better
        elif self._log_odds > 12.0:
            fitted, other, better, self._log_odds = other, fitted, -better, 0.0
        elif better < (-30.0):
            # frames for which that holds: less than a tenth of a second, before a sum of it would be forgotten
            unlooked = 5
            self._clear = _Clear(who, better, unlooked)
        return _reaching(fitted, other, better)

    def _other(self, window: Window, seen: Association, fitted: Fitted, feature: int) -> Fitted | None:
        """The fit of the only tag's other pose, where there is another."""
        own = self._features.points[self._features.corners_of(feature - self._features.beads)]
        best: Fitted | None = None
        for sighted in sighted_now(window, self._features):
            if sighted.feature != feature:
                continue
            camera = self._cameras[sighted.camera]
            for _, T in two_poses(own, camera.undistort(sighted.uv[0])):
                there = camera.T_rig_camera @ T
                if _rotated(there, fitted.motion.T) < _FLIP_RAD:
                    continue
                other = self._fit(seen.seen, Motion.still(there), feature=seen.feature)
                if other is None or _rotated(other.motion.T, fitted.motion.T) < _FLIP_RAD:
                    continue
                if best is None or other.cost < best.cost:
                    best = other
        return best


def _reaching(fitted: Fitted, other: Fitted, better: float) -> Fitted:
    """Widen the covariance of a fit towards the alternative pose.

    The covariance reaches over to the other pose as far as that is possible, by how much better it is.
    """
    share = 1.0 / (1.0 + np.exp(np.clip(-better, -50.0, 50.0)))
    off = np.concatenate(
        [
            other.motion.T[:3, 3] - fitted.motion.T[:3, 3],
            matrix_to_rotation_vector(other.motion.T[:3, :3] @ fitted.motion.T[:3, :3].T),
        ]
    )
    cov = fitted.cov.copy()
    cov[:6, :6] += share * np.outer(off, off)
    return replace(fitted, cov=cov)


def _rotated(T: Float, other: Float) -> float:
    """Angle between two poses [rad]: the trace of a rotation is 1 + 2 cos."""
    cosine = 0.5 * (float(np.vdot(T[:3, :3], other[:3, :3])) - 1.0)
    return float(np.arccos(min(max(cosine, -1.0), 1.0)))
