"""Find the beads of a rigid object, and the frame they are written in.

Bead positions over time with covariances enter, from cameras or a running master. Minimised over beads q_b and poses
R_t, p_t, with the covariances C of the points, which hold what the cameras' pixels measured (a bundle adjustment,
linear in the points: Triggs et al. 2000):

    sum_tb  rho( e' C^-1 e ),   e = R_t q_b + p_t - x_tb

The beads are shared, a pose is an epoch's own (`master.calibrate.adjust`). The frame of q is free: what only moves the
whole body is no uncertainty of it. rho is Geman and McClure's, so that a bead that was mistaken, or was half hidden,
costs itself. Observations that do not determine the beads are refused with the cause.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import numpy as np

from common.arrays import Bool, Float, Int
from common.calibration.object_profile import ObjectProfile
from common.errors import FitError
from common.geometry.transforms import fit_rigid, matrix_to_rotation_vector, rigid, skew, transform
from master.calibrate.adjust import Loss, Normal, geman_mcclure, minimise, stepped_poses
from master.calibrate.observations import Observations, thinned
from master.calibrate.session import Progress

_ROUNDS = 20


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """A rigid body that explains what was seen."""

    seen: Observations  # the epochs that were used
    beads_m: Float  # (B, 3) in a frame of its own
    cov_m2: Float  # (3 B, 3 B) of the beads among each other, from the covariances of the points alone
    T: Float  # (T, 4, 4) body -> rig
    off_m: Float  # (T, B, 3) fitted minus seen; NaN: not seen
    weight: Float  # (T, B) 0..1; 0: not seen
    spread: float  # residuals as a factor of what the covariances expect

    @property
    def outlier(self) -> Bool:
        """The observations (T, B) that the body does not explain."""
        # weight below which a bead at an epoch counts as an outlier
        return self.seen.known & (self.weight < 0.1)


def usable(seen: Observations) -> Bool:
    """The epochs (T,) that constrain the body: three beads or more are known."""
    return seen.known.sum(axis=1) >= 3


def fit_bundle(seen: Observations) -> Bundle:
    """Fit a body to all epochs that are usable, thinned to a maximum.

    Raises:
        FitError: A bead is never seen together with two others whose places are known.
    """
    most = 1500  # epochs: more of the same motion adds time, not information
    own = seen.at(thinned(np.flatnonzero(usable(seen)), most))
    beads, T = first_body(own)
    known_cov = np.where(np.isfinite(own.cov), own.cov, np.eye(3))
    whiten = np.asarray(np.linalg.inv(np.linalg.cholesky(known_cov)), np.float64)
    scale_2, body, cov = 1.0, _Body(beads, T), np.empty(0)
    for _ in range(_ROUNDS):
        chi = (_whitened(body, own, whiten) ** 2).sum(axis=-1)
        last, scale_2 = scale_2, _scale_2(chi, own.known)
        found = minimise(partial(_equations, own, whiten, _loss(scale_2)), _stepped, body, gain_share=1e-10)
        body, cov = found.x, found.normal.covariance(_free(found.x.beads_m))
        if abs(scale_2 / last - 1.0) < 1e-4:
            break
    chi = (_whitened(body, own, whiten) ** 2).sum(axis=-1)
    weight = np.where(own.known, _loss(scale_2)(np.nan_to_num(chi))[1], 0.0)
    off = _off(body.beads_m, body.T, own.value)
    return Bundle(own, body.beads_m, scale_2 * cov, body.T, off, weight, float(np.sqrt(scale_2)))


@dataclass(frozen=True, slots=True, eq=False)
class _Body:
    """What is fitted: beads (B, 3) [m], and poses (T, 4, 4) body -> rig."""

    beads_m: Float
    T: Float


def _loss(scale_2: float) -> Loss:
    soft_2 = 12.0  # chi square of three numbers at which a bead counts a quarter
    return geman_mcclure(float(np.sqrt(soft_2 * scale_2)))


def _whitened(body: _Body, seen: Observations, whiten: Float) -> Float:
    """Fitted minus seen (T, B, 3) in standard deviations; NaN: not seen."""
    return (whiten @ _off(body.beads_m, body.T, seen.value)[..., None])[..., 0]


def _equations(seen: Observations, whiten: Float, loss: Loss, body: _Body) -> Normal:
    """Normal equations of beads and poses; a pose turns and moves by rig axes."""
    epochs, count = seen.known.shape
    R = body.T[:, None, :3, :3]
    by_turn = -skew((R @ body.beads_m[..., None])[..., 0])
    by_pose = whiten @ np.concatenate([by_turn, np.broadcast_to(np.eye(3), by_turn.shape)], axis=-1)
    by_beads = np.zeros((epochs, count, 3, count, 3))
    each = np.arange(count, dtype=np.int64)
    by_beads[:, each, :, each] = np.moveaxis(whiten @ R, 1, 0)
    normal = Normal(3 * count, epochs, 6)
    normal.add(
        _whitened(body, seen, whiten).reshape(epochs, -1),
        by_beads.reshape(epochs, 3 * count, 3 * count),
        by_pose.reshape(epochs, 3 * count, 6),
        loss=loss,
        group=3,
    )
    return normal


def _stepped(body: _Body, shared: Float, own: Float) -> _Body:
    return _Body(body.beads_m + shared.reshape(-1, 3), stepped_poses(body.T, own))


def first_body(seen: Observations) -> tuple[Float, Float]:
    """Beads (B, 3), by medians from the best known epoch, and poses (T, 4, 4).

    Raises:
        FitError: A bead is never seen together with two others whose places are known.
    """
    known = seen.known
    size = np.nan_to_num(np.einsum("tbii->tb", seen.cov), nan=0.0).sum(axis=1)
    most = known.sum(axis=1) == known.sum(axis=1).max(initial=0)
    first: int = int(np.argmin(np.where(most, size, np.inf)))
    beads = seen.value[first] - np.nanmean(seen.value[first], axis=0)
    for _ in range(3 + len(seen.names)):
        T = np.array([_pose(points, beads) for points in seen.value])
        placed = np.asarray((seen.value - T[:, None, :3, 3]) @ T[:, :3, :3], np.float64)
        beads = _medians(placed, beads)
    if np.isnan(beads).any():
        lost = [name for name, bead in zip(seen.names, beads, strict=True) if np.isnan(bead).any()]
        raise FitError(f"{', '.join(lost)}: never seen by two cameras together with three others")
    T = np.array([_pose(points, beads) for points in seen.value])
    return beads, T


def _medians(placed: Float, beads: Float) -> Float:
    """Beads (B, 3) by medians of places (T, B, 3); those of no place as they were."""
    out = beads.copy()
    observed = np.flatnonzero(np.isfinite(placed).all(axis=2).any(axis=0))
    out[observed] = np.nanmedian(placed[:, observed], axis=0)
    return out


def _pose(points: Float, beads: Float) -> Float:
    """Pose (4, 4) of a body (B, 3) from points (B, 3); NaN: fewer than three known."""
    both = np.isfinite(points[:, 0] + beads[:, 0])
    return fit_rigid(points[both], beads[both]) if both.sum() >= 3 else np.full((4, 4), np.nan)


def _off(beads: Float, T: Float, points: Float) -> Float:
    return np.array([transform(pose, beads) for pose in T]) - points


def _scale_2(chi: Float, known: Bool) -> float:
    """Factor of the covariances, at least 1, by the median of chi-squares (T, B).

    Of the 3 n numbers of an epoch 6 go into its pose, so the chi square of a bead is that of 3 - 6 / n
    numbers, whose median follows by Wilson and Hilferty (1931).
    """
    own = chi[known]
    free = 3.0 - 6.0 / float(known.sum(axis=1).mean())
    median = free * (1.0 - 2.0 / (9.0 * free)) ** 3
    return max(1.0, float(np.median(own)) / median)


def _free(beads: Float) -> Float:
    """Basis (3 B, 3 B - 6) of steps that change the body and not only its frame."""
    middle = beads - beads.mean(axis=0)
    moves = np.concatenate([np.tile(np.eye(3), (len(beads), 1)), skew(middle).reshape(-1, 3)], axis=1)
    return np.linalg.svd(moves)[0][:, 6:]


LINE_M = 5e-3  # from the line through the first two beads; nearer, they do not determine how it is turned about that
OWN = (
    "origin in the middle of the beads, x from the first to the second, y to the side of the one farthest from that"
    " line"
)


def own_frame(beads_m: Float, names: tuple[str, ...]) -> Float:
    """`T_own_body` (4, 4) for beads (B, 3) [m], with axes by `OWN`; z is x times y.

    Raises:
        FitError: The beads lie in one line.
    """
    x = beads_m[1] - beads_m[0]
    length = float(np.linalg.norm(x))
    x = x / max(length, 1e-9)
    aside = (beads_m - beads_m[0]) - np.outer((beads_m - beads_m[0]) @ x, x)
    far = np.linalg.norm(aside, axis=1)
    if length < LINE_M or far.max() < LINE_M:
        raise FitError(
            f"{', '.join(names)} lie in one line (all within {1e3 * float(far.max()):.1f} mm of it): how the object is"
            f" turned about it nobody can see. Put one bead aside, by {1e3 * LINE_M:.0f} mm at least"
        )
    y = aside[int(np.argmax(far))] / far.max()
    R = np.stack([x, y, np.cross(x, y)])
    return rigid(R, -R @ beads_m.mean(axis=0))


def frame_of(
    beads_m: Float, names: tuple[str, ...], like: ObjectProfile, where: str
) -> tuple[Float, dict[str, float]]:
    """`T_file_body` (4, 4) that fits beads (B, 3) to a file's; misses by bead [m].

    Raises:
        FitError: The file has fewer than three of them, in one line, or they lie elsewhere.
    """
    shared = [row for row, name in enumerate(names) if name in like.markers]
    there = np.array([like.markers[names[row]].position_m for row in shared]).reshape(-1, 3)
    spread = np.linalg.svd(there - there.mean(axis=0), compute_uv=False) if len(shared) > 2 else np.zeros(3)
    if len(shared) < 3 or spread[1] < LINE_M:
        raise FitError(
            f"{where}: has {len(shared)} of the beads {', '.join(names)}; its frame needs three not collinear"
        )
    T = fit_rigid(there, beads_m[shared])
    off = np.linalg.norm(transform(T, beads_m[shared]) - there, axis=1)
    misses = {names[row]: float(miss) for row, miss in zip(shared, off, strict=True)}
    worst = max(misses, key=lambda name: misses[name])
    like_m = 0.015  # by which beads may lie elsewhere than in the file that the frame is taken from
    if misses[worst] > like_m:
        raise FitError(
            f"{where}: {worst} lies {1e3 * misses[worst]:.0f} mm from where the file has it: its frame cannot be"
            " kept. Are the names in the order of the beads? Else give it a frame of its own: another name, no --like"
        )
    return T, misses


MOTION = (
    "hold the object before the cameras for fifteen seconds, hands behind it, all beads in sight of two cameras: turn"
    " it slowly about all its axes, and carry it to all sides"
)
ENOUGH = 240  # epochs at which all beads are known
ENOUGH_LOOKS = 15
_LOOK_RAD = np.radians(10.0)  # turned by so much, a bead shows another side: what misleads is another
# By which a distance between beads may change, from the tenth to the ninetieth percentile of quarters of a second.
_RIGID_M = 2e-3


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """Beads of an object."""

    bundle: Bundle
    T_own_body: Float  # (4, 4) of the frame that is reported, see `own_frame`
    looks: int  # in how many distinct poses cameras saw it
    sigma_m: Float  # (B,) standard deviation of each place among the others, largest axis

    @property
    def names(self) -> tuple[str, ...]:
        """Of the beads."""
        return self.bundle.seen.names

    @property
    def rms_m(self) -> Float:
        """Rms residual (B,) of each bead from the body, without outliers."""
        kept = np.where((self.bundle.weight > 0) & ~self.bundle.outlier, 1.0, np.nan)
        return np.sqrt(np.nanmean(kept * (self.bundle.off_m**2).sum(axis=-1), axis=0))

    @property
    def outlier_share(self) -> Float:
        """Share (B,) of each bead's observations that the body does not fit."""
        return self.bundle.outlier.sum(axis=0) / np.maximum(self.bundle.seen.known.sum(axis=0), 1)


