"""Fit finds the time offset of two cameras from the evidence of their tracks.

A frame of the second camera that was really taken `d` later than its stamp shows every marker where it was
`d` later: x(t) = x_true(t) + d v, with v its velocity in that image. Two things that are constant in truth
then change in step with the velocity:

- **the epipolar residual** of each marker, which should be what lens and mount make it: e = e0 + d (n . v), with n the
  normal of the epipolar line. It sees motion across the baseline.
- **the distance between two markers**, which should stay what the hand makes it. Along the baseline a wrong time is a
  wrong depth D v d / B, which no epipolar line contradicts; but a hand that is taken for 10 % farther away is taken for
  10 % larger, too:  l = l0 + d (dl/dx . v), in first order. Rigid motion of any kind leaves all distances alone, so no
  assumption about the hand's path is made; fingers change distances, but not in step with the hand's velocity.

Velocity is measured and noisy, from the same frames as the position. So each equation also gets an
*instrument* (Durbin, "Errors in variables", 1954): the velocity that the first camera saw, from frames other
than the one compared. It knows the motion and shares no noise with either side, so noise neither imitates an
offset nor hides one.

Time is cut into blocks, and each item of each block (a *unit*: one marker's residual, or one distance, for a
second) keeps its own constant: its sums are taken about its own means, so whatever changes slowly, lens
errors across the image or another posture of the fingers, is no evidence. With the covariances of instrument
z, value e and rate g

    s_ze = d s_zg  for a unit,      d = sum w s_ze / sum w s_zg  for all together

Weights are 1 / (the unit's residual variance), refitted some times from the median: a unit in which a camera
took another thing for the marker, or in which fingers moved, counts for little (Huber, "Robust Statistics",
1981, 7.8).

Errors of neighbouring frames are anything but independent, so the uncertainty is how much batches of frames
disagree: from tenths of a block to two blocks, and the length that disagrees most counts (Flyvbjerg &
Petersen, "Error estimates on averages of correlated data", 1989), with the jackknife's correction for
leverage (Bell & McCaffrey, "Bias reduction in standard errors", 2002). It is widened by Student's
distribution for how many batches carry the evidence: outside "3 sigma" lies as much as of a normal
distribution. Added is what a calibration that is off by what it may be would imitate where depth changes in
step with velocity.
"""

from dataclasses import dataclass
from functools import cache
from math import hypot, sqrt

import numpy as np
from scipy.special import ndtr, stdtrit

from common.arrays import Bool, Float, Int
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import cross, invert
from master.fabrik.settings import RAYS


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Frames of one camera."""

    t_s: Float  # when each marker's row was exposed (T, M) [s], by the stamps
    xy: Float  # normalised image points (T, M, 2), undistorted; NaN: not seen


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Equations `value = constant + offset * rate` (T, I); NaN: nothing seen.

    Items, each with a constant, are the M epipolar residuals [px], then distances between markers [m].
    """

    value: Float
    rate: Float  # how the value changes with the offset [per s]
    instrument: Float  # the rate as the first camera predicts it
    pixel_effect: Float  # what a pixel of wrong calibration along the epipolar line would make of `value`
    # where the marker was in the first camera's image, of a distance the middle of the two, (T, I, 2)
    place: Float


