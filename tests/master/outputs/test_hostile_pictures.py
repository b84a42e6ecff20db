"""Pictures that claim more than their camera has, sent over a real bus to all that show or decode them."""

import resource
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import pytest
import rerun as rr

from common.bus.zenoh_bus import ZenohBus
from common.calibration import CameraCalibration, load
from common.geometry.camera_model import CameraModel
from common.messages import Command, Health, Preview, Still
from common.messages.picture_size import Size
from master.calibrate.cameras.boards import Checkerboard
from master.calibrate.cameras.capture import StillTaker, capture, new_folder
from master.calibrate.cameras.coverage import LiveViews
from master.console.link import PictureSizes
from master.console.state import ConsoleSettings, ConsoleState
from master.outputs.rerun_scene import CameraImages
from master.run.ingest import Ingest
from tests.network_helpers import free_endpoint, until
from tests.picture_helpers import TINY, claiming, hostile

CALIB = Path(__file__).parents[3] / "calib_json"
SIZES: dict[str, Size] = {"left": (640, 480), "right": (640, 480)}
HUGE = claiming(30_000, 30_000)  # 630 bytes: 2.7 GB
LARGER = claiming(4000, 4000)  # what a message may carry, but no camera of the rig has
WELL = cv2.imencode(".jpg", np.full((480, 640, 3), 90, np.uint8))[1].tobytes()
HALF = cv2.imencode(".jpg", np.full((240, 320, 3), 90, np.uint8))[1].tobytes()
TIMES_MORE_MB = 32.0


class NoClocks:
    """What a `StillTaker` asks an `Ingest`, without slaves."""

    def get(self, _timeout_s: float) -> None:
        return None

    def clock_of(self, _camera: str) -> None:
        return None


@pytest.fixture
def ends() -> Iterator[tuple[ZenohBus, ZenohBus]]:
    """The bus of a master, and that of a slave."""
    endpoint = free_endpoint()
    master = ZenohBus(endpoint, None)
    slave = ZenohBus(None, endpoint)
    try:
        yield master, slave
    finally:
        slave.close()
        master.close()


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def serve(slave: ZenohBus, name: str, jpegs: list[bytes]) -> None:
    """A slave that answers each question for a still with the next of these."""

    def answer(command: Command) -> Health:
        jpeg = jpegs.pop(0) if len(jpegs) > 1 else jpegs[0]
        slave.publish("still", name, hostile(Still(name, 1, 5, TINY), jpeg))
        return Health(command.target, 1, 5, {}, {})

    slave.serve(name, answer)


@pytest.mark.parametrize(
    ("jpeg", "known"), [(HUGE, False), (LARGER, True), (HALF, True), (WELL[:-200], True)]
)
def test_a_calibration_decodes_no_still_of_another_size_and_says_whose(
    ends: tuple[ZenohBus, ZenohBus], jpeg: bytes, known: bool, tmp_path: Path
) -> None:
    master, slave = ends
    serve(slave, "left", [WELL])
    serve(slave, "right", [jpeg])
    taker = StillTaker(master, cast(Ingest, NoClocks()), SIZES)
    live, stop, lines = LiveViews(Checkerboard(9, 6, 0.025), tuple(SIZES)), threading.Event(), list[str]()
    try:
        assert until(lambda: set(taker.take().images) == {"left"})
        before_mb, before_s = peak_mb(), time.thread_time()
        round_ = taker.take()
        assert peak_mb() - before_mb < TIMES_MORE_MB
        assert time.thread_time() - before_s < 1.0
        assert set(round_.images) == {"left"}
        assert round_.images["left"].shape == (480, 640, 3)
        assert ("right" in round_.refused) == known, "what no camera sends is not even a message"

        def notify(line: str) -> None:
            lines.append(line)
            stop.set()

        new_folder(tmp_path / "views")
        capture(taker.take, live, tmp_path / "views", 5, stop, notify)
        assert ("the picture of right is" if known else "no picture from right") in lines[0]
    finally:
        taker.close()


def test_the_console_shows_no_preview_larger_than_the_camera_and_says_why(
    ends: tuple[ZenohBus, ZenohBus], tmp_path: Path
) -> None:
    master, slave = ends
    shutil.copytree(CALIB, tmp_path / "calib")
    state = ConsoleState(ConsoleSettings(tmp_path / "calib"), lambda: master)
    try:

        def shown(t_ns: int, jpeg: bytes, name: str = "left") -> bool:
            slave.publish("preview", name, hostile(Preview(name, t_ns, TINY), jpeg))
            picture = state.preview(name)
            return picture is not None and picture.t_ns == t_ns

        assert until(lambda: shown(1, HALF))
        before_mb = peak_mb()
        for jpeg in (HUGE, LARGER, claiming(641, 480)):
            slave.publish("preview", "left", hostile(Preview("left", 2, TINY), jpeg))
        assert until(lambda: shown(3, HALF, "right"))  # what was sent before it was read before it
        assert until(lambda: "claims 641 x 480 px" in state.preview_error("left"))
        assert "camera file here says 640 x 480" in state.preview_error("left")
        picture = state.preview("left")
        assert picture is None or picture.t_ns == 1
        assert until(lambda: shown(4, WELL)), "as large as the camera is not too large"
        assert "claims" not in state.preview_error("left")
        assert peak_mb() - before_mb < TIMES_MORE_MB
    finally:
        state.close()


def test_a_camera_file_is_not_read_for_every_picture() -> None:
    read = list[str]()

    def file(name: str) -> CameraCalibration:
        read.append(name)
        return load(CALIB / "cameras" / f"{name}.json", CameraCalibration)

    sizes = PictureSizes(file)
    for _ in range(50):
        assert not sizes.fits(Preview("left", 1, LARGER))
        assert sizes.fits(Preview("invented", 1, LARGER)), "no file says how large it is"
    assert len(read) < 50


def test_the_viewer_gets_no_picture_larger_than_the_camera() -> None:
    file = load(CALIB / "cameras" / "left.json", CameraCalibration)
    images = CameraImages(rr.RecordingStream("test"), {"left": CameraModel.of(file, np.eye(4))})
    assert not images.log("left", LARGER, 0)
    assert not images.log("left", HUGE, 0)
    assert not images.log("left", b"\xff\xd8\xff jpeg", 0)
    assert images.log("left", HALF, 0)
    assert images.log("left", WELL, 200_000_000)
