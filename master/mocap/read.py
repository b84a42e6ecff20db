"""Reader of motion capture of a hand.

The format is found by the file's name, joints by their names, length by unit or hand size.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.arrays import Float
from common.calibration.json_file import read_json
from common.errors import RecordingError
from master.mocap.bvh_file import read_bvh
from master.mocap.c3d_file import read_c3d
from master.mocap.csv_file import read_csv
from master.mocap.joint_motion import METRES, POINTS, JointMotion, PointTable, Side, Unit, checked_times
from master.mocap.joint_names import choose_names, shown
from master.mocap.track import known

_PALM_M = (0.05, 0.125)
"""From the wrist to the middle knuckle: 0.44 to 0.5 of a hand's length (Buchholz et al., 1992), children included."""
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
    given = _given(reading.joints)
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
    """Return the length unit in which positions (T, J, 3) have the size of a hand.

    Also returns the distance from wrist to middle knuckle in metres.

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
    if suffix == ".bvh":
        return read_bvh(path)
    if suffix == ".c3d":
        return read_c3d(path)
    if suffix in (".csv", ".tsv", ".txt"):
        return read_csv(path, rate_hz)
    raise RecordingError(f"{path}: motion capture is read from {_FORMS}")


def _given(joints: Path | None) -> dict[str, str | None]:
    return {} if joints is None else read_json(joints, dict[str, str | None])
