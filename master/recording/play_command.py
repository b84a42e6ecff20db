"""`phalanx-master play`."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from common.errors import PhalanxError
from master.master_bus import host_bus
from master.options import HERE_BUS, BusEnd, MessageFile
from master.recording.lines import ProgressLine, bar
from master.recording.play import PlaySettings, run_play
from master.stopping import stop_on_signals


def play(
    file: MessageFile,
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

    connection = None if no_bus else host_bus(bus)
    try:
        passed = run_play(settings, connection, stop, _player_status, show)
    finally:
        if connection is not None:
            connection.close()
    poses = passed.digest.counts["poses"]
    line.end(f"{poses} poses in {passed.seconds:.2f} s, {passed.poses_per_s:.0f} poses/s")
    if not passed.whole:
        typer.echo("played in part, or with jumps: these are not the sums of the whole recording")
    for text in passed.digest.lines():
        typer.echo(text)


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


def _player_status(line: str) -> None:
    typer.echo(f"play: {line}")
