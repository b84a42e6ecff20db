"""Codes of tags: as published, found again by OpenCV with the corners in the printed order."""

import cv2
import numpy as np
import pytest

from common.arrays import Image
from common.calibration.object_profile import TagFamily
from common.geometry import tag_family
from common.geometry.tag_family import GRIDS, Grid, dictionary, tag_bits, tag_image

# 0xd7e00984b of tag36h11.c, and the cells its bits belong to, in order (AprilRobotics, apriltag).
CODE = 0x0000000D7E00984B
CELLS = np.array(
    [
        [(1, 1), (2, 1), (3, 1), (4, 1), (5, 1), (2, 2), (3, 2), (4, 2), (3, 3)],
        [(6, 1), (6, 2), (6, 3), (6, 4), (6, 5), (5, 2), (5, 3), (5, 4), (4, 3)],
        [(6, 6), (5, 6), (4, 6), (3, 6), (2, 6), (5, 5), (4, 5), (3, 5), (4, 4)],
        [(1, 6), (1, 5), (1, 4), (1, 3), (1, 2), (2, 5), (2, 4), (2, 3), (3, 4)],
    ]
)


def test_the_first_april_tag_is_the_published_one() -> None:
    published = np.zeros((6, 6), np.uint8)
    for place, (x, y) in enumerate(CELLS.reshape(-1, 2)):
        published[y - 1, x - 1] = CODE >> (35 - place) & 1
    np.testing.assert_array_equal(tag_bits("apriltag_36h11", 0), published)


def test_it_is_so_under_an_opencv_that_holds_it_upright(monkeypatch: pytest.MonkeyPatch) -> None:
    was, held = tag_bits("apriltag_25h9", 7), tag_family._opencv_bits

    def upright(grid: Grid, number: int) -> Image:
        return np.rot90(held(grid, number), 2)

    rotated = not tag_family._upside_down()
    tag_family._upside_down.cache_clear()
    monkeypatch.setattr(tag_family, "_opencv_bits", upright)
    try:
        assert tag_family._upside_down() is rotated
        np.testing.assert_array_equal(tag_bits("apriltag_25h9", 7), was)
    finally:
        tag_family._upside_down.cache_clear()


@pytest.mark.parametrize("family", GRIDS)
def test_opencv_finds_the_tag_with_its_corners_as_printed(family: TagFamily) -> None:
    last = GRIDS[family].tags - 1
    image = np.kron(tag_image(family, last, 2), np.ones((10, 10), np.uint8))
    corners, found, _ = cv2.aruco.ArucoDetector(dictionary(family, [3, last])).detectMarkers(image)
    assert found is not None
    assert found.ravel().tolist() == [1]
    low, high = 20.0, image.shape[0] - 21.0
    printed = [[low, low], [high, low], [high, high], [low, high]]
    np.testing.assert_allclose(corners[0].reshape(4, 2), printed, atol=1.0)


@pytest.mark.parametrize("number", [-1, 30])
def test_a_tag_that_the_family_does_not_have_is_refused(number: int) -> None:
    with pytest.raises(ValueError, match="apriltag_16h5 has 0 to 29"):
        tag_bits("apriltag_16h5", number)
