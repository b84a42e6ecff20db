"""IMU data of a recording: imu.csv beside frames.csv, one row per sample.

`t_ns,gx,gy,gz,ax,ay,az[,mx,my,mz][,qw,qx,qy,qz[,heading_sigma]]` in rad/s, m/s^2, uT and rad, on the clock of the
frames; the quaternion takes the sensor's axes to its world, whose z axis is vertical, and its heading may have drifted
so far. `nan`: the sensor did not give the value. As of frames.csv, a cut last row is dropped, every other broken row
is an error.
"""

import csv
import io
import logging
import re
from collections.abc import Iterable, Sequence
from math import nan
from pathlib import Path

import numpy as np

from common.arrays import Float
from common.calibration.files import replacing
from common.errors import RecordingError
from common.messages import ImuSample
from common.recording.recorded_files import read_table

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
    values = {name: _number(where, name, text) for name, text in zip(header[1:], line[1:], strict=True)}

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


def _number(where: str, name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError as error:
        raise RecordingError(f"{where}: {name}: {text!r} is not a number") from error
    most = 1e6  # no sensor gives as much, in any of the units
    if abs(value) > most:
        raise RecordingError(f"{where}: {name}: {text!r} is not a finite number, or above {most:g}")
    return value
