"""The command `phalanx calibrate board` draws a board at true scale.

A vector page: the board, a ruler to check the printer by, and the options to calibrate with it.
"""

from argparse import Namespace
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import FigureCanvasPdf
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from common.calibration.files import replacing
from common.command_line import UsageError, echo
from common.errors import CalibrationError
from master.calibrate.cameras.boards import Board, Charuco, Checkerboard, board_of, options_of
from master.calibrate.object.cube_sheet import cube

PAPERS_MM = {"A4": (297.0, 210.0), "A3": (420.0, 297.0), "A2": (594.0, 420.0), "letter": (279.4, 215.9)}
_EDGE_MM = 8.0  # printers leave some millimetres blank, and a board needs white about it
_FOOT_MM = 20.0  # ruler and text
Rectangle = tuple[float, float, float, float]
"""x, y, width, height [mm]; y down."""


@dataclass(frozen=True, slots=True)
class Page:
    """Where everything goes on the paper [mm], from its top left corner, y down."""

    width_mm: float
    height_mm: float
    left_mm: float
    top_mm: float


def page_for(board: Board, paper: str) -> Page:
    """The board in the middle of the paper, laid whichever way it fits.

    Raises:
        CalibrationError: No such paper, or the board does not fit; the message states how large it may be.
    """
    if paper not in PAPERS_MM:
        raise CalibrationError(f"--paper {paper!r}: there are {', '.join(PAPERS_MM)}")
    across, down = squares(board)
    side = 1e3 * board.square_m
    largest = 0.0
    for width, height in (PAPERS_MM[paper], PAPERS_MM[paper][::-1]):
        free_x, free_y = width - 2 * _EDGE_MM, height - _EDGE_MM - _FOOT_MM
        largest = max(largest, min(free_x / across, free_y / down))
        if across * side <= free_x + 1e-9 and down * side <= free_y + 1e-9:
            return Page(width, height, (width - across * side) / 2, _EDGE_MM + (free_y - down * side) / 2)
    raise CalibrationError(
        f"the {board} is {across * side:g} x {down * side:g} mm and does not fit on {paper} with its margins:"
        f" squares of up to {np.floor(10 * largest) / 10:g} mm do"
    )


def squares(board: Board) -> tuple[int, int]:
    """Squares across and down."""
    if isinstance(board, Checkerboard):
        return board.columns + 1, board.rows + 1
    return board.columns, board.rows


def dark_rectangles(board: Board) -> list[Rectangle]:
    """All that is printed black, from the board's top left corner."""
    across, down = squares(board)
    side = 1e3 * board.square_m
    dark = [(x * side, y * side, side, side) for y in range(down) for x in range(across) if (x + y) % 2 == 0]
    return dark + (_marker_rectangles(board) if isinstance(board, Charuco) else [])


def _marker_rectangles(board: Charuco) -> list[Rectangle]:
    """The dark cells of the markers; those in a row that touch are one."""
    cells = board.markers().markerSize + 2  # a marker has a dark border of one cell
    side, cell = 1e3 * board.square_m, 1e3 * board.marker_m / cells
    margin = (side - cells * cell) / 2
    found: list[Rectangle] = []
    light = ((x, y) for y in range(board.rows) for x in range(board.columns) if (x + y) % 2 == 1)
    for number, (x, y) in enumerate(light):
        image = np.asarray(cv2.aruco.generateImageMarker(board.markers(), number, cells))
        dark = np.pad(np.equal(image, 0).astype(np.int64), ((0, 0), (1, 1)))
        for row in range(cells):
            edges = [int(edge) for edge in np.flatnonzero(np.diff(dark[row]))]
            for begin, end in zip(edges[::2], edges[1::2], strict=True):
                left = x * side + margin + begin * cell
                found.append((left, y * side + margin + row * cell, (end - begin) * cell, cell))
    return found