def measure_object(seen: Observations) -> Measurement:
    """Measure.

    Raises:
        FitError: Too little is seen, the beads lie in one line, are not rigid, or the motion does not
            determine them.
    """
    refuse_insufficient(seen)
    refuse_loose(seen)
    bundle = fit_bundle(seen)
    own = own_frame(bundle.beads_m, seen.names)
    looks = looks_of(bundle.T)
    # What misleads cameras about a bead is the same while it shows the same side: looks count, and not epochs.
    size = bundle.cov_m2.reshape(len(seen.names), 3, len(seen.names), 3)
    variance = np.array([np.linalg.eigvalsh(size[b, :, b])[-1] for b in range(len(seen.names))])
    # what is off in the same way all the time averages out over no more
    sigma = np.sqrt(variance * max(1.0, len(bundle.T) / min(looks, 24)))
    found = Measurement(bundle, own, looks, sigma)
    outlier_share = found.outlier_share
    worst = int(np.argmax(outlier_share))
    if outlier_share[worst] > 0.3:
        raise FitError(
            f"{seen.names[worst]}: {100 * outlier_share[worst]:.0f} % of its views are elsewhere than the other"
            " beads show: is its colour calibrated, is nothing else of that colour seen, are the cameras calibrated?"
        )
    fewest_looks = 4
    if looks < fewest_looks or float(sigma.max()) > 1e-3:  # standard deviation of a bead, at most
        raise FitError(
            f"it was seen in {looks} ways of turning and places, the beads are known to"
            f" {1e3 * float(sigma.max()):.1f} mm: {MOTION}"
        )
    return found


