"""Where the caps' centroids are, and how sure that is: from pixels, and from the hand as it was known last.

What a camera sees of a cap is not its centroid; the difference follows from the direction in which the finger points
(`master.stereo.caps`), which is itself only as sure as the hand is. So a point's covariance has these parts:

    centroids     noise, cover and time, each camera's own                  gain diag(sigma^2) gain'
    alike         part of the noise is the same in all cameras              moves the point, not its depth
    direction     one finger is tilted for all cameras alike                spread of six tilted hands
    radius        the profile's, a tenth                                    0.1 of the whole correction
    relief        of a flat marker: the back of a hand is none              0.4 mm
    calibration   what its provenance says is left                          `master.stereo.place`

Tilt matters most along the sight: two cameras see a finger that points at one of them from different sides, so that
a degree of tilt moves the two centroids apart, and the distance with them.

Cameras side by side see the same cap in the same light, so that its rim and its shading mislead them alike: of what a
whole cap's centroid is wrong by, most is an error of place that all cameras see, and little is one of disparity. What
hides a part of a cap, or comes of time, is each camera's own.

How sure a tilt is, an instant says alone (`master.ik.certainty`): the error of this correction repeats that of the last
pose. For the same reason the hand fit must be told more. It believes that fingers move between instants as fast as its
priors allow: told less than it believes itself, it would follow its own error, and finger and cap would drag each
other away.
"""

from dataclasses import dataclass, replace

import numpy as np

from common.arrays import Float
from common.camera_model import CameraModel
from master.fabrik.estimate import MarkerPositions, SolvedHand
from master.stereo.caps import TURN_RAD_S, CapLook, CapModel
from master.stereo.odd_camera import odd_camera
from master.stereo.place import Placement

_RADIUS = 0.1  # relative error of a profile's radii: 0.8 mm
_RELIEF_M = 0.4e-3  # 16 mm of paint on a back with 50 mm radius of curvature bulge by 0.6 mm
# Of the variance of whole caps' centroids, rendered and detected: 0.7 of all together, 0.8 by medians, but of single
# fingers 0.3 (little) to 0.8 (index); between 0.7 and 0.8 by how often 95 % regions hold the truth. Above this sigma a
# slave suspects that something hides a part (`slave.markers.sigma`), or time adds its own.
_ALIKE, _ALIKE_PX = 0.75, 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Located(MarkerPositions):
    """The markers of one instant by the rays of all cameras.

    Attributes:
        repeated: (M, 3, 3) [m^2] what is to be added to `cov_m2` for a fit that starts at the same hand.
    """

    repeated: Float


