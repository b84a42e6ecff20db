"""A board has known corners, and they are found in an image.

Frame of a board: origin at its first inner corner, x along the columns, y down the rows, z into the board, so
that a board seen upright from the front is nearly unrotated in the camera's frame. Corners are numbered row
by row.

Checkerboards are located by OpenCV's classic finder, where it fails by the sector-based one. The place is
refined by `cornerSubPix` in a window of half the distance to the next grid line, which on rendered boards is
twice as good as the sector-based finder's own (0.05 against 0.10 px). Corners of the outermost row look out
on squares that are often cut to half; their window is smaller. On a ChArUco board, which is seen in part and
from the side as well, the window is one of the board seen from the front, and ends where the markers begin.
"""

import re
from argparse import Namespace
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import cast

import cv2
import numpy as np

from common.arrays import Float, Image, Int
from common.errors import CalibrationError

DICTIONARIES = {
    name.removeprefix("DICT_"): getattr(cv2.aruco, name)
    for name in dir(cv2.aruco)
    if name.startswith("DICT_") and name[5].isdigit()
}


@dataclass(frozen=True, slots=True)
class Checkerboard:
    """A checkerboard by its inner corners."""

    columns: int  # this and rows: inner corners along x and y (squares less one), at least 3
    rows: int
    square_m: float  # side of a square [m]

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3:
            raise CalibrationError(f"{self}: a checkerboard needs at least 3 x 3 inner corners")
        _check_length(self, "square", self.square_m)

    def __str__(self) -> str:
        return f"checkerboard of {self.columns} x {self.rows} inner corners, squares of {self.square_m * 1e3:g} mm"


@dataclass(frozen=True, slots=True)
class Charuco:
    """ChArUco board: markers identify its corners.

    Its first square is dark; in the `old_layout`, that of OpenCV before 4.6, it is light where rows are even.
    """

    columns: int  # this and rows: squares along x and y, at least 3
    rows: int
    square_m: float  # this and marker_m: side of a square and of a marker [m]
    marker_m: float
    dictionary: str = "4X4_50"  # name of the marker family without `DICT_`, such as 4X4_50
    old_layout: bool = False
    inverted: bool = False  # printed white on black

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
            f"{', in the layout of OpenCV before 4.6' * self.old_layout}{', white on black' * self.inverted}"
        )

    def markers(self) -> cv2.aruco.Dictionary:
        """OpenCV's table of the markers."""
        return cv2.aruco.getPredefinedDictionary(DICTIONARIES[self.dictionary])

    def pattern(self) -> cv2.aruco.CharucoBoard:
        """The board as OpenCV knows it."""
        size = self.columns, self.rows
        board = cv2.aruco.CharucoBoard(size, self.square_m, self.marker_m, self.markers())
        board.setLegacyPattern(self.old_layout)
        return board

    def layouts(self) -> Iterator["Charuco"]:
        """This board as other programs print it: in the old layout, white on black, both."""
        for old, inverted in ((True, False), (False, True), (True, True)):
            if not old or self.rows % 2 == 0:
                yield replace(self, old_layout=old, inverted=inverted)


@dataclass(frozen=True, slots=True)
class CircleGrid:
    """Dark circles on white paper in straight rows; their centres are its corners."""

    columns: int  # this and rows: circles along x and y, at least 3
    rows: int
    square_m: float  # from centre to centre [m]
    circle_m: float  # diameter [m]

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3:
            raise CalibrationError(f"{self}: a grid needs at least 3 x 3 circles")
        _check_length(self, "distance of centres", self.square_m)
        if not 0.0 < self.circle_m < self.square_m:
            raise CalibrationError(f"{self}: circles must be smaller than the distance of their centres")

    def __str__(self) -> str:
        return (
            f"grid of {self.columns} x {self.rows} circles of {self.circle_m * 1e3:g} mm,"
            f" {self.square_m * 1e3:g} mm from centre to centre"
        )


Board = Checkerboard | Charuco | CircleGrid


def grid_shape(board: Board) -> tuple[int, int]:
    """Rows and columns of the inner corners."""
    if isinstance(board, Charuco):
        return board.rows - 1, board.columns - 1
    return board.rows, board.columns


def board_corners(board: Board) -> Float:
    """Inner corners (N, 3) [m] in the board's frame, row by row, z = 0."""
    rows, columns = grid_shape(board)
    y, x = np.mgrid[0:rows, 0:columns]
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) * board.square_m


def grid_edges(board: Board) -> Int:
    """Pairs (E, 2) of corners one square apart: along the rows, then the columns."""
    rows, columns = grid_shape(board)
    n = np.arange(rows * columns).reshape(rows, columns)
    along = np.stack([n[:, :-1].ravel(), n[:, 1:].ravel()], axis=1)
    down = np.stack([n[:-1].ravel(), n[1:].ravel()], axis=1)
    return np.concatenate([along, down]).astype(np.int64)


