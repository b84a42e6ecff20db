"""The reader finds our joints in a motion-capture file by their names.

`mixamorig:RightHandIndex1` is the right index's MCP. A name is cut into words at separators, digits and capitals. One
word names the finger, one the joint: MCP, PIP and DIP, or the bone that begins there, as in WebXR. Where joints of a
finger are numbered, their number determines which is which: 1 2 3 (and 4, or an end) are MCP, PIP, DIP (and tip), 0 1
2 3 begin with the metacarpal; of a thumb 1 2 3 are CMC, MCP, IP; `RightInHandIndex` is a metacarpal. A thumb whose
joints are called like a finger's (proximal, intermediate, distal) begins at its CMC.

The format is found by the file's name, length by its unit or the size of the hand.
"""

import re
import struct
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import c3d
import numpy as np

from common.arrays import Float
from common.calibration.files import read_json
from common.errors import RecordingError
from common.hand.model import FINGER_JOINTS, JOINTS
from master.mocap.bvh_file import (
    MAX_BYTES,
    METRES,
    POINTS,
    JointMotion,
    PointTable,
    Side,
    Unit,
    checked_times,
    known,
    read_bvh,
)
from master.mocap.csv_file import read_csv

_WORD = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
_SIDES: dict[str, Side] = {"left": "left", "l": "left", "right": "right", "r": "right"}
_FINGERS = {"thumb": 0, "index": 1, "middle": 2, "mid": 2, "ring": 3, "little": 4, "pinky": 4, "pinkie": 4}
_ORDINALS = {"first": 0, "second": 1, "third": 2, "fourth": 3, "fifth": 4}
_BASE, _MCP, _PIP, _DIP, _TIP = range(5)
_PARTS = {
    **dict.fromkeys(("metacarpal", "cmc", "mc", "carpal", "trapezium"), _BASE),
    **dict.fromkeys(("mcp", "knuckle", "proximal", "pp"), _MCP),
    **dict.fromkeys(("pip", "intermediate", "medial", "mp"), _PIP),
    **dict.fromkeys(("dip", "ip", "distal", "dp"), _DIP),
    **dict.fromkeys(("tip", "end", "nub"), _TIP),
}
_MARKER_NAMES = ("thumb", "index", "middle", "ring", "little")
_SHOWN = 80  # names of an error message

Key = tuple[Side | None, str]


@dataclass(slots=True)
class _Finger:
    """What was found of one finger: joints by word, joints by number."""

    worded: dict[int, list[str]] = field(default_factory=dict[int, list[str]])
    numbered: dict[int, list[str]] = field(default_factory=dict[int, list[str]])


def match_names(
    names: Iterable[str], ends: frozenset[str] = frozenset()
) -> dict[Side | None, dict[str, list[str]]]:
    """Return side -> point of ours -> the names that mean it.

    `ends` are the end sites: a tip, where the finger has no joint there.
    """
    found: dict[Side | None, dict[str, list[str]]] = {}
    fingers: dict[tuple[Side | None, int], _Finger] = {}
    for name in names:
        words = [part for word in _WORD.findall(name.rsplit(":", 1)[-1]) for part in _split(word.lower())]
        side: Side | None = next((_SIDES[word] for word in words if word in _SIDES), None)
        rest = [word for word in words if word not in _SIDES]
        finger = _finger_of(rest)
        if finger is None:
            if name not in ends and (point := _point_of(rest)):
                found.setdefault(side, {}).setdefault(point, []).append(name)
            continue
        one = fingers.setdefault((side, finger), _Finger())
        part = next((_PARTS[word] for word in rest if word in _PARTS), _BASE if "in" in rest else None)
        if name in ends and part is not None:
            part = _TIP  # it is called after the joint before it
        number = next((int(word) for word in rest if word.isdigit()), None)
        if part is not None:
            one.worded.setdefault(part, []).append(name)
        elif number is not None:
            one.numbered.setdefault(number, []).append(name)
        elif rest == [_MARKER_NAMES[finger]]:
            found.setdefault(side, {}).setdefault(rest[0], []).append(name)
    for (side, finger), one in fingers.items():
        for part, meant in _parts(one, finger == 0, ends).items():
            joint = _joint(finger, part)
            if joint is not None:
                found.setdefault(side, {}).setdefault(joint, []).extend(meant)
    for points in found.values():
        hand = points.pop("hand", None)
        if hand is not None and "wrist" not in points:  # a hand's own joint is its wrist
            points["wrist"] = hand
    unsided = found.get(None, {})
    if any(_is_finger(point) for point in unsided):
        # The fingers name no side, so `hand_left` and `back_right` are markers to the left and right of something.
        return {side: points for side, points in found.items() if any(map(_is_finger, points))}
    return found


