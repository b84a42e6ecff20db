"""Association of the observations of a window with features.

They are one list, with one image position for each feature, for the fit; and what starts look at.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.geometry.camera_model import CameraModel
from master.objects.features import Features
from master.objects.fit import Fitted
from master.objects.start import Sighted, reach
from master.objects.sums import Observations
from master.objects.window import ImageObservation, Window

CentroidSigma = Callable[[int, Float, Float], Float]


@dataclass(frozen=True, slots=True, eq=False)
class Association:
    """Observations of a window with one image position for each.

    `feature` (n,) is what each is a part of.
    """

    seen: Observations
    feature: Int
    now: Bool
    features: int
    cameras: int

    @classmethod
    def of(
        cls,
        window: Window,
        features: Features,
        cameras: tuple[CameraModel, ...],
        T: Float | None,
        centroid_sigma: CentroidSigma,
    ) -> "Association | None":
        """All that is seen; None: nothing.

        Args:
            window: The observations.
            features: Of the object.
            cameras: Of the rig.
            T: A pose (4, 4) near which the object is; of two places of a bead the nearer to it is taken. None: none.
            doubt: Camera, pose and areas (..., B) [px^2] of its beads -> by how much their centroids may be off [px].
        """
        columns: list[tuple[Int, Int, Float, Float, Float, Float, Bool]] = []
        for c, both in enumerate(window.views):
            for kind, line in enumerate(both):
                observed = [observation for observation in line if len(observation.point)]
                if not observed:
                    continue
                point = np.concatenate([one.point for one in observed])
                uv, sigma = _nearer(observed, point, features, cameras[c], T)
                if T is not None and kind == 0:
                    area = np.concatenate([one.area_px2 for one in observed]).reshape(len(observed), -1)
                    sigma = np.hypot(sigma, centroid_sigma(c, T, area).ravel())
                there: Int = np.flatnonzero(np.isfinite(uv[:, 0] + uv[:, 1] + sigma))
                t_ns = np.concatenate([one.t_ns for one in observed])
                size = [len(one.point) for one in observed]
                late = np.repeat([one.t_sigma_s for one in observed], size)
                near = window.near(c, kind)
                now = np.repeat([one is near for one in observed], size)
                tau = (t_ns[there] - (window.t_ns - window.origin_ns)) * 1e-9
                at = np.full(len(there), c)
                columns.append((at, point[there], tau, uv[there], sigma[there], late[there], now[there]))
        if not sum(len(column[0]) for column in columns):
            return None
        camera, point, tau, uv, sigma, t_sigma, now = (
            np.concatenate(column) for column in zip(*columns, strict=True)
        )
        seen = Observations(camera, point, tau, uv, sigma, t_sigma)
        return cls(seen, features.feature[point], now, features.count, len(cameras))

    def used(self, fitted: Fitted) -> Bool:
        """Return (C, F) which features the pose rests on in which camera.

        The frames nearest to the epoch count.
        """
        out = np.zeros((self.cameras, self.features), np.bool_)
        associated = fitted.used & self.now
        out[self.seen.camera[associated], self.feature[associated]] = True
        return out


def _nearer(
    line: list[ImageObservation], point: Int, features: Features, camera: CameraModel, T: Float | None
) -> tuple[Float, Float]:
    """Return positions (K, 2) of the points (K,) of observations; sigmas.

    The alternative is taken where a pose has the point nearer to it.
    """
    uv, sigma = np.concatenate([one.uv for one in line]), np.concatenate([one.sigma_px for one in line])
    alternative = np.concatenate([one.alt_uv for one in line])
    if T is None or np.isnan(alternative).all():
        return uv, sigma
    there = camera.project(features.points[point] @ T[:3, :3].T + T[:3, 3])
    first, second = (np.linalg.norm(one - there, axis=1) for one in (uv, alternative))
    return np.where((second < first)[:, None], alternative, uv), sigma


def sighted_now(window: Window, features: Features) -> list[Sighted]:
    """Return what each camera sees now of each feature.

    The observations are brought to the epoch along a line.
    """
    out: list[Sighted] = []
    at_ns = window.t_ns - window.origin_ns
    for c, both in enumerate(window.views):
        for kind, line in enumerate(both):
            first = window.near(c, kind)
            if first is None:
                continue
            for feature in np.unique(features.feature[first.point]):
                rows = features.feature[first.point] == feature
                if np.isnan(first.uv[rows]).any():
                    continue
                uv = _brought(first.point[rows], line, at_ns)
                alternative = first.alt_uv[rows]
                places = [uv] if np.isnan(alternative).any() else [uv, alternative]
                out.append(Sighted(c, int(feature), np.stack(places)))
    return out


def _brought(points: Int, line: tuple[ImageObservation, ...], at_ns: int) -> Float:
    """Extrapolate points (n, 2) of the nearest observation to a time.

    They move on as from the next observation that has them all.
    """
    found: list[tuple[Float, Float]] = []
    for observation in line:
        rows = [
            int(np.flatnonzero(observation.point == p)[0]) for p in points if (observation.point == p).any()
        ]
        if len(rows) == len(points) and np.isfinite(observation.uv[rows]).all():
            found.append((observation.uv[rows], (observation.t_ns[rows] - at_ns) * 1e-9))
    associated = reach(np.array([tau[0] for _, tau in found]))
    if len(associated) < 2:
        return found[0][0]
    uv, tau = found[int(associated[0])]
    other, other_tau = found[int(associated[1])]
    return uv - (tau / (other_tau - tau))[:, None] * (other - uv)