def progress_of(seen: Observations) -> Progress:
    """How far the motion is, and what is still missing."""
    if not len(seen):
        return Progress(0.0, "", "no pose comes: is `phalanx run` running, on this --bus?")
    whole, looks = int(seen.known.all(axis=1).sum()), 0
    rows = np.flatnonzero(usable(seen))
    if len(rows):
        shown = 200  # epochs from which ways of turning are counted while it goes on
        with suppress(FitError):
            looks = looks_of(first_body(seen.at(thinned(rows, shown)))[1])
    share = min(whole / ENOUGH, looks / ENOUGH_LOOKS, 1.0)
    recent = seen.known[-30:].mean(axis=0)
    poor = [name for name, part in zip(seen.names, recent, strict=True) if part < 0.5]
    if poor:
        hint = f"not seen by two cameras: {', '.join(poor)}"
    elif share >= 1.0:
        hint = "done"
    elif looks / ENOUGH_LOOKS < whole / ENOUGH:
        hint = "turn it about another axis, and carry it elsewhere"
    else:
        hint = "go on like this"
    return Progress(share, f"{whole} epochs, {looks} ways of turning and places", hint, share >= 1.0)


def refuse_insufficient(seen: Observations) -> None:
    """Refuse what is too short, or too seldom seen whole.

    Raises:
        FitError: With the bead that is seen least.
    """
    together = int((seen.known.all(axis=1) if len(seen.names) == 3 else usable(seen)).sum())
    fewest = 60  # epochs at which all beads are known
    if together >= fewest:
        return
    if not seen.known.any():
        raise FitError(f"no bead is seen by two cameras at once: {MOTION}")
    each = ", ".join(
        f"{name} {100 * share:.0f} %" for name, share in zip(seen.names, seen.known.mean(axis=0), strict=True)
    )
    how = "all beads" if len(seen.names) == 3 else "three beads or more"
    raise FitError(
        f"{how} are seen by two cameras at {together} of {len(seen.t_s)} epochs, at least {fewest} are needed"
        f" ({each}): {MOTION}"
    )