def orderings(board: Board) -> tuple[Int, ...]:
    """Rotations of the pattern that look the same, the unrotated one first.

    As orders (N,) of corner numbers. A ChArUco board has one. A checkerboard with an odd sum of columns and
    rows has one too, because its colours distinguish its ends; others, and all grids of circles, look the same
    after half a turn, square ones also after a quarter.
    """
    rows, columns = grid_shape(board)
    n = np.arange(rows * columns).reshape(rows, columns)
    if isinstance(board, Charuco):
        return (n.ravel(),)
    # Square (0, 0) keeps its colour if the sum of its indices stays even: after half a turn it is (rows-2, cols-2).
    found, circles = [n], isinstance(board, CircleGrid)
    if circles or (rows + columns) % 2 == 0:
        found.append(np.rot90(n, 2))
    if rows == columns and (circles or columns % 2 == 0):
        found += [np.rot90(n, 1), np.rot90(n, 3)]
    return tuple(rotated.ravel() for rotated in found)


def _check_length(board: object, what: str, length_m: float) -> None:
    # From a stamp under a microscope to a wall: outside, the unit was mistaken.
    if not 5e-4 <= length_m <= 1.0:
        raise CalibrationError(f"{board}: the {what} must be between 0.5 mm and 1 m (give it in mm)")


def board_of(
    size: str, square_mm: float, marker_mm: float | None, dictionary: str, circle_mm: float | None = None
) -> Board:
    """The board that the options name.

    Raises:
        CalibrationError: The size is not two numbers, or there can be no such board.
    """
    found = re.fullmatch(r"(\d+)x(\d+)", size)
    if found is None:
        raise CalibrationError(f"--board {size!r}: expected COLUMNSxROWS, for example 9x6")
    columns, rows = int(found[1]), int(found[2])
    if circle_mm is not None:
        if marker_mm is not None:
            raise CalibrationError("--circle-mm: a grid of circles has no markers, leave --marker-mm out")
        return CircleGrid(columns, rows, square_mm * 1e-3, circle_mm * 1e-3)
    if marker_mm is None:
        return Checkerboard(columns, rows, square_mm * 1e-3)
    return Charuco(columns, rows, square_mm * 1e-3, marker_mm * 1e-3, dictionary)


def board_in(options: Namespace) -> Board:
    """The board that a command's options name."""
    size, square_mm, marker_mm = options.board, options.square_mm, options.marker_mm
    return board_of(size, square_mm, marker_mm, options.dictionary, options.circle_mm)


def options_of(board: Board) -> str:
    """The options from which `board_of` makes `board`."""
    text = f"--board {board.columns}x{board.rows} --square-mm {1e3 * board.square_m:g}"
    if isinstance(board, Charuco):
        text += f" --marker-mm {1e3 * board.marker_m:g} --dictionary {board.dictionary}"
    return text + (f" --circle-mm {1e3 * board.circle_m:g}" if isinstance(board, CircleGrid) else "")


_WINDOW_PX = (3, 15)  # smaller ones hold too little of the edges: five times the error
_REFINE = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-4)


@dataclass(frozen=True, slots=True, eq=False)
class ImageObservation:
    """The board in one image."""

    # corners (N, 2) [px], board's order, distorted image, (0, 0) = centre of the top-left pixel. NaN: not
    # seen
    corners_px: Float
    # standard deviation [px] of the blur of the board's edges, in the direction where it is worse
    blur_px: float
    speed_px_s: Float | None = None  # of the corners (N, 2); None: not known, or still

    @property
    def seen(self) -> int:
        """Number of corners seen."""
        return int(np.isfinite(self.corners_px[:, 0]).sum())


