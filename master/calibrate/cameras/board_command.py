"""`phalanx calibrate board`: a board to print."""

from argparse import Namespace

from common.command_line import UsageError
from common.terminal import echo
from master.calibrate.cameras.options import board_of


def board(options: Namespace) -> None:
    """Draw a board at true scale.

    With a ruler of 100 mm and the options to calibrate with it.
    """
    from master.calibrate.cameras.board_print import print_board  # matplotlib takes a second to import

    marker = None
    side = options.square_mm
    if options.kind == "charuco":
        side = 29.0 if side is None else side
        marker = 0.75 * side if options.marker_mm is None else options.marker_mm
    elif options.marker_mm is not None:
        raise UsageError("--marker-mm: a checkerboard has no markers; use --kind charuco")
    drawn = board_of(options.size or "9x6", 25.0 if side is None else side, marker, options.dictionary)
    print_board(options.out, drawn, options.paper)
    echo(f"wrote {options.out}: {drawn}, on {options.paper}. Print it at 100 % and measure the ruler: 100 mm")
