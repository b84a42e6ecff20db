"""Record an IMU beside the camera, or import the table of a foreign one.

Samples go to imu.csv, row by row, on a thread of their own; `record --imu-csv FILE` makes one of a foreign table.
"""

import csv
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TextIO

import numpy as np

from common.arrays import Float
from common.errors import ImuError, PhalanxError, RecordingError
from common.imu.csv_table import HEADERS, IMU, QUATERNION, Table, row, write_imu
from common.imu.fusion import OrientationFilter, TiltErrors
from common.messages import ImuSample
from slave.report import imu_counters
from slave.sources import NO_ORIENTATION, ImuSource


class ImuRecorder:
    """Writes an IMU once there is a recording; `failure`: what has ended it early."""

    def __init__(
        self, source: ImuSource, orientation: OrientationFilter | None, stop: threading.Event
    ) -> None:
        """Start to read: nothing grows old in a buffer while the camera is opened."""
        self._source, self._orientation, self._stop = source, orientation, stop
        self._counters = imu_counters(source, orientation)
        self._file: TextIO | None = None
        self._kept = False
        self.failure: PhalanxError | None = None
        self._thread = threading.Thread(target=self._work, name="imu recording", daemon=True)
        self._thread.start()

    def start(self, folder: Path) -> None:
        """Write from now on, into a recording; RecordingError: it cannot be written."""
        path = folder / IMU
        try:
            # line by line: each row is with the system at once
            file = path.open("x", buffering=1, newline="", encoding="ascii")
            csv.writer(file, lineterminator="\n").writerow(HEADERS[-1])
        except OSError as error:
            raise RecordingError(f"{path}: cannot write: {error.strerror}") from error
        self._file = file

    def keep(self) -> None:
        """The camera's recording has frames: what was written belongs to it."""
        self._kept = True

    def close(self) -> dict[str, int]:
        """Stop, delete an unwanted file and return the counts. Safe to call twice."""
        self._stop.set()
        self._thread.join()
        self._source.close()
        file, self._file = self._file, None
        if file is not None:
            with suppress(OSError):  # that a disk is full has been reported
                file.close()
            if not self._kept:
                with suppress(OSError):  # the folder is not empty
                    Path(file.name).unlink()
                    Path(file.name).parent.rmdir()
        return self._counters.counts()

    def _work(self) -> None:
        try:
            while (sample := self._source.read()) is not None:
                sample = sample if self._orientation is None else self._orientation.push(sample)
                if (file := self._file) is not None:
                    csv.writer(file, lineterminator="\n").writerow(row(sample))
                    self._counters.item(sample.seq)
        except ImuError as error:
            self.failure = error
        except OSError as error:
            self.failure = RecordingError(f"{IMU}: ended: {error.strerror}")


def import_table(table: Table, source: str, folder: Path | None, notify: Callable[[str], None]) -> None:
    """Compute the orientation of every sample, write imu.csv, report what it has.

    `source`: what the IMU is called; `folder`: where imu.csv goes, None: it is only looked at.
    Raises RecordingError: there is an imu.csv already, or it cannot be written.
    """
    if folder is not None and (folder / IMU).exists():
        raise RecordingError(f"{folder / IMU}: is there already: give another folder to --out")
    step_s = 1e-9 * np.diff(table.t_ns)
    period_s = float(np.median(step_s))
    fusion = OrientationFilter(1.0 / period_s)
    samples: list[ImuSample] = []
    sigma_rad: list[float] = []
    rest_s = 0.0
    for k, t_ns in enumerate(table.t_ns.tolist()):
        try:
            rows = table.gyro_rad_s[k], table.accel_m_s2[k], table.mag_ut[k]
            sample = ImuSample(source, 0, k, t_ns, *rows, NO_ORIENTATION)
        except ValueError as error:
            raise RecordingError(f"sample {k + 1}, at {1e-9 * t_ns:.3f} s: {error}") from error
        samples.append(fusion.push(sample))
        sigma_rad.append(fusion.tilt_sigma_rad)
        rest_s += period_s if fusion.at_rest else 0.0
    for what, names in table.columns.items():
        notify(f"{what + ':':12s} {names}{' in ' + table.units[what] if what in table.units else ''}")
    gaps = step_s > 1.5 * period_s
    longest = f", the longest {step_s.max():.3f} s" if gaps.any() else ""
    notify(
        f"samples:     {len(samples)} in {float(step_s.sum()):.2f} s, {1.0 / period_s:.1f} Hz; "
        f"{int(gaps.sum())} gaps{longest}; {table.incomplete} rows with NaN, {table.late} not after the last, left out"
    )
    bias = np.degrees(fusion.bias_rad_s)
    notify(f"bias:        {bias[0]:.3f}, {bias[1]:.3f}, {bias[2]:.3f} deg/s; at rest for {rest_s:.1f} s")
    _send_orientation(
        np.array([one.orientation_wxyz for one in samples]), np.array(sigma_rad), fusion, table, notify
    )
    if fusion.counts:
        notify(
            "filter:      " + ", ".join(f"{name} {count}" for name, count in sorted(fusion.counts.items()))
        )
    if folder is not None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RecordingError(f"{folder}: cannot be made: {error.strerror}") from error
        write_imu(folder, samples)
        notify(f"written:     {folder / IMU}")


def _send_orientation(
    found: Float, sigma_rad: Float, fusion: OrientationFilter, table: Table, notify: Callable[[str], None]
) -> None:
    """Report the final orientation, its uncertainty, and its error against a truth."""
    known = np.isfinite(found).all(axis=1)
    if not known.any():
        notify("orientation: never known: too short, or forces are missing")
        return
    last = ", ".join(f"{value:.4f}" for value in found[known][-1])
    notify(
        f"orientation: known for {100 * known.mean():.1f} % of the samples, wxyz {last} at the end; "
        f"tilt to {np.degrees(sigma_rad[known][-1]):.2f} deg per axis, heading drifted by "
        f"{np.degrees(fusion.heading_sigma_rad):.1f} deg (one sigma)"
    )
    errors = TiltErrors.of(found, table.truth_wxyz, sigma_rad)
    if QUATERNION not in table.columns:
        return
    if not len(errors.sigma_rad):
        notify("inclination: no sample has both an orientation and the table's quaternion")
        return
    notify(
        f"inclination: {errors.rms_deg:.2f} deg rms against {table.columns[QUATERNION]}, taken for true (z axis up), "
        f"{len(errors.sigma_rad)} samples; stated {errors.stated_deg:.2f}, {100 * errors.within:.1f} % within 95 %"
    )
