"""`phalanx-slave join`: one recording of several cameras."""

import argparse
from collections.abc import Callable
from pathlib import Path

PURPOSE = "one recording of several cameras"
EXAMPLES = """\
  phalanx-slave join recordings/wave-left recordings/wave-right -o recordings/wave
        one recording of all cameras, for `phalanx replay` and the calibrations
  phalanx-slave join recordings/grasp-left recordings/grasp-right recordings/grasp-wrist -o recordings/grasp
        of marker cameras and a wrist device: one of kind both
"""
_EVERY = 500  # frames, between two lines that say how far it is


def add_options(command: argparse.ArgumentParser) -> None:
    """The options of `join`."""
    command.add_argument(
        "recordings", type=Path, nargs="+", metavar="RECORDING", help="one folder per camera"
    )
    command.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER", help="new or empty")
    command.add_argument(
        "--by-wall-clock",
        action="store_true",
        help="recorded on several machines: trust their wall clocks (keep them together by NTP or PTP)",
    )


def run(options: argparse.Namespace, notify: Callable[[str], None], aside: Callable[[str], None]) -> int:
    """Join them.

    Raises:
        RecordingError: One is broken, or they do not belong together.
    """
    from slave.join import join_recordings

    def progress(done: int, total: int) -> None:
        if done % _EVERY == 0:
            aside(f"{done} of {total} frames")

    counts = join_recordings(options.recordings, options.output, options.by_wall_clock, progress)
    notify(f"{options.output}: " + ", ".join(f"{name} {count} frames" for name, count in counts.items()))
    return 0
