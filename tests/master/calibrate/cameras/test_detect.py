"""Corners found in rendered images, against truth in pixels; boards found, told apart and advised about."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from common.arrays import Image
from common.errors import CalibrationError, FitError
from common.geometry.transforms import axis_rotation, rigid
from master.calibrate.cameras.boards import (
    Board,
    Charuco,
    Checkerboard,
    CircleGrid,
    board_corners,
    find_board,
    orderings,
)
from master.calibrate.cameras.views import look
from tests.master.calibrate.cameras.board_images import render
from tests.master.calibrate.cameras.board_scenes import scene

CHECKER = Checkerboard(9, 6, 0.025)
CHARUCO = Charuco(7, 5, 0.035, 0.026)
CIRCLES = CircleGrid(7, 5, 0.035, 0.0175)


@pytest.mark.parametrize(
    ("board", "median_px"), [(CHECKER, 0.06), (CHARUCO, 0.15)], ids=["checkerboard", "charuco"]
)
def test_corners_are_found_to_a_fraction_of_a_pixel(board: Board, median_px: float) -> None:
    truth = scene(21, 1, views=6, board=board)
    off: list[float] = []
    for view in range(6):
        seen = find_board(board, render(truth, view, "left", seed=21))
        assert seen is not None
        assert seen.seen >= 0.8 * len(board_corners(board))
        off.append(float(np.sqrt(np.nanmean((seen.corners_px - truth.corners(view, "left")) ** 2))))
    assert np.median(off) < median_px
    assert max(off) < 4 * median_px


def test_centres_of_circles_are_found_and_not_those_of_ellipses() -> None:
    truth = scene(21, 1, views=6, board=CIRCLES)
    off: list[float] = []
    for view in range(6):
        seen = find_board(CIRCLES, render(truth, view, "left", seed=21))
        if view == 2:  # the image's border cuts a circle
            assert seen is None
            continue
        assert seen is not None
        true = truth.corners(view, "left")  # half a turn looks the same
        off.append(min(float(np.sqrt(np.mean((seen.corners_px[o] - true) ** 2))) for o in orderings(CIRCLES)))
        assert seen.blur_px == pytest.approx(1.0, rel=0.3)
    assert np.median(off) < 0.03  # centres of ellipses are off by 0.1 and more
    assert max(off) < 0.1


def test_an_upside_down_picture_has_the_same_corners_in_the_same_order() -> None:
    truth = scene(22, 1, views=1, board=CHECKER)
    image = render(truth, 0, "left", seed=22)
    upright = find_board(CHECKER, image)
    rotated = find_board(CHECKER, np.ascontiguousarray(image[::-1, ::-1]))
    assert upright is not None
    assert rotated is not None
    back = np.array([image.shape[1] - 1, image.shape[0] - 1]) - rotated.corners_px
    np.testing.assert_allclose(back, upright.corners_px, atol=0.05)


def test_blur_is_measured() -> None:
    truth = scene(23, 1, views=1, board=CHECKER)
    for sigma in (1.0, 2.0, 4.0):
        seen = find_board(CHECKER, render(truth, 0, "left", seed=23, blur_px=sigma))
        assert seen is not None
        assert seen.blur_px == pytest.approx(sigma, rel=0.3)
    image = render(truth, 0, "left", seed=23)
    smeared = find_board(CHECKER, cv2.blur(image, (13, 1)).astype(np.uint8))
    assert smeared is not None
    assert smeared.blur_px > 2.5  # the worse of the two directions: 13 px of motion


def test_a_board_cut_off_or_absent_is_not_found() -> None:
    truth = scene(24, 1, views=1, board=CHECKER)
    image = render(truth, 0, "left", seed=24)
    left = int(truth.corners(0, "left")[:, 0].min())
    assert find_board(CHECKER, np.ascontiguousarray(image[:, left + 40 :])) is None
    noise = np.random.default_rng(24).integers(0, 255, (240, 320), dtype=np.uint8)
    assert find_board(CHECKER, noise) is None
    assert find_board(CHARUCO, noise) is None


def _look(board: Board, *images: Image) -> None:
    look(board, [(str(i), {"left": lambda image=image: image}) for i, image in enumerate(images)])


def test_the_board_that_is_there_is_named_when_another_was_asked_for() -> None:
    image = render(scene(25, 1, views=1, board=CHECKER), 0, "left", seed=25)
    with pytest.raises(FitError, match=r"10 x 7 inner corners.* in any of 1 images: they show a .* 9 x 6"):
        _look(Checkerboard(10, 7, 0.025), image)
    with pytest.raises(FitError, match="count the inner corners"):
        _look(Checkerboard(4, 3, 0.025), np.full((120, 160), 128, np.uint8))
    charuco = render(scene(26, 1, views=1, board=CHARUCO), 0, "left", seed=26)
    with pytest.raises(FitError, match=r"they show a ChArUco board of 7 x 5 .* 4X4"):
        _look(Charuco(7, 5, 0.035, 0.026, "6X6_250"), charuco)
    with pytest.raises(FitError, match="the pictures are mirrored"):
        _look(CHARUCO, np.ascontiguousarray(charuco[:, ::-1]))
    with pytest.raises(FitError, match="there is no image"):
        look(CHECKER, [])


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("old_layout", [False, True])
def test_a_charuco_board_is_taken_as_it_is_printed(old_layout: bool, inverted: bool) -> None:
    asked, printed = Charuco(7, 6, 0.035, 0.026), Charuco(7, 6, 0.035, 0.026, old_layout=old_layout)
    truth = scene(27, 1, views=2, board=printed)
    images = [render(truth, view, "left", seed=27) for view in range(2)]
    if inverted:
        images = [255 - image for image in images]
    views = look(asked, [(str(i), {"left": lambda image=image: image}) for i, image in enumerate(images)])
    assert views.board == replace(printed, inverted=inverted)
    assert ("OpenCV before 4.6" in str(views.board), "white on black" in str(views.board)) == (
        old_layout,
        inverted,
    )
    assert not views.unseen
    for view, (_, seen) in enumerate(views.of("left")):
        assert np.sqrt(np.nanmean((seen.corners_px - truth.corners(view, "left")) ** 2)) < 0.3


def test_images_of_two_modes_are_refused() -> None:
    image = render(scene(25, 1, views=1, board=CHECKER), 0, "left", seed=25)
    with pytest.raises(FitError, match="'left': view 1 is 320 x 240 px, the views before it 640 x 480"):
        _look(CHECKER, image, cv2.resize(image, (320, 240)).astype(np.uint8))


def test_impossible_boards_are_refused() -> None:
    with pytest.raises(CalibrationError, match="at least 3 x 3"):
        Checkerboard(2, 6, 0.025)
    with pytest.raises(CalibrationError, match=r"between 0.5 mm and 1 m"):
        Checkerboard(9, 6, 25.0)
    with pytest.raises(CalibrationError, match="smaller than the square"):
        Charuco(7, 5, 0.02, 0.03)
    with pytest.raises(CalibrationError, match="no dictionary '4X4_51'"):
        Charuco(7, 5, 0.03, 0.02, "4X4_51")
    with pytest.raises(CalibrationError, match="needs 70 markers, dictionary 4X4_50 has 50"):
        Charuco(14, 10, 0.03, 0.02)
    assert [
        len(orderings(b)) for b in (CHECKER, CHARUCO, Checkerboard(7, 5, 0.01), Checkerboard(6, 6, 0.01))
    ] == [
        1,
        1,
        2,
        4,
    ]


def test_corners_of_a_board_seen_from_the_side_are_as_good() -> None:
    truth = scene(28, 1, views=1, board=Charuco(4, 5, 0.054, 0.0405))
    middle = board_corners(truth.board).mean(axis=0)
    for tilt_deg in (60.0, 66.0, 70.0):
        turn = axis_rotation(2, 0.6) @ axis_rotation(1, np.radians(tilt_deg)) @ axis_rotation(2, 0.4)
        tilted = replace(truth, T_rig_board=rigid(turn, np.array([0.0, 0.0, 0.6]) - turn @ middle)[None])
        seen = find_board(truth.board, render(tilted, 0, "left", seed=28, blur_px=0.5))
        assert seen is not None
        assert seen.seen == 12
        assert np.sqrt(np.mean((seen.corners_px - tilted.corners(0, "left")) ** 2)) < 0.2