@dataclass(frozen=True, slots=True, eq=False)
class CameraPair:
    """A reference camera and another one."""

    rotation: Float  # (3, 3) from the reference camera's frame to the other's
    translation: Float  # (3,) [m] likewise
    focal_px: float  # of the other camera

    @classmethod
    def of(cls, reference: CameraModel, other: CameraModel) -> "CameraPair":
        """Geometry of two placed cameras."""
        T = invert(other.T_rig_camera) @ reference.T_rig_camera
        return cls(T[:3, :3], T[:3, 3], float(other.matrix[0, 0]))

    def evidence(self, reference: Track, other: Track, rows: Int, gap_s: float) -> Evidence:
        """Compare frames of the reference with the other's track, both in time order.

        Args:
            rows: Frames (K,) of the reference, which has one before and one after each.
            gap_s: Longest time between neighbouring frames that still are one track.
        """
        later, sooner = rows + 1, rows - 1
        span = (reference.t_s[later] - reference.t_s[sooner])[..., None]
        known = np.where(span < 2.0 * gap_s, (reference.xy[later] - reference.xy[sooner]) / span, np.nan)
        # A rolling shutter sees each marker at another time, and a distance needs both at one.
        t_s = reference.t_s[rows].mean(axis=1, keepdims=True)
        xy = reference.xy[rows] + known * (t_s - reference.t_s[rows])[..., None]
        jerk_px_s3 = 3e6  # ten times what a hand does: the track jumped to another thing
        seen, velocity = carried(other, t_s, gap_s, jerk_px_s3 / self.focal_px)
        # of other frames again: its noise is not `xy`'s
        middle = 0.5 * (reference.xy[later] + reference.xy[sooner])
        one, two = _pairs(xy.shape[1])
        place = np.concatenate([middle, 0.5 * (middle[:, one] + middle[:, two])], axis=1)
        value, rate, instrument, pixel_effect = self._equations(xy, known, seen, velocity)
        return Evidence(value, rate, instrument, pixel_effect, place)

    def _equations(
        self, xy: Float, known: Float, seen: Float, velocity: Float
    ) -> tuple[Float, Float, Float, Float]:
        """Value, rate, instrument, pixel effect (K, I) of points, velocities (K, M, 2)."""
        ray = np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1)
        a = ray @ self.rotation.T  # the ray in the other camera's frame
        line = cross(np.broadcast_to(self.translation, a.shape), a)
        length = np.hypot(line[..., 0], line[..., 1])
        normal = line[..., :2] / length[..., None]
        along = np.stack([-normal[..., 1], normal[..., 0]], axis=-1)
        residual = (normal * seen).sum(-1) + line[..., 2] / length
        place = (along * seen).sum(-1)
        depth = self._depth(a, along, place)
        # The first camera's velocity in the other's image, as if the depth stayed.
        moved = depth[..., None] * (known @ self.rotation[:, :2].T)
        depth_there = depth * a[..., 2] + self.translation[2]
        expected = (moved[..., :2] - seen * moved[..., 2:]) / depth_there[..., None]
        distance = _distances(ray, depth)
        value = np.concatenate([self.focal_px * residual, distance], axis=-1)
        changes: list[Float] = []
        step_s = 1e-3  # of the numerical derivative of a distance
        for v in (velocity, expected, along / (self.focal_px * step_s)):  # the last: a pixel
            before = self._depth(a, along, place - step_s * (along * v).sum(-1))
            change = (distance - _distances(ray, before)) / step_s
            changes.append(np.concatenate([self.focal_px * (normal * v).sum(-1), change], axis=-1))
        rate, instrument, pixel_effect = changes
        return value, rate, instrument, step_s * pixel_effect

    def _depth(self, a: Float, along: Float, place: Float) -> Float:
        """Depths (K, M) [m] on reference rays of places on epipolar lines; NaN: no hand."""
        a_along, t_along = (along * a[..., :2]).sum(-1), along @ self.translation[:2]
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (place * self.translation[2] - t_along) / (a_along - place * a[..., 2])
        nearest_m, farthest_m = 0.05, 5.0
        return np.where((depth > nearest_m) & (depth < farthest_m), depth, np.nan)


def carried(track: Track, t_s: Float, gap_s: float, jerk_s3: float) -> tuple[Float, Float]:
    """Interpolate points and velocities (K, M, 2) of a track at times (K, 1).

    Cubic through the four frames around each. NaN where a frame is missing, a gap is too long, or the third
    derivative exceeds `jerk_s3` [1/s^3].
    """
    centre = track.t_s.mean(axis=1)
    first = np.searchsorted(centre, t_s[:, 0]) - 2
    inside = (first >= 0) & (first + 3 < len(centre))
    nodes = np.clip(first, 0, max(len(centre) - 4, 0))[:, None] + np.arange(4)
    if len(centre) < 4:
        nothing = np.full((len(t_s), *track.xy.shape[1:]), np.nan)
        return nothing, nothing
    t, x = track.t_s[nodes], track.xy[nodes]  # (K, 4, M), (K, 4, M, 2)
    gap = np.diff(t, axis=1)
    away = t_s[:, None] - t
    good = (
        inside[:, None] & (gap < gap_s).all(axis=1) & (away[:, 1] > -0.5 * gap_s) & (away[:, 2] < 0.5 * gap_s)
    )
    # Newton's divided differences.
    d1 = np.diff(x, axis=1) / gap[..., None]
    d2 = np.diff(d1, axis=1) / (t[:, 2:] - t[:, :-2])[..., None]
    d3 = (d2[:, 1] - d2[:, 0]) / (t[:, 3] - t[:, 0])[..., None]
    good &= 6.0 * np.abs(d3).max(axis=-1) < jerk_s3
    u, v, w = (away[:, i, :, None] for i in range(3))
    point = x[:, 0] + u * (d1[:, 0] + v * (d2[:, 0] + w * d3))
    velocity = d1[:, 0] + (u + v) * d2[:, 0] + (u * v + u * w + v * w) * d3
    bad = ~good[..., None]
    return np.where(bad, np.nan, point), np.where(bad, np.nan, velocity)


