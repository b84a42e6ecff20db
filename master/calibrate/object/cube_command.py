"""`phalanx-master calibrate cube`: a box of tags to print and fold, and its object file."""

from pathlib import Path
from typing import Annotated

import typer

from common.calibration import save
from common.object_profile import TagFamily


def cube(
    out: Annotated[Path, typer.Option("--out", "-o", help="Page to write, .pdf or .svg.")],
    name: Annotated[str, typer.Option(help="Name of the object.")] = "box",
    calibration: Annotated[Path, typer.Option(help="Tree with objects/.")] = Path("calib_json"),
    family: Annotated[TagFamily, typer.Option(help="Family of the tags.")] = "aruco_5x5_100",
    first: Annotated[int, typer.Option(help="Number of the first tag.")] = 0,
    side_mm: Annotated[float, typer.Option(help="Side of the box.")] = 40.0,
    edge_mm: Annotated[
        float, typer.Option(help="Edge of the black squares, as measured on the print.")
    ] = 30.0,
) -> None:
    """Draw the net of a box of tags at true scale and write objects/<name>.json.

    Print at 100 %, measure the ruler, glue it round a box of that size. Name the object under `objects` of the rig.

    Examples:

      phalanx-master calibrate cube -o box.pdf

      phalanx-master calibrate cube --name mug --side-mm 50 --edge-mm 38 -o mug.pdf
    """
    from master.calibrate.object.cube_sheet import TagBox, print_box  # matplotlib takes a second to import

    box = TagBox(name, family, first, 1e-3 * side_mm, 1e-3 * edge_mm)
    path = calibration / "objects" / f"{name}.json"
    if path.exists():
        raise typer.BadParameter(f"--name {name}: {path} is there already, which is not overwritten")
    path.parent.mkdir(exist_ok=True)
    print_box(out, box)
    save(path, box.profile())
    typer.echo(f"wrote {out} and {path}. Print it at 100 % and measure the ruler: 100 mm")
