"""The boards whose corners are known: checkerboard and ChArUco.

Frame of a board: origin at its first inner corner, x along the columns, y down the rows, z into the board, so that a
board seen upright from the front is nearly unrotated in the camera's frame. Corners are numbered row by row.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from common.arrays import Float, Int
from common.errors import CalibrationError

DICTIONARIES = {
    name.removeprefix("DICT_"): getattr(cv2.aruco, name)
    for name in dir(cv2.aruco)
    if name.startswith("DICT_") and name[5].isdigit()
}


@dataclass(frozen=True, slots=True)
class Checkerboard:
    """A checkerboard by its inner corners.

    Attributes:
        columns, rows: Inner corners along x and y (squares less one), at least 3.
        square_m: Side of a square [m].
    """

    columns: int
    rows: int
    square_m: float

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3:
            raise CalibrationError(f"{self}: a checkerboard needs at least 3 x 3 inner corners")
        _check_length(self, "square", self.square_m)

    def __str__(self) -> str:
        return f"checkerboard of {self.columns} x {self.rows} inner corners, squares of {self.square_m * 1e3:g} mm"


@dataclass(frozen=True, slots=True)
class Charuco:
    """ChArUco board whose corners are identified by markers.

    OpenCV's present pattern (first square dark).

    Attributes:
        columns, rows: Squares along x and y, at least 3.
        square_m, marker_m: Side of a square and of a marker [m].
        dictionary: Name of the marker family without `DICT_`, such as 4X4_50.
    """

    columns: int
    rows: int
    square_m: float
    marker_m: float
    dictionary: str = "4X4_50"

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3:
            raise CalibrationError(f"{self}: a ChArUco board needs at least 3 x 3 squares")
        _check_length(self, "square", self.square_m)
        _check_length(self, "marker", self.marker_m)
        if self.marker_m >= self.square_m:
            raise CalibrationError(f"{self}: the marker must be smaller than the square")
        if self.dictionary not in DICTIONARIES:
            raise CalibrationError(
                f"{self}: no dictionary {self.dictionary!r}; there are {', '.join(DICTIONARIES)}"
            )
        needed, held = self.columns * self.rows // 2, len(self.markers().bytesList)
        if needed > held:
            raise CalibrationError(f"{self}: needs {needed} markers, dictionary {self.dictionary} has {held}")

    def __str__(self) -> str:
        return (
            f"ChArUco board of {self.columns} x {self.rows} squares of {self.square_m * 1e3:g} mm,"
            f" markers of {self.marker_m * 1e3:g} mm from {self.dictionary}"
        )

    def markers(self) -> cv2.aruco.Dictionary:
        """OpenCV's table of the markers."""
        return cv2.aruco.getPredefinedDictionary(DICTIONARIES[self.dictionary])

    def pattern(self) -> cv2.aruco.CharucoBoard:
        """The board as OpenCV knows it."""
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_m, self.marker_m, self.markers())


Board = Checkerboard | Charuco


def grid_shape(board: Board) -> tuple[int, int]:
    """Rows and columns of the inner corners."""
    if isinstance(board, Checkerboard):
        return board.rows, board.columns
    return board.rows - 1, board.columns - 1


def board_corners(board: Board) -> Float:
    """Inner corners (N, 3) [m] in the board's frame, row by row, z = 0."""
    rows, columns = grid_shape(board)
    y, x = np.mgrid[0:rows, 0:columns]
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) * board.square_m


def grid_edges(board: Board) -> Int:
    """Return pairs of corner numbers that are one square apart.

    Shape (E, 2): along the rows first, then down the columns.
    """
    rows, columns = grid_shape(board)
    n = np.arange(rows * columns).reshape(rows, columns)
    along = np.stack([n[:, :-1].ravel(), n[:, 1:].ravel()], axis=1)
    down = np.stack([n[:-1].ravel(), n[1:].ravel()], axis=1)
    return np.concatenate([along, down]).astype(np.int64)


def orderings(board: Board) -> tuple[Int, ...]:
    """Return the rotations of the pattern that look the same.

    Orders (N,) of corner numbers, the unrotated one first.

    A ChArUco board has one. A checkerboard with an odd sum of columns and rows has one too, because its colours set
    its ends apart; other checkerboards look the same after half a turn, square ones also after a quarter.
    """
    rows, columns = grid_shape(board)
    n = np.arange(rows * columns).reshape(rows, columns)
    if isinstance(board, Charuco):
        return (n.ravel(),)
    # Square (0, 0) keeps its colour if the sum of its indices stays even: after half a turn it is (rows-2, cols-2).
    found = [n]
    if (rows + columns) % 2 == 0:
        found.append(np.rot90(n, 2))
    if rows == columns and columns % 2 == 0:
        found += [np.rot90(n, 1), np.rot90(n, 3)]
    return tuple(rotated.ravel() for rotated in found)


def _check_length(board: object, what: str, length_m: float) -> None:
    # From a stamp under a microscope to a wall: outside, the unit was mistaken.
    if not 5e-4 <= length_m <= 1.0:
        raise CalibrationError(f"{board}: the {what} must be between 0.5 mm and 1 m (give it in mm)")
