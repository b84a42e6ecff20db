"""Read IMU recordings of any columns from CSV, and write our own.

A column's name is cut into words (`Gyroscope X (deg/s)`, `gyro_x_dps`, `gyrX`, `angular_velocity.x`,
`w_RS_S_x [rad s^-1]`); one names what is measured, one the axis, the last ones or what stands in brackets the unit.
Other columns are ignored. Commas, semicolons or tabs separate columns; between semicolons a decimal comma is one;
comments before the header are skipped, and a header of two lines (group, then axis) is joined. Units that the header
lacks can be given; else that of time is the one by which the recording has 4 to 4000 samples a second, that of forces
the one that gives gravity, and rates are in rad/s. A value that is empty or NaN was not measured.

Our own, imu.csv beside frames.csv, has one row per sample:
`t_ns,gx,gy,gz,ax,ay,az[,mx,my,mz][,qw,qx,qy,qz[,heading_sigma]]` in rad/s, m/s^2, uT and rad, on the clock of the
frames; the quaternion takes the sensor's axes to its world, whose z axis is vertical, and its heading may have drifted
so far. `nan`: the sensor did not give the value. As of frames.csv, a cut last row is dropped, every other broken row
is an error.
"""

import csv
import io
import logging
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from itertools import pairwise
from math import nan, pi
from pathlib import Path

import numpy as np

from common.arrays import Float, Int
from common.calibration.files import replacing
from common.errors import RecordingError
from common.messages import ImuSample
from common.recording.recorded_files import read_table

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
    *("bias", "offset", "std", "cov", "covariance", "sigma"),
    *("temp", "temperature", "euler", "gravity", "free"),
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
    """One column that is read: place in a row, name, unit ("": not in the name)."""

    index: int
    name: str
    unit: str


Columns = Mapping[tuple[str, str], Column]  # (what, axis) -> column