class CapLocator:
    """Locates the markers of one rig. Holds no state between calls."""

    def __init__(self, cameras: tuple[CameraModel, ...], caps: CapModel, place: Placement) -> None:
        """Locate with these cameras, caps and depth model."""
        self._cameras, self._caps, self._place = cameras, caps, place
        # How far each u, v, u, v ... goes with a step of a metre along x, y, z, by the scale of the image (2 C, 3).
        self._axes = np.concatenate([camera.T_rig_camera[:3, :2].T for camera in cameras])
        self._nothing = np.zeros((len(cameras), len(caps.on_finger)), dtype=np.bool_)

    def __call__(
        self,
        uv: Float,
        sigma_px: Float,
        area_px2: Float,
        hand: SolvedHand | None,
        age_s: float,
        *,
        as_seen: bool = False,
    ) -> Located:
        """Locate the markers of one instant.

        Args:
            uv: (C, M, 2) [px]; NaN: not seen.
            sigma_px: (C, M).
            area_px2: (C, M).
            hand: The hand known so far; None: a cap may point anywhere where it is seen.
            age_s: How long ago it was so [s].
            as_seen: Nothing tells of a hand, so the markers may be on something flat: what is seen of them is taken
                for their centroid, and the whole correction for doubt.
        """
        found = self._once(uv, sigma_px, area_px2, hand, age_s, as_seen=as_seen)
        if not found.left_out.any():
            return found
        out = found.left_out
        uv, area_px2 = np.where(out[..., None], np.nan, uv), np.where(out, np.nan, area_px2)
        found = self._once(uv, sigma_px, area_px2, hand, age_s, as_seen=as_seen)
        return replace(found, left_out=out & ~found.apart)

    def _once(
        self,
        uv: Float,
        sigma_px: Float,
        area_px2: Float,
        hand: SolvedHand | None,
        age_s: float,
        *,
        as_seen: bool,
    ) -> Located:
        """As `__call__`, but `left_out` is only told, not yet left out."""
        points = self._place.roughly(uv, sigma_px)
        look = self.look(points, hand, age_s)
        if as_seen:
            look.bias_px[0] = 0.0
        doubt = self._caps.doubt_px(area_px2, points, self._cameras, look.whole_m2)
        caps_uv, sure_px = uv - look.bias_px[0], np.hypot(sigma_px, doubt)
        placed = self._place(caps_uv, sure_px)
        bias = look.bias_px.transpose(2, 1, 3, 0).reshape(len(points), -1, len(look.bias_px))  # (M, 2C, T)
        moved = placed.gain @ bias
        tilt = moved[..., 1:] - moved[..., :1]
        tilted = tilt @ tilt.swapaxes(1, 2) / tilt.shape[-1]
        corrected = _RADIUS * moved[..., :1]
        alike = self._alike(placed.gain, sigma_px, doubt)
        cov = placed.cov + alike + tilted + corrected @ corrected.swapaxes(1, 2)
        cov[~self._caps.on_finger] += _RELIEF_M**2 * np.eye(3)
        apart = placed.apart(uv)
        left_out = self._nothing
        if apart.any():
            left_out = odd_camera(self._place, caps_uv, sure_px, apart)
            placed.points[apart], cov[apart] = np.nan, np.nan
        repeated = tilted * (self._unsure(hand, age_s) - 1.0)[:, None, None]
        return Located(placed.points, cov, placed.cov, apart, left_out, repeated)

    def _alike(self, gain: Float, sigma_px: Float, doubt_px: Float) -> Float:
        """What it changes in covariances (M, 3, 3) that cameras err alike, as if the marker were elsewhere.

        The same part of each camera's variance is taken as one step of the marker, instead of as each camera's own.

        Args:
            gain: (M, 3, 2 C) [m/px].
            sigma_px: (C, M) as the slaves have it; NaN: not seen.
            doubt_px: (C, M) of hidden caps, who share nothing: what hides them is elsewhere for each camera.
        """
        least = np.minimum(np.nan_to_num(np.fmin.reduce(sigma_px, axis=0)), _ALIKE_PX)
        shared = np.where(doubt_px.any(axis=0), 0.0, _ALIKE * least * least)
        step = gain @ self._axes
        return shared[:, None, None] * (step @ step.swapaxes(1, 2) - gain @ gain.swapaxes(1, 2))

    def look(self, points: Float, hand: SolvedHand | None, age_s: float) -> CapLook:
        """How caps at (M, 3) [m] look: as the hand has them, and tilted as far as it is unsure."""
        if hand is None:
            ahead = self._caps.anyhow(points, self._cameras)
        else:
            turned = (TURN_RAD_S * age_s) ** 2 * np.eye(3)
            ahead = self._caps.tilted(hand.joints, hand.tilt_cov_rad2 + turned)
        return self._caps.look(ahead, points, self._cameras)

    def _unsure(self, hand: SolvedHand | None, age_s: float) -> Float:
        """By how much the variance of the tilt is larger to the hand fit than to us (M,)."""
        if hand is None:
            return np.ones(len(self._caps.on_finger))
        turned = 2.0 * (TURN_RAD_S * age_s) ** 2
        ours = np.einsum("fii->f", hand.tilt_cov_rad2) + turned
        walked = np.einsum("fii->f", hand.tilt_walk_rad2_s2) * (age_s * age_s) - turned
        return self._caps.by_marker(1.0 + np.maximum(walked, 0.0) / np.maximum(ours, 1e-12))
