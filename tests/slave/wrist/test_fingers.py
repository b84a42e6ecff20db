"""Seams between fingers: beside every finger of a rendered hand, never crossing, and there in the dark, too."""

import dataclasses

import cv2
import numpy as np
import pytest
from msgspec.structs import replace

from common.arrays import Image
from common.errors import CalibrationError
from common.geometry.transforms import axis_rotation
from common.hand.profiles import mirrored_profile
from common.recording.frame_recording import Illumination
from slave.wrist.laser import NONE, separate
from slave.wrist.led_image import WristView
from slave.wrist.seams import search_bands_of
from slave.wrist.strobe import lit
from tests.slave.wrist.wrist_frames import CAMERA, HAND, RIG, VIEW, renderer, scene

BLACK = np.zeros((400, 640), dtype=np.uint8)


def led_images(name: str, count: int, seed: int) -> list[tuple[float, Image]]:
    """Differences of LED and ambient frame at times spread over a scene."""
    device = renderer(name, seed)
    times = [scene(name, seed).period_s * k / count for k in range(count)]
    return [
        (t, lit(device.render(t, Illumination.LED), device.render(t, Illumination.AMBIENT))) for t in times
    ]


@pytest.mark.parametrize(("name", "seed"), [("curl@indoor", 11), ("spread@dark", 12), ("spread@bright", 13)])
def test_laser_points_and_tips_lie_on_their_own_fingers(name: str, seed: int) -> None:
    right = total = 0
    for t, image in led_images(name, 12, seed):
        fingers = separate(image, VIEW)
        assert fingers.shown
        truth = scene(name, seed).truth(t)
        long = truth.laser_len_vis[1:6] > 0.01
        found = fingers.finger_of(truth.laser_uv[1:6])
        right += int((found == np.arange(5))[long].sum())
        total += int(long.sum())
    assert right >= 0.95 * total


def test_the_seams_of_fingers_never_cross() -> None:
    for _, image in led_images("standard@indoor", 12, 3):
        seams = separate(image, VIEW).seams[:3]
        assert (np.diff(search_bands_of(VIEW).thumb_side * seams, axis=0) <= 0.0).all()


@pytest.mark.parametrize("image", [BLACK, np.full_like(BLACK, 255), np.full_like(BLACK, 12)])
def test_an_image_without_a_hand_has_the_seams_of_geometry(image: Image) -> None:
    fingers = separate(image, VIEW)
    search_bands = search_bands_of(VIEW)
    assert (np.abs(fingers.seams - search_bands.middle) <= search_bands.half + 1e-9).all()
    rest = VIEW.model.forward(VIEW.T_camera_palm, np.zeros((5, 4))).position_m
    knuckles = VIEW.optics.project(rest[[8, 13, 18, 23]])
    np.testing.assert_array_equal(fingers.finger_of(knuckles), [1, 2, 3, 4])


def test_a_black_image_is_reported() -> None:
    assert not separate(BLACK, VIEW).shown


def test_a_left_hand_has_its_thumb_on_the_other_side() -> None:
    rotated = np.diag([-1.0, 1.0, 1.0, 1.0]) @ VIEW.T_camera_palm @ np.diag([-1.0, 1.0, 1.0, 1.0])
    rig = replace(RIG, T_camera_palm=tuple(tuple(row) for row in rotated.tolist()))
    left = search_bands_of(WristView.of(rig, CAMERA, mirrored_profile(HAND)))
    assert left.thumb_side == -search_bands_of(VIEW).thumb_side
    mirror = 2.0 * VIEW.optics.matrix[0, 2]
    np.testing.assert_allclose(left.middle[:3], mirror - search_bands_of(VIEW).middle[:3], atol=1.0)


def test_a_pixel_that_is_not_seen_is_on_no_finger() -> None:
    fingers = separate(BLACK, VIEW)
    np.testing.assert_array_equal(fingers.finger_of(np.array([[np.nan, 3.0]])), [NONE])
    assert len(fingers.finger_of(np.empty((0, 2)))) == 0


def test_a_crease_between_touching_fingers_is_the_seam() -> None:
    """Two bright bars that touch in a darker line, drawn where index and middle hang."""
    search_bands = search_bands_of(VIEW)
    image = np.zeros_like(BLACK)
    crease = search_bands.middle[0] + 0.3 * search_bands.half[0]
    for k, u in enumerate(crease.tolist()):
        row = int(search_bands.rows[k])
        cv2.rectangle(image, (int(u) - 45, row - 5), (int(u) + 45, row + 5), 120, -1)
        cv2.rectangle(image, (int(u) - 3, row - 5), (int(u) + 3, row + 5), 60, -1)
    found = separate(image, VIEW).seams[0]
    inside = slice(12, 36)
    assert np.abs(found - crease)[inside].max() < 8.0


@pytest.mark.parametrize(("rotated_deg", "part"), [(-100.0, "fingers"), (60.0, "thumb")])
def test_a_palm_whose_fingers_the_camera_cannot_see_is_refused(rotated_deg: float, part: str) -> None:
    T = VIEW.T_camera_palm.copy()
    T[:3, :3] = axis_rotation(0, np.radians(rotated_deg)) @ T[:3, :3]
    with pytest.raises(CalibrationError, match=f"T_camera_palm: the camera does not see the {part}"):
        search_bands_of(dataclasses.replace(VIEW, T_camera_palm=T))
