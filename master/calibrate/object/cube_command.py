"""`phalanx calibrate cube`: a box of tags to print and fold, and its object file."""

from argparse import Namespace

from common.calibration import save
from common.command_line import UsageError
from common.terminal import echo


def cube(options: Namespace) -> None:
    """Draw the net of a box of tags at true scale and write objects/<name>.json."""
    from master.calibrate.object.cube_sheet import TagBox, print_box  # matplotlib takes a second to import

    box = TagBox(options.name, options.family, options.first, 1e-3 * options.side_mm, 1e-3 * options.edge_mm)
    path = options.calibration / "objects" / f"{options.name}.json"
    if path.exists():
        raise UsageError(f"--name {options.name}: {path} is there already, which is not overwritten")
    path.parent.mkdir(exist_ok=True)
    print_box(options.out, box)
    save(path, box.profile())
    echo(f"wrote {options.out} and {path}. Print it at 100 % and measure the ruler: 100 mm")