def refuse_loose(seen: Observations) -> None:
    """Refuse beads that do not keep their distances, most of the time.

    Raises:
        FitError: Which bead moved, where the others determine it.
    """
    change = changes(seen)
    loose = {pair: by for pair, by in change.items() if by[0] > by[1]}
    if not loose:
        return
    worst = max(loose, key=lambda pair: loose[pair][0] / loose[pair][1])
    listed = ", ".join(
        f"{seen.names[a]} - {seen.names[b]} by {1e3 * by:.1f} mm" for (a, b), (by, _) in loose.items()
    )
    guilty = guilty_of(change, len(seen.names))
    blame = (
        f"{seen.names[worst[0]]} or {seen.names[worst[1]]} moved, or one of them is taken for something else"
        if guilty is None
        else f"{seen.names[guilty]} moved, or something else is taken for it"
    )
    if guilty is None and len(loose) == len(change) > 1:
        blame = f"all of them: a camera moved meanwhile, or {blame}"
    raise FitError(
        f"not rigid: distances between beads change ({listed}); {blame}. Fasten it and do the motion again"
    )


def guilty_of(change: Mapping[tuple[int, int], tuple[float, float]], count: int) -> int | None:
    """The one bead without which the others keep their distances; None: unknown."""
    rest = [
        max((by / most for pair, (by, most) in change.items() if bead not in pair), default=0.0)
        for bead in range(count)
    ]
    best, next_best = np.argsort(rest)[:2].tolist()
    return best if rest[best] < 1.0 and 2.0 * rest[best] < rest[next_best] else None


