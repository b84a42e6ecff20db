"""Alignment finds the frame and the clock of a motion capture in ours.

The offset of the clocks is found first by the speeds of the same points, which no rotation and no shift changes:
normalised cross-correlation with missing samples masked (Padfield, "Masked object registration in the Fourier
domain", IEEE Trans. Image Process. 21, 2012). Then turn R, shift s and offset d together by Gauss-Newton with the
weights of Geman & McClure, from the rigid fit of Kabsch (1976):

    p_ours(t) = R p_theirs(t - d) + s

Their sigma is estimated by the jackknife over consecutive parts (Efron & Tibshirani, 1993, chapter 11), as errors
last from frame to frame. What is fitted hides what is constant: an error of where our frame lies, and a delay of
ours.
"""

from dataclasses import dataclass

import numpy as np
from scipy import signal

from common.arrays import Bool, Float, Int
from common.errors import FitError
from common.geometry.transforms import fit_rigid, rigid, rotation_vector_to_matrix
from master.mocap.bvh_file import Track, known

HALF_NS = 20_000_000  # half of the time over which a speed is a difference
_STEP_NS = 10_000_000


def clock_offset(ours: Track, theirs: Track) -> tuple[int, float, float]:
    """Return our time less theirs [ns], the correlation of speeds, an alternative.

    The third value is how much later an alternative offset is [s], NaN: none.

    Raises:
        FitError: The speeds do not agree anywhere.
    """
    a, first_a = _speeds(ours)
    b, first_b = _speeds(theirs)
    half = 0.5 * min(np.isfinite(a).sum(), np.isfinite(b).sum())
    least_s = 2.0  # that both must show together
    overlap = min(len(a), len(b), max(least_s * 1e9 / _STEP_NS, half))
    score = _masked_correlation(a, b, overlap)
    best = int(np.argmax(score))
    correlated = 0.5
    if not score[best] > correlated:
        raise FitError(
            f"the speeds of poses and motion capture agree nowhere (correlation {max(score[best], 0.0):.2f} at best, of"
            f" {overlap * _STEP_NS * 1e-9:.1f} s or more together): the same hand at the same time? Where both have"
            " one clock and one frame, give --aligned"
        )
    inner = score[best - 1 : best + 2]
    shift = 0.0
    if 0 < best < len(score) - 1 and np.isfinite(inner).all():
        curvature = inner[0] - 2.0 * inner[1] + inner[2]
        shift = 0.5 * (inner[0] - inner[2]) / curvature if curvature < 0.0 else 0.0
    lags = np.arange(len(score)) - best
    alternative, separation_ns = 0.9, 500_000_000  # a second peak that counts
    far = np.where(np.abs(lags) * _STEP_NS > separation_ns, score, -1.0)
    second = int(np.argmax(far))
    alternative_s = (
        (second - best) * _STEP_NS * 1e-9 if far[second] > alternative * score[best] else float("nan")
    )
    lag = best + shift - (len(b) - 1)
    return round(first_a - first_b + lag * _STEP_NS), float(score[best]), alternative_s


