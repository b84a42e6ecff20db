"""A measurement finds an object's beads, and the frame they are written in.

Observations are checked, fitted, and refused with the cause. The frame is the object's own, by the beads, or
that of an existing file.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from common.arrays import Float, Int
from common.calibration.object_profile import ObjectProfile
from common.errors import FitError
from common.geometry.transforms import fit_rigid, matrix_to_rotation_vector, rigid, transform
from master.calibrate.object.bundle import Bundle, Seen, fit_bundle, usable

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


def measure_object(seen: Seen) -> Measurement:
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


def refuse_insufficient(seen: Seen) -> None:
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


def refuse_loose(seen: Seen) -> None:
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


def changes(seen: Seen) -> dict[tuple[int, int], tuple[float, float]]:
    """Change of distance of each pair of beads and its limit [m].

    Without pairs that were hardly seen.
    """
    window: Int = (seen.t_s / 0.25).astype(np.int64)
    out = dict[tuple[int, int], tuple[float, float]]()
    for a, b in combinations(range(len(seen.names)), 2):
        way = seen.points_m[:, a] - seen.points_m[:, b]
        distance = np.linalg.norm(way, axis=1)
        unit = way / distance[:, None]
        variance = np.einsum("ti,tij,tj->t", unit, seen.cov_m2[:, a] + seen.cov_m2[:, b], unit)
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
