"""Two runs of the oracle side by side: the table, and for each set whether the new one is as good."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf, isfinite, isnan
from pathlib import Path

from bench.oracle.score import Samples, Solved, figures, samples_of
from bench.oracle.truth import truths_of

ALL = "all"


@dataclass(frozen=True, slots=True)
class Rule:
    """What a figure of the new run must keep to.

    Attributes:
        figure: Which.
        most_times, least_times: Against that of the old run.
        most, least: By itself.
        of: Sets it holds for: each "set", "all" together, or "both".
    """

    figure: str
    most_times: float | None = None
    least_times: float | None = None
    most: float | None = None
    least: float | None = None
    of: str = "both"


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
_ROUNDING = 1e-9


@dataclass(frozen=True, slots=True)
class Compared:
    """One set, or all.

    Attributes:
        name: Of the set.
        old, new: Figures of both runs.
        fails: What of the new one breaks a rule, and by how much.
    """

    name: str
    old: Mapping[str, float]
    new: Mapping[str, float]
    fails: tuple[str, ...]


def compare(out: Path, old: str, new: str, sets: Sequence[str]) -> list[Compared]:
    """Each set, then all of them together.

    Raises:
        RecordingError: A run lacks a set.
    """
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
        if most is not None and now > most * base + _ROUNDING:
            yield f"{rule.figure} {value:.3g}{what}, at most {most:g}{what}" + _too(rule, old)
        if least is not None and now < least * base - _ROUNDING:
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
