"""Figures of a run against exact truth; two runs side by side: the table, and whether the new one is as good."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from math import inf, isfinite, isnan
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.oracle.truth import STEP_NS, Truth, truths_of
from common.arrays import Bool, Float, Int
from common.hand.model import FINGER_JOINTS
from common.recording.recorded_files import read_npz

LAGS_NS = 1_000_000 * np.arange(-20, 61)
_OF_FINGER = np.zeros((26, 5), np.bool_)
for _finger, _joints in enumerate(FINGER_JOINTS):
    _OF_FINGER[list(_joints), _finger] = True


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """The poses of one run of one set, T of all its recordings one after another."""

    piece: npt.NDArray[np.str_]  # (T,) name of the recording
    t_ns: Int  # (T,) moments
    position_m: Float  # (T, 26, 3), angles_rad: (T, 5, 4), cov_m2: (T, 26, 3, 3), valid, tracked: (T, 26)
    angles_rad: Float
    cov_m2: Float
    valid: Bool
    tracked: Bool
    spent_us: Float  # (T,) processor time [us]

    @classmethod
    def load(cls, path: Path) -> "Solved":
        """Read out/NAME/SET.npz; RecordingError: absent or broken."""
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
        lag_m2: (L,) sum of squares [m^2] between fast TRACKED joints and truth delayed by each of `LAGS_NS`.
    """

    joint_mm: Float = field(default_factory=_nothing)
    tracked: Float = field(default_factory=_nothing)
    inside: Float = field(default_factory=_nothing)
    false: Float = field(default_factory=_nothing)
    pip_deg: Float = field(default_factory=_nothing)  # (P,) error of each PIP
    hidden_deg: Float = field(default_factory=_nothing)  # (H,) of those of hidden fingers
    thumb_deg: Float = field(default_factory=_nothing)  # (S,) error of each MCP of a thumb
    rest_mm: Float = field(default_factory=_nothing)  # (R,) a joint's step while the truth rests
    spent_us: Float = field(default_factory=_nothing)  # (T,) processor time of each pose
    lag_m2: Float = field(default_factory=lambda: np.zeros(len(LAGS_NS)))
    wanted: int = 0  # how many joints there are in truth, at all moments
    epochs: int = 0  # with a hand in truth
    without: int = 0  # of them without one in the run
    ghosts: int = 0  # with a hand in the run alone

    def joined(self, other: "Samples") -> "Samples":
        """Both together."""
        parts = ((one.name, getattr(self, one.name), getattr(other, one.name)) for one in fields(self))
        added = ("lag_m2", "wanted", "epochs", "without", "ghosts")
        both: dict[str, Any] = {n: a + b if n in added else np.concatenate([a, b]) for n, a, b in parts}
        return Samples(**both)


def samples_of(run: Solved, truths: Mapping[str, Truth], other: Solved | None = None) -> Samples:
    """Of one set; a moment at which only the `other` run has a pose counts as one without a hand."""
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
    false_mm, false_deg = 15.0, 20.0  # from there on a TRACKED joint is a false one
    bent_wrong = ((pip_deg > false_deg)[:, None, :] & _OF_FINGER).any(axis=2)
    missed = _missing(run.t_ns, other_ns, truth)
    exists = np.asarray(known.any(axis=1), np.bool_)
    return Samples(
        joint_mm=mm[scored],
        tracked=run.tracked[scored].astype(np.float64),
        inside=_inside(off_m[scored], run.cov_m2[scored]),
        false=((mm > false_mm) | bent_wrong)[scored].astype(np.float64),
        pip_deg=pip_deg[np.isfinite(pip_deg)],
        hidden_deg=hidden_deg[np.isfinite(hidden_deg)],
        thumb_deg=thumb_deg[np.isfinite(thumb_deg)],
        rest_mm=_rest_mm(run, truth, valid),
        spent_us=run.spent_us,
        lag_m2=_lag_m2(run, truth, scored & run.tracked),  # others are off by more than they lag
        wanted=int(known.sum()) + missed * int(known.any(axis=0).sum()),
        epochs=int(exists.sum()) + missed,
        without=int((exists & ~scored.any(axis=1)).sum()) + missed,
        ghosts=int((~exists & run.valid.any(axis=1)).sum()),
    )


