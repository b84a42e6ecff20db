"""Meaning and unit of the columns of a third-party IMU table.

By the names in its header.

A name is cut into words (`Gyroscope X (deg/s)`, `gyro_x_dps`, `gyrX`, `angular_velocity.x`, `w_RS_S_x [rad s^-1]`); one
of them names what is measured, one the axis, the last ones or what stands in brackets the unit. Others are ignored.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import pi

from common.errors import RecordingError

TIME, GYRO, ACCEL, MAG, QUATERNION = "time", "gyro", "accel", "mag", "quaternion"
G_M_S2 = 9.80665
UNITS: dict[str, dict[str, float]] = {
    TIME: {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0},  # to ns
    GYRO: {"rad/s": 1.0, "deg/s": pi / 180.0, "mdeg/s": pi / 180e3},
    ACCEL: {"m/s^2": 1.0, "g": G_M_S2, "mg": 1e-3 * G_M_S2},
    MAG: {"uT": 1.0, "T": 1e6, "mT": 1e3, "nT": 1e-3, "gauss": 100.0, "mgauss": 0.1},
    QUATERNION: {},
}
AXES = {TIME: ("",), GYRO: tuple("xyz"), ACCEL: tuple("xyz"), MAG: tuple("xyz"), QUATERNION: tuple("wxyz")}
_WORDS = {
    TIME: {"t", "time", "timestamp", "stamp", "elapsed", "clock"},
    GYRO: {"gyro", "gyr", "gyroscope", "angular", "omega", "rotation", "w", "g"},
    ACCEL: {"acc", "accel", "accelerometer", "acceleration", "a"},
    MAG: {"mag", "magn", "magnetometer", "magnetic", "m"},
    QUATERNION: {"quat", "quaternion", "orientation", "q"},
}
_OTHERS = {
    "bias",
    "offset",
    "std",
    "cov",
    "covariance",
    "sigma",
    "temp",
    "temperature",
    "euler",
    "gravity",
    "free",
}
_SPELT = {
    TIME: {"sec": "s", "secs": "s", "seconds": "s", "second": "s", "µs": "us", "μs": "us", "usec": "us", "msec": "ms",
           "nsec": "ns", "milliseconds": "ms", "microseconds": "us", "nanoseconds": "ns"},
    GYRO: {"rads": "rad/s", "rads1": "rad/s", "rad": "rad/s", "radps": "rad/s", "radsec": "rad/s", "degs": "deg/s",
           "degs1": "deg/s", "deg": "deg/s", "degps": "deg/s", "dps": "deg/s", "°s": "deg/s", "degsec": "deg/s",
           "degrees": "deg/s", "mdps": "mdeg/s", "mdegs": "mdeg/s"},
    ACCEL: {"ms2": "m/s^2", "mss": "m/s^2", "mps2": "m/s^2", "ms²": "m/s^2", "gs": "g"},
    MAG: {"ut": "uT", "µt": "uT", "μt": "uT", "t": "T", "mt": "mT", "nt": "nT", "g": "gauss", "mg": "mgauss"},
    QUATERNION: {},
}  # fmt: skip
_FUSED = re.compile(
    r"(gyroscope|gyro|gyr|accel|acc|magn|mag|quat|[gwamq])([xyz]|(?<=q)w|(?<=quat)w|(?<=q)[0-3])"
)
_CUT = re.compile(r"[^a-z0-9°²µμ]+")


@dataclass(frozen=True, slots=True)
class Column:
    """One column that is read: its place in a row, its name, and its unit.

    The unit is "" where the name does not state it.
    """

    index: int
    name: str
    unit: str


Columns = Mapping[tuple[str, str], Column]  # (what, axis) -> column


def find_columns(header: Sequence[str]) -> dict[tuple[str, str], Column]:
    """The columns that a header names; of several times the leftmost.

    Raises:
        RecordingError: Two columns could be the same thing.
    """
    found: dict[tuple[str, str], Column] = {}
    for index, name in enumerate(header):
        known = _meaning(name)
        if known is None:
            continue
        what, axis, unit = known
        column, before = Column(index, name.strip(), unit), found.get((what, axis))
        if before is None or (_linear(before.name) and not _linear(name)):
            found[what, axis] = column
        elif what != TIME and _linear(before.name) == _linear(name):
            raise RecordingError(
                f"columns {before.name!r} and {column.name!r} could both be {what} {axis}: leave one out or rename it"
            )
    if not all((QUATERNION, axis) in found for axis in AXES[QUATERNION]):
        found = {key: column for key, column in found.items() if key[0] != QUATERNION}
    return found


def _meaning(name: str) -> tuple[str, str, str] | None:
    """What a column is: quantity, axis and unit; None: nothing that is read."""
    bare, _, bracket = name.strip().strip("#").strip().replace("[", "(").partition("(")
    words = _words(re.sub(r"(?<=[a-z])(?=[A-Z])", "_", bare))
    if not words or _OTHERS.intersection(words):
        return None
    fused = next((match for word in words if (match := _FUSED.fullmatch(word))), None)
    if fused is not None:  # and what stands before it, `opt_qw`, adds nothing more
        axis = fused[2].translate(str.maketrans("0123", "wxyz"))
        words = [fused[1], axis, *words[words.index(fused[0]) + 1 :]]
    if words[-1] in "0123" and _WORDS[QUATERNION].intersection(words):
        words[-1] = "wxyz"[int(words[-1])]
    axis = next((word for word in reversed(words) if word in AXES[QUATERNION]), "")
    rest = (
        [word for k, word in enumerate(words) if k != len(words) - 1 - words[::-1].index(axis)]
        if axis
        else words
    )
    for what, keywords in _WORDS.items():
        if axis in AXES[what] and any(
            word in keywords and (k == 0 or len(word) > 1) for k, word in enumerate(rest)
        ):
            return what, axis, _unit(what, rest, bracket)
    return None


def _unit(what: str, words: list[str], bracket: str) -> str:
    """Return the unit stated by the brackets or the last words of a column name.

    "": none.
    """
    spelt = {_joined(unit): unit for unit in UNITS[what]} | _SPELT[what]
    endings = ["".join(words[k:]) for k in range(1, len(words))] + (words if what == TIME else [])
    return next((spelt[ending] for ending in (_joined(bracket), *endings) if ending in spelt), "")


def _joined(text: str) -> str:
    return "".join(_words(text))


def _words(text: str) -> list[str]:
    return [word for word in _CUT.split(text.lower()) if word]


def _linear(name: str) -> bool:
    """Whether a column may be without gravity; ROS calls the one with gravity so."""
    return "linear" in name.lower()