def _distances(ray: Float, depth: Float) -> Float:
    """Distances (K, P) [m] between markers at depths (K, M) on rays (K, M, 3)."""
    one, other = _pairs(depth.shape[1])
    points = depth[..., None] * ray
    return np.linalg.norm(points[:, one] - points[:, other], axis=-1)


@cache
def _pairs(markers: int) -> tuple[Int, Int]:
    """Each marker with the next ones, every pair once."""
    neighbours = 3  # distances of each marker to so many next ones: of six markers these are all 15 pairs
    pairs = {
        (min(m, n), max(m, n))
        for m in range(markers)
        for n in ((m + step) % markers for step in range(1, neighbours + 1))
        if m != n
    }
    one, other = np.array(sorted(pairs), np.int64).reshape(-1, 2).T
    return one, other


TENTHS = 10  # of a block, the shortest batches
_LENGTHS = (1, 2, 5, 10, 20)  # of batches [tenths of a block]
_THREE_SIGMA = float(ndtr(3.0))


@dataclass(frozen=True, slots=True)
class TimeOffset:
    """How much later a camera's frames are than their stamps, against the reference."""

    offset_ns: float
    sigma_ns: float  # standard deviation [ns]
    batches: float  # how many stretches of time carry it, as an effective number


def unit_sums(evidence: Evidence, markers: int, tenth: Int) -> Float:
    """Return the sums (10, I, 8) of one block, and the floor variance of each unit.

    n, s_zg, s_ze, s_zc, s_gg, s_ge, s_ee, floor: of what is left of each quantity when a constant and a plane
    over the image are taken out of the block.

    Args:
        evidence: Of the block's frames (K, I).
        markers: How many of the items are residuals.
        tenth: In which tenth of the block each frame lies (K,).
    """
    # residual below which a unit is not taken to be better: centroids of a tenth of a pixel, at half a metre
    residual_floor_px, distance_floor_m = 0.2, 1e-3
    floor = np.full(evidence.value.shape[1], distance_floor_m**2)
    floor[:markers] = residual_floor_px**2
    good = _plausible(evidence, floor)
    at_least = 8  # equations of a unit
    good &= good.sum(axis=0) >= at_least
    n = good.sum(axis=0)
    x, y = np.moveaxis(evidence.place, -1, 0)
    parts = (x, y, evidence.instrument, evidence.value, evidence.rate, evidence.pixel_effect)
    x, y, z, e, g, c = (_about_mean(part, good, n) for part in parts)
    y = _without(y, x)
    z, e, g, c = (_without(_without(part, x), y) for part in (z, e, g, c))
    products = np.stack([good.astype(np.float64), z * g, z * e, z * c, g * g, g * e, e * e], axis=-1)
    sums = np.zeros((TENTHS, len(floor), 8))
    np.add.at(sums[..., :7], tenth, products)
    sums[..., 7] = floor
    return sums