def _speeds(track: Track) -> tuple[Float, int]:
    """Mean speed of the points (K,) [m/s] every 10 ms, NaN: not known; first [ns]."""
    count = int((track.t_ns[-1] - track.t_ns[0]) // _STEP_NS) + 1 if len(track.t_ns) else 0
    most_steps = 400_000  # 67 minutes
    if count > most_steps:
        raise FitError(
            f"{count * _STEP_NS * 6e-11:.0f} minutes are too long to align: take a part, --from and --until"
        )
    t_ns = track.t_ns[0] + _STEP_NS * np.arange(count) if count else np.zeros(0, np.int64)
    speed = np.linalg.norm(track.velocity(t_ns, HALF_NS), axis=2)
    known = np.isfinite(speed)
    total = np.where(known, speed, 0.0).sum(axis=1)
    some = known.any(axis=1)
    if not some.any():
        raise FitError("no point is seen for two frames in a row: nothing to align by")
    return np.where(some, total / np.maximum(known.sum(axis=1), 1), np.nan), int(t_ns[0])


def _masked_correlation(a: Float, b: Float, overlap: float) -> Float:
    """Correlation of `a` and shifted `b`, lags of `signal.correlate`; -1: too few."""
    known_a, known_b = np.isfinite(a).astype(np.float64), np.isfinite(b).astype(np.float64)
    a = np.where(known_a > 0.0, a - np.nanmean(a), 0.0)
    b = np.where(known_b > 0.0, b - np.nanmean(b), 0.0)

    def of(first: Float, second: Float) -> Float:
        return np.asarray(signal.correlate(first, second, mode="full", method="fft"), np.float64)

    count = np.maximum(of(known_a, known_b), 1.0)
    sum_a, sum_b = of(a, known_b), of(known_a, b)
    variance_a = of(a * a, known_b) - sum_a**2 / count
    variance_b = of(known_a, b * b) - sum_b**2 / count
    least = 1e-9 * max(float((a * a).sum()), float((b * b).sum()), 1e-12)
    good = (count > overlap - 0.5) & (variance_a > least) & (variance_b > least)
    spread = np.sqrt(np.where(good, variance_a * variance_b, 1.0))
    return np.where(good, (of(a, b) - sum_a * sum_b / count) / spread, -1.0)


_ITERATIONS = 30
_PARTS = 8


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """From the frame and clock of a motion capture to ours.

    Attributes:
        T_rig_file: (4, 4) their positions to ours; a mirroring where `mirrored`.
        offset_ns: Our time less theirs.
        rotation_sigma_deg, shift_sigma_m, offset_sigma_s: Standard deviations; of the shift amid the points.
        residual_m: Median distance that is left.
        correlation: Of the speeds; NaN where nothing was fitted.
        alternative_s: Another offset is nearly as likely, this much later; NaN: none.
        mirrored: Their axes are left-handed, or it is the other hand.
    """

    T_rig_file: Float
    offset_ns: int = 0
    rotation_sigma_deg: float = 0.0
    shift_sigma_m: float = 0.0
    offset_sigma_s: float = 0.0
    residual_m: float = float("nan")
    correlation: float = float("nan")
    alternative_s: float = float("nan")
    mirrored: bool = False

    def moved(self, track: Track) -> Track:
        """Their points in our frame, on our clock."""
        position = track.position_m @ self.T_rig_file[:3, :3].T + self.T_rig_file[:3, 3]
        return Track(track.t_ns + self.offset_ns, position)


def align(ours: Track, theirs: Track) -> Alignment:
    """Find frame and clock of `theirs` from points that both have, in the same order.

    Raises:
        FitError: They do not move alike, share too little, or all points lie on a line.
    """
    offset_ns, correlation, alternative_s = clock_offset(ours, theirs)
    most_rows, count = 4000, len(ours.t_ns)
    rows = np.unique(np.linspace(0, count - 1, min(count, most_rows)).astype(np.int64))  # evenly
    target = ours.position_m[rows]
    start = [_registered(theirs.at(ours.t_ns[rows] - offset_ns), target, mirror) for mirror in (False, True)]
    mirrored = start[1][1] < 0.5 * start[0][1]  # median residual
    flip = np.diag([1.0, 1.0, -1.0]) if mirrored else np.eye(3)
    T = start[1][0] if mirrored else start[0][0]
    fit = _Fit.of(ours, Track(theirs.t_ns, theirs.position_m @ flip), rows, T @ _four(flip), float(offset_ns))
    sigma = fit.sigma()
    return Alignment(
        T_rig_file=fit.T @ _four(flip),
        offset_ns=round(fit.offset_ns),
        rotation_sigma_deg=float(np.degrees(np.linalg.norm(sigma[:3]))),
        shift_sigma_m=float(np.linalg.norm(sigma[3:6])),
        offset_sigma_s=float(sigma[6]),
        residual_m=fit.residual_m,
        correlation=correlation,
        alternative_s=alternative_s,
        mirrored=mirrored,
    )


def _registered(source: Float, target: Float, mirror: bool) -> tuple[Float, float]:
    """Robust rigid motion (4, 4) from points (N, J, 3) to others, median rest [m]."""
    if mirror:
        source = source * [1.0, 1.0, -1.0]
    both = known(source) & known(target)
    p, q = source[both], target[both]
    least_rows = 30
    if both.any(axis=1).sum() < least_rows:
        raise FitError(
            f"poses and motion capture share {int(both.any(axis=1).sum())} times, at least {least_rows} are needed"
        )
    _check_spread(p)
    weight, off = np.ones(len(p)), np.zeros(len(p))
    T = np.eye(4)
    for _ in range(_ITERATIONS):
        T = fit_rigid(q, p, weight)
        off = np.linalg.norm(p @ T[:3, :3].T + T[:3, 3] - q, axis=1)
        weight = _weights(off)
    T = T @ _four(np.diag([1.0, 1.0, -1.0])) if mirror else T
    return T, float(np.median(off))


def _check_spread(points: Float) -> None:
    """Raise FitError where points (N, 3) lie on a line."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1]
    least_spread_m = 0.005  # across the line that points lie along: less does not determine a rotation
    if spread < least_spread_m * np.sqrt(len(points)):
        raise FitError(
            "the points that poses and motion capture share lie on a line: they determine no rotation"
        )


def _weights(off: Float) -> Float:
    """Of Geman & McClure, with three times the median distance as scale."""
    floor_m = 1e-5
    scale = max(3.0 * float(np.median(off)), floor_m)
    return 1.0 / (1.0 + (off / scale) ** 2) ** 2


def _four(linear: Float) -> Float:
    return rigid(linear, np.zeros(3))


@dataclass(slots=True)
class _Fit:
    """Joint fit of R, s and d; holds the normal equations of each part of the time."""

    T: Float
    offset_ns: float
    residual_m: float
    normal: Float
    gradient: Float

    @classmethod
    def of(cls, ours: Track, theirs: Track, rows: Int, T: Float, offset_ns: float) -> "_Fit":
        """Fit from a start; `T` maps `theirs`."""
        t_ns, target = ours.t_ns[rows], ours.position_m[rows]
        part = np.minimum(_PARTS * np.arange(len(rows)) // len(rows), _PARTS - 1)
        fit = cls(T, offset_ns, np.inf, np.zeros((_PARTS, 7, 7)), np.zeros((_PARTS, 7)))
        for _ in range(_ITERATIONS):
            at = t_ns - round(fit.offset_ns)
            R = fit.T[:3, :3]
            found = theirs.at(at) @ R.T + fit.T[:3, 3]
            speed = theirs.velocity(at, HALF_NS) @ R.T
            speed = np.where(np.isfinite(speed), speed, 0.0)
            both = known(found) & known(target)
            middle = found[both].mean(axis=0)
            fit._normal(found, target, speed, both, part, middle)
            step = _solved(fit.normal.sum(axis=0), fit.gradient.sum(axis=0))
            rotated = rotation_vector_to_matrix(step[:3])
            fit.T = rigid(rotated, middle - rotated @ middle + step[3:6]) @ fit.T
            fit.offset_ns += float(np.clip(1e9 * step[6], -5e7, 5e7))
            if np.abs(step[:3]).max() < 1e-7 and np.abs(step[3:6]).max() < 1e-7 and abs(step[6]) < 1e-6:
                break
        return fit

    def _normal(
        self, found: Float, target: Float, speed: Float, both: Bool, part: Int, middle: Float
    ) -> None:
        """Write the normal equations of each part of the time.

        Unknowns are (rotation [rad] about the middle, shift [m], offset [s]).
        """
        off = np.where(both[..., None], target - found, 0.0)
        distance = np.linalg.norm(off[both], axis=1)
        self.residual_m = float(np.median(distance))
        weight = np.zeros(both.shape)
        weight[both] = _weights(distance)
        jacobian = np.zeros((*both.shape, 3, 7))
        arm = np.where(both[..., None], found - middle, 0.0)
        for axis in range(3):
            jacobian[..., axis] = np.cross(np.eye(3)[axis], arm)
            jacobian[..., axis, 3 + axis] = 1.0
        jacobian[..., 6] = -speed
        weighted = jacobian * weight[..., None, None]
        for k in range(_PARTS):
            own = part == k
            a = weighted[own].reshape(-1, 7)
            self.normal[k] = a.T @ jacobian[own].reshape(-1, 7)
            self.gradient[k] = a.T @ off[own].reshape(-1)

    def sigma(self) -> Float:
        """Jackknife standard deviations (7,) of rotation [rad], shift [m], offset [s]."""
        A, g = self.normal.sum(axis=0), self.gradient.sum(axis=0)
        without = [_solved(A - self.normal[k], g - self.gradient[k]) for k in range(_PARTS)]
        spread = np.array(without) - np.mean(without, axis=0)
        return np.sqrt((_PARTS - 1) / _PARTS * (spread**2).sum(axis=0))


def _solved(normal: Float, gradient: Float) -> Float:
    """Step (7,) of normal equations; what nothing constrains (d at rest) stays."""
    return np.asarray(np.linalg.pinv(normal, rcond=1e-9, hermitian=True) @ gradient, np.float64)
