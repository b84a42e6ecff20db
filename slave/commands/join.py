"""`phalanx-slave record --join`: one recording of several cameras."""

import argparse

from common.terminal import echo, remark


def join(options: argparse.Namespace) -> int:
    """Join them.

    Raises:
        RecordingError: One is broken, or they do not belong together.
    """
    from slave.join import join_recordings

    def progress(done: int, total: int) -> None:
        every = 500  # frames, between two lines that report the progress
        if done % every == 0:
            remark(f"{done} of {total} frames")

    counts = join_recordings(options.join, options.output, options.by_wall_clock, progress)
    echo(f"{options.output}: " + ", ".join(f"{name} {count} frames" for name, count in counts.items()))
    return 0
