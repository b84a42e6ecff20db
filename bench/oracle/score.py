"""How good the poses of a run are against exact truth: what each set adds, and the figures of one set or of all."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
import numpy.typing as npt

from bench.oracle.truth import STEP_NS, Truth
from common.arrays import Bool, Float, Int
from common.hand.model import FINGER_JOINTS
from common.recording.recorded_files import read_npz

CHI2_95 = 7.814727903
"""95 % of a chi-square of 3 degrees of freedom."""
_FLOOR_M2 = 1e-10  # added to covariances: 0.01 mm, so that one without width can be inverted
_FALSE_MM, _FALSE_DEG = 15.0, 20.0  # from there on a TRACKED joint is a false one
_REST_MM = 0.05  # of the fastest joint from instant to instant: the hand rests
_FOLLOWS_NS = 60_000_000  # longer apart, two instants are no step
_SAME_NS = 4_000_000  # poses of two runs at most so far apart are of one instant
_FAST_M_S = 0.2  # of a joint: slower, its lag is less than its other errors
_LONG_NS = 300_000_000  # of motion in which a lag can be seen
LAGS_NS = 1_000_000 * np.arange(-20, 61)
_OF_FINGER = np.zeros((26, 5), np.bool_)
for _finger, _joints in enumerate(FINGER_JOINTS):
    _OF_FINGER[list(_joints), _finger] = True


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """The poses of one run of one set, T of all its recordings one after another.

    Attributes:
        piece: (T,) name of the recording.
        t_ns: (T,) instants.
        position_m: (T, 26, 3), angles_rad: (T, 5, 4), cov_m2: (T, 26, 3, 3), valid, tracked: (T, 26).
        spent_us: (T,) processor time [us].
    """

    piece: npt.NDArray[np.str_]
    t_ns: Int
    position_m: Float
    angles_rad: Float
    cov_m2: Float
    valid: Bool
    tracked: Bool
    spent_us: Float

    @classmethod
    def load(cls, path: Path) -> "Solved":
        """Read out/NAME/SET.npz.

        Raises:
            RecordingError: It is not there, or broken.
        """
        names = [one.name for one in fields(cls)]
        data = read_npz(path, names, "run it again")
        return cls(
            piece=np.asarray(data["piece"], np.str_),
            t_ns=data["t_ns"].astype(np.int64),
            position_m=data["position_m"],
            angles_rad=data["angles_rad"],
            cov_m2=data["cov_m2"],
            valid=data["valid"].astype(np.bool_),
            tracked=data["tracked"].astype(np.bool_),
            spent_us=data["spent_us"],
        )

    def of(self, piece: str) -> "Solved":
        """One recording alone."""
        chosen = self.piece == piece
        return Solved(**{one.name: getattr(self, one.name)[chosen] for one in fields(self)})


def _nothing() -> Float:
    return np.zeros(0)


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """What is scored, one value each; `joined` adds sets to one another.

    Attributes:
        joint_mm, tracked, inside: (N,) of each valid joint its error, whether it is TRACKED, and whether its 95 %
            region holds the truth; a joint without a covariance has no region.
        false: (N,) whether it is off by 15 mm, or the PIP of its finger by 20 degrees.
        pip_deg: (P,) error of each PIP, `hidden_deg` (H,) of those of hidden fingers.
        thumb_deg: (S,) error of each MCP of a thumb.
        rest_mm: (R,) length of a step that a joint makes while the truth rests.
        wanted: How many joints there are in truth, at all instants.
        instants, without, ghosts: With a hand in truth, those of them without one in the run, and the reverse.
        spent_us: (T,) processor time of each pose.
        misfit: (L,) sum of squares [m^2] between TRACKED joints that move fast and truth delayed by each of `LAGS_NS`.
    """

    joint_mm: Float = field(default_factory=_nothing)
    tracked: Float = field(default_factory=_nothing)
    inside: Float = field(default_factory=_nothing)
    false: Float = field(default_factory=_nothing)
    pip_deg: Float = field(default_factory=_nothing)
    hidden_deg: Float = field(default_factory=_nothing)
    thumb_deg: Float = field(default_factory=_nothing)
    rest_mm: Float = field(default_factory=_nothing)
    spent_us: Float = field(default_factory=_nothing)
    misfit: Float = field(default_factory=lambda: np.zeros(len(LAGS_NS)))
    wanted: int = 0
    epochs: int = 0
    without: int = 0
    ghosts: int = 0

    def joined(self, other: "Samples") -> "Samples":
        """Both together."""
        return Samples(
            *(
                np.concatenate([getattr(self, name), getattr(other, name)])
                for name in (
                    "joint_mm",
                    "tracked",
                    "inside",
                    "false",
                    "pip_deg",
                    "hidden_deg",
                    "thumb_deg",
                    "rest_mm",
                    "spent_us",
                )
            ),
            misfit=self.misfit + other.misfit,
            wanted=self.wanted + other.wanted,
            epochs=self.epochs + other.epochs,
            without=self.without + other.without,
            ghosts=self.ghosts + other.ghosts,
        )


def samples_of(run: Solved, truths: Mapping[str, Truth], other: Solved | None = None) -> Samples:
    """Of one set; an instant at which only the `other` run has a pose counts as one without a hand."""
    out = Samples()
    for piece, truth in truths.items():
        extra = np.zeros(0, np.int64) if other is None else other.of(piece).t_ns
        out = out.joined(_piece(run.of(piece), truth, extra))
    return out


def _piece(run: Solved, truth: Truth, other_ns: Int) -> Samples:
    joints_m, angles_rad = truth.at(run.t_ns)
    known = np.asarray(np.isfinite(joints_m).all(axis=2), np.bool_)
    valid = np.asarray(run.valid & np.isfinite(run.position_m).all(axis=2), np.bool_)
    off_m = run.position_m - joints_m
    scored = valid & known
    mm = 1e3 * np.linalg.norm(off_m, axis=2)
    pip_deg = np.degrees(np.abs(run.angles_rad - angles_rad)[:, :, 2])
    shown = np.stack([valid[:, list(chain[1:])].all(axis=1) for chain in FINGER_JOINTS], axis=1)
    thumb_deg = np.where(shown, pip_deg, np.nan)[:, 0]
    pip_deg = np.where(shown & (np.arange(5) > 0), pip_deg, np.nan)  # of the thumb it is another joint
    hidden_deg = pip_deg[truth.hidden_at(run.t_ns)]
    bent_wrong = ((pip_deg > _FALSE_DEG)[:, None, :] & _OF_FINGER).any(axis=2)
    missed = _missing(run.t_ns, other_ns, truth)
    exists = np.asarray(known.any(axis=1), np.bool_)
    return Samples(
        joint_mm=mm[scored],
        tracked=run.tracked[scored].astype(np.float64),
        inside=_inside(off_m[scored], run.cov_m2[scored]),
        false=((mm > _FALSE_MM) | bent_wrong)[scored].astype(np.float64),
        pip_deg=pip_deg[np.isfinite(pip_deg)],
        hidden_deg=hidden_deg[np.isfinite(hidden_deg)],
        thumb_deg=thumb_deg[np.isfinite(thumb_deg)],
        rest_mm=_rest_mm(run, truth, valid),
        spent_us=run.spent_us,
        misfit=_misfit(run, truth, scored & run.tracked),  # others are off by more than they lag
        wanted=int(known.sum()) + missed * int(known.any(axis=0).sum()),
        epochs=int(exists.sum()) + missed,
        without=int((exists & ~scored.any(axis=1)).sum()) + missed,
        ghosts=int((~exists & run.valid.any(axis=1)).sum()),
    )


def _missing(t_ns: Int, other_ns: Int, truth: Truth) -> int:
    """How many instants of the other run, where there is a hand, this one has no pose of."""
    if not len(other_ns):
        return 0
    if len(t_ns):
        after = np.clip(np.searchsorted(t_ns, other_ns), 1, max(len(t_ns) - 1, 1))
        near = np.minimum(
            np.abs(t_ns[after - 1] - other_ns), np.abs(t_ns[np.minimum(after, len(t_ns) - 1)] - other_ns)
        )
        other_ns = other_ns[near > _SAME_NS]
    return int(np.isfinite(truth.at(other_ns)[0]).any(axis=(1, 2)).sum())


def _inside(off_m: Float, cov_m2: Float) -> Float:
    """(N,) whether errors (N, 3) are within the 95 % regions of covariances (N, 3, 3); without one: 0."""
    known = np.asarray(np.isfinite(cov_m2).all(axis=(1, 2)), np.bool_)
    cov = np.where(known[:, None, None], cov_m2, np.eye(3)) + _FLOOR_M2 * np.eye(3)
    chi2 = (off_m * np.linalg.solve(cov, off_m[:, :, None])[:, :, 0]).sum(axis=1)
    return (known & (chi2 <= CHI2_95)).astype(np.float64)


def _rest_mm(run: Solved, truth: Truth, valid: Bool) -> Float:
    """Steps (R,) [mm] from instant to instant of joints of a hand that rests, less those of the truth."""
    if len(run.t_ns) < 2 or not truth.continuous:
        return _nothing()
    exact = truth.at(run.t_ns)[0]
    moved_m = np.diff(exact, axis=0)
    known = np.asarray(np.isfinite(moved_m).all(axis=2), np.bool_)
    length = 1e3 * np.linalg.norm(moved_m, axis=2)
    rests = known.any(axis=1) & (np.where(known, length, 0.0).max(axis=1) < _REST_MM)
    rests &= np.diff(run.t_ns) < _FOLLOWS_NS
    step = 1e3 * np.linalg.norm(np.diff(run.position_m, axis=0) - moved_m, axis=2)
    return step[rests[:, None] & known & valid[1:] & valid[:-1]]


def _misfit(run: Solved, truth: Truth, scored: Bool) -> Float:
    """(L,) sum over joints of the squares of what differs in motion, each joint's mean error left out."""
    out = np.zeros(len(LAGS_NS))
    if not truth.continuous:
        return out
    whole = np.asarray(scored.any(axis=1), np.bool_)
    for lag in (LAGS_NS[0], LAGS_NS[-1]):  # the same instants for all lags
        whole &= np.isfinite(truth.at(run.t_ns - lag)[0]).any(axis=(1, 2))
    if whole.sum() < 2 or np.ptp(run.t_ns[whole]) < _LONG_NS:
        return out
    step_m = truth.at(run.t_ns + STEP_NS)[0] - truth.at(run.t_ns - STEP_NS)[0]
    fast = np.linalg.norm(step_m, axis=2) > _FAST_M_S * 2e-9 * STEP_NS
    used = scored & whole[:, None] & fast
    count = np.maximum(used.sum(axis=0), 1)[:, None]
    for k, lag in enumerate(LAGS_NS):
        off = np.where(used[:, :, None], run.position_m - truth.at(run.t_ns - lag)[0], 0.0)
        off = np.where(used[:, :, None], off - off.sum(axis=0) / count, 0.0)
        out[k] = (off**2).sum()
    return out


