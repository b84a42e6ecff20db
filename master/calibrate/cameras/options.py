"""How a board is named on the command line."""

import re

from common.errors import CalibrationError
from master.calibrate.cameras.boards import Board, Charuco, Checkerboard


def board_of(size: str, square_mm: float, marker_mm: float | None, dictionary: str) -> Board:
    """The board that the options name.

    Raises:
        CalibrationError: The size is not two numbers, or there can be no such board.
    """
    found = re.fullmatch(r"(\d+)x(\d+)", size)
    if found is None:
        raise CalibrationError(f"--board {size!r}: expected COLUMNSxROWS, for example 9x6")
    columns, rows = int(found[1]), int(found[2])
    if marker_mm is None:
        return Checkerboard(columns, rows, square_mm * 1e-3)
    return Charuco(columns, rows, square_mm * 1e-3, marker_mm * 1e-3, dictionary)


def options_of(board: Board) -> str:
    """Return the options that specify `board`.

    `board_of` of them is that board again.
    """
    text = f"--board {board.columns}x{board.rows} --square-mm {1e3 * board.square_m:g}"
    if isinstance(board, Charuco):
        text += f" --marker-mm {1e3 * board.marker_m:g} --dictionary {board.dictionary}"
    return text
