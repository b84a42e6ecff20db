"""`phalanx-master record | play | info`: recordings of messages from the command line."""

import sys
import threading
from pathlib import Path
from typing import Annotated

import typer

from common.bus import Bus
from common.errors import PhalanxError
from common.recording import open_messages
from master.master_bus import bus_of_master, carry_bus
from master.options import CALIB_JSON, HERE_BUS, BusEnd, Calibration, Rigs
from master.recording.lines import ProgressLine, bar, events_of, progress_text, table
from master.recording.play import PlaySettings, run_play
from master.recording.process import RecordSettings, run_recorder
from master.recording.recorder import Progress
from master.stopping import stop_on_signals
from master.tuning import RigFiles

File = Annotated[Path, typer.Argument(metavar="FILE.mcap", help="The recording.")]


def record(
    file: File,
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

    end = run_recorder(settings, lambda stop: _master_bus(bus, stop), stop, _recorder_says, show)
    dropped = sum(end.dropped.values())
    _recorder_says(
        f"recorded {end.seconds:.2f} s, {sum(end.counts.values())} messages, {dropped} dropped,"
        f" {end.written_bytes * 1e-6:.2f} MB in {file}"
    )


def play(
    file: File,
    speed: Annotated[
        str, typer.Option(help="1: as it was; 0.5: half as fast; max: as fast as it goes.")
    ] = "1",
    from_s: Annotated[
        float | None, typer.Option("--from", help="Begin so many s after the beginning.")
    ] = None,
    to_s: Annotated[float | None, typer.Option("--to", help="End so many s after the beginning.")] = None,
    bus: BusEnd = HERE_BUS,
    no_bus: Annotated[
        bool, typer.Option("--no-bus", help="Tell it nobody; with --out, or for the sums.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option(help="Folder for poses.npz and what else there is, as of `run --poses`.")
    ] = None,
    loop: Annotated[bool, typer.Option("--loop", help="Begin again at the end, until Ctrl-C.")] = False,
    solved: Annotated[
        bool, typer.Option("--solved", help="Tell what was told live, instead of solving it again.")
    ] = False,
) -> None:
    """Play a recording: what the master took is solved again, with the files that it carries, and goes to the bus as
    from a live master. At the end stands a SHA-256 of all poses: it is the same at any speed.

    While it plays, the bus answers the commands pause, resume, seek and speed. After a jump, and with --from, the two
    seconds before are solved silently, so that filters have settled; what follows is near to that of a whole pass,
    not equal to it.

    Examples:

      phalanx-master play out/wave.mcap

      phalanx-master play out/wave.mcap --speed max --no-bus --out out/wave

      phalanx-master play out/wave.mcap --speed 0.5 --from 10 --to 20 --loop
    """
    settings = PlaySettings(file, _speed(speed), from_s, to_s, out, loop, solved)
    stop, line = stop_on_signals(), ProgressLine(sys.stderr, "play")

    def show(position_s: float, length_s: float) -> None:
        done = position_s / length_s if length_s > 0.0 else 1.0
        line.show(f"{bar(done)} {position_s:.1f} of {length_s:.1f} s")

    connection = None if no_bus else carry_bus(bus)
    try:
        passed = run_play(settings, connection, stop, _player_says, show)
    finally:
        if connection is not None:
            connection.close()
    poses = passed.digest.counts["poses"]
    line.end(f"{poses} poses in {passed.seconds:.2f} s, {passed.poses_per_s:.0f} poses/s")
    if not passed.whole:
        typer.echo("played in part, or with jumps: these are not the sums of the whole recording")
    for text in passed.digest.lines():
        typer.echo(text)


def info(file: File) -> None:
    """Show what is in a recording of messages: streams, rates, length, files, and what happened.

    Examples:

      phalanx-master info out/wave.mcap
    """
    recording = open_messages(file)
    events = events_of(recording)
    typer.echo("\n".join(table(recording, events)))


def _speed(text: str) -> float:
    """The factor that was asked for; 0: as fast as it goes.

    Raises:
        PhalanxError: It is something else.
    """
    try:
        factor = 0.0 if text == "max" else float(text)
    except ValueError:
        factor = -1.0
    if not 0.0 < factor <= 1000.0 and text != "max":
        raise PhalanxError(f"--speed {text}: must be max, or a number above 0 and at most 1000")
    return factor


def _master_bus(endpoint: str, stop: threading.Event) -> Bus | None:
    """The bus as the master sees it, once one listens there; None when stopped before."""
    return bus_of_master(endpoint, stop, lambda _error: _recorder_says(f"waiting for a master at {endpoint}"))


def _stop_with_input(stop: threading.Event) -> None:
    """Stop when whoever started us closes our input, or dies."""
    sys.stdin.read()
    stop.set()


def _recorder_says(line: str) -> None:
    typer.echo(f"recorder: {line}")


def _player_says(line: str) -> None:
    typer.echo(f"play: {line}")
