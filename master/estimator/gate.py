"""Associate: which of two places in an image is the marker.

A slave that cannot exclude a second place of a marker's colour names both. Of all combinations of the two over the
cameras the one of least cost is taken, in units of chi-square:

    reprojection error of the rays (`master.fabrik.intersection`)
    + distance from where the hand's other markers predict the marker
    + distance from where the marker was, at most `past_most`
    + `overrule` for every camera whose first choice is not followed: it knows size, shape and motion in its image

A combination counts only where its rays meet before the cameras, no farther from the prediction than noise is once in a
million; and one that overrules a camera only where it is no farther from the marker's past, either. The past may have
been a mistake: it can overrule one camera, but not two that agree on a place. Where nothing is left, or where two
combinations that overrule cameras fit alike at different places, the marker is dropped for this epoch.
"""

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from common.arrays import Bool, Float, Int
from common.kernels import constant, kernel
from master.estimator.cameras import CameraArrays, project
from master.fabrik.intersection import triangulate


@dataclass(frozen=True, slots=True, kw_only=True)
class GateSettings:
    """Numbers of the association.

    Attributes:
        overrule: Least gain in chi-square for each camera that is overruled: 1 in 100 by chance, one degree of freedom.
        past_most: Largest cost of the distance from the past: more than one camera, less than two.
        false_alarm: Probability that noise alone is farther from a prediction than the gate.
        most_cameras: Cameras with an alternative that are combined, 32 combinations; those beyond are rejected.
        same_m: [m] combinations whose points are nearer are one thing: a finger's width.
        place_m: [m] standard deviation of a marker's place a moment ago.
        speed_m_s: [m/s] standard deviation of a marker's speed.
        forget_s: [s] age from which a past place is not used.
        model_m: [m] standard deviation of a marker's place in a hand that its other markers show: fingers are predicted
            by posture alone.
        spread_m: [m] standard deviation of a marker's distance from the middle of a hand that is not solved.
    """

    overrule: float = float(chdtri(1, 0.01))
    past_most: float = 1.5 * float(chdtri(1, 0.01))
    false_alarm: float = 1e-6
    most_cameras: int = 5
    same_m: float = 0.02
    place_m: float = 0.01
    speed_m_s: float = 1.0
    forget_s: float = 0.5
    model_m: float = 0.015
    spread_m: float = 0.1


SETTINGS = GateSettings()


class Prior(NamedTuple):
    """Where M markers are expected (M, 3), rig frame, NaN: nowhere; (M, 3, 3)."""

    points_m: Float
    cov_m2: Float


@dataclass(frozen=True, slots=True, eq=False)
class Association:
    """One place for each marker.

    Attributes:
        uv: (C, M, 2) [px]; NaN: not seen, or dropped.
        sigma_px: (C, M).
        area_px2: (C, M); NaN where the second place is taken, whose area is not known.
        taken: (M,) another combination than the cameras' first choices is taken.
        dropped: (M,) nothing fits, or it is ambiguous.
    """

    uv: Float
    sigma_px: Float
    area_px2: Float
    taken: Bool
    dropped: Bool


def among(others_m: Float, on_hand: Int, settings: GateSettings = SETTINGS) -> Prior:
    """Expect markers `on_hand` around the others (M, 3); no hand is solved."""
    points, triangulated = np.full(others_m.shape, np.nan), others_m[on_hand]
    triangulated = triangulated[np.isfinite(triangulated[:, 0])]
    if len(triangulated):
        points[on_hand] = np.median(triangulated, axis=0)
    return Prior(points, np.tile(settings.spread_m**2 * np.eye(3), (len(points), 1, 1)))


def associate(
    cameras: CameraArrays,
    pixels: tuple[Float, Float, Float],
    alternatives: tuple[Float, Float],
    hand: Prior,
    past: tuple[Float, Float],
    rays_px: float = 0.0,
    settings: GateSettings = SETTINGS,
) -> Association:
    """Choose for every marker that has an alternative; pass on the others.

    Args:
        cameras: In the order of the observations' first axis.
        pixels: First places of one epoch (C, M, 2) [px], sigma (C, M) [px], area (C, M) [px^2]; NaN: not seen.
        alternatives: Second places (C, M, 2) [px] and sigma (C, M); NaN: none.
        hand: All markers as the hand's other markers predict them, those that have no alternative.
        past: Where each marker was last (M, 3) [m], and how long ago (M,) [s]; NaN: never.
        rays_px: Standard deviation per axis that the calibration leaves.
        settings: Numbers.
    """
    first_uv, first_sigma, area = pixels
    alternative: Bool = np.isfinite(alternatives[0][..., 0])
    taken = np.zeros(len(area[0]), np.bool_)
    out = Association(first_uv.copy(), first_sigma.copy(), area.copy(), taken, taken.copy())
    for m in np.flatnonzero(alternative.any(axis=0)):
        where = np.flatnonzero(alternative[:, m])
        out.uv[where[settings.most_cameras :], m] = np.nan
        where = where[: settings.most_cameras]
        # (K, r) whether the second place is taken in each such camera; the first combination: nowhere.
        second = np.array(list(product((False, True), repeat=len(where))))
        uv = np.repeat(out.uv[:, m : m + 1], len(second), axis=1)
        sigma_px = np.repeat(first_sigma[:, m : m + 1], len(second), axis=1)
        for c, use in zip(where, second.T, strict=True):
            uv[c, use], sigma_px[c, use] = alternatives[0][c, m], alternatives[1][c, m]
        age_s = past[1][m]
        moved = (settings.place_m + settings.speed_m_s * age_s) ** 2 * np.eye(3)
        was = past[0][m] if age_s <= settings.forget_s else np.full(3, np.nan)
        model = settings.model_m**2 * np.eye(3)
        priors = Prior(hand.points_m[m], hand.cov_m2[m] + model), Prior(was, moved)
        k = _best(cameras, uv, sigma_px, second.sum(axis=1), priors, rays_px, settings)
        out.dropped[m], out.taken[m] = k is None, k is not None and k > 0
        out.uv[:, m] = np.nan if k is None else uv[:, k]
        out.sigma_px[:, m] = np.nan if k is None else sigma_px[:, k]
        out.area_px2[out.uv[:, m, 0] != first_uv[:, m, 0], m] = np.nan
    return out


