"""`phalanx export`: what was recorded of hands, for every other tool."""

import sys
from argparse import Namespace

from common.clock import now_ns
from common.command_line import echo
from common.errors import PhalanxError
from master.commands.summary import write_summary
from master.recording.lines import ProgressLine, bar

_MOTION = ("bvh", "gltf")


def export(options: Namespace) -> None:
    """Export recorded hands for other tools.

    The formats are tables, motion capture, an animated model and Rerun.
    """
    if options.compare is not None:
        for given, option in (
            (options.to, "--to"),
            (options.out, "--out"),
            (options.hand, "--hand"),
            (options.up, "--up"),
        ):
            _refuse(bool(given), option, "exporting", f"--compare {options.compare}")
        from master.mocap.read import Reading
        from master.recording.export import truth
        from master.recording.export.take import Window

        wanted = truth.Wanted(
            Reading(options.joints, options.unit, options.side, options.rate),
            tuple(options.only or ()),
            Window(options.from_s, options.to_s),
            options.aligned,
            options.calibration,
            tuple(options.rig or ()),
        )
        found = truth.compare_source(
            options.source, options.compare, wanted, lambda line: echo(f"compare: {line}")
        )
        if options.json_file is not None:
            write_summary(options.json_file, found)
        return
    if options.to is None:
        raise PhalanxError("give --to FORMAT to export, or --compare FILE to hold the poses against it")
    for given, option in (
        (options.joints, "--joints"),
        (options.side, "--side"),
        (options.aligned, "--aligned"),
        (options.json_file, "--json"),
    ):
        _refuse(bool(given), option, "--compare", f"--to {options.to}")
    to, this = options.to, f"--to {options.to}"
    _refuse(to not in _MOTION and options.rate is not None, "--rate", "bvh and gltf", this)
    _refuse(to not in _MOTION and options.up is not None, "--up", "bvh and gltf", this)
    _refuse(to != "bvh" and options.unit is not None, "--unit", "bvh", this)
    _refuse(to != "rrd" and bool(options.rig), "--rig", "rrd", this)
    # Imported here: what writes these formats takes a second to load, which no other command should wait for.
    from master.recording.export.bvh import Axes
    from master.recording.export.run import Wanted
    from master.recording.export.run import export as export_source
    from master.recording.export.take import Window

    wanted = Wanted(
        options.to,
        options.out,
        tuple(options.only or ()),
        tuple(options.hand or ()),
        options.calibration,
        tuple(options.rig or ()),
        Window(options.from_s, options.to_s),
        options.rate,
        Axes(options.unit or "cm", options.up or "y"),
    )
    progress = _Progress()
    export_source(options.source, wanted, progress.notify, progress.update)


def _refuse(wrong: bool, option: str, purpose: str, this: str) -> None:
    if wrong:
        raise PhalanxError(f"{option} is for {purpose}, and this is {this}")


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
