"""The simulated card: drawn where the cameras must see it, at the distances that are promised, in a marker's paint."""

from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from common.arrays import Float, Image
from common.calibration import CameraCalibration, RigCalibration, load
from common.errors import CalibrationError
from common.geometry.srgb import to_linear
from common.geometry.transforms import transform
from common.sim.board import BOARD, BoardRenderer
from common.sim.scenes import DISTANCES_M, HEIGHT_M, MARKER, WIDTH_M, CardScene

CALIB = Path(__file__).parents[3] / "calib_json"
RIG = load(CALIB / "rigs" / "desk.json", RigCalibration)
CAMERAS = {name: load(CALIB / "cameras" / f"{name}.json", CameraCalibration) for name in RIG.cameras}
SCENE = CardScene(RIG, CAMERAS, 7)
STEP_S = BOARD.held_s + BOARD.moved_s
SIDE = np.linspace(-0.5, 0.5, 50)


def outline(camera: str, place: int) -> Float:
    """The card's outline (200, 2) [px] by the exact projection of its edges, which the lens bends."""
    low, high = np.full_like(SIDE, -0.5), np.full_like(SIDE, 0.5)
    x, y = np.concatenate([SIDE, high, -SIDE, low]), np.concatenate([low, SIDE, high, -SIDE])
    edge = np.stack([WIDTH_M * x, HEIGHT_M * y, np.zeros_like(x)], axis=1)
    return SCENE.optics[camera].project(transform(SCENE.poses[place], edge))


def centroid(polygon: Float) -> Float:
    """Centroid (2,) of the area that a polygon (N, 2) encloses, by Green's theorem."""
    a, b = polygon, np.roll(polygon, -1, axis=0)
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return ((a + b) * cross[:, None]).sum(axis=0) / (3.0 * cross.sum())


def seen(image: Image, around: Float) -> Float:
    """Centroid (2,) [px] of the green light that the picture has more than its wall, near an outline."""
    light = to_linear(image[..., 1] / 255.0)
    low, high = np.floor(around.min(axis=0)).astype(int) - 4, np.ceil(around.max(axis=0)).astype(int) + 5
    box = light[low[1] : high[1], low[0] : high[0]] - np.median(light)
    v, u = np.indices(box.shape)
    return low + np.array([(box * u).sum(), (box * v).sum()]) / box.sum()


@pytest.mark.parametrize("camera", RIG.cameras)
def test_the_card_is_drawn_where_the_camera_sees_it(camera: str) -> None:
    renderer = BoardRenderer(SCENE, camera)
    for place in (0, 4, 8):
        expected = outline(camera, place)
        frames = [seen(renderer.render(place * STEP_S + 0.1 * k), expected) for k in range(4)]
        np.testing.assert_allclose(np.mean(frames, axis=0), centroid(expected), atol=0.03)


def test_it_is_held_at_the_distances_between_the_lenses_and_faces_them() -> None:
    left, right = (RIG.camera_pose(name) for name in RIG.cameras)
    for place, distance_m in enumerate(DISTANCES_M):
        T = SCENE.T_rig_board(place * STEP_S + 0.5 * BOARD.held_s)
        middle = T[:3, 3] - 0.5 * (left[:3, 3] + right[:3, 3])
        assert (T[:3, 3] - left[:3, 3]) @ left[:3, 2] == pytest.approx(distance_m, abs=1e-12)
        np.testing.assert_allclose(np.cross(middle, left[:3, 2]), 0.0, atol=1e-12)
        np.testing.assert_allclose(T[:3, 2], left[:3, 2], atol=1e-12)


def test_the_distances_span_the_volume_of_the_desk_and_what_a_fit_asks_for() -> None:
    assert RIG.volume is not None
    assert min(DISTANCES_M) < RIG.volume.low_m[2] < RIG.volume.high_m[2] < max(DISTANCES_M)
    assert max(DISTANCES_M) > 2.5 * min(DISTANCES_M)


def test_its_colour_is_that_of_the_marker_in_the_camera_files() -> None:
    bgr = BoardRenderer(SCENE, "left").render(0.0)[238:242, 338:342].reshape(1, -1, 3)
    hue, saturation, value = np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2HSV)).reshape(-1, 3).mean(axis=0)
    colour = (CAMERAS["left"].markers or {})[MARKER]
    for x, low, high in zip((hue, saturation, value), colour.hsv_low, colour.hsv_high, strict=True):
        assert low <= x <= high


def test_held_frames_differ_by_noise_alone_and_moved_ones_by_the_card() -> None:
    renderer = BoardRenderer(SCENE, "left")
    first, second = renderer.render(0.0), renderer.render(0.1)
    assert (first != second).any()
    again = renderer.render(0.0)
    np.testing.assert_array_equal(again, first)  # of what was kept as of what is drawn afresh
    moved = renderer.render(14 * (BOARD.held_s + BOARD.moved_s) + BOARD.held_s + 0.5 * BOARD.moved_s)
    assert np.abs(second.astype(int) - first).max() < 25 < np.abs(moved.astype(int) - first).max()


def test_one_camera_is_refused() -> None:
    alone = msgspec.structs.replace(RIG, cameras=("left",))
    with pytest.raises(CalibrationError, match="scene card: rig 'desk' has one camera, a depth needs two"):
        CardScene(alone, CAMERAS, 7)