def find_columns(header: Sequence[str]) -> dict[tuple[str, str], Column]:
    """The columns that a header names, the leftmost of several times.

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
    rest = list(reversed(words))
    if axis:
        rest.remove(axis)  # the last one
    rest.reverse()
    for what, keywords in _WORDS.items():
        if axis in AXES[what] and any(
            word in keywords and (k == 0 or len(word) > 1) for k, word in enumerate(rest)
        ):
            return what, axis, _unit(what, rest, bracket)
    return None


def _unit(what: str, words: list[str], bracket: str) -> str:
    """Unit stated by the brackets or the last words of a column name; "": none."""
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


_RATES_HZ = (4.0, 4000.0)  # a factor of a thousand: one unit of time fits, no other
_GRAVITY_M_S2 = (6.0, 15.0)  # median size of the force
_EMPTY = frozenset({"", "nan", "na", "null", "none"})


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """A recording of T samples by time.

    Attributes:
        t_ns: (T,), rising.
        gyro_rad_s, accel_m_s2, mag_ut: (T, 3) in the sensor's axes; NaN: not measured.
        truth_wxyz: (T, 4) of the quaternion in it, whose z axis is up; NaN: none.
        columns: Quantity -> names of its columns.
        units: Quantity -> the unit, and where it is from.
        late: Rows that were rejected because they are not after the one before.
        incomplete: Rows with a value that was not measured, of rate or force.
    """

    t_ns: Int
    gyro_rad_s: Float
    accel_m_s2: Float
    mag_ut: Float
    truth_wxyz: Float
    columns: Mapping[str, str]
    units: Mapping[str, str]
    late: int
    incomplete: int


def read_csv(path: Path, units: Mapping[str, str] | None = None, rate_hz: float | None = None) -> Table:
    """Read a recording.

    Args:
        path: The file.
        units: Quantity (`time`, `gyro`, `accel`, `mag`) -> its unit, where the header does not state it.
        rate_hz: Samples per second of a table without a column of time.

    Raises:
        RecordingError: It cannot be read; the text names file, line, and the column that is missing.
    """
    try:
        text = read_table(path.parent, path.name)
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: there is no such file") from error
    try:
        return _read(text.removeprefix("\ufeff").splitlines(), units or {}, rate_hz)
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from error
    except csv.Error as error:
        raise RecordingError(f"{path}: not a table of text: {error}") from error


def _read(lines: Sequence[str], given: Mapping[str, str], rate_hz: float | None) -> Table:
    first, delimiter, columns = _header(lines, timed=rate_hz is None)
    times, values, late = _rows(lines, first, delimiter, columns)
    if len(values) < 2:
        raise RecordingError(f"{len(values)} rows below the header of line {first}: at least 2 are needed")
    scaled, units = _scaled(values, columns, given)
    if rate_hz is None:
        unit, units[TIME] = _time_unit(times, columns[TIME, ""].unit, given.get(TIME))
        ns = [int((one * unit).to_integral_value()) for one in times]
    else:
        ns, units[TIME] = [round(k * 1e9 / rate_hz) for k in range(len(values))], f"{rate_hz:g} Hz, as given"
    most_ns = 10**18  # what imu.csv can hold
    if max(abs(ns[0]), abs(ns[-1])) >= most_ns:
        raise RecordingError(
            f"time: {times[-1]} {units[TIME]} is out of range for any clock: give --time-unit"
        )
    measured = np.isfinite(np.column_stack((scaled[GYRO], scaled[ACCEL]))).all(axis=1)
    names = {
        what: ", ".join(columns[what, axis].name for axis in axes)
        for what, axes in AXES.items()
        if all((what, axis) in columns for axis in axes)
    }
    unit_within = 0.05  # of the length of a quaternion: others are no rotation
    scaled[QUATERNION][~(np.abs(np.linalg.norm(scaled[QUATERNION], axis=1) - 1.0) < unit_within)] = nan
    t_ns, incomplete = np.array(ns, np.int64), int((~measured).sum())
    gyro, accel, mag, quaternion = (scaled[what] for what in (GYRO, ACCEL, MAG, QUATERNION))
    return Table(t_ns, gyro, accel, mag, quaternion, names, units, late, incomplete)


def _header(lines: Sequence[str], *, timed: bool) -> tuple[int, str, Columns]:
    """How many lines stand before the rows, the delimiter and the columns."""
    best: tuple[int, list[str], dict[tuple[str, str], object]] | None = None
    preamble = 30  # lines in which the header must stand
    for k, line in enumerate(lines[:preamble]):
        delimiter = max(",;\t", key=line.count)
        if not line.count(delimiter):
            continue
        names = next(csv.reader([line], delimiter=delimiter))
        options = [(k + 1, names)]
        if k + 1 < len(lines):
            below = next(csv.reader([lines[k + 1]], delimiter=delimiter))
            options.append((k + 2, _one_header(names, below)))
        for first, header in options:
            columns = find_columns(header)
            missing = _missing(columns, timed=timed)
            if not missing:
                return first, delimiter, columns
            if best is None or len(columns) > len(best[2]):
                best = first, header, dict(columns)
    if best is None:
        raise RecordingError(
            f"line 1: no header: none of the first {preamble} lines has a comma, semicolon or tab"
        )
    first, header, found = best
    missing = ", ".join(_missing(found, timed=timed))
    raise RecordingError(
        f"line {first}: no column for {missing}; the header has {', '.join(header)}. Names like t_s, gyro_x_dps, "
        "acc_x_g, gx, ax are understood; a table without time needs --rate-hz"
    )


def _one_header(groups: Sequence[str], names: Sequence[str]) -> list[str]:
    """A header of two lines as one: the upper line's name holds until the next."""
    out: list[str] = []
    group = ""
    for k, name in enumerate(names):
        group = (groups[k].strip() if k < len(groups) else "") or group
        out.append(f"{name} {group}".strip())
    return out


def _missing(columns: Mapping[tuple[str, str], object], *, timed: bool) -> list[str]:
    needed = [(what, axis) for what in ((TIME,) if timed else ()) + (GYRO, ACCEL) for axis in AXES[what]]
    return [f"{what} {axis}".strip() for what, axis in needed if (what, axis) not in columns]


def _rows(
    lines: Sequence[str], first: int, delimiter: str, columns: Columns
) -> tuple[list[Decimal], Float, int]:
    """Times as written, values (T, columns) as in `columns`, number of late rows."""
    times: list[Decimal] = []
    values: list[list[float]] = []
    late, last = 0, len(lines)
    time = columns.get((TIME, ""))
    width = 1 + max(column.index for column in columns.values())
    for number, cells in enumerate(csv.reader(lines[first:], delimiter=delimiter), first + 1):
        if not any(cell.strip() for cell in cells) or cells[0].lstrip().startswith("#"):
            continue
        if len(cells) < width:
            if number == last:  # cut by whatever ended the recording
                break
            raise RecordingError(f"line {number}: {len(cells)} columns, the header has at least {width}")
        row = [
            float(_number(number, column.name, cells[column.index], delimiter)) for column in columns.values()
        ]
        if time is not None:
            t = _number(number, time.name, cells[time.index], delimiter)
            if not t.is_finite() or (times and t <= times[-1]):
                late += 1
                continue
            times.append(t)
        values.append(row)
    return times, np.array(values).reshape(-1, len(columns)), late


