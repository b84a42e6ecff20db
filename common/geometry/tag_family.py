"""Codes of fiducial tags as printed: which cell of which tag is white.

OpenCV 4 and the first of 5 hold the AprilTag families turned by half a turn against the pictures that their authors
publish and everybody prints; a later 5 mends that (opencv/opencv pull request 28823). Here they are as published under
either. The ArUco families are OpenCV's own.
"""

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple, cast

import cv2
import numpy as np

from common.arrays import Image
from common.calibration.object_profile import TagFamily


class Grid(NamedTuple):
    """OpenCV's name of a family, cells of code along a side, number of tags."""

    opencv: str
    cells: int
    tags: int


GRIDS: dict[TagFamily, Grid] = {
    "apriltag_16h5": Grid("DICT_APRILTAG_16h5", 4, 30),
    "apriltag_25h9": Grid("DICT_APRILTAG_25h9", 5, 35),
    "apriltag_36h11": Grid("DICT_APRILTAG_36h11", 6, 587),
    "aruco_4x4_50": Grid("DICT_4X4_50", 4, 50),
    "aruco_5x5_100": Grid("DICT_5X5_100", 5, 100),
    "aruco_6x6_250": Grid("DICT_6X6_250", 6, 250),
}
# Tag 0 of 36h11 as published (AprilRobotics, tag36_11_00000.png), 1 = white.
PUBLISHED = ("110101", "011101", "011000", "101000", "010110", "000100")


def tag_bits(family: TagFamily, number: int) -> Image:
    """Code of a tag as printed, (cells, cells), 1 = white, row 0 on top, no border.

    Raises:
        ValueError: The family has no such tag.
    """
    grid = GRIDS[family]
    if not 0 <= number < grid.tags:
        raise ValueError(f"tag {number}: {family} has 0 to {grid.tags - 1}")
    bits = _opencv_bits(grid, number)
    return np.rot90(bits, 2).copy() if family.startswith("apriltag") and _upside_down() else bits


def tag_image(family: TagFamily, number: int, margin: int = 0) -> Image:
    """Image of a whole tag, one byte (0 or 255) a cell.

    Code, black border, `margin` cells of white paper around it.

    Raises:
        ValueError: The family has no such tag.
    """
    black = np.pad(tag_bits(family, number), 1)
    return (255 * np.pad(black, margin, constant_values=1)).astype(np.uint8)


def dictionary(family: TagFamily, numbers: Sequence[int]) -> cv2.aruco.Dictionary:
    """OpenCV dictionary that detects these tags, the first as 0; corners as printed.

    Raises:
        ValueError: The family has no such tag.
    """
    rows = [cv2.aruco.Dictionary.getByteListFromBits(tag_bits(family, number)) for number in numbers]
    return cv2.aruco.Dictionary(np.concatenate(rows), GRIDS[family].cells)


def _opencv_bits(grid: Grid, number: int) -> Image:
    known = cv2.aruco.getPredefinedDictionary(cast(int, getattr(cv2.aruco, grid.opencv)))
    bits = cv2.aruco.Dictionary.getBitsFromByteList(known.bytesList[number : number + 1], grid.cells)
    return np.asarray(bits, np.uint8)


@cache
def _upside_down() -> bool:
    """Whether this OpenCV holds the AprilTag families upside down."""
    published = np.array([[int(cell) for cell in row] for row in PUBLISHED], np.uint8)
    held = _opencv_bits(GRIDS["apriltag_36h11"], 0)
    return bool((np.rot90(held, 2) == published).all())
