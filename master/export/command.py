"""`phalanx-master export`: what was recorded of hands, for every other tool."""

import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

from common.clock import now_ns
from common.errors import PhalanxError
from master.options import CALIB_JSON, Calibration
from master.recording.lines import ProgressLine, bar

_EVERY_NS = 100_000_000
_MOTION = ("bvh", "gltf")


def export(
    source: Annotated[
        Path, typer.Argument(help="poses.npz of a run or of solve, or an .mcap recording.", metavar="SOURCE")
    ],
    to: Annotated[
        Literal["csv", "parquet", "bvh", "gltf", "rrd"],
        typer.Option(
            "--to",
            help="csv, parquet: tables. bvh: motion capture. gltf: an animated, skinned hand. rrd: for Rerun.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="File of the first hand, or folder. What else there is stands beside it, with a name behind its own:"
            " of another hand, object_NAME, contact_HAND_NAME, gestures. Default: beside SOURCE.",
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option("--only", metavar="NAME", help="This hand; once for each. Default: all."),
    ] = None,
    hand: Annotated[
        list[Path] | None,
        typer.Option(
            "--hand",
            metavar="FILE",
            help="Hand profile, for bvh, gltf, rrd. Default: that of an .mcap, else of CALIBRATION/hands.",
        ),
    ] = None,
    calibration: Calibration = CALIB_JSON,
    rig: Annotated[
        list[str] | None,
        typer.Option(
            "--rig", help="Of an rrd: rig of CALIBRATION/rigs; an .mcap knows its own. Once for each."
        ),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(
            metavar="HZ",
            min=0.1,
            max=1000.0,
            help="Frames a second of bvh and gltf. Default: that of the poses.",
        ),
    ] = None,
    from_s: Annotated[
        float | None, typer.Option("--from", metavar="S", help="Seconds after the beginning of SOURCE.")
    ] = None,
    to_s: Annotated[float | None, typer.Option("--until", metavar="S", help="Until there.")] = None,
    unit: Annotated[
        Literal["m", "cm", "mm"] | None,
        typer.Option(help="Of length in a bvh; default cm. All others have metres."),
    ] = None,
    up: Annotated[
        Literal["y", "rig"] | None,
        typer.Option(
            help="Of bvh and gltf. y (default): y up in the reference camera's picture, z out of it. rig: its own,"
            " y down, z into the scene."
        ),
    ] = None,
) -> None:
    """Write what was recorded of hands for other tools: tables, motion capture, an animated model, Rerun.

    Positions read back are those of the poses to 0.1 mm in every format. In tables what was not observed is empty; in a
    motion it stands still, and how often is said. docs/export.md has columns, axes, and how to open the files in
    Blender, Unity and pandas.

    Examples:

      phalanx-master export out/demo/poses.npz --to csv

      phalanx-master export out/wave.mcap --to parquet -o tables

      phalanx-master export out/demo/poses.npz --to bvh -o wave.bvh --rate 30 --from 2 --until 8

      phalanx-master export out/demo/poses.npz --to gltf -o wave.glb --hand calib_json/hands/default-right.json

      phalanx-master export out/demo/poses.npz --to rrd --rig desk
    """
    _refuse(to not in _MOTION and rate is not None, "--rate", "bvh and gltf", to)
    _refuse(to not in _MOTION and up is not None, "--up", "bvh and gltf", to)
    _refuse(to != "bvh" and unit is not None, "--unit", "bvh", to)
    _refuse(to != "rrd" and bool(rig), "--rig", "rrd", to)
    # Imported here: what writes these formats takes a second to load, which no other command should wait for.
    from master.export.bvh import Axes
    from master.export.run import Wanted
    from master.export.run import export as export_source
    from master.export.window import Window

    wanted = Wanted(
        to,
        out,
        tuple(only or ()),
        tuple(hand or ()),
        calibration,
        tuple(rig or ()),
        Window(from_s, to_s),
        rate,
        Axes(unit or "cm", up or "y"),
    )
    progress = _Progress()
    export_source(source, wanted, progress.say, progress.tell)


def _refuse(wrong: bool, option: str, formats: str, to: str) -> None:
    if wrong:
        raise PhalanxError(f"{option} is for {formats}, and this is --to {to}")


class _Progress:
    """The bar of what goes on, and the lines of what is done; holds when the bar was drawn last."""

    def __init__(self) -> None:
        self._line = ProgressLine(sys.stderr, "export")
        self._shown_ns = now_ns()

    def tell(self, what: str, done: int, total: int) -> None:
        """It goes on. Where no terminal shows the bar in place it is left out: files are written in seconds."""
        if sys.stderr.isatty() and now_ns() - self._shown_ns > _EVERY_NS:
            self._shown_ns = now_ns()
            self._line.show(f"{bar(done / max(total, 1))} {what}, {done} of {total}")

    def say(self, line: str) -> None:
        """Something is done."""
        if sys.stderr.isatty():
            sys.stderr.write("\r\x1b[K")
        typer.echo(f"export: {line}")