def print_board(path: Path, board: Board, paper: str) -> None:
    """Write the page as PDF or SVG, by the ending of the file.

    Raises:
        CalibrationError: It does not fit, the ending is another, or the file cannot be written.
    """
    kinds = {".pdf": FigureCanvasPdf, ".svg": FigureCanvasSVG}
    if path.suffix.lower() not in kinds:
        raise CalibrationError(f"{path}: a board is printed as .pdf or .svg")
    page = page_for(board, paper)
    figure = Figure(figsize=(page.width_mm / 25.4, page.height_mm / 25.4))
    canvas = kinds[path.suffix.lower()](figure)
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, page.width_mm), ylim=(page.height_mm, 0))
    axes.set_axis_off()
    _fill(axes, [(page.left_mm + x, page.top_mm + y, w, h) for x, y, w, h in dark_rectangles(board)])
    _foot(axes, page, board)
    try:
        with replacing(path) as file:
            undated = {"CreationDate": None} if path.suffix.lower() == ".pdf" else {"Date": None}
            canvas.print_figure(file, format=path.suffix.lower()[1:], metadata=undated, dpi=72)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot write: {error.strerror}") from error


def _fill(axes: Axes, rectangles: list[Rectangle]) -> None:
    """One outline for all: pieces drawn one by one show hairlines where they touch."""
    vertices: list[tuple[float, float]] = []
    for x, y, width, height in rectangles:
        vertices += [(x, y), (x + width, y), (x + width, y + height), (x, y + height), (x, y)]
    codes = [Outline.MOVETO, Outline.LINETO, Outline.LINETO, Outline.LINETO, Outline.CLOSEPOLY]
    outline = Outline(vertices, codes * len(rectangles))
    axes.add_patch(PathPatch(outline, facecolor="black", edgecolor="none", linewidth=0, snap=False))


def _foot(axes: Axes, page: Page, board: Board) -> None:
    left, top = _EDGE_MM + 2, page.height_mm - _FOOT_MM + 6
    ruler_mm = 100.0
    marks = [(left, top, ruler_mm, 0.3)]
    for step in range(0, int(ruler_mm) + 1, 5):
        length = 3.0 if step % 50 == 0 else 2.0 if step % 10 == 0 else 1.2
        at = min(max(step - 0.1, 0.0), ruler_mm - 0.2)  # the end marks end with the ruler
        marks.append((left + at, top, 0.2, length))
    _fill(axes, marks)
    axes.text(left, top + 7, f"{board}:   {options_of(board)}", fontsize=7, va="center")
    note = (
        "100 mm: measure it. Print at 100 %, not fitted to the page; if it differs, give the measured square."
    )
    axes.text(left + ruler_mm + 3, top + 1.2, note, fontsize=6, va="center")


def board(options: Namespace) -> None:
    """Draw a board at true scale, with a ruler, or a box of tags."""
    if options.kind == "box":
        print_of_box(options)
        return
    marker, side = None, options.square_mm
    if options.kind == "charuco":
        side = 29.0 if side is None else side
        marker = 0.75 * side if options.marker_mm is None else options.marker_mm
    elif options.marker_mm is not None:
        raise UsageError("--marker-mm: a checkerboard has no markers; use --kind charuco")
    drawn = board_of(options.size or "9x6", 25.0 if side is None else side, marker, options.dictionary)
    paper = options.paper or "A4"
    print_board(options.out, drawn, paper)
    echo(f"wrote {options.out}: {drawn}, on {paper}. Print it at 100 % and measure the ruler: 100 mm")


def print_of_box(options: Namespace) -> None:
    """Draw a box of tags, unless an option is given that only boards have."""
    given = {"board": options.size, "square-mm": options.square_mm, "marker-mm": options.marker_mm}
    for name, value in (given | {"paper": options.paper}).items():
        if value is not None:
            raise UsageError(f"--{name}: is of a board; a box has --side-mm and --edge-mm, on A4")
    cube(options)
