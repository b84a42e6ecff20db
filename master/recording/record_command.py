"""`phalanx-master record`."""

import sys
import threading
from pathlib import Path
from typing import Annotated

import typer

from common.bus import Bus
from master.master_bus import bus_of_master
from master.options import CALIB_JSON, HERE_BUS, BusEnd, Calibration, MessageFile, Rigs
from master.recording.lines import ProgressLine, progress_text
from master.recording.process import RecordSettings, run_recorder
from master.recording.recorder import Progress
from master.rig import RigFiles
from master.stopping import stop_on_signals


def record(
    file: MessageFile,
    rig: Rigs,
    calibration: Calibration = CALIB_JSON,
    hand: Annotated[Path | None, typer.Option(help="Hand profile; default: the one the rig names.")] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.0, help="Length in s; default: until Ctrl-C.")
    ] = None,
    bus: BusEnd = HERE_BUS,
    frames: Annotated[
        float,
        typer.Option(
            min=0.0, max=30.0, metavar="HZ", help="Keep whole frames of each camera, so many a second."
        ),
    ] = 0.0,
    previews: Annotated[
        bool, typer.Option("--previews", help="Keep the small pictures of the cameras.")
    ] = False,
    reserve_mb: Annotated[float, typer.Option(min=0.0, help="MB that stay free on the disk.")] = 200.0,
    raw: Annotated[
        bool,
        typer.Option(
            "--raw", help="Have every slave with --raw-folder keep its raw frames, in DIR/FILE'S NAME-CAMERA."
        ),
    ] = False,
    # A name to be announced when ready; then it ends with its standard input, too.
    owned: Annotated[
        str | None,
        typer.Option(hidden=True),
    ] = None,
) -> None:
    """Record what a running master takes and tells, in one MCAP file with the rig's calibration. A process of its own:
    it waits for the master, goes on when that was started again, and never slows the tracking.

    Ctrl-C ends the file. A disk that is full ends it too, with exit code 1; what was written is readable. A replay is
    what was told live, bit for bit, where the master was started with `run --record FILE`; a recording that began
    later is near to it once filters have settled.

    Examples:

      phalanx-master record out/wave.mcap --rig desk

      phalanx-master record out/wave.mcap --rig desk --rig wrist --seconds 60

      phalanx-master record out/wave.mcap --rig desk --frames 2 --previews --reserve-mb 1000

      phalanx-master record out/wave.mcap --rig desk --raw
    """
    settings = RecordSettings(
        file,
        RigFiles(calibration, tuple(rig), hand),
        seconds,
        frames,
        previews,
        round(reserve_mb * 1e6),
        owned,
        raw,
    )
    stop = stop_on_signals()
    if owned is not None:
        threading.Thread(target=_stop_with_input, args=(stop,), daemon=True).start()
    line = ProgressLine(sys.stderr, "recorder")

    def show(now: Progress, lost: int) -> None:
        if owned is None:
            line.show(progress_text(now, lost, seconds))

    end = run_recorder(settings, lambda stop: _master_bus(bus, stop), stop, _recorder_status, show)
    dropped = sum(end.dropped.values())
    _recorder_status(
        f"recorded {end.seconds:.2f} s, {sum(end.counts.values())} messages, {dropped} dropped,"
        f" {end.written_bytes * 1e-6:.2f} MB in {file}"
    )


def _master_bus(endpoint: str, stop: threading.Event) -> Bus | None:
    """The bus as the master sees it, once one listens there; None when stopped before."""
    return bus_of_master(
        endpoint, stop, lambda _error: _recorder_status(f"waiting for a master at {endpoint}")
    )


def _stop_with_input(stop: threading.Event) -> None:
    """Stop when whoever started us closes our input, or dies."""
    sys.stdin.read()
    stop.set()


def _recorder_status(line: str) -> None:
    typer.echo(f"recorder: {line}")
