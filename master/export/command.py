"""`phalanx-master export`: what was recorded of hands, for every other tool."""

import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

from common.clock import now_ns
from common.errors import PhalanxError
from master.options import CALIB_JSON, Calibration, JointNames, JsonFile
from master.recording.lines import ProgressLine, bar
from master.summary import write_summary

_EVERY_NS = 100_000_000
_MOTION = ("bvh", "gltf")


def export(
    source: Annotated[
        Path, typer.Argument(help="poses.npz of a run or of solve, or an .mcap recording.", metavar="SOURCE")
    ],
    to: Annotated[
        Literal["csv", "parquet", "bvh", "gltf", "rrd"] | None,
        typer.Option(
            "--to",
            help="csv, parquet: tables. bvh: motion capture. gltf: an animated, skinned hand. rrd: for Rerun.",
        ),
    ] = None,
    compare: Annotated[
        Path | None,
        typer.Option(
            "--compare",
            metavar="FILE",
            help="Instead of --to: errors of the poses against motion capture of that hand, .csv, .tsv, .bvh, .c3d.",
        ),
    ] = None,
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
            "--rig",
            help="Of an rrd: rig of CALIBRATION/rigs; an .mcap knows its own. Once for each. Of --compare: whose"
            " markers the poses have.",
        ),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(
            metavar="HZ",
            min=0.1,
            max=1000.0,
            help="Frames a second of bvh and gltf, default that of the poses; of a --compare table without times.",
        ),
    ] = None,
    from_s: Annotated[
        float | None, typer.Option("--from", metavar="S", help="Seconds after the beginning of SOURCE.")
    ] = None,
    to_s: Annotated[float | None, typer.Option("--until", metavar="S", help="Until there.")] = None,
    unit: Annotated[
        Literal["m", "cm", "mm"] | None,
        typer.Option(
            help="Of length in a bvh, default cm (all others have metres); in --compare FILE, default as it says."
        ),
    ] = None,
    up: Annotated[
        Literal["y", "rig"] | None,
        typer.Option(
            help="Of bvh and gltf. y (default): y up in the reference camera's picture, z out of it. rig: its own,"
            " y down, z into the scene."
        ),
    ] = None,
    joints: JointNames = None,
    side: Annotated[
        Literal["left", "right"] | None, typer.Option(help="Of --compare: which hand of a file with both.")
    ] = None,
    aligned: Annotated[
        bool,
        typer.Option(
            "--aligned",
            help="FILE of --compare has the rig's frame, and the poses' clock or seconds from the beginning of SOURCE."
            " Default: both are fitted.",
        ),
    ] = False,
    json_file: JsonFile = None,
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

      phalanx-master export out/me/poses.npz --compare motive.csv --side right --json errors.json

      phalanx-master export out/demo/poses.npz --compare truth.csv --aligned
    """
    if compare is not None:
        for given, option in ((to, "--to"), (out, "--out"), (hand, "--hand"), (up, "--up")):
            _refuse(bool(given), option, "exporting", f"--compare {compare}")
        from master.export import truth
        from master.export.window import Window
        from master.mocap.read import Reading

        part, how = Window(from_s, to_s), Reading(joints, unit, side, rate)
        wanted = truth.Wanted(how, tuple(only or ()), part, aligned, calibration, tuple(rig or ()))
        found = truth.compare_source(source, compare, wanted, lambda line: typer.echo(f"compare: {line}"))
        if json_file is not None:
            write_summary(json_file, found)
        return
    if to is None:
        raise PhalanxError("give --to FORMAT to export, or --compare FILE to hold the poses against it")
    for given, option in (
        (joints, "--joints"),
        (side, "--side"),
        (aligned, "--aligned"),
        (json_file, "--json"),
    ):
        _refuse(bool(given), option, "--compare", f"--to {to}")
    _refuse(to not in _MOTION and rate is not None, "--rate", "bvh and gltf", f"--to {to}")
    _refuse(to not in _MOTION and up is not None, "--up", "bvh and gltf", f"--to {to}")
    _refuse(to != "bvh" and unit is not None, "--unit", "bvh", f"--to {to}")
    _refuse(to != "rrd" and bool(rig), "--rig", "rrd", f"--to {to}")
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
    export_source(source, wanted, progress.notify, progress.update)


def _refuse(wrong: bool, option: str, purpose: str, this: str) -> None:
    if wrong:
        raise PhalanxError(f"{option} is for {purpose}, and this is {this}")


class _Progress:
    """The bar of what goes on, and the lines of what is done; holds when the bar was drawn last."""

    def __init__(self) -> None:
        self._line = ProgressLine(sys.stderr, "export")
        self._shown_ns = now_ns()

    def update(self, what: str, done: int, total: int) -> None:
        """It goes on. Where no terminal shows the bar in place it is left out: files are written in seconds."""
        if sys.stderr.isatty() and now_ns() - self._shown_ns > _EVERY_NS:
            self._shown_ns = now_ns()
            self._line.show(f"{bar(done / max(total, 1))} {what}, {done} of {total}")

    def notify(self, line: str) -> None:
        """Something is done."""
        if sys.stderr.isatty():
            sys.stderr.write("\r\x1b[K")
        typer.echo(f"export: {line}")
