"""Pictures of a board for a calibration: kept when the board is held still somewhere new."""

import threading
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from common.arrays import Image
from common.calibration import CameraCalibration, RigCalibration, load
from common.errors import CalibrationError
from common.messages import Still
from common.sim.board import BOARD as PRINTED
from common.sim.board import BoardRenderer, BoardScene
from master.calibrate.cameras.boards import Checkerboard
from master.calibrate.cameras.capture import NOTES, Round, capture, new_folder
from master.calibrate.cameras.coverage import LiveViews
from master.calibrate.cameras.views import image_sets, look

CALIB = Path(__file__).parents[4] / "calib_json"
RIG = load(CALIB / "rigs" / "desk.json", RigCalibration)
CAMERAS = {name: load(CALIB / "cameras" / f"{name}.json", CameraCalibration) for name in RIG.cameras}
SCENE = BoardScene(RIG, CAMERAS, 3)
BOARD = Checkerboard(PRINTED.columns, PRINTED.rows, PRINTED.square_m)
STEP_S = PRINTED.held_s + PRINTED.moved_s


@pytest.fixture(scope="module")
def renderers() -> dict[str, BoardRenderer]:
    return {name: BoardRenderer(SCENE, name) for name in RIG.cameras}


def at(renderers: dict[str, BoardRenderer], t_s: float) -> dict[str, Image]:
    return {name: renderer.render(t_s) for name, renderer in renderers.items()}


def test_a_view_is_kept_once_it_is_held_still_and_only_once(renderers: dict[str, BoardRenderer]) -> None:
    live = LiveViews(BOARD, RIG.cameras)
    output = [live.push(at(renderers, t)) for t in (0.1, 0.4, 0.7, 1.0)]
    assert [verdict.kept for verdict in output] == [False, True, False, False]
    assert "hold it still" in output[0].text
    assert "seen there already" in output[2].text
    again = [live.push(at(renderers, STEP_S + t)) for t in (0.1, 0.4)]
    assert [verdict.kept for verdict in again] == [False, True]
    assert [view.name for view in live.views] == ["001", "002"]
    assert set(live.views[0].observations) == {"left", "right"}
    assert live.board_views().sizes_px == {"left": (640, 480), "right": (640, 480)}


def test_a_moving_board_is_never_kept(renderers: dict[str, BoardRenderer]) -> None:
    live = LiveViews(BOARD, RIG.cameras)
    for t_s in PRINTED.held_s + PRINTED.moved_s * np.linspace(0.25, 0.75, 5):
        assert not live.push(at(renderers, float(t_s))).kept


def test_one_camera_that_moved_is_enough_to_refuse(renderers: dict[str, BoardRenderer]) -> None:
    live = LiveViews(BOARD, RIG.cameras)
    first = at(renderers, 0.1)
    live.push(first)
    shifted = np.roll(first["right"], 3, axis=1)
    assert "hold it still" in live.push(first | {"right": shifted}).text


def test_without_a_board_it_says_so() -> None:
    live = LiveViews(BOARD, RIG.cameras)
    assert live.push({"left": np.full((480, 640, 3), 90, np.uint8)}).text == "no camera sees the board"


def stills(images: dict[str, Image], seq: int) -> dict[str, Still]:
    encoded = {
        name: cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1] for name, image in images.items()
    }
    return {name: Still(name, seq, seq, data.tobytes()) for name, data in encoded.items()}


def test_what_was_kept_is_a_folder_that_the_calibrations_read(
    renderers: dict[str, BoardRenderer], tmp_path: Path
) -> None:
    times = iter([k * STEP_S + t for k in range(10) for t in (0.2, 0.5)])
    lines: list[str] = []

    def take() -> Round:
        images = at(renderers, next(times))
        return Round(stills(images, 1), images, 4.0)

    live = LiveViews(BOARD, RIG.cameras)
    folder = tmp_path / "board"
    new_folder(folder)
    count = capture(take, live, folder, 3, threading.Event(), lines.append, lambda: "tilt it more")
    assert count == 3
    assert [line for line in lines if line.startswith("view 3 of 3: left and right; tilt it more")]
    assert msgspec.json.decode((folder / NOTES).read_bytes())["largest_spread_ms"] == 4.0
    views = look(BOARD, image_sets(folder, RIG.cameras))
    assert [view.name for view in views.views] == ["001", "002", "003"]
    for mine, read in zip(live.views, views.views, strict=True):
        for name in RIG.cameras:
            step = mine.observations[name].corners_px - read.observations[name].corners_px
            assert np.abs(step).max() < 0.2  # what JPEG costs
    with pytest.raises(CalibrationError, match=r"holds .* already"):
        new_folder(folder)


def test_a_stop_ends_it_with_what_there_is(tmp_path: Path) -> None:
    stop = threading.Event()
    lines: list[str] = []

    def take() -> Round:
        stop.set()
        return Round({}, {}, float("nan"))

    new_folder(tmp_path / "new")
    assert capture(take, LiveViews(BOARD, ("left",)), tmp_path / "new", 5, stop, lines.append) == 0
    assert lines == ["no camera answers (no picture from left: is the slave running?)"]
    new_folder(tmp_path / "new")  # nothing was kept: it can be used again


def test_a_camera_that_gives_no_picture_is_named(renderers: dict[str, BoardRenderer], tmp_path: Path) -> None:
    times = iter((0.2, 0.5))
    lines: list[str] = []

    def take() -> Round:
        image = {"left": renderers["left"].render(next(times))}
        return Round(stills(image, 1), image, 0.0)

    new_folder(tmp_path / "one")
    capture(take, LiveViews(BOARD, RIG.cameras), tmp_path / "one", 1, threading.Event(), lines.append)
    assert lines[-1] == "view 1 of 1: left (no picture from right: is the slave running?)"


def test_after_each_view_it_says_what_is_missing_until_nothing_is(
    renderers: dict[str, BoardRenderer],
) -> None:
    live = LiveViews(BOARD, RIG.cameras)
    output: list[str] = []
    for k in range(PRINTED.poses):
        images = at(renderers, k * STEP_S + 0.2)
        live.push(images)
        if live.push(images).kept:
            output.append(live.missing())
    assert "tilt the board" in output[0]  # one view shows no tilt
    assert (
        len({text for text in output if "image" in text}) >= 2
    )  # then parts of an image that no corner has seen
    assert output[-1].startswith("nothing is missing")


def test_a_camera_that_saw_no_board_comes_first(renderers: dict[str, BoardRenderer]) -> None:
    live = LiveViews(BOARD, RIG.cameras)
    for t_s in (0.2, 0.5):
        live.push({"left": renderers["left"].render(t_s)})
    assert live.missing() == "show the board to right"
