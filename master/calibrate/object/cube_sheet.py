"""`phalanx calibrate board --kind box` draws a box of tags to cut and fold.

Its five faces are one net at true scale; the object's file is written too. The top is in the middle of the
net and the four sides stand about it, each with its upper edge at the top. The frame of the object is in the
middle of the box: x to the right and y up on the top as it is printed, z out of it.
"""

from argparse import Namespace
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_pdf import FigureCanvasPdf
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from common.arrays import Float
from common.calibration import save
from common.calibration.files import Matrix4, replacing
from common.calibration.object_profile import BoxShape, ObjectProfile, Tag, TagFamily, Tags
from common.command_line import UsageError, echo
from common.errors import CalibrationError
from common.geometry.tag_family import GRIDS, tag_image
from common.geometry.transforms import rigid

_A4_MM = (210.0, 297.0)
_SIDES = ((1, 0), (0, 1), (-1, 0), (0, -1))  # outward, object frame: the first tags; the last is the top


@dataclass(frozen=True, slots=True)
class TagBox:
    """A box with a tag on each of five faces, the sixth for what carries it."""

    name: str
    family: TagFamily
    first: int  # number of the first tag; the others follow
    side_m: float  # this and edge_m: of the box, and of the tags' black squares [m]
    edge_m: float

    def __post_init__(self) -> None:
        grid = GRIDS[self.family]
        quiet = self.edge_m / (grid.cells + 2)
        if not 0.0 < self.edge_m <= self.side_m - 2.0 * quiet + 1e-9:
            raise CalibrationError(
                f"--edge-mm {1e3 * self.edge_m:g}: a tag needs a cell of white about it, {1e3 * quiet:.1f} mm,"
                f" on a face of {1e3 * self.side_m:g} mm"
            )
        if not 0 <= self.first <= grid.tags - 5:
            raise CalibrationError(
                f"--first {self.first}: {self.family} has tags 0 to {grid.tags - 1}, five are needed"
            )
        if not 3e3 * self.side_m <= _A4_MM[0] - 16.0:  # the net is three sides wide, with 8 mm beside it
            raise CalibrationError(f"--side-mm {1e3 * self.side_m:g}: the net does not fit on A4: 64 does")

    def profile(self) -> ObjectProfile:
        """The file of the object."""
        half = 0.5 * self.side_m
        poses = [
            rigid(np.array([[-y, 0, x], [x, 0, y], [0, 1, 0]], float), half * np.array([x, y, 0]))
            for x, y in _SIDES
        ]
        poses.append(rigid(np.eye(3), np.array([0.0, 0.0, half])))
        tags = tuple(
            Tag(id=self.first + k, edge_m=self.edge_m, T_object_tag=_rows(T)) for k, T in enumerate(poses)
        )
        size = (self.side_m, self.side_m, self.side_m)
        tagged = Tags(family=self.family, tags=tags)
        return ObjectProfile(version=1, name=self.name, tags=tagged, shape=(BoxShape(size_m=size),))


def dark_squares(box: TagBox) -> list[tuple[float, float, float]]:
    """Left edge, lower edge and size [mm] of all black cells, from the net's middle.

    x to the right, y up.
    """
    cells = GRIDS[box.family].cells + 2
    cell = 1e3 * box.edge_m / cells
    found: list[tuple[float, float, float]] = []
    for k, outward in enumerate((*_SIDES, (0, 0))):
        dark = np.equal(tag_image(box.family, box.first + k), 0)
        up = np.array([0, 1]) if outward == (0, 0) else -np.array(outward)
        right = np.array([up[1], -up[0]])
        for row, column in np.argwhere(dark):
            along, above = (column + 0.5 - cells / 2) * cell, (cells / 2 - row - 0.5) * cell
            middle = 1e3 * box.side_m * np.array(outward) + along * right + above * up
            found.append((float(middle[0] - cell / 2), float(middle[1] - cell / 2), cell))
    return found


def print_box(path: Path, box: TagBox) -> None:
    """Write the net on an A4 page as PDF or SVG, by the file's ending.

    Raises:
        CalibrationError: Another ending, or the file cannot be written.
    """
    kinds = {".pdf": FigureCanvasPdf, ".svg": FigureCanvasSVG}
    kind = path.suffix.lower()
    if kind not in kinds:
        raise CalibrationError(f"{path}: a box is printed as .pdf or .svg")
    width, height = _A4_MM
    figure = Figure(figsize=(width / 25.4, height / 25.4))
    canvas = kinds[kind](figure)
    middle = (0.5 * width, 0.55 * height)
    axes = figure.add_axes(
        (0, 0, 1, 1), xlim=(-middle[0], width - middle[0]), ylim=(-middle[1], height - middle[1])
    )
    axes.set_axis_off()
    side = 1e3 * box.side_m
    for x, y in (*_SIDES, (0, 0)):
        axes.add_patch(
            Rectangle(
                (side * (x - 0.5), side * (y - 0.5)), side, side, fill=False, edgecolor="0.7", linewidth=0.4
            )
        )
    for left, low, size in dark_squares(box):
        # A little larger, so that no hairline shows where two touch.
        axes.add_patch(
            Rectangle((left - 0.01, low - 0.01), size + 0.02, size + 0.02, facecolor="black", linewidth=0)
        )
    foot = -1.5 * side - 18.0
    ruler_mm = 100.0
    axes.add_patch(Rectangle((-ruler_mm / 2, foot), ruler_mm, 0.4, facecolor="black", linewidth=0))
    numbers = f"{box.family} {box.first} to {box.first + 4}"
    text = f"100 mm: measure it. Box of {side:g} mm, {numbers}, edge {1e3 * box.edge_m:g} mm"
    axes.text(0.0, foot - 6.0, text, ha="center", size=9)
    try:
        with replacing(path) as file:
            undated = {"CreationDate": None} if kind == ".pdf" else {"Date": None}
            canvas.print_figure(file, format=kind[1:], metadata=undated, dpi=72)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot write: {error.strerror}") from error


def _rows(T: Float) -> Matrix4:
    a, b, c, d = ((float(r[0]), float(r[1]), float(r[2]), float(r[3])) for r in T + 0.0)
    return a, b, c, d


def cube(options: Namespace) -> None:
    """Draw the net of a box of tags at true scale and write objects/<name>.json."""
    box = TagBox(options.name, options.family, options.first, 1e-3 * options.side_mm, 1e-3 * options.edge_mm)
    path = options.calibration / "objects" / f"{options.name}.json"
    if path.exists():
        raise UsageError(f"--name {options.name}: {path} is there already, which is not overwritten")
    path.parent.mkdir(exist_ok=True)
    print_box(options.out, box)
    save(path, box.profile())
    echo(f"wrote {options.out} and {path}. Print it at 100 % and measure the ruler: 100 mm")
