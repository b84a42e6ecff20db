"""`phalanx export`: what was recorded of hands, for every other tool."""

import sys
from argparse import Namespace

from common.clock import now_ns
from common.command_line import echo
from common.errors import PhalanxError
from master.commands.summary import write_summary
from master.recording.lines import ProgressLine, bar


def export(options: Namespace) -> None:
    """Export recorded hands for other tools.

    The formats are tables, motion capture, an animated model and Rerun.
    """
    if options.compare is not None:
        _compare(options, f"--compare {options.compare}")
    elif options.to is not None:
        _convert(options, f"--to {options.to}")
    else:
        raise PhalanxError("give --to FORMAT to export, or --compare FILE to hold the poses against it")


def _compare(options: Namespace, this: str) -> None:
    _refuse(options, "to out hand up", "exporting", this)
    from master.mocap.read import Reading
    from master.recording.export.take import Window
    from master.recording.export.truth import compare_source

    found = compare_source(
        options.source,
        options.compare,
        Reading(options.joints, options.unit, options.side, options.rate),
        Window(options.from_s, options.to_s),
        lambda line: echo(f"compare: {line}"),
        hands=options.only,
        aligned=options.aligned,
        calibration=options.calibration,
        rigs=options.rig,
    )
    if options.json_file is not None:
        write_summary(options.json_file, found)


def _convert(options: Namespace, this: str) -> None:
    _refuse(options, "joints side aligned json_file", "--compare", this)
    if options.to not in ("bvh", "gltf"):
        _refuse(options, "rate up", "bvh and gltf", this)
    if options.to != "bvh":
        _refuse(options, "unit", "bvh", this)
    if options.to != "rrd":
        _refuse(options, "rig", "rrd", this)
    # Imported here: what writes these formats takes a second to load, which no other command should wait for.
    from master.recording.export.bvh import Axes
    from master.recording.export.run import Wanted
    from master.recording.export.run import export as export_source
    from master.recording.export.take import Window

    wanted = Wanted(
        options.to,
        options.out,
        tuple(options.only),
        tuple(options.hand),
        options.calibration,
        tuple(options.rig),
        Window(options.from_s, options.to_s),
        options.rate,
        Axes(options.unit or "cm", options.up or "y"),
    )
    progress = _Progress()
    export_source(options.source, wanted, progress.notify, progress.update)


def _refuse(options: Namespace, names: str, purpose: str, this: str) -> None:
    """PhalanxError where one of these options is given."""
    for name in names.split():
        if getattr(options, name):
            option = name.removesuffix("_file")
            raise PhalanxError(f"--{option} is for {purpose}, and this is {this}")


class _Progress:
    """Progress bar of an export, and the lines of what is done."""

    def __init__(self) -> None:
        self._line = ProgressLine(sys.stderr, "export")
        self._shown_ns = now_ns()

    def update(self, what: str, done: int, total: int) -> None:
        """Redraw the bar, on a terminal only: files are written in seconds."""
        every_ns = 100_000_000
        if sys.stderr.isatty() and now_ns() - self._shown_ns > every_ns:
            self._shown_ns = now_ns()
            self._line.show(f"{bar(done / max(total, 1))} {what}, {done} of {total}")

    def notify(self, line: str) -> None:
        """Something is done."""
        if sys.stderr.isatty():
            sys.stderr.write("\r\x1b[K")
        echo(f"export: {line}")
