"""The laser's line on a board in one view: sub-pixel, only on the board, and nothing made of what is no line."""

import cv2
import numpy as np
import pytest

from common.arrays import Image
from common.errors import FitError
from common.recording.frame_recording import Illumination
from master.calibrate.wrist.device import BoardPose, board_pose
from master.calibrate.wrist.laser_line import line_on_board
from tests.master.calibrate.wrist.devices import BOARD, OPTICS, cycles_of, plane_of, scene_of, view_of

SEED, VIEWS = 11, 1
AMBIENT, LASER, LED = Illumination.AMBIENT, Illumination.LASER, Illumination.LED


def first() -> tuple[dict[Illumination, Image], BoardPose]:
    frames = cycles_of(SEED, VIEWS)[0]
    return dict(frames), board_pose(view_of("0", frames), BOARD, OPTICS)


def off_plane_mm(laser: Image, ambient: Image, placed: BoardPose) -> float:
    """Largest distance of a point from the true plane."""
    plane = plane_of(SEED)
    points = line_on_board(laser, ambient, placed, BOARD, OPTICS).points_m
    return float(1e3 * np.abs(points @ np.array(plane.normal) - plane.offset_m).max())


def test_the_board_is_where_it_was_rendered() -> None:
    _, placed = first()
    true = scene_of(SEED, VIEWS).poses[0]
    rotated = np.degrees(np.arccos((np.trace(placed.T_camera_board[:3, :3].T @ true[:3, :3]) - 1.0) / 2.0))
    assert rotated < 0.2
    assert 1e3 * np.linalg.norm(placed.T_camera_board[:3, 3] - true[:3, 3]) < 0.3
    sigma_mm = 1e3 * np.sqrt(np.diag(placed.covariance)[3:])
    assert (sigma_mm < 0.2).all()


def test_points_lie_on_the_laser_and_within_the_squares() -> None:
    frames, placed = first()
    assert off_plane_mm(frames[LASER], frames[AMBIENT], placed) < 0.15
    points = line_on_board(frames[LASER], frames[AMBIENT], placed, BOARD, OPTICS).points_m
    on_board = (points - placed.T_camera_board[:3, 3]) @ placed.T_camera_board[:3, :3] / BOARD.square_m
    assert ((on_board[:, :2] > -1.0) & (on_board[:, :2] < [9.0, 6.0])).all()
    assert np.abs(on_board[:, 2]).max() < 1e-6


def test_a_brighter_line_on_the_table_next_to_the_board_is_not_taken() -> None:
    frames, placed = first()
    laser = frames[LASER].copy()
    corners = OPTICS.project(placed.T_camera_board[:3, 3] + np.zeros((1, 3)))
    outside = 470 if corners[0, 1] < 300 else 8
    laser[outside : outside + 3] = 255
    assert off_plane_mm(laser, frames[AMBIENT], placed) < 0.15


def test_specks_of_glare_on_the_board_do_not_bend_the_line() -> None:
    frames, placed = first()
    laser = frames[LASER].copy()
    middle = OPTICS.project(placed.centre_m[None])[0]
    cv2.circle(laser, (round(middle[0]) - 6, round(middle[1]) - 6), 4, 255, -1)
    assert off_plane_mm(laser, frames[AMBIENT], placed) < 0.3


def test_a_line_along_the_border_of_two_rows_is_refused() -> None:
    frames, placed = first()
    laser = frames[AMBIENT].copy()
    ends = (
        placed.T_camera_board[:3, 3]
        + BOARD.square_m * np.array([[-1.0], [9.0]]) * placed.T_camera_board[:3, 0]
    )
    a, b = np.rint(OPTICS.project(ends)).astype(int).tolist()
    cv2.line(laser, a, b, 255, 2)
    with pytest.raises(FitError, match=r"along the border of two rows .*: shift the board"):
        line_on_board(laser, frames[AMBIENT], placed, BOARD, OPTICS)


@pytest.mark.parametrize("colour", [0, 1, 2], ids=["blue", "green", "red"])
def test_a_broad_line_of_any_colour_is_as_good(colour: int) -> None:
    frames, placed = first()
    ambient = np.repeat(frames[AMBIENT][..., None], 3, axis=2)
    light = np.clip(frames[LASER].astype(float) - frames[AMBIENT], 0.0, None)
    laser = ambient.astype(float)
    laser[..., colour] += 4.0 * cv2.GaussianBlur(light, (0, 0), 5.0)
    both = np.clip(laser.round(), 0, 255).astype(np.uint8)
    assert off_plane_mm(both, ambient, placed) < 0.3


@pytest.mark.parametrize(
    ("kind", "match"),
    [(AMBIENT, "no laser line"), (LED, "no laser line|less than a square|no straight line")],
)
def test_a_frame_of_another_kind_gives_no_line(kind: Illumination, match: str) -> None:
    # Frames that slipped by one: what is called the laser frame is another.
    frames, placed = first()
    with pytest.raises(FitError, match=match):
        line_on_board(frames[kind], frames[AMBIENT], placed, BOARD, OPTICS)


@pytest.mark.parametrize("level", [0, 255])
def test_black_and_white_images_give_no_line(level: int) -> None:
    frames, placed = first()
    flat = np.full_like(frames[LASER], level)
    with pytest.raises(FitError):
        line_on_board(flat, frames[AMBIENT], placed, BOARD, OPTICS)
    with pytest.raises(FitError):
        line_on_board(flat, flat, placed, BOARD, OPTICS)


def test_a_board_that_moved_between_the_frames_is_refused() -> None:
    frames, _ = first()
    frames[LED] = np.roll(frames[LED], 4, axis=1)
    with pytest.raises(FitError, match=r"moved by [34]\.\d px .* hold it still"):
        board_pose(view_of("0", frames), BOARD, OPTICS)


def test_a_constant_speed_is_taken_out_by_the_mean_of_both_ends() -> None:
    frames, placed = first()
    moved_px = 0.8  # more than a pixel is refused
    later = (1.0 - moved_px) * frames[LED] + moved_px * np.roll(frames[LED], 1, axis=1)
    frames[LED] = np.rint(later).astype(np.uint8)
    frames.pop(LASER)
    between = board_pose(view_of("0", frames), BOARD, OPTICS)
    moved = OPTICS.project(between.centre_m) - OPTICS.project(placed.centre_m)
    np.testing.assert_allclose(moved, [0.5 * moved_px, 0.0], atol=0.1)


@pytest.mark.parametrize("level", [0, 255])
def test_no_board_is_reported(level: int) -> None:
    blank = np.full((400, 640), level, np.uint8)
    with pytest.raises(FitError, match="no board found"):
        board_pose(view_of("0", {AMBIENT: blank, LED: blank}), BOARD, OPTICS)