def _plausible(evidence: Evidence, floor: Float) -> Bool:
    """Mask (T, I): nothing jumps, and both cameras see the marker move alike.

    Values are compared with the median of five in a row, which follows any smooth course; velocities of the
    two cameras with each other. Both by the median of their differences, which outliers do not move (Hampel,
    1974).
    """
    good = np.isfinite(evidence.value + evidence.rate + evidence.instrument + evidence.place.sum(axis=-1))
    value = np.where(good, evidence.value, np.nan)
    padded = np.pad(value, ((2, 2), (0, 0)), constant_values=np.nan)
    smoothed = _median(np.stack([padded[i : i + len(value)] for i in range(5)]))
    jump = np.abs(value - smoothed)
    unlike = np.abs(np.where(good, evidence.rate - evidence.instrument, np.nan))
    far = 6.0  # medians of a normal distribution: 4 sigma
    return (jump <= far * _median(jump) + np.sqrt(floor)) & (unlike <= far * _median(unlike))


def _median(x: Float) -> Float:
    """Lower medians on axis 0 without NaN; numpy's own is slow on small arrays."""
    ordered = np.sort(x, axis=0)  # NaN last
    middle = np.maximum(np.isfinite(x).sum(axis=0) - 1, 0) // 2
    return np.take_along_axis(ordered, middle[None], axis=0)[0]


def _about_mean(x: Float, good: Bool, n: Int) -> Float:
    x = np.where(good, x, 0.0)
    return np.where(good, x - x.sum(axis=0) / np.maximum(n, 1), 0.0)


def _without(x: Float, column: Float) -> Float:
    """x (T, I) without its component along `column` (T, I), unless that is noise."""
    length = (column * column).sum(axis=0)
    still = 1e-3  # [1, normalised image]: half a pixel
    return x - column * ((column * x).sum(axis=0) / (length + still**2 * len(x)))


def fit_offset(blocks: Float) -> TimeOffset | None:
    """Fit the offset from the sums (B, 10, I, 8) of blocks; None: too little motion."""
    n, zg, ze, _, gg, ge, ee, _ = np.moveaxis(blocks.sum(axis=1), -1, 0)
    floor = blocks[:, 0, :, 7]
    moved = zg > 0.0
    if not moved.any():
        return None

    def variance(offset: float | Float) -> Float:
        """Residual variance (B, I) of each unit, never below its floor."""
        fitted = 4  # constant, plane, offset
        return floor + np.maximum(ee - 2.0 * offset * ge + offset * offset * gg, 0.0) / np.maximum(
            n - fitted, 1
        )

    slope = np.where(moved, ze / np.where(moved, zg, 1.0), 0.0)
    offset = _weighted_median(slope[moved], (zg / variance(slope))[moved])
    weight, total = np.zeros_like(zg), 0.0
    times = 8
    for _ in range(times):
        weight = 1.0 / variance(offset)
        total = float((weight * zg).sum())
        if total <= 0.0:
            return None
        offset = float((weight * ze).sum()) / total
    information, lagged, weight_of_rays = (
        (weight[:, None] * blocks[..., part]).sum(axis=2).ravel() for part in (1, 2, 3)
    )
    scatter = [_scatter(information, lagged - offset * information, length) for length in _LENGTHS]
    batches_at_least = 3.0
    if scatter[0][1] < batches_at_least:
        return None
    long_batches_at_least = 5.0  # fewer add little that shorter ones do not
    sigma, count = max([scatter[0], *(of for of in scatter[1:] if of[1] >= long_batches_at_least)])
    sigma *= float(stdtrit(count - 1.0, _THREE_SIGMA)) / 3.0
    sigma = hypot(sigma, sqrt(2.0) * RAYS.rig_px * float(weight_of_rays.sum()) / total)
    return TimeOffset(offset * 1e9, sigma * 1e9, count)


def _scatter(information: Float, residual: Float, length: int) -> tuple[float, float]:
    """Sigma of the offset [s] and effective number of batches of `length` tenths."""
    starts = np.arange(0, len(information), length)
    information, residual = np.add.reduceat(information, starts), np.add.reduceat(residual, starts)
    total = information.sum()
    leverage_at_most = 0.95
    share = np.clip(information / total, 0.0, leverage_at_most)
    residual = residual / (1.0 - share)
    return float(np.sqrt((residual * residual).sum()) / total), 1.0 / max(float((share * share).sum()), 1e-12)


def _weighted_median(values: Float, weights: Float) -> float:
    order = np.argsort(values)
    sums = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(sums, 0.5 * sums[-1])])
