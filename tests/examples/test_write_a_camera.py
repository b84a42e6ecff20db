"""Add a camera: a driver is one class with `read` and `close`; this one reads a folder of pictures."""

import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from common.clock import Clock
from common.errors import CameraError
from common.messages import MarkerDetections, Message
from slave.markers.reloadable import CalibratedDetector
from slave.report import DetectionCounters
from slave.sender import MarkerPipeline, run
from slave.sources import Frame, FrameSource
from tests.slave.painted import NAMES, camera, hand, render


class FolderCamera:
    """Pictures of a folder in the order of their names, as frames of a camera of a fixed rate."""

    def __init__(self, folder: Path, rate_hz: float, clock: Clock) -> None:
        """Open the folder.

        Raises:
            CameraError: No picture is in it.
        """
        self._left, self._clock = sorted(folder.glob("*.png")), clock
        self._period_ns, self._seq = round(1e9 / rate_hz), 0
        if not self._left:
            raise CameraError(f"{folder}: no picture; put PNG files of the camera's size there")

    def read(self) -> Frame | None:
        """Return the next picture as a frame, or None after the last.

        Raises:
            CameraError: A file is no picture.
        """
        if not self._left:
            return None
        path = self._left.pop(0)
        image = cv2.imread(str(path))
        if image is None:
            raise CameraError(f"{path}: no picture; remove it")
        self._seq += 1
        return Frame(
            self._seq, self._seq * self._period_ns, self._clock.now_ns(), np.asarray(image, np.uint8)
        )

    def close(self) -> None:
        """Give the folder back; nothing is held open."""


class StillClock(Clock):
    """A clock that stands."""

    def now_ns(self) -> int:
        """The time [ns]."""
        return 10**9


def test_its_frames_go_through_the_loop_of_every_slave(tmp_path: Path) -> None:
    picture, sent = render(hand()), list[Message]()
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), picture)
    source: FrameSource = FolderCamera(tmp_path, 50.0, StillClock())
    detector = CalibratedDetector(camera(), NAMES)
    counters = DetectionCounters(NAMES)
    run(source, MarkerPipeline("left", 7, sent.append, detector.push, counters), threading.Event())
    found = [one for one in sent if isinstance(one, MarkerDetections)]
    assert [(one.seq, one.t_ns) for one in found] == [(1, 20_000_000), (2, 40_000_000), (3, 60_000_000)]
    assert all(np.isfinite(one.uv).all() for one in found)


def test_an_empty_folder_is_an_error_that_names_it(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match=f"{tmp_path}: no picture; put PNG files"):
        FolderCamera(tmp_path, 50.0, StillClock())
