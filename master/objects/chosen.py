"""What is fitted: the sightings of a window as one list, with one place for each feature; and what starts look at."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.camera_model import CameraModel
from master.objects.features import Features
from master.objects.fit import Fitted
from master.objects.start import Sighted, reach
from master.objects.sums import Observations
from master.objects.window import Sighting, Window

Doubt = Callable[[int, Float, Float], Float]


@dataclass(frozen=True, slots=True, eq=False)
class Chosen:
    """Observations of a window with one place for each; `feature` (n,) is what each is a part of."""

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
        doubt: Doubt,
    ) -> "Chosen | None":
        """All that is seen; None: nothing.

        Args:
            window: The sightings.
            features: Of the object.
            cameras: Of the rig.
            T: A pose (4, 4) near which the object is; of two places of a bead the nearer to it is taken. None: none.
            doubt: Camera, pose and areas (B,) [px^2] of its beads -> by how much their centroids may be off [px].
        """
        rows: list[tuple[Int, Int, Float, Float, Float, Float, Bool]] = []
        for c, both in enumerate(window.views):
            for kind, line in enumerate(both):
                for sighting in line:
                    uv, sigma = _nearer(sighting, features, cameras[c], T), sighting.sigma_px
                    if T is not None and kind == 0:
                        sigma = np.hypot(sigma, doubt(c, T, sighting.area_px2))
                    there = np.isfinite(uv).all(axis=1) & np.isfinite(sigma)
                    n = int(there.sum())
                    tau = (sighting.t_ns[there] - (window.t_ns - window.origin_ns)) * 1e-9
                    late, now = np.full(n, sighting.t_sigma_s), np.full(n, sighting is window.near(c, kind))
                    rows.append(
                        (np.full(n, c), sighting.point[there], tau, uv[there], sigma[there], late, now)
                    )
        if not sum(len(row[0]) for row in rows):
            return None
        camera, point, tau, uv, sigma, t_sigma, now = (
            np.concatenate(column) for column in zip(*rows, strict=True)
        )
        seen = Observations(camera, point, tau, uv, sigma, t_sigma)
        return cls(seen, features.feature[point], now, features.count, len(cameras))

    def used(self, fitted: Fitted) -> Bool:
        """(C, F) which features the pose rests on in which camera, in the frames nearest to the instant."""
        out = np.zeros((self.cameras, self.features), np.bool_)
        chosen = fitted.used & self.now
        out[self.seen.camera[chosen], self.feature[chosen]] = True
        return out


def _nearer(sighting: Sighting, features: Features, camera: CameraModel, T: Float | None) -> Float:
    """Places (K, 2) of a sighting, rivals taken where a pose has the point nearer to them."""
    if T is None or np.isnan(sighting.rival_uv).all():
        return sighting.uv
    there = camera.project(features.points[sighting.point] @ T[:3, :3].T + T[:3, 3])
    first, second = (np.linalg.norm(uv - there, axis=1) for uv in (sighting.uv, sighting.rival_uv))
    return np.where((second < first)[:, None], sighting.rival_uv, sighting.uv)


def sighted_now(window: Window, features: Features) -> list[Sighted]:
    """What each camera sees now of each feature, brought to the instant along a line."""
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
                rival = first.rival_uv[rows]
                places = [uv] if np.isnan(rival).any() else [uv, rival]
                out.append(Sighted(c, int(feature), np.stack(places)))
    return out


def _brought(points: Int, line: tuple[Sighting, ...], at_ns: int) -> Float:
    """Points (n, 2) of the nearest sighting, moved on as from the next one that has them all."""
    found: list[tuple[Float, Float]] = []
    for sighting in line:
        rows = [int(np.flatnonzero(sighting.point == p)[0]) for p in points if (sighting.point == p).any()]
        if len(rows) == len(points) and np.isfinite(sighting.uv[rows]).all():
            found.append((sighting.uv[rows], (sighting.t_ns[rows] - at_ns) * 1e-9))
    chosen = reach(np.array([tau[0] for _, tau in found]))
    if len(chosen) < 2:
        return found[0][0]
    uv, tau = found[int(chosen[0])]
    other, other_tau = found[int(chosen[1])]
    return uv - (tau / (other_tau - tau))[:, None] * (other - uv)