def _split(word: str) -> list[str]:
    """The words of one without capitals: `righthandindex`, `rthumb`."""
    for ahead in ("left", "right", "hand", "l", "r"):
        rest = word.removeprefix(ahead)
        if rest != word and (rest in _FINGERS or rest in ("hand", "wrist", "palm") or len(_split(rest)) > 1):
            return [ahead, *_split(rest)]
    return [word]


def _is_finger(point: str) -> bool:
    return point not in ("wrist", "palm", "back", "back2", "back3")


def _finger_of(words: list[str]) -> int | None:
    """The finger that words name, thumb 0 ... little 4."""
    named = {_FINGERS[word] for word in words if word in _FINGERS}
    if len(named) == 1:
        return named.pop()
    if named:
        return None  # two fingers: a marker between them
    counted = {_ORDINALS[word] for word in words if word in _ORDINALS}
    if len(counted) == 1 and any(word in _PARTS for word in words):
        return counted.pop()
    if "finger" in words[:-2] and (number := words[words.index("finger") + 1]) in "12345":
        return int(number) - 1 if any(word in _PARTS for word in words) else None
    return None


def _point_of(words: list[str]) -> str | None:
    """Point of wrist, palm or back that words name; `hand` is where it begins."""
    if "wrist" in words and "forearm" not in words:
        return "wrist"
    plain = [word for word in words if word not in ("of", "the", "marker")]
    if plain == ["hand"]:
        return "hand"
    core = [word for word in plain if word != "hand"]
    if "palm" in words:
        return "palm"
    if core[:1] == ["back"] and core[1:] in ([], ["2"], ["3"]):
        return "".join(core)
    return None


def _parts(one: _Finger, thumb: bool, ends: frozenset[str]) -> dict[int, list[str]]:
    """Joint of a finger -> the names that mean it."""
    out = {part: list(names) for part, names in one.worded.items()}
    counted = 3  # joints of a finger: fewer numbers do not determine which
    numbers = sorted(one.numbered) if len(one.numbered) >= counted else []
    if joints := [name for name in out.get(_TIP, []) if name not in ends]:
        out[_TIP] = joints  # a tip of its own goes before what lies beyond it
    tips = out.get(_TIP, [])
    counted_tip = (len(numbers) == 4 and numbers[0] == 1) or len(numbers) == 5
    if tips and counted_tip and set(tips) <= ends:
        del out[_TIP]
    elif thumb and len(numbers) == 4 and not tips:
        counted_tip = True
    last = _TIP if counted_tip and _TIP not in out else _DIP
    for step, number in enumerate(reversed(numbers)):
        part = last - step
        if part > _BASE or (part == _BASE and not thumb):
            out.setdefault(part, []).extend(one.numbered[number])
    if thumb and (numbers or (_PIP in out and _BASE not in out)):
        # Counted from the end as a finger's, a thumb's MCP is a CMC: it has one joint less.
        out = {{_MCP: _BASE, _PIP: _MCP}.get(part, part): names for part, names in out.items()}
    return out


def _joint(finger: int, part: int) -> str | None:
    """The name of a joint of ours; None: a thumb has no PIP."""
    chain = FINGER_JOINTS[finger]
    if finger:
        return JOINTS[chain[part]]
    at = {_BASE: 0, _MCP: 1, _DIP: 2, _TIP: 3}.get(part)
    return None if at is None else JOINTS[chain[at]]


@dataclass(frozen=True, slots=True)
class MatchedNames:
    """The points of one hand: ours -> name in the file; side stated or asked for."""

    side: Side | None
    names: Mapping[str, str]