def changes(seen: Observations) -> dict[tuple[int, int], tuple[float, float]]:
    """Change of distance of each pair of beads and its limit [m].

    Without pairs that were hardly seen.
    """
    window: Int = (seen.t_s / 0.25).astype(np.int64)
    out = dict[tuple[int, int], tuple[float, float]]()
    for a, b in combinations(range(len(seen.names)), 2):
        way = seen.value[:, a] - seen.value[:, b]
        distance = np.linalg.norm(way, axis=1)
        unit = way / distance[:, None]
        variance = np.einsum("ti,tij,tj->t", unit, seen.cov[:, a] + seen.cov[:, b], unit)
        known = np.isfinite(distance)
        if not known.any():
            continue
        # What is half hidden is less sure, and elsewhere than it seems.
        typical = float(np.percentile(variance[known], 25.0))
        sure, in_window, windows = 4.0, 5, 8
        known &= variance <= sure * typical
        medians = [
            np.median(distance[known & (window == w)])
            for w in np.unique(window[known])
            if (known & (window == w)).sum() >= in_window
        ]
        if len(medians) < windows:
            continue
        low, high = np.percentile(medians, (10.0, 90.0))
        # most of a sigma changes from frame to frame, or is a suspicion that does not come true
        out[a, b] = float(high - low), _RIGID_M + 0.5 * float(np.sqrt(typical))
    return out


def looks_of(T: Float) -> int:
    """Count the poses (T, 4, 4) that give cameras distinct views, greedily."""
    kept = np.empty((0, 4, 4))
    for pose in T:
        turn = matrix_to_rotation_vector(kept[:, :3, :3].swapaxes(1, 2) @ pose[:3, :3])
        rotation = np.linalg.norm(turn, axis=-1)
        way = np.linalg.norm(kept[:, :3, 3] - pose[:3, 3], axis=1)
        if not ((rotation < _LOOK_RAD) & (way < 0.04)).any():  # and so does one that is elsewhere
            kept = np.concatenate([kept, pose[None]])
    return len(kept)
