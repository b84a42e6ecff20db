"""Cameras are asked again and again, each by itself; a JPEG tells its size without being decoded."""

import logging
import threading

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.bus import LoopbackBus
from common.errors import BusError
from common.messages import Command, Health
from master.outputs.previews import PictureAsker, jpeg_size
from tests.network_helpers import until


class OneDeaf(LoopbackBus):
    """A bus on which the camera "deaf" answers only when `release` is set."""

    def __init__(self) -> None:
        super().__init__()
        self.release = threading.Event()
        self.asked: list[str] = []

    def ask(self, command: Command, timeout_s: float) -> Health:
        self.asked.append(command.target)
        if command.target == "deaf":
            self.release.wait(20.0)
            raise BusError("no answer")
        return Health(command.target, 1, 2, {}, {})


def test_a_camera_that_keeps_silent_does_not_delay_the_others() -> None:
    bus = OneDeaf()
    asker = PictureAsker(bus, ("deaf", "left"), period_s=0.005)
    try:
        assert until(lambda: bus.asked.count("left") >= 5)
        assert bus.asked.count("deaf") == 1
    finally:
        bus.release.set()
        asker.close()
    count = len(bus.asked)
    assert not until(lambda: len(bus.asked) > count, 0.05)  # nothing is asked after close


def test_absence_is_said_once_and_again_after_the_camera_was_there(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    bus = LoopbackBus()
    asker = PictureAsker(bus, ("left",), period_s=0.005)
    answered = threading.Event()

    def answer(command: Command) -> Health:
        answered.set()
        return Health("left", 1, 2, {}, {})

    try:
        assert until(lambda: len(caplog.records) == 1)
        slave = bus.join()
        slave.serve("left", answer)
        assert answered.wait(60.0)
        assert len(caplog.records) == 1
        slave.close()
        assert until(lambda: len(caplog.records) == 2)
    finally:
        asker.close()


@pytest.mark.parametrize("shape", [(1, 1), (240, 320), (121, 77, 3), (544, 728, 3)])
@pytest.mark.parametrize("flags", [[], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 4]])
def test_the_size_of_what_opencv_writes(shape: tuple[int, ...], flags: list[int]) -> None:
    data = cv2.imencode(".jpg", np.full(shape, 90, np.uint8), flags)[1].tobytes()
    assert jpeg_size(data) == (shape[1], shape[0])
    for cut in range(20):
        assert jpeg_size(data[:cut]) is None


@given(st.binary(max_size=200))
def test_no_bytes_crash_or_hang_it(tail: bytes) -> None:
    size = jpeg_size(b"\xff\xd8" + tail)
    assert size is None or min(size) > 0