def _missing(t_ns: Int, other_ns: Int, truth: Truth) -> int:
    """How many moments of the other run, where there is a hand, this one has no pose of."""
    if not len(other_ns):
        return 0
    if len(t_ns):
        after = np.clip(np.searchsorted(t_ns, other_ns), 1, max(len(t_ns) - 1, 1))
        near = np.minimum(
            np.abs(t_ns[after - 1] - other_ns), np.abs(t_ns[np.minimum(after, len(t_ns) - 1)] - other_ns)
        )
        same_ns = 4_000_000  # poses of two runs at most so far apart are of one moment
        other_ns = other_ns[near > same_ns]
    return int(np.isfinite(truth.at(other_ns)[0]).any(axis=(1, 2)).sum())


def _inside(off_m: Float, cov_m2: Float) -> Float:
    """(N,) whether errors (N, 3) are within the 95 % regions of covariances (N, 3, 3); without one: 0."""
    known = np.asarray(np.isfinite(cov_m2).all(axis=(1, 2)), np.bool_)
    floor_m2 = 1e-10  # added to covariances: 0.01 mm, so that one without width can be inverted
    cov = np.where(known[:, None, None], cov_m2, np.eye(3)) + floor_m2 * np.eye(3)
    chi2 = (off_m * np.linalg.solve(cov, off_m[:, :, None])[:, :, 0]).sum(axis=1)
    return (known & (chi2 <= 7.814727903)).astype(np.float64)  # of three degrees of freedom


def _rest_mm(run: Solved, truth: Truth, valid: Bool) -> Float:
    """Steps (R,) [mm] from moment to moment of joints of a hand that rests, less those of the truth."""
    if len(run.t_ns) < 2 or not truth.continuous:
        return _nothing()
    exact = truth.at(run.t_ns)[0]
    moved_m = np.diff(exact, axis=0)
    known = np.asarray(np.isfinite(moved_m).all(axis=2), np.bool_)
    length = 1e3 * np.linalg.norm(moved_m, axis=2)
    rest_mm = 0.05  # of the fastest joint from moment to moment: the hand rests
    rests = known.any(axis=1) & (np.where(known, length, 0.0).max(axis=1) < rest_mm)
    follows_ns = 60_000_000  # longer apart, two moments are no step
    rests &= np.diff(run.t_ns) < follows_ns
    step = 1e3 * np.linalg.norm(np.diff(run.position_m, axis=0) - moved_m, axis=2)
    return step[rests[:, None] & known & valid[1:] & valid[:-1]]


def _lag_m2(run: Solved, truth: Truth, scored: Bool) -> Float:
    """(L,) sum over joints of the squares of what differs in motion, each joint's mean error left out."""
    out = np.zeros(len(LAGS_NS))
    if not truth.continuous:
        return out
    whole = np.asarray(scored.any(axis=1), np.bool_)
    for lag in (LAGS_NS[0], LAGS_NS[-1]):  # the same moments for all lags
        whole &= np.isfinite(truth.at(run.t_ns - lag)[0]).any(axis=(1, 2))
    long_ns = 300_000_000  # of motion in which a lag can be seen
    if whole.sum() < 2 or np.ptp(run.t_ns[whole]) < long_ns:
        return out
    step_m = truth.at(run.t_ns + STEP_NS)[0] - truth.at(run.t_ns - STEP_NS)[0]
    fast_m_s = 0.2  # of a joint: slower, its lag is less than its other errors
    fast = np.linalg.norm(step_m, axis=2) > fast_m_s * 2e-9 * STEP_NS
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
        "lag ms": _lag_ms(samples.lag_m2),
        "pose us": _percentile(samples.spent_us, 50.0),
        "poses": float(len(samples.spent_us)),
        "no hand": float(samples.without),
        "ghosts": float(samples.ghosts),
    }


def _mean(values: Float) -> float:
    return float(values.mean()) if len(values) else np.nan


def _percentile(values: Float, share: float) -> float:
    return float(np.percentile(values, share)) if len(values) else np.nan


def _lag_ms(lag_m2: Float) -> float:
    """Where it is least, by a parabola through three; NaN where nothing moves, or at an end."""
    k = int(lag_m2.argmin())
    if not lag_m2.any() or k in (0, len(lag_m2) - 1):
        return np.nan
    before, at, after = lag_m2[k - 1 : k + 2]
    bend = before - 2.0 * at + after
    return float(1e-6 * LAGS_NS[k] + (0.5 * (before - after) / bend if bend > 0.0 else 0.0))


ALL = "all"


@dataclass(frozen=True, slots=True)
class Rule:
    """What a figure of the new run must keep to."""

    figure: str  # which
    most_times: float | None = None  # against that of the old run
    least_times: float | None = None
    most: float | None = None  # by itself
    least: float | None = None
    of: str = "both"  # sets it holds for: each "set", "all" together, or "both"


