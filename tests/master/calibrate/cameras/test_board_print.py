"""The printed page is read back: the black of the PDF is painted again and measured, and the board found in it."""

import re
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from common.arrays import Float, Image
from common.errors import CalibrationError
from master.calibrate.cameras.board_print import page_for, print_board
from master.calibrate.cameras.boards import (
    Board,
    Charuco,
    Checkerboard,
    board_corners,
    board_of,
    find_board,
    grid_edges,
    options_of,
)

PX_PER_MM = 6.0
BOARDS = [
    Checkerboard(9, 6, 0.025),
    Checkerboard(5, 7, 0.03),
    Charuco(9, 6, 0.029, 0.022),
    Charuco(5, 7, 0.03, 0.02),
]


def outlines(pdf: bytes) -> tuple[tuple[float, float], list[Float]]:
    """Size of a PDF's page and its black polygons (n, 2), both in mm from the top left corner."""
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", pdf)
    assert box is not None
    width, height = float(box[1]) * 25.4 / 72.0, float(box[2]) * 25.4 / 72.0
    stream = next(
        zlib.decompress(found[1]) for found in re.finditer(rb"stream\r?\n(.*?)\r?\nendstream", pdf, re.DOTALL)
    )
    polygons: list[Float] = []
    for part in re.findall(rb"0 g\n+((?:[-\d.]+ [-\d.]+ [ml]\n|h\n)+)", stream):
        for one in part.split(b"h\n"):
            points = np.array([[float(n) for n in line.split()[:2]] for line in one.splitlines()])
            if len(points) >= 3:
                polygons.append(points * [1, -1] * 25.4 / 72.0 + [0.0, height])
    return (width, height), polygons


def painted(pdf: bytes) -> Image:
    """The black polygons of a PDF's page as an image."""
    (width, height), polygons = outlines(pdf)
    page = np.full((round(height * PX_PER_MM), round(width * PX_PER_MM)), 255, np.uint8)
    for polygon in polygons:
        fixed = (polygon * PX_PER_MM * 16 - 8).round().astype(np.int32)
        cv2.fillPoly(page, [fixed], 0, lineType=cv2.LINE_AA, shift=4)
    return page


@pytest.mark.parametrize("board", BOARDS, ids=str)
def test_squares_of_the_page_are_as_long_as_they_say(board: Board, tmp_path: Path) -> None:
    print_board(tmp_path / "board.pdf", board, "A4")
    found = find_board(board, painted((tmp_path / "board.pdf").read_bytes()))
    assert found is not None
    assert found.seen == len(board_corners(board))
    edges = grid_edges(board)
    sides = np.linalg.norm(found.corners_px[edges[:, 0]] - found.corners_px[edges[:, 1]], axis=1) / PX_PER_MM
    np.testing.assert_allclose(sides.mean(), 1e3 * board.square_m, atol=0.02)
    np.testing.assert_allclose(sides, 1e3 * board.square_m, atol=0.1)


def test_the_ruler_is_100_mm_and_the_same_board_is_the_same_file(tmp_path: Path) -> None:
    for name in ("a.pdf", "b.pdf"):
        print_board(tmp_path / name, BOARDS[0], "A4")
    pdf = (tmp_path / "a.pdf").read_bytes()
    assert pdf == (tmp_path / "b.pdf").read_bytes()
    (width, height), polygons = outlines(pdf)
    assert (width, height) == pytest.approx((297.0, 210.0), abs=1e-6)
    ruler = max((np.ptp(p[:, 0]) for p in polygons if np.ptp(p[:, 1]) < 1.0), default=0.0)
    assert ruler == pytest.approx(100.0, abs=1e-3)
    ends = [p[:, 0] for p in polygons if 2.0 < np.ptp(p[:, 1]) < 4.0]
    assert max(x.max() for x in ends) - min(x.min() for x in ends) == pytest.approx(100.0, abs=1e-3)


def test_a_board_that_is_too_large_is_refused_with_what_would_fit() -> None:
    with pytest.raises(CalibrationError, match=r"300 x 210 mm .* A4 .* up to 26 mm"):
        page_for(Checkerboard(9, 6, 0.03), "A4")
    assert page_for(Checkerboard(9, 6, 0.026), "A4").width_mm == 297.0
    assert page_for(Checkerboard(9, 6, 0.03), "A3").width_mm == 420.0
    assert page_for(Checkerboard(5, 8, 0.025), "A4").width_mm == 210.0  # upright
    with pytest.raises(CalibrationError, match="A4, A3, A2, letter"):
        page_for(BOARDS[0], "A5")


def test_only_vector_files_and_only_into_folders_that_are_there(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"\.pdf or \.svg"):
        print_board(tmp_path / "board.png", BOARDS[0], "A4")
    with pytest.raises(CalibrationError, match="cannot write"):
        print_board(tmp_path / "nowhere" / "board.pdf", BOARDS[0], "A4")
    print_board(tmp_path / "board.svg", BOARDS[0], "A4")
    assert b"841.88" in (tmp_path / "board.svg").read_bytes()[:2000]  # 297 mm in points


@pytest.mark.parametrize("board", BOARDS)
def test_the_options_on_the_page_name_the_board_again(board: Board) -> None:
    words = options_of(board).split()
    given = dict(zip(words[::2], words[1::2], strict=True))
    marker = given.get("--marker-mm")
    found = board_of(
        given["--board"],
        float(given["--square-mm"]),
        None if marker is None else float(marker),
        given.get("--dictionary", "4X4_50"),
    )
    assert (found.columns, found.rows, type(found)) == (board.columns, board.rows, type(board))
    assert found.square_m == pytest.approx(board.square_m)
    if isinstance(found, Charuco) and isinstance(board, Charuco):
        assert (found.dictionary, found.marker_m) == (board.dictionary, pytest.approx(board.marker_m))
