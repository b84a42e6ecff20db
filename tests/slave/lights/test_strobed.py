"""A strobed camera: its lights hear of every frame, go dark when it is lost, and are dark before it is closed."""

from typing import cast

import msgspec
import numpy as np
import pytest

from common.calibration import CameraCalibration
from common.errors import CameraError, LightsError
from slave.lights.controller import Strobe
from slave.lights.strobed import StrobedCamera
from slave.sources import Frame, Tunable
from tests.slave.lights.stage import CAMERA, RIG


class Source(Tunable):
    """A camera with two frames, which is lost then, and gone at last."""

    def __init__(self, output: list[object], tunes: bool = True) -> None:
        self.output, self.tunes, self.count = output, tunes, 0

    def read(self) -> Frame | None:
        self.count += 1
        if self.count == 3:
            raise CameraError("lost")
        return None if self.count > 3 else Frame(self.count, 1000 * self.count, 0, np.zeros((2, 2), np.uint8))

    def close(self) -> None:
        self.output.append("camera closed")

    def tune(self, camera: CameraCalibration) -> None:
        if not self.tunes:
            raise CameraError("not taken")
        self.output.append(("camera", camera.exposure_us))

    def metrics(self) -> dict[str, float]:
        return {"exposure_us": 1.0}

    def counts(self) -> dict[str, int]:
        return {"camera.lost": 1}


class Controller:
    """Notes what it is told."""

    def __init__(self, output: list[object], fails: bool = False) -> None:
        self.output, self.fails = output, fails

    def push(self, seq: int, t_ns: int) -> None:
        self.output.append((seq, t_ns))

    def expose(self, exposure_us: float) -> None:
        self.output.append(("lights", exposure_us))

    def stalled(self) -> None:
        self.output.append("dark")

    def counts(self) -> dict[str, int]:
        return {"lights.pulses": 5}

    def close(self) -> None:
        self.output.append("lights closed")
        if self.fails:
            raise LightsError("unplugged")


def test_frames_are_reported_and_a_lost_camera_is_dark() -> None:
    output: list[object] = []
    camera = StrobedCamera(Source(output), CAMERA, RIG, cast(Strobe, Controller(output)))
    assert camera.read() is not None
    assert camera.read() is not None
    with pytest.raises(CameraError, match="lost"):
        camera.read()
    assert camera.read() is None
    assert output == [(1, 1000), (2, 2000), "dark", "dark"]
    assert camera.counts() == {"camera.lost": 1, "lights.pulses": 5}


@pytest.mark.parametrize("fails", [False, True])
def test_lights_go_first_and_the_camera_is_closed_in_any_case(fails: bool) -> None:
    output: list[object] = []
    camera = StrobedCamera(Source(output), CAMERA, RIG, cast(Strobe, Controller(output, fails)))
    if fails:
        with pytest.raises(LightsError):
            camera.close()
    else:
        camera.close()
    assert output == ["lights closed", "camera closed"]


@pytest.mark.parametrize(("wanted_us", "between_us"), [(1500.0, 2000.0), (2500.0, 2500.0)])
def test_while_the_exposure_changes_the_longer_one_is_lit(wanted_us: float, between_us: float) -> None:
    output: list[object] = []
    camera = StrobedCamera(Source(output), CAMERA, RIG, cast(Strobe, Controller(output)))
    camera.tune(msgspec.structs.replace(CAMERA, exposure_us=wanted_us))
    assert output == [("lights", between_us), ("camera", wanted_us), ("lights", wanted_us)]


def test_an_exposure_that_is_not_taken_changes_no_light() -> None:
    output: list[object] = []
    camera = StrobedCamera(Source(output, tunes=False), CAMERA, RIG, cast(Strobe, Controller(output)))
    with pytest.raises(CameraError, match="not taken"):
        camera.tune(msgspec.structs.replace(CAMERA, exposure_us=2500.0))
    assert output == [("lights", 2500.0), ("lights", 2000.0)]
