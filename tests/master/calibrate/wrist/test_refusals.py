"""What a session of a wrist device may go wrong by: each fault is refused with its cause and the remedy."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from common.arrays import Float, Image
from common.calibration import HandProfile, load
from common.errors import FitError
from common.geometry.transforms import intersect_plane
from common.hand.wrist import laser_plane_of
from common.recording.frame_recording import Illumination
from common.sim.wrist.scene import WristScene
from master.calibrate.cameras.boards import Board, Charuco, Checkerboard
from master.calibrate.wrist.curl import fit_curls
from master.calibrate.wrist.device import LitView, board_in_views
from master.calibrate.wrist.palm import BoardOffset, refuse_elsewhere
from tests.conftest import ROOT
from tests.master.calibrate.wrist.devices import BOARD, CAMERA, OPTICS, RIG, cycles_of, view_of

CHARUCO = Charuco(9, 6, 0.015, 0.011)


def rendered() -> tuple[LitView, ...]:
    return tuple(view_of(str(k), frames) for k, frames in enumerate(cycles_of(8, 2)))


def printed(board: Charuco, change: Callable[[Image], Image] = lambda image: image) -> tuple[LitView, ...]:
    """One view of a ChArUco board that fills the picture."""
    drawn = np.asarray(board.pattern().generateImage((600, 400), marginSize=20), np.uint8)
    whole = np.asarray(cv2.copyMakeBorder(drawn, 40, 40, 20, 20, cv2.BORDER_CONSTANT, value=255), np.uint8)
    return (view_of("0", {Illumination.LED: np.ascontiguousarray(change(whole))}),)


@pytest.mark.parametrize(
    ("views", "asked", "cause"),
    [
        (rendered, Checkerboard(9, 5, 0.015), "they show a checkerboard of 9 x 6 inner corners"),
        (rendered, Checkerboard(10, 7, 0.015), "they show a checkerboard of 9 x 6 inner corners"),
        (rendered, CHARUCO, "check columns, rows, sizes and dictionary"),
        (lambda: printed(CHARUCO), Charuco(6, 9, 0.015, 0.011), "they show a ChArUco board of 9 x 6"),
        (lambda: printed(CHARUCO, lambda image: image[:, ::-1]), CHARUCO, "mirrored"),
    ],
    ids=["smaller", "larger", "another kind", "sides exchanged", "mirrored"],
)
def test_a_wrong_board_is_named(views: Callable[[], tuple[LitView, ...]], asked: Board, cause: str) -> None:
    with pytest.raises(FitError, match=f"no board found in . views?, looking for the .*: .*{cause}"):
        board_in_views(views(), asked)


def test_boards_as_other_programs_print_them_are_taken() -> None:
    old = next(CHARUCO.layouts())
    assert old.old_layout
    assert board_in_views(printed(old), CHARUCO) == old
    assert board_in_views(rendered(), BOARD) == BOARD


@pytest.mark.parametrize(
    "wrong",
    [Checkerboard(4, 7, 0.010), Checkerboard(7, 4, 0.020), Checkerboard(7, 4, 0.005)],
    ids=["columns along the hand", "squares of twice the size", "squares of half the size"],
)
def test_a_palm_by_another_board_is_refused(wrong: Checkerboard) -> None:
    offset, true = BoardOffset(0.085, 0.004, 0.022, 1.0), Checkerboard(7, 4, 0.010)
    palm = np.array(RIG.T_camera_palm)
    T_camera_board = palm @ offset.T_palm_board(true)
    refuse_elsewhere(T_camera_board @ np.linalg.inv(offset.T_palm_board(true)), RIG)
    T_camera_board[:3, 3] *= wrong.square_m / true.square_m
    with pytest.raises(FitError, match=r"palm lies \d+ mm and \d+ deg from .* check --board .* --square-mm"):
        refuse_elsewhere(T_camera_board @ np.linalg.inv(offset.T_palm_board(wrong)), RIG)


def curled() -> Float:
    """Laser points (120, 5, 2) [px] of a hand that closes and opens twice."""
    hand = load(ROOT / "calib_json/hands/default-right.json", HandProfile)
    scene = WristScene.by_name("curl@indoor", RIG, {"wrist": CAMERA}, hand, 4)
    uv = np.array([scene.truth(t).laser_uv[1:6] for t in np.linspace(0.0, 0.5 * scene.period_s, 30)])
    uv = np.concatenate([uv, uv[::-1], uv, uv[::-1]])
    return uv + np.random.default_rng(0).normal(0.0, 0.3, uv.shape)


def slipped(uv: Float) -> Float:
    later = np.arange(len(uv)) >= len(uv) // 2
    return uv + 20.0 * later[:, None, None] * np.array([1.0, 0.0])


def few(uv: Float) -> Float:
    return uv[:15]


def never(uv: Float) -> Float:
    return np.full_like(uv, np.nan)


def at_rest(uv: Float) -> Float:
    return uv[:1] + 0.0 * uv


@pytest.mark.parametrize(
    ("spoil", "cause"),
    [
        (slipped, "the device slipped on"),
        (few, "15 points, at least 20"),
        (never, "0 points, at least 20"),
        (at_rest, "moved by 0.0 mm, at least 15 are needed: bend it to a fist"),
    ],
)
def test_a_curl_that_gives_no_lines_is_refused(spoil: Callable[[Float], Float], cause: str) -> None:
    normal, offset_m = laser_plane_of(RIG, "the rig")

    def points(uv: Float) -> Float:
        return intersect_plane(np.zeros(3), OPTICS.ray(uv), normal, offset_m)

    assert all(curl.line is not None for curl in fit_curls(points(curled())))
    with pytest.raises(FitError, match=cause):
        fit_curls(points(spoil(curled())))