RULES = (
    Rule("joint mm", most_times=1.02),
    Rule("99 % mm", most_times=1.1),
    Rule("cover %", least=90.0, of="set"),
    Rule("cover %", least=93.0, most=98.0, of=ALL),
    Rule("false TRACKED %", most=2.0),
    Rule("jitter mm", most_times=1.0),
    Rule("valid %", least_times=0.98),
    Rule("ghosts", most_times=1.0),
)


@dataclass(frozen=True, slots=True)
class Compared:
    """One set, or all."""

    name: str  # of the set
    old: Mapping[str, float]
    new: Mapping[str, float]
    fails: tuple[str, ...]  # what of the new one breaks a rule, and by how much


def compare(out: Path, old: str, new: str, sets: Sequence[str]) -> list[Compared]:
    """Each set, then all of them together; RecordingError: a run lacks a set."""
    found: list[Compared] = []
    totals = Samples(), Samples()
    for name in sets:
        truths = truths_of(out, name)
        runs = [Solved.load(out / run / f"{name}.npz") for run in (old, new)]
        both = samples_of(runs[0], truths, runs[1]), samples_of(runs[1], truths, runs[0])
        found.append(judged(name, figures(both[0]), figures(both[1])))
        totals = totals[0].joined(both[0]), totals[1].joined(both[1])
    return [*found, judged(ALL, figures(totals[0]), figures(totals[1]))]


def judged(name: str, old: Mapping[str, float], new: Mapping[str, float]) -> Compared:
    """By the rules; a figure that neither run has is not judged, one that only the old has breaks its rule."""
    kind = ALL if name == ALL else "set"
    fails = [text for rule in RULES if rule.of in ("both", kind) for text in _broken(rule, old, new)]
    return Compared(name, old, new, tuple(fails))


def _broken(rule: Rule, old: Mapping[str, float], new: Mapping[str, float]) -> Iterator[str]:
    was, now = old[rule.figure], new[rule.figure]
    if isnan(now):
        if not isnan(was):
            yield f"{rule.figure}: nothing to measure, was {was:.2f}"
        return
    for most, least, what, base in (
        (rule.most_times, rule.least_times, " x", was),
        (rule.most, rule.least, "", 1.0),
    ):
        if isnan(base):
            continue
        value = now if not what else _ratio(was, now)
        rounding = 1e-9
        if most is not None and now > most * base + rounding:
            yield f"{rule.figure} {value:.3g}{what}, at most {most:g}{what}" + _too(rule, old)
        if least is not None and now < least * base - rounding:
            yield f"{rule.figure} {value:.3g}{what}, at least {least:g}{what}" + _too(rule, old)


def _too(rule: Rule, old: Mapping[str, float]) -> str:
    """Says it where the old run breaks a rule of its own figure as well."""
    was = old[rule.figure]
    broken = (rule.most is not None and was > rule.most) or (rule.least is not None and was < rule.least)
    return f" (old: {was:.3g})" if broken else ""


def _ratio(old: float, new: float) -> float:
    if old == new:
        return 1.0
    return new / old if old else inf


def table(compared: Sequence[Compared]) -> str:
    """Figures by column, old, new and ratio of each set by row; then the verdicts."""
    names = list(compared[0].new)
    width = max(len(one.name) for one in compared)
    lines = [" " * (width + 7) + " ".join(f"{name:>{_width(name)}s}" for name in names)]
    for one in compared:
        ratio = {name: _ratio(one.old[name], one.new[name]) for name in names}
        for label, row in (("old", one.old), ("new", one.new), ("ratio", ratio)):
            cells = " ".join(f"{_cell(row[name], label):>{_width(name)}s}" for name in names)
            lines.append(f"{one.name if label == 'old' else '':{width}s} {label:5s} {cells}")
    lines.append("")
    lines += [
        f"{one.name:{width}s} {'FAILS: ' + '; '.join(one.fails) if one.fails else 'ok'}" for one in compared
    ]
    return "\n".join(lines)


def _width(name: str) -> int:
    return max(len(name), 7)


def _cell(value: float, label: str) -> str:
    if isnan(value):
        return "-"
    if label == "ratio" or not isfinite(value):
        return f"{value:.3f}"
    return f"{value:.0f}" if abs(value) >= 1000.0 or value == int(value) else f"{value:.2f}"


def plain(compared: Sequence[Compared]) -> dict[str, object]:
    """For JSON, which has no number for what could not be measured."""

    def numbers(row: Mapping[str, float]) -> dict[str, float | None]:
        return {name: value if isfinite(value) else None for name, value in row.items()}

    return {
        one.name: {"old": numbers(one.old), "new": numbers(one.new), "fails": list(one.fails)}
        for one in compared
    }
