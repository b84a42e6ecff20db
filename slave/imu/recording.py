"""Recorder of a real IMU beside the camera that is recorded.

Its samples go to imu.csv, row by row, on a thread of their own.
"""

import csv
import threading
from contextlib import suppress
from pathlib import Path
from typing import TextIO

from common.errors import ImuError, PhalanxError, RecordingError
from common.imu.fusion import OrientationFilter
from common.imu.recording import HEADERS, IMU, row
from slave.counters import imu_counters
from slave.sources import ImuSource


class ImuRecorder:
    """Reader of an IMU that writes its samples once there is a recording.

    Holds the thread, the file, and in `failure` what has ended it before its time.
    """

    def __init__(
        self, source: ImuSource, orientation: OrientationFilter | None, stop: threading.Event
    ) -> None:
        """Start to read: nothing grows old in a buffer while the camera is opened.

        Args:
            source: The open IMU; given back by `close`.
            orientation: Makes the orientation of the samples; None: the sensor's own.
            stop: Ends the stream of the source; set by `close`.
        """
        self._source, self._orientation, self._stop = source, orientation, stop
        self._counters = imu_counters(source, orientation)
        self._file: TextIO | None = None
        self._kept = False
        self.failure: PhalanxError | None = None
        self._thread = threading.Thread(target=self._work, name="imu recording", daemon=True)
        self._thread.start()

    def start(self, folder: Path) -> None:
        """Write from now on, into a recording.

        Raises:
            RecordingError: The file cannot be written.
        """
        path = folder / IMU
        try:
            file = path.open(
                "x", buffering=1, newline="", encoding="ascii"
            )  # each row is with the system at once
            csv.writer(file, lineterminator="\n").writerow(HEADERS[-1])
        except OSError as error:
            raise RecordingError(f"{path}: cannot write: {error.strerror}") from error
        self._file = file

    def keep(self) -> None:
        """The camera's recording has frames: what was written belongs to it."""
        self._kept = True

    def close(self) -> dict[str, int]:
        """Stop, delete an unwanted file and return the counts.

        Safe to call twice.
        """
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