def _number(line: int, name: str, text: str, delimiter: str) -> Decimal:
    text = text.strip()
    if text.lower() in _EMPTY:
        return Decimal("nan")
    try:
        return Decimal(text.replace(",", ".") if delimiter != "," else text)
    except InvalidOperation as error:
        raise RecordingError(f"line {line}: column {name!r}: {text!r} is not a number") from error


def _scaled(
    values: Float, columns: Columns, given: Mapping[str, str]
) -> tuple[dict[str, Float], dict[str, str]]:
    """Quantities (T, axes) in SI units (field: uT), and their units with the source."""
    places = {key: k for k, key in enumerate(columns)}
    scaled: dict[str, Float] = {}
    units: dict[str, str] = {}
    for what in (GYRO, ACCEL, MAG, QUATERNION):
        keys = [(what, axis) for axis in AXES[what]]
        if not all(key in places for key in keys):
            scaled[what] = np.full((len(values), len(keys)), nan)
            continue
        raw = values[:, [places[key] for key in keys]]
        named = {columns[key].unit for key in keys} - {""}
        if len(named) > 1:
            raise RecordingError(f"{what}: its columns say {' and '.join(sorted(named))}: they need one unit")
        unit, who = next(iter(named), ""), "header"
        if not unit:
            unit, who = given.get(what, ""), "given"
        if not unit and what != QUATERNION:
            unit, who = _likely(what, raw), "not stated"
        scaled[what] = raw * UNITS[what].get(unit, 1.0)
        if unit:
            units[what] = f"{unit} ({who})"
    _refuse_impossible(scaled, units)
    return scaled, units


def _likely(what: str, raw: Float) -> str:
    """Return the likely unit of a quantity where none is stated."""
    if what != ACCEL:
        return next(iter(UNITS[what]))
    size = _size(raw)
    low, high = _GRAVITY_M_S2
    return next((unit for unit, scale in UNITS[ACCEL].items() if low < size * scale < high), "m/s^2")


def _refuse_impossible(scaled: Mapping[str, Float], units: Mapping[str, str]) -> None:
    force, fastest = _size(scaled[ACCEL]), float(np.nanmax(np.abs(scaled[GYRO]), initial=0.0))
    low, high = _GRAVITY_M_S2
    if not low < force < high:
        raise RecordingError(
            f"accel: the median force is {force:.3g} m/s^2 in {units[ACCEL]}, gravity is 9.81: another unit "
            f"(--accel-unit {'|'.join(UNITS[ACCEL])}), or gravity was taken away"
        )
    rate_rad_s = 70.0  # 4000 deg/s, beyond any gyroscope: then it is in degrees
    if fastest > rate_rad_s:
        raise RecordingError(
            f"gyro: up to {fastest:.3g} rad/s in {units[GYRO]}, no gyroscope has as much: --gyro-unit deg/s?"
        )


def _size(vectors: Float) -> float:
    """Median length of those that were measured (T, 3); NaN: none was."""
    size = np.sqrt(np.square(vectors).sum(axis=1))
    return float(np.median(size[np.isfinite(size)])) if np.isfinite(size).any() else nan


def _time_unit(times: Sequence[Decimal], named: str, given: str | None) -> tuple[Decimal, str]:
    """Nanoseconds in one of the unit of time, and what that is."""
    step = float(np.median(np.array([float(b - a) for a, b in pairwise(times)])))
    low, high = _RATES_HZ
    fits = [unit for unit, scale in UNITS[TIME].items() if low < 1e9 / (step * scale) <= high]
    if not (unit := named or given or next(iter(fits), "")):
        raise RecordingError(
            f"time: a step of {step:g} fits no unit: give --time-unit {'|'.join(UNITS[TIME])}"
        )
    return Decimal(UNITS[TIME][unit]), f"{unit} ({'header' if named else 'given' if given else 'not stated'})"