def _best(
    cameras: CameraArrays,
    uv: Float,
    sigma_px: Float,
    overruled: Int,
    priors: tuple[Prior, Prior],
    rays_px: float,
    settings: GateSettings,
) -> int | None:
    """Return which of K combinations is the marker; None: none, ambiguous.

    0 is that of the first choices.

    Args:
        cameras, rays_px, settings: As of `associate`.
        uv, sigma_px: (C, K, 2), (C, K) [px].
        overruled: (K,) cameras whose first choice each does not follow.
        priors: Of the one marker, by hand and past: (3,), (3, 3).
    """
    seen = np.flatnonzero(np.isfinite(uv[:, 0, 0]))
    if len(seen) == 1:
        c = int(seen[0])
        places, fits, cost = uv[c], np.ones(len(overruled), np.bool_), np.zeros(len(overruled))
        cov = sigma_px[c, :, None, None] ** 2 * np.eye(2)
        priors = _in_image(cameras, c, priors[0]), _in_image(cameras, c, priors[1])
        same = np.inf  # of two places that one camera sees alone, it knows best itself
    else:
        found = triangulate(cameras, uv, sigma_px, rays_px)
        places, cov, cost = found.points_m, found.cov_m2, found.chi_square
        fits, same = np.isfinite(places[:, 0]) & ~found.outliers, settings.same_m
    from_hand, from_past = (_distances(places, cov, *prior) for prior in priors)
    farthest = float(chdtri(places.shape[1], settings.false_alarm))
    fits = fits & (from_hand <= farthest) & ((from_past <= farthest) | (overruled == 0))
    if not fits.any():
        return None
    cost = cost + from_hand + np.minimum(from_past, settings.past_most) + settings.overrule * overruled
    cost = np.where(fits, cost, np.inf)
    best = int(np.argmin(cost))
    near = (cost <= cost[best] + settings.overrule) & (np.linalg.norm(places - places[best], axis=1) > same)
    return None if best > 0 and near[overruled > 0].any() else best


def rehearse(cameras: CameraArrays) -> None:
    """Call every kernel once, so that none is compiled while a hand is tracked."""
    nothing = Prior(np.full((1, 3), np.nan), np.full((1, 3, 3), np.nan))
    _in_image(cameras, 0, Prior(nothing.points_m[0], nothing.cov_m2[0]))
    one = np.ones((len(cameras.scale), 1))
    pixels, alternatives = np.full((*one.shape, 2), 100.0), np.full((*one.shape, 2), 101.0)
    associate(cameras, (pixels, one, one), (alternatives, one), nothing, (nothing.points_m, one[0]))


@kernel
def _seen_at(cameras: CameraArrays, c: int, point: Float, uv: Float, J: Float) -> None:
    """Write where camera `c` sees a point, and derivatives.

    Functions that kernels call have no entry point from Python.
    """
    project(cameras, c, point, uv, J)


def _in_image(cameras: CameraArrays, c: int, prior: Prior) -> Prior:
    """A prior of one marker as camera `c` sees it: (2,) [px], (2, 2) [px^2]."""
    uv, J = np.full(2, np.nan), np.zeros((2, 3))
    _seen_at(cameras, constant(c), np.ascontiguousarray(prior.points_m), uv, J)
    return Prior(uv, J @ prior.cov_m2 @ J.T)


def _distances(places: Float, cov: Float, expected: Float, expected_cov: Float) -> Float:
    """Squared Mahalanobis distances (K,) of places (K, n) from an expected one."""
    if not np.isfinite(expected).all():
        return np.zeros(len(places))
    off = np.where(np.isfinite(places), places - expected, 0.0)
    both = np.where(np.isfinite(cov), cov, 0.0) + expected_cov
    return (off * np.linalg.solve(both, off[..., None])[..., 0]).sum(axis=1)
