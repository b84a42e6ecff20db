"""Which of two things of one colour is the marker: decided by the other cameras, then by where the marker was.

A slave that could not exclude a second place of a marker's colour names both, the marker and its rival. Of all
combinations of the two over the cameras the one of least cost is taken, in units of chi square:

    misfit of the rays (master.stereo.misfit)
    + distance from where the hand, as its other markers show it, should have the marker
    + distance from where the marker was, at most `_PAST`
    + `CLEARLY` for every slave that is overruled: it knows size, shape and motion in its image

A combination counts only where its rays meet before the cameras, no farther from the hand than noise is once in a
million; and one that overrules a slave only where it is no farther from the marker's past, either. The past may have
been a mistake: it can overrule one slave, but not two that agree on a place. Where nothing is left, or two that are no
choice of the slaves fit alike at different places, the marker is dropped for this instant, its rays included.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.special import chdtri

from common.arrays import Bool, Float, Int
from common.camera_model import CameraModel
from master.stereo.place import Placement

CLEARLY = float(chdtri(1, 0.01))
"""By how much of chi square a combination must be better for each slave it overrules: 1 in 100 by chance, 6.6."""
_PAST = 1.5 * CLEARLY  # more than one slave, less than two
_TOO_FAR = {degrees: float(chdtri(degrees, 1e-6)) for degrees in (2, 3)}
_RIVAL_CAMERAS = 5  # 32 combinations; cameras with a rival beyond these are left out for that marker
_SAME_M = 0.02  # combinations whose points are nearer are one thing


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """Where markers are believed to be: points (M, 3) [m], rig frame, and covariances (M, 3, 3); NaN: no idea."""

    points: Float
    cov: Float


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
        self, uv: Float, sigma_px: Float, rival_uv: Float, rival_sigma_px: Float, hand: Belief, past: Belief
    ) -> Chosen:
        """Choose for every marker that has a rival; the others are passed on.

        Args:
            uv: First places (C, M, 2) [px] of one instant; NaN: not seen.
            sigma_px: (C, M).
            rival_uv: Second places (C, M, 2) [px]; NaN: none.
            rival_sigma_px: (C, M).
            hand: Where the other markers of the hand say that the markers are.
            past: Where the markers were.
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
            beliefs = [Belief(b.points[m], b.cov[m]) for b in (hand, past)]
            k = self._best(options, sigmas, use.sum(axis=1), *beliefs)
            taken[m], dropped[m] = k is not None and k > 0, k is None
            uv[:, m] = np.nan if k is None else options[:, k]
            sigma_px[:, m] = np.nan if k is None else sigmas[:, k]
        return Chosen(uv, sigma_px, taken, dropped)

    def _best(self, uv: Float, sigma_px: Float, overruled: Int, hand: Belief, past: Belief) -> int | None:
        """Which of the K combinations (C, K, 2) it is; 0 is the slaves' own, None: it cannot be told.

        Args:
            uv, sigma_px: (C, K, 2), (C, K) [px].
            overruled: (K,) slaves whose choice each does not follow.
            hand, past: Of the one marker: (3,), (3, 3).
        """
        seen = np.flatnonzero(np.isfinite(uv[:, 0, 0]))
        if len(seen) == 1:
            c = int(seen[0])
            places, fits, cost = uv[c], np.ones(len(overruled), dtype=bool), np.zeros(len(overruled))
            beliefs = [_away(places, sigma_px[c], *self._image(c, belief)) for belief in (hand, past)]
            same = np.inf  # which of two places it is that a single camera sees, the slave knows best
        else:
            placed = self._place(uv, sigma_px)
            places, cost = placed.points, placed.misfit
            fits = np.isfinite(places[:, 0]) & (placed.misfit <= placed.limit)
            beliefs = [_away(places, placed.cov, belief.points, belief.cov) for belief in (hand, past)]
            same = _SAME_M
        from_hand, from_past = beliefs
        too_far = _TOO_FAR[places.shape[1]]
        fits = fits & (from_hand <= too_far) & ((from_past <= too_far) | (overruled == 0))
        if not fits.any():
            return None
        cost = np.where(fits, cost + from_hand + np.minimum(from_past, _PAST) + CLEARLY * overruled, np.inf)
        best = int(np.argmin(cost))
        alike = (cost <= cost[best] + CLEARLY) & (np.linalg.norm(places - places[best], axis=1) > same)
        return None if best > 0 and alike[overruled > 0].any() else best

    def _image(self, c: int, belief: Belief) -> tuple[Float, Float]:
        """A belief about one marker as camera `c` sees it: place (2,) [px] and covariance (2, 2) [px^2]."""
        camera = self._cameras[c]
        step = 1e-3 * np.eye(3)
        there = camera.project(belief.points)
        turn = (camera.project(belief.points + step) - there).T / 1e-3  # (2, 3) [px/m]
        return there, turn @ belief.cov @ turn.T


def _away(places: Float, cov: Float, believed: Float, believed_cov: Float) -> Float:
    """Squared distance (K,) of places (K, n) from a belief (n,), (n, n), in units of chi square; 0: no idea.

    Args:
        places: NaN: none; its distance is 0.
        cov: Their covariances (K, n, n), or standard deviations per axis (K,) [px].
        believed, believed_cov: The belief.
    """
    if not np.isfinite(believed).all():
        return np.zeros(len(places))
    if cov.ndim == 1:
        cov = cov[:, None, None] ** 2 * np.eye(2)
    off = np.where(np.isfinite(places), places - believed, 0.0)
    both = np.where(np.isfinite(cov), cov, 0.0) + believed_cov
    return (off * np.linalg.solve(both, off[..., None])[..., 0]).sum(axis=1)