def figures(samples: Samples) -> dict[str, float]:
    """The figures of a set, or of several joined; NaN where nothing was to be measured."""
    tracked = samples.tracked > 0.0
    return {
        "joint mm": _mean(samples.joint_mm),
        "99 % mm": _percentile(samples.joint_mm, 99.0),
        "TRACKED mm": _mean(samples.joint_mm[tracked]),
        "its 99 %": _percentile(samples.joint_mm[tracked], 99.0),
        "PIP deg": _mean(samples.pip_deg),
        "hidden": _mean(samples.hidden_deg),
        "thumb deg": _mean(samples.thumb_deg),
        "cover %": 100.0 * _mean(samples.inside),
        "TRACKED cover %": 100.0 * _mean(samples.inside[tracked]),
        "valid %": 100.0 * len(samples.joint_mm) / samples.wanted if samples.wanted else np.nan,
        "TRACKED %": 100.0 * float(tracked.sum()) / samples.wanted if samples.wanted else np.nan,
        "false TRACKED %": 100.0 * _mean(samples.false[tracked]),
        "jitter mm": float(np.sqrt(_mean(samples.rest_mm**2))),
        "lag ms": _lag_ms(samples.misfit),
        "pose us": _percentile(samples.spent_us, 50.0),
        "poses": float(len(samples.spent_us)),
        "no hand": float(samples.without),
        "ghosts": float(samples.ghosts),
    }


def _mean(values: Float) -> float:
    return float(values.mean()) if len(values) else np.nan


def _percentile(values: Float, share: float) -> float:
    return float(np.percentile(values, share)) if len(values) else np.nan


def _lag_ms(misfit: Float) -> float:
    """Where it is least, by a parabola through three; NaN where nothing moves, or at an end."""
    k = int(misfit.argmin())
    if not misfit.any() or k in (0, len(misfit) - 1):
        return np.nan
    before, at, after = misfit[k - 1 : k + 2]
    bend = before - 2.0 * at + after
    return float(1e-6 * LAGS_NS[k] + (0.5 * (before - after) / bend if bend > 0.0 else 0.0))
