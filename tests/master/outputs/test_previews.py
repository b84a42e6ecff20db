"""Cameras are asked again and again, each by itself."""

import logging
import threading

import pytest

from common.errors import BusError
from common.messages import Command, Health
from master.outputs.bus import PictureAsker
from tests.memory_bus import LoopbackBus
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
