"""`phalanx record`."""

import sys
import threading
from argparse import Namespace

from common.bus.bus import Bus
from common.terminal import echo
from master.commands.options import rigs_of
from master.recording.lines import ProgressLine, progress_text
from master.recording.process import RecordSettings, run_recorder
from master.recording.recorder import Progress
from master.rig.files import RigFiles
from master.run.master_bus import bus_of_master
from master.run.stopping import stop_on_signals


def record(options: Namespace) -> None:
    """Record what a running master receives and publishes.

    In one MCAP file with the rig's calibration.
    """
    settings = RecordSettings(
        options.file,
        RigFiles(options.calibration, tuple(rigs_of(options)), options.hand),
        options.seconds,
        options.frames,
        options.previews,
        round(options.reserve_mb * 1e6),
        options.owned,
        options.raw,
    )
    stop = stop_on_signals()
    if options.owned is not None:
        threading.Thread(target=_stop_with_input, args=(stop,), daemon=True).start()
    line = ProgressLine(sys.stderr, "recorder")

    def show(now: Progress, lost: int) -> None:
        if options.owned is None:
            line.show(progress_text(now, lost, options.seconds))

    end = run_recorder(settings, lambda stop: _master_bus(options.bus, stop), stop, _recorder_status, show)
    dropped = sum(end.dropped.values())
    _recorder_status(
        f"recorded {end.seconds:.2f} s, {sum(end.counts.values())} messages, {dropped} dropped,"
        f" {end.written_bytes * 1e-6:.2f} MB in {options.file}"
    )


def _master_bus(endpoint: str, stop: threading.Event) -> Bus | None:
    """Return the bus as the master sees it, once one listens there.

    None when stopped before.
    """
    return bus_of_master(
        endpoint, stop, lambda _error: _recorder_status(f"waiting for a master at {endpoint}")
    )


def _stop_with_input(stop: threading.Event) -> None:
    """Stop when whoever started us closes our input, or dies."""
    sys.stdin.read()
    stop.set()


def _recorder_status(line: str) -> None:
    echo(f"recorder: {line}")
