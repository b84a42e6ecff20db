"""A recording whose passes disagree about the principal point is told from one of a camera, at rest or in motion."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from common.arrays import Float, Image
from common.camera_model import CameraModel
from slave.cameras.source import Frame
from slave.wrist.background import lit
from slave.wrist.registration import led_shift, shifted
from slave.wrist.strobe import Triple
from tests.slave.wrist.wrist_frames import VIEW, strobed

MIDDLE = np.array([319.5, 239.5])


def optics(principal_off_px: tuple[float, float]) -> CameraModel:
    """The device's camera with its principal point so far off the middle of the image."""
    matrix = VIEW.optics.matrix.copy()
    matrix[:2, 2] = MIDDLE + principal_off_px
    return replace(VIEW.optics, matrix=matrix)


def triples(led_px: Float, name: str = "standard") -> list[Triple]:
    """Triples from all over a scene, the light of the LEDs moved by (2,) [px]."""
    shown: list[Triple] = []
    for start_s in np.arange(0.0, 24.0, 3.0):
        ambient, laser, led = strobed(name, 1, 5, float(start_s))
        light = shifted(lit(led.image, ambient.image), led_px)
        shown.append(Triple(ambient, laser, replace(led, image=cv2.add(ambient.image, light))))
    return shown


@pytest.mark.parametrize("off_px", [(2.8, -2.7), (-4.0, 1.0), (1.3, 6.0)])
@pytest.mark.parametrize("name", ["standard", "curl@bright"])
def test_a_mirrored_principal_point_is_found(off_px: tuple[float, float], name: str) -> None:
    mirrored = -2.0 * np.array(off_px)
    np.testing.assert_allclose(led_shift(triples(mirrored, name), optics(off_px)), mirrored)


@pytest.mark.parametrize("name", ["standard", "curl@bright", "poses"])
def test_frames_of_one_lens_are_left_as_they_are(name: str) -> None:
    assert not led_shift(triples(np.zeros(2), name), optics((2.8, -2.7))).any()


def test_another_shift_is_none_of_its_business() -> None:
    assert not led_shift(triples(np.array([5.6, 5.4])), optics((2.8, -2.7))).any()
    assert not led_shift(triples(np.array([-14.0, 5.4])), optics((2.8, -2.7))).any()


def test_what_cannot_be_measured_is_not_believed() -> None:
    mirrored = np.array([-1.0, 8.0])
    assert not led_shift(triples(mirrored), optics((0.5, -4.0))).any()
    dark = Frame(0, 0, 0, np.zeros((480, 640), np.uint8))
    bright = Frame(0, 0, 0, np.full((480, 640), 255, np.uint8))
    for frames in ([], [Triple(dark, dark, dark)], [Triple(dark, bright, bright)] * 30):
        assert not led_shift(frames, optics((2.8, -2.7))).any()


def test_an_image_moves_by_parts_of_pixels() -> None:
    image: Image = np.zeros((40, 50), np.uint8)
    image[20, 30] = 200
    moved = shifted(image, np.array([-3.5, 2.0]))
    assert moved[22, 26] == moved[22, 27] == 100
    assert moved.sum() == 200
    assert shifted(image, np.zeros(2)) is image