def choose_names(
    names: tuple[str, ...],
    ends: frozenset[str],
    where: str,
    given: Mapping[str, str | None],
    side: Side | None,
) -> MatchedNames:
    """Find which name of a file is which point of one hand.

    Args:
        ends: Those of the names that are end sites.
        where: The file, for errors.
        given: Point of ours -> name that a person gives it; None: it has none.
        side: That is wanted; None: that which is there.

    Raises:
        RecordingError: A name that is given is not there, two names mean one point, or both hands are there.
    """
    for point, name in given.items():
        if point not in POINTS:
            raise RecordingError(f"{where}: --joints: {point!r} is no joint of ours: {', '.join(POINTS)}")
        if name is not None and name not in names:
            raise RecordingError(f"{where}: --joints: {point}: it has no {name!r}, but {shown(names)}")
    taken = {name for name in given.values() if name is not None}
    found = match_names((name for name in names if name not in taken), ends)
    sided: list[Side] = [one for one in found if one is not None]
    if side is None and len(sided) > 1:
        raise RecordingError(f"{where}: has both hands: say which with --side left or --side right")
    own = side or (sided[0] if sided else None)
    merged: dict[str, list[str]] = {}
    for group in dict.fromkeys((own, None)):
        for point, meant in found.get(group, {}).items():
            merged.setdefault(point, []).extend(meant)
    out = {point: name for point, name in given.items() if name is not None}
    for point, meant in merged.items():
        if point in given:
            continue
        if len(meant) > 1:
            raise RecordingError(
                f"{where}: {' and '.join(meant)} both mean {point}: say which with --joints,"
                f' a JSON file such as {{"{point}": "{meant[-1]}"}}'
            )
        out[point] = meant[0]
    return MatchedNames(own, {point: out[point] for point in POINTS if point in out})


def shown(names: Iterable[str]) -> str:
    """Names in one line, the first of them where there are many."""
    listed = list(names)
    more = f" and {len(listed) - _SHOWN} more" if len(listed) > _SHOWN else ""
    return (", ".join(listed[:_SHOWN]) or "nothing") + more


# From the wrist to the middle knuckle: 0.44 to 0.5 of a hand's length (Buchholz et al., 1992), children included.
_PALM_M = (0.05, 0.125)
_FORMS = "a .csv, .tsv or .txt table, a .bvh or a .c3d"


@dataclass(frozen=True, slots=True)
class Reading:
    """How a person wants a file read.

    Attributes:
        joints: JSON file: point of ours -> name in the file, or null for one that is to be left out.
        unit: Of length; None: by the file, else by the size of the hand.
        side: Of a file with both hands.
        rate_hz: Of a table without times.
    """

    joints: Path | None = None
    unit: Unit | None = None
    side: Side | None = None
    rate_hz: float | None = None


def read_motion(path: Path, reading: Reading | None = None) -> JointMotion:
    """Read the joints and markers of one hand.

    Raises:
        RecordingError: The file cannot be read, no name in it is known, or its unit is unknown; with what it has.
        CalibrationError: The file of names is broken.
    """
    reading = reading or Reading()
    table = _table(path, reading.rate_hz)
    given = {} if reading.joints is None else read_json(reading.joints, dict[str, str | None])
    matched = choose_names(table.names, table.ends, str(path), given, reading.side)
    if not matched.names:
        raise RecordingError(
            f"{path}: no name in it is that of a joint of a hand; it has {shown(table.names)}. Say which is which with"
            f' --joints, a JSON file of pairs such as {{"index-finger-tip": "NAME"}}; ours are {", ".join(POINTS)}'
        )
    t_ns = checked_times(table.t_s, str(path))
    columns = [table.names.index(name) for name in matched.names.values()]
    names, position = tuple(matched.names), table.position[:, columns]
    unit, remarks = reading.unit or table.unit, list[str]()
    if unit is None:
        unit, palm_m = unit_by_size(names, position, path)
        remarks.append(
            f"{path.name} does not say its unit of length: with {unit} there are {1e3 * palm_m:.0f} mm from wrist to"
            " middle knuckle"
        )
    rejected = [name for name in table.names if name not in matched.names.values()]
    if rejected:
        remarks.append(f"not of this hand, or of no name that is known: {shown(rejected)}")
    return JointMotion(t_ns, names, METRES[unit] * position, matched.side, str(path), tuple(remarks))