IMU = "imu.csv"
_RATES = ("gx", "gy", "gz", "ax", "ay", "az")
_FIELD, _QUATERNION, _DRIFT = ("mx", "my", "mz"), ("qw", "qx", "qy", "qz"), "heading_sigma"
HEADERS = tuple(
    ("t_ns", *_RATES, *field, *quaternion)
    for field in ((), _FIELD)
    for quaternion in ((), _QUATERNION, (*_QUATERNION, _DRIFT))
)
_INTEGER = re.compile(r"-?[0-9]{1,18}")
_LOG = logging.getLogger(__name__)


def read_imu(folder: Path, source: str) -> tuple[ImuSample, ...]:
    """Samples of a recording's IMU, called `source`, by time; empty without imu.csv.

    Raises:
        RecordingError: The file is broken; the text names file, line and column.
    """
    path = folder / IMU
    try:
        text = read_table(folder, IMU)
    except FileNotFoundError:
        return ()
    whole, _, cut = text.rpartition("\n")
    if cut:
        _LOG.warning("%s: the last line is cut, left out: the recording was not ended, but broke off", path)
    try:
        reader = csv.reader(io.StringIO(whole, newline=""))
        header = tuple(next(reader, ()))
        lines = [(reader.line_num, line) for line in reader if line]
    except csv.Error as error:
        raise RecordingError(f"{path}: not a table of text: {error}") from error
    if header not in HEADERS:
        quaternion = f"{','.join(_QUATERNION)}, with or without {_DRIFT}, or not"
        allowed = f"t_ns,{','.join(_RATES)}, then {','.join(_FIELD)} or not, then {quaternion}"
        raise RecordingError(f"{path}: header {','.join(header)}: must be {allowed}")
    samples: list[ImuSample] = []
    for number, line in lines:
        sample = _sample(f"{path}: line {number}", source, len(samples), header, line)
        if samples and sample.t_ns <= samples[-1].t_ns:
            raise RecordingError(
                f"{path}: line {number}: t_ns: {sample.t_ns} is not after {samples[-1].t_ns}"
            )
        samples.append(sample)
    return tuple(samples)


def write_imu(folder: Path, samples: Iterable[ImuSample]) -> None:
    """Write imu.csv, all columns, with the digits that give back the same numbers.

    Raises:
        RecordingError: It cannot be written; nothing is left half done.
    """
    text = io.StringIO(newline="")
    table = csv.writer(text, lineterminator="\n")
    table.writerow(HEADERS[-1])
    table.writerows(row(one) for one in samples)
    try:
        with replacing(folder / IMU) as file:
            file.write(text.getvalue().encode())
    except OSError as error:
        raise RecordingError(f"{folder / IMU}: cannot write: {error.strerror}") from error


def row(sample: ImuSample) -> list[int | float]:
    """One row of a table with all columns, those of the last of `HEADERS`."""
    values = [sample.gyro_rad_s, sample.accel_m_s2, sample.mag_ut, sample.orientation_wxyz]
    return [sample.t_ns, *np.concatenate(values).tolist(), sample.heading_sigma_rad]


def _sample(where: str, source: str, seq: int, header: Sequence[str], line: Sequence[str]) -> ImuSample:
    if len(line) != len(header):
        raise RecordingError(f"{where}: {len(line)} columns, the header has {len(header)}")
    if not _INTEGER.fullmatch(line[0]):
        raise RecordingError(f"{where}: t_ns: {line[0]!r} is not an integer")
    values = {name: _cell(where, name, text) for name, text in zip(header[1:], line[1:], strict=True)}

    if (drift := values.get(_DRIFT, nan)) < 0.0:
        raise RecordingError(f"{where}: {_DRIFT}: {drift:g} is below 0")

    def vector(*names: str) -> Float:
        return np.array([values.get(name, np.nan) for name in names])

    try:
        return ImuSample(
            source=source,
            session=0,
            seq=seq,
            t_ns=int(line[0]),
            gyro_rad_s=vector(*_RATES[:3]),
            accel_m_s2=vector(*_RATES[3:]),
            mag_ut=vector(*_FIELD),
            orientation_wxyz=vector(*_QUATERNION),
            heading_sigma_rad=drift,
        )
    except ValueError as error:
        raise RecordingError(f"{where}: {error}") from error


def _cell(where: str, name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError as error:
        raise RecordingError(f"{where}: {name}: {text!r} is not a number") from error
    most = 1e6  # no sensor gives as much, in any of the units
    if abs(value) > most:
        raise RecordingError(f"{where}: {name}: {text!r} is not a finite number, or above {most:g}")
    return value
