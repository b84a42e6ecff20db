"""Which of two things of one colour is the marker: decided by the other cameras, then by where the marker was.

A slave that could not exclude a second place of a marker's colour names both, the marker and its rival. Of all
combinations of the two over the cameras the one with the least misfit is taken, in units of chi square:

    misfit of the rays (master.stereo.misfit)  +  distance from the expected place, by its own covariance and spread

A combination counts only where its rays meet in front of the cameras and where it is not farther from the expected
place than noise is once in a million. The slave's own choice, which knows size, shape and motion in the image, stands
unless another combination is better by more than `CLEARLY`. Where none is left, or two that are no choice of the slave
fit alike at different places, the marker is dropped for this instant: not even its rays are used.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np

from common.arrays import Bool, Float
from common.camera_model import CameraModel
from master.stereo.misfit import chi_square_quantile
from master.stereo.place import Placement

CLEARLY = chi_square_quantile(0.01, 1)
"""By how much of chi square another combination must be better than the slave's: 1 in 100 by chance, 6.6."""
_TOO_FAR = {degrees: chi_square_quantile(1e-6, degrees) for degrees in (2, 3)}
_RIVAL_CAMERAS = 5  # 32 combinations; cameras with a rival beyond these are left out for that marker
_SAME_M = 0.02  # combinations whose points are nearer are one thing


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """Where each marker is believed to be.

    Attributes:
        points: (M, 3) [m], rig frame; NaN: no idea.
        spread_m: (M,) standard deviation per axis [m].
    """

    points: Float
    spread_m: Float


@dataclass(frozen=True, slots=True, eq=False)
class Chosen:
    """The places to go on with.

    Attributes:
        uv: (C, M, 2) [px]; NaN: not seen, or dropped.
        sigma_px: (C, M).
        taken: (M,) another combination than the slaves' was taken.
        dropped: (M,) nothing fits, or it cannot be told what.
    """

    uv: Float
    sigma_px: Float
    taken: Bool
    dropped: Bool


class RivalChooser:
    """Chooses for one rig. Holds no state between calls."""

    def __init__(self, cameras: tuple[CameraModel, ...], place: Placement) -> None:
        """Choose with these cameras, placing points by `place`."""
        self._cameras, self._place = cameras, place

    def __call__(
        self, uv: Float, sigma_px: Float, rival_uv: Float, rival_sigma_px: Float, expected: Expected
    ) -> Chosen:
        """Choose for every marker that has a rival; the others are passed on.

        Args:
            uv: First places (C, M, 2) [px] of one instant; NaN: not seen.
            sigma_px: (C, M).
            rival_uv: Second places (C, M, 2) [px]; NaN: none.
            rival_sigma_px: (C, M).
            expected: Where the markers are believed to be.
        """
        uv, sigma_px = uv.copy(), sigma_px.copy()
        taken, dropped = np.zeros(uv.shape[1], dtype=bool), np.zeros(uv.shape[1], dtype=bool)
        rivals = np.isfinite(rival_uv[..., 0])
        for m in np.flatnonzero(rivals.any(axis=0)):
            cameras = np.flatnonzero(rivals[:, m])
            uv[cameras[_RIVAL_CAMERAS:], m] = np.nan
            cameras = cameras[:_RIVAL_CAMERAS]
            # (K, r) whether the rival stands for the marker in each such camera; the first: nowhere
            use = np.array(list(product((False, True), repeat=len(cameras))))
            options = np.repeat(uv[:, m : m + 1], len(use), axis=1)
            sigmas = np.repeat(sigma_px[:, m : m + 1], len(use), axis=1)
            for c, rival in zip(cameras, use.T, strict=True):
                options[c, rival], sigmas[c, rival] = rival_uv[c, m], rival_sigma_px[c, m]
            k = self._best(options, sigmas, expected.points[m], float(expected.spread_m[m]))
            taken[m], dropped[m] = k is not None and k > 0, k is None
            uv[:, m] = np.nan if k is None else options[:, k]
            sigma_px[:, m] = np.nan if k is None else sigmas[:, k]
        return Chosen(uv, sigma_px, taken, dropped)

    def _best(self, uv: Float, sigma_px: Float, expected: Float, spread_m: float) -> int | None:
        """Which of the K combinations (C, K, 2) it is; 0 is the slaves' own, None: it cannot be told."""
        seen = np.flatnonzero(np.isfinite(uv[:, 0, 0]))
        if len(seen) == 1:
            c = int(seen[0])
            return self._nearest(self._cameras[c], uv[c], sigma_px[c], expected, spread_m)
        placed = self._place(uv, sigma_px)
        points, cost = placed.points, placed.misfit
        fits = np.isfinite(points[:, 0]) & (placed.misfit <= placed.limit)
        if np.isfinite(expected[0]) and fits.any():
            cov = np.where(fits[:, None, None], placed.cov, 0.0) + spread_m**2 * np.eye(3)
            off = points - expected
            away = np.einsum("ki,ki->k", off, np.linalg.solve(cov, off[..., None])[..., 0])
            fits &= away <= _TOO_FAR[3]
            cost = cost + away
        if not fits.any():
            return None
        cost = np.where(fits, cost, np.inf)
        best = int(np.argmin(cost))
        if cost[0] <= cost[best] + CLEARLY:
            return 0
        alike = (cost <= cost[best] + CLEARLY) & (np.linalg.norm(points - points[best], axis=1) > _SAME_M)
        return None if alike.any() else best

    @staticmethod
    def _nearest(
        camera: CameraModel, uv: Float, sigma_px: Float, expected: Float, spread_m: float
    ) -> int | None:
        """As `_best` where one camera sees the marker: places (K, 2), (K,); by the expected place alone."""
        there = camera.project(expected)
        if not np.isfinite(there).all():
            return 0
        depth = float(np.linalg.norm(expected - camera.centre))
        variance = sigma_px**2 + camera.matrix[0, 0] * camera.matrix[1, 1] * (spread_m / depth) ** 2
        away = ((uv - there) ** 2).sum(axis=1) / variance
        best = int(np.argmin(away))
        if away[best] > _TOO_FAR[2]:
            return None
        return 0 if away[0] <= away[best] + CLEARLY else best