def require(motion: JointMotion, needed: tuple[str, ...], what: str) -> None:
    """Refuse a motion that lacks points.

    Raises:
        RecordingError: With the points that are missing, and those that are there.
    """
    have = [name for name in motion.names if known(motion.of(name)).any()]
    missing = [name for name in needed if name not in have]
    if missing:
        raise RecordingError(
            f"{motion.source}: {what} needs {', '.join(missing)}; known in it: {', '.join(have) or 'nothing'}."
            " If a point has another name there, say so with --joints FILE"
            + "".join(f". {remark}" for remark in motion.remarks)
        )


def unit_by_size(names: tuple[str, ...], position: Float, path: Path) -> tuple[Unit, float]:
    """Unit in which positions (T, J, 3) have a hand's size, and wrist to knuckle [m].

    Raises:
        RecordingError: There is no wrist or middle knuckle, or no unit makes a hand of it.
    """
    ends = ("wrist", "middle-finger-phalanx-proximal")
    if not all(name in names for name in ends):
        raise RecordingError(f"{path}: does not say its unit of length: give --unit m, cm or mm")
    wrist, knuckle = (position[:, names.index(name)] for name in ends)
    length = float(np.nanmedian(np.linalg.norm(knuckle - wrist, axis=1)))
    for unit, metres in METRES.items():
        if _PALM_M[0] <= metres * length <= _PALM_M[1]:
            return unit, metres * length
    raise RecordingError(
        f"{path}: from wrist to middle knuckle are {length:.4g}, of no unit the size of a hand: give --unit"
    )


def _table(path: Path, rate_hz: float | None) -> PointTable:
    suffix = path.suffix.lower()
    if not path.is_file():
        raise RecordingError(f"{path}: no such file: give {_FORMS}")
    if path.stat().st_size > MAX_BYTES:
        raise RecordingError(f"{path}: larger than 1 GiB: cut it")
    if suffix == ".bvh":
        return read_bvh(path)
    if suffix == ".c3d":
        return read_c3d(path)
    if suffix in (".csv", ".tsv", ".txt"):
        return read_csv(path, rate_hz)
    raise RecordingError(f"{path}: motion capture is read from {_FORMS}")


def read_c3d(path: Path) -> PointTable:
    """Read the labelled points of a C3D file (c3d.org), by py-c3d.

    A point whose residual is negative was not seen.

    Raises:
        RecordingError: It cannot be read, or has no labelled points.
    """
    units: dict[str, Unit] = {"m": "m", "cm": "cm", "mm": "mm", "in": "in"}
    broken = (
        OSError,
        ValueError,
        LookupError,
        AssertionError,
        AttributeError,
        TypeError,
        struct.error,
        EOFError,
    )
    try:
        with path.open("rb") as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it warns of files without analog channels
            reader = cast(Any, c3d).Reader(file)
            labels = [str(label).strip() for label in reader.point_labels]
            rate_hz = float(reader.point_rate)
            unit = str(reader.get("POINT:UNITS").string_value).strip().lower()
            frames = [np.asarray(points, np.float64)[:, :4] for _, points, _ in reader.read_frames()]
    except broken as error:
        raise RecordingError(f"{path}: cannot read as C3D: {error or type(error).__name__}") from error
    if not frames or not labels:
        raise RecordingError(f"{path}: has no frames, or no points with labels")
    points = np.stack(frames)[:, : len(labels)]
    if not rate_hz > 0.0:
        raise RecordingError(f"{path}: POINT:RATE is {rate_hz:g}: no frames a second")
    labels = labels[: points.shape[1]]
    named = [k for k, label in enumerate(labels) if label and labels.index(label) == k]
    position = np.where(points[..., 3:4] < 0.0, np.nan, points[..., :3])[:, named]
    t_s = np.arange(len(points)) / rate_hz
    return PointTable(tuple(labels[k] for k in named), t_s, position, units.get(unit))
