"""`phalanx-master calibrate board`: a board to print."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from master.calibrate.cameras.options import Dictionary, board_of


def board(
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write, .pdf or .svg.")],
    kind: Annotated[Literal["checkerboard", "charuco"], typer.Option(help="Kind of board.")] = "checkerboard",
    paper: Annotated[str, typer.Option(help="A4, A3, A2 or letter.")] = "A4",
    size: Annotated[
        str | None,
        typer.Option(
            "--board", help="COLUMNSxROWS: inner corners, of a ChArUco board squares. Default: 9x6, 9x6."
        ),
    ] = None,
    square_mm: Annotated[float | None, typer.Option(help="Side of a square. Default: 25, 29.")] = None,
    marker_mm: Annotated[float | None, typer.Option(help="Side of a marker. Default: 3/4 square.")] = None,
    dictionary: Dictionary = "4X4_50",
) -> None:
    """Draw a board at true scale, with a ruler of 100 mm and the options to calibrate with it.

    Print at 100 %, measure the ruler, and glue the print on something flat.

    Examples:

      phalanx-master calibrate board -o board.pdf

      phalanx-master calibrate board --kind charuco --paper A3 --board 11x7 --square-mm 36 -o board.pdf
    """
    from master.calibrate.cameras.board_print import print_board  # matplotlib takes a second to import

    marker = None
    side = square_mm
    if kind == "charuco":
        side = 29.0 if side is None else side
        marker = 0.75 * side if marker_mm is None else marker_mm
    elif marker_mm is not None:
        raise typer.BadParameter("--marker-mm: a checkerboard has no markers; say --kind charuco")
    drawn = board_of(size or "9x6", 25.0 if side is None else side, marker, dictionary)
    print_board(out, drawn, paper)
    typer.echo(f"wrote {out}: {drawn}, on {paper}. Print it at 100 % and measure the ruler: 100 mm")
