"""Length, counts and progress line of a recording.

The length is what it was asked for; the line reports how far it is.
"""

import math
from dataclasses import dataclass
from typing import TextIO


@dataclass(frozen=True, slots=True)
class Length:
    """Length of a recording.

    Until one of the two is reached, or, with neither, until stopped.

    Attributes:
        seconds: Between the first and the last frame [s], by the times of the frames.
        frames: Frames recorded; dropped ones do not count.
    """

    seconds: float | None = None
    frames: int | None = None

    def expected(self, rate_hz: float) -> int | None:
        """How many frames that is at `rate_hz` frames per second; None: not known."""
        counts = [] if self.frames is None else [self.frames]
        if self.seconds is not None:
            counts.append(math.ceil(self.seconds * rate_hz))
        return min(counts, default=None)

    def left_s(self, elapsed_s: float, frames: int, rate_hz: float) -> float | None:
        """Time left [s] after `elapsed_s` and `frames`; 0: reached; None: until stopped."""
        left = [] if self.frames is None else [(self.frames - frames) / rate_hz]
        if self.seconds is not None:
            left.append(self.seconds - elapsed_s)
        return max(min(left), 0.0) if left else None


@dataclass(frozen=True, slots=True)
class Progress:
    """How a recording is.

    Attributes:
        frames: Written: file and row.
        dropped: Did not fit the queue, or came out of it after the end: the disk or the encoders were too slow.
        lost: Gaps in the camera's own counter.
        waiting: Frames in the queue, of `capacity`.
        written_bytes: All files so far.
        bytes_per_s: Over the last second.
        free_bytes: Free on the disk.
        seconds: From the first frame to the last that was taken [s].
        left_s: Until the length asked for [s]; None: until stopped.
        disk_s: Until the reserve of the disk is reached [s]; infinite while nothing is written.
    """

    frames: int
    dropped: int
    lost: int
    waiting: int
    capacity: int
    written_bytes: int
    bytes_per_s: float
    free_bytes: int
    seconds: float
    left_s: float | None
    disk_s: float


class ProgressDisplay:
    """Display of the progress.

    On a terminal in place at every call, elsewhere a line at every fifth.

    Holds how often it was called.
    """

    def __init__(self, name: str, stream: TextIO) -> None:
        """Show the recording of camera `name` on `stream`."""
        self._name = name
        self._stream = stream
        self._calls = 0

    def show(self, progress: Progress) -> None:
        """The recording goes on; called once a second."""
        self._calls += 1
        plain_every = 5  # calls, where no terminal shows the line in place
        if self._stream.isatty():
            self._write(f"\r{self._name}: {progress_text(progress)}\x1b[K")
        elif self._calls % plain_every == 0:
            self._write(f"{self._name}: {progress_text(progress)}\n")

    def end(self, progress: Progress) -> None:
        """The recording is over."""
        text = (
            f"{self._name}: {progress.frames} frames in {progress.seconds:.2f} s, {progress.dropped} dropped, "
            f"{progress.lost} lost by the camera, {megabytes(progress.written_bytes)}"
        )
        self._write(f"\r{text}\x1b[K\n" if self._stream.isatty() else f"{text}\n")

    def _write(self, text: str) -> None:
        try:
            self._stream.write(text)
            self._stream.flush()
        except OSError:
            return  # nobody reads any more; the recording goes on


def progress_text(progress: Progress) -> str:
    """One line for a person who waits."""
    parts = [f"{progress.frames} frames", f"{progress.dropped} dropped"]
    if progress.lost:
        parts.append(f"{progress.lost} lost by the camera")
    parts.append(f"queue {progress.waiting}/{progress.capacity}")
    parts.append(f"{progress.bytes_per_s * 1e-6:.1f} MB/s")
    parts.append(f"{megabytes(progress.free_bytes)} free")
    if progress.disk_s < (math.inf if progress.left_s is None else progress.left_s):
        parts.append(f"disk full in {progress.disk_s:.0f} s")
    elif progress.left_s is not None:
        parts.append(f"{progress.left_s:.0f} s left")
    return ", ".join(parts)


def megabytes(count: int) -> str:
    """A number of bytes as MB or GB."""
    return f"{count * 1e-9:.1f} GB" if count >= 10**9 else f"{count * 1e-6:.1f} MB"