def find_board(board: Board, image: Image) -> ImageObservation | None:
    """Detect the board in an image (H, W) or (H, W, 3) BGR.

    None where it is not found whole (ChArUco: 8 corners of it).
    """
    grey = image if image.ndim == 2 else cast(Image, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    if isinstance(board, CircleGrid):
        corners = _circles(board, grey)
    else:
        corners = _charuco(board, grey) if isinstance(board, Charuco) else _checkerboard(board, grey)
    if corners is None or np.isfinite(corners[:, 0]).sum() < 8:  # a pose and a few corners to check it
        return None
    return ImageObservation(corners, _blur(board, grey, corners))


def _checkerboard(board: Checkerboard, grey: Image) -> Float | None:
    size = (board.columns, board.rows)
    classic = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, corners = cv2.findChessboardCorners(grey, size, flags=classic | cv2.CALIB_CB_FAST_CHECK)
    if not found:
        found, corners = cv2.findChessboardCornersSB(grey, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not found:
        found, corners = cv2.findChessboardCorners(grey, size, flags=classic)
    if not found:
        return None
    rough = _upright(board, grey, np.asarray(corners, dtype=np.float64).reshape(-1, 2))
    return _refined(board, grey, rough)


def _circles(board: CircleGrid, grey: Image) -> Float | None:
    """Images of the circles' centres, which are not the centres of their images.

    The image of a circle of radius r at x is an ellipse, whose dual conic is H C H^T, with that of the circle, C
    (Hartley and Zisserman, Multiple view geometry, section 8.5); H is from the grid to the image.
    """
    how, most = cv2.SimpleBlobDetector.Params(), grey.size / (board.columns * board.rows)
    how.minArea, how.maxArea, how.minDistBetweenBlobs = 20.0, float(most), 4.0
    size, detector = (board.columns, board.rows), cv2.SimpleBlobDetector.create(how)
    found, seen = cv2.findCirclesGrid(grey, size, flags=cv2.CALIB_CB_SYMMETRIC_GRID, blobDetector=detector)
    if not found:
        return None
    corners = _not_mirrored(board, np.asarray(seen, dtype=np.float64).reshape(-1, 2)).reshape(-1, 2)
    drawn = board_corners(board)
    H = np.asarray(cv2.findHomography(drawn[:, :2], corners)[0], np.float64)
    centre = np.append(drawn[:, :2], np.ones((len(drawn), 1)), axis=1) @ H.T
    spread = (0.5 * board.circle_m) ** 2 * (H[:, :2] @ H[:, :2].T)
    ellipse = (spread[2] - centre * centre[:, 2:]) / (spread[2, 2] - centre[:, 2:] ** 2)
    return corners - (ellipse - centre / centre[:, 2:])[:, :2]


def _not_mirrored(board: Board, corners: Float) -> Float:
    """Corners as (rows, columns, 2), columns in the order that a camera sees."""
    grid = corners.reshape(*grid_shape(board), 2)
    along, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    return grid[:, ::-1] if along[0] * down[1] - along[1] * down[0] < 0.0 else grid


def _upright(board: Checkerboard, grey: Image, corners: Float) -> Float:
    """The corners in the board's order: not mirrored, square (0, 0) dark if a choice."""
    (rows, columns), grid = grid_shape(board), _not_mirrored(board, corners)
    middles = (grid[:-1, :-1] + grid[:-1, 1:] + grid[1:, :-1] + grid[1:, 1:]) / 4.0
    light = _sample(grey, middles)
    even = np.add.outer(np.arange(rows - 1), np.arange(columns - 1)) % 2 == 0
    if light[even].mean() > light[~even].mean():
        if (rows + columns) % 2 == 1:
            grid = grid[::-1, ::-1]
        elif rows == columns:
            grid = np.rot90(grid, 1, (0, 1))
    return grid.reshape(-1, 2).copy()


def _charuco(board: Charuco, grey: Image) -> Float | None:
    image = cv2.bitwise_not(grey) if board.inverted else grey
    detected = cv2.aruco.CharucoDetector(board.pattern()).detectBoard(image)
    # The stubs promise arrays; where nothing is seen there is None.
    found, ids = cast(tuple[Float | None, Int | None], detected[:2])
    if found is None or ids is None:
        return None
    rows, columns = grid_shape(board)
    corners = np.full((rows * columns, 2), np.nan)
    corners[ids.reshape(-1)] = found.reshape(-1, 2)
    return _refined_upright(board, grey, corners)


def _refined(board: Checkerboard, grey: Image, corners: Float) -> Float | None:
    """Refine rough corners; None: one moves by more than its window.

    A checkerboard is found whole or not at all: one wrong corner condemns the grid.
    """
    half = _windows(board, corners)
    each = zip(corners[:, None], half.astype(int).tolist(), strict=True)
    refined = np.concatenate([_sub_pixel(grey, corner, window) for corner, window in each])
    return None if (np.abs(refined - corners) > half[:, None]).any() else refined


def _refined_upright(board: Charuco, grey: Image, corners: Float) -> Float:
    """Refine corners in the picture of the board as seen from the front.

    A window there reaches the markers on all sides. In a picture of a tilted board it would be too small one way,
    or hold markers the other way: seen at 70 degrees, corners were three times as far off.
    """
    refined, seen = np.full_like(corners, np.nan), np.isfinite(corners[:, 0])
    if seen.sum() < 8:
        return refined
    edges = corners[grid_edges(board)]
    longest = float(np.nanmax(np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1), initial=1.0))
    free = 0.45 * (1.0 - board.marker_m / board.square_m)  # of a square; markers begin at a half
    side = float(np.clip(longest, _WINDOW_PX[0] / free, _WINDOW_PX[1] / free))
    drawn = (board_corners(board)[:, :2] / board.square_m + 1.0) * side
    homography = cast(
        "Float | None", cv2.findHomography(drawn[seen], corners[seen], cv2.RANSAC, longest / 4.0)[0]
    )
    if homography is None or abs(np.linalg.det(homography)) < 1e-12:
        return refined  # all in one line
    size, half = (round(board.columns * side), round(board.rows * side)), round(free * side)
    upright = cv2.warpPerspective(grey, homography, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    rough = _through(np.asarray(np.linalg.inv(homography), np.float64), corners)
    seen &= (np.abs(rough - drawn) < side / 2.0).all(axis=1)  # another corner got its number
    found = rough.copy()
    found[seen] = _sub_pixel(np.asarray(upright, np.uint8), rough[seen], half)
    seen &= (np.abs(found - rough) <= half).all(axis=1)
    refined[seen] = _through(homography, found[seen])
    return refined


def _sub_pixel(grey: Image, corners: Float, half: int) -> Float:
    """Corners (n, 2) [px] refined in windows of that half side [px]."""
    start = corners.astype(np.float32).reshape(-1, 1, 2)
    return np.asarray(cv2.cornerSubPix(grey, start, (half, half), (-1, -1), _REFINE), np.float64).reshape(
        -1, 2
    )


def _through(homography: Float, points: Float) -> Float:
    """Points (n, 2) seen through a homography (3, 3)."""
    return np.asarray(cv2.perspectiveTransform(points[None], homography), np.float64)[0]


def _windows(board: Checkerboard, corners: Float) -> Float:
    """Half the side (N,) [px] of each corner's window."""
    rows, columns = grid_shape(board)
    grid = corners.reshape(rows, columns, 2)
    along, down = grid[:-1, 1:] - grid[:-1, :-1], grid[1:, :-1] - grid[:-1, :-1]
    area = np.abs(along[..., 0] * down[..., 1] - along[..., 1] * down[..., 0])
    longer = np.maximum(np.linalg.norm(along, axis=-1), np.linalg.norm(down, axis=-1))
    height = area / np.maximum(longer, 1e-9)
    reach = np.full((rows, columns), np.inf)
    for i in (0, 1):
        for j in (0, 1):
            part = reach[i : rows - 1 + i, j : columns - 1 + j]
            np.fmin(part, height, out=part)
    share = np.full((rows, columns), 0.3)  # of the distance to the next grid line
    share[1:-1, 1:-1] = 0.5
    half = np.minimum(np.maximum(np.round(share * reach), _WINDOW_PX[0]), _WINDOW_PX[1])
    return half.ravel()


def _blur(board: Board, grey: Image, corners: Float) -> float:
    """Standard deviation [px] of the blur across the board's edges, the worse way.

    A step blurred by a Gaussian has the steepest slope step / (sigma sqrt(2 pi)).
    """
    rows, columns = grid_shape(board)
    edges = grid_edges(board)
    split = rows * (columns - 1)
    # Up to the middle of a square; beside a marker only its white margin is free.
    reach = 0.4 * (1.0 - board.marker_m / board.square_m) if isinstance(board, Charuco) else 0.35
    steps = np.linspace(-reach, reach, 29)
    worst = 0.0
    for family in (edges[:split], edges[split:]):
        a, b = corners[family[:, 0]], corners[family[:, 1]]
        length = np.linalg.norm(b - a, axis=1)
        known = np.isfinite(length) & (length > 0)
        if not known.any():
            continue
        a, b, length = a[known], b[known], length[known, None]
        across = (b - a)[:, ::-1] * [1.0, -1.0] / length
        points = ((a + b) / 2)[:, None] + across[:, None] * (length * steps)[..., None]
        if isinstance(board, CircleGrid):  # from the centre to the paper
            points = a[:, None] + (b - a)[:, None] * (steps + reach)[:, None]
        profile = _sample(grey, points)
        rise = np.abs(profile[:, -4:].mean(axis=1) - profile[:, :4].mean(axis=1))
        slope = np.abs(np.diff(profile, axis=1)).max(axis=1) / (length[:, 0] * (steps[1] - steps[0]))
        clear = rise > 10.0
        if clear.any():
            worst = max(worst, float(np.median(rise[clear] / slope[clear]) / np.sqrt(2 * np.pi)))
    return worst


def _sample(grey: Image, points: Float) -> Float:
    """Brightness (A, B) at pixels (A, B, 2), interpolated."""
    u, v = np.moveaxis(points.astype(np.float32), -1, 0)
    return cast(Image, cv2.remap(grey, u, v, cv2.INTER_LINEAR)).astype(np.float64)
