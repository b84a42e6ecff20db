"""`phalanx play`."""

import sys
from argparse import Namespace

from common.errors import PhalanxError
from common.terminal import echo
from master.recording.lines import ProgressLine, bar
from master.recording.play import PlaySettings, run_play
from master.run.master_bus import host_bus
from master.run.stopping import stop_on_signals


def play(options: Namespace) -> None:
    """Play a recording."""
    settings = PlaySettings(
        options.file,
        _speed(options.speed),
        options.from_s,
        options.to_s,
        options.out,
        options.loop,
        options.solved,
    )
    stop, line = stop_on_signals(), ProgressLine(sys.stderr, "play")

    def show(position_s: float, length_s: float) -> None:
        done = position_s / length_s if length_s > 0.0 else 1.0
        line.show(f"{bar(done)} {position_s:.1f} of {length_s:.1f} s")

    connection = None if options.no_bus else host_bus(options.bus)
    try:
        passed = run_play(settings, connection, stop, _player_status, show)
    finally:
        if connection is not None:
            connection.close()
    poses = passed.digest.counts["poses"]
    line.end(f"{poses} poses in {passed.seconds:.2f} s, {passed.poses_per_s:.0f} poses/s")
    if not passed.whole:
        echo("played in part, or with jumps: these are not the sums of the whole recording")
    for text in passed.digest.lines():
        echo(text)


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
    echo(f"play: {line}")
