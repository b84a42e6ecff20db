"""Record the raw frames of one camera to disk, and show the progress.

    camera loop ── offer ──▶ bounded queue ──▶ encoders (PNG) ──▶ one writer: the file, then its row
                     │
                     └ queue full: dropped, counted, a gap in `seq`

The camera never waits for the disk. The recording ends with what was complete where less than a reserve would be left
on the disk, or it is full or gone, and `failure` states why.
"""

import math
import os
import queue
import shutil
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TextIO

import numpy as np

from common.clock import Clock
from common.errors import RecordingError
from common.recording.frame_recording import Illumination, Manifest, RecordedClock
from common.recording.frame_writing import RecordingWriter, encode_png
from slave.cameras.replay import is_grey
from slave.sources import Frame, FrameSource


@dataclass(frozen=True, slots=True)
class Length:
    """Length of a recording: until one of the two is reached, or until stopped."""

    seconds: float | None = None  # between the first and the last frame [s], by the times of the frames
    frames: int | None = None  # frames recorded; dropped ones do not count

    def expected(self, rate_hz: float) -> int | None:
        """How many frames that is at `rate_hz` frames per second; None: not known."""
        by_time = None if self.seconds is None else math.ceil(self.seconds * rate_hz)
        return min((count for count in (self.frames, by_time) if count is not None), default=None)

    def left_s(self, elapsed_s: float, frames: int, rate_hz: float) -> float | None:
        """Time left [s] after `elapsed_s` and `frames`; 0: reached; None: until stopped."""
        left = [] if self.frames is None else [(self.frames - frames) / rate_hz]
        if self.seconds is not None:
            left.append(self.seconds - elapsed_s)
        return max(min(left), 0.0) if left else None


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of a recording."""

    frames: int  # written: file and row
    # did not fit the queue, or came out of it after the end: the disk or the encoders were too slow
    dropped: int
    lost: int  # gaps in the camera's own counter
    waiting: int  # frames in the queue, of `capacity`
    capacity: int
    written_bytes: int
    bytes_per_s: float  # over the last second
    free_bytes: int  # free on the disk
    seconds: float  # from the first frame to the last that was taken [s]
    left_s: float | None  # until the length asked for [s]; None: until stopped
    disk_s: float  # until the reserve of the disk is reached [s]; infinite while nothing is written


class ProgressDisplay:
    """Shows the progress: on a terminal in place, elsewhere a line at every 5th call."""

    def __init__(self, name: str, stream: TextIO) -> None:
        self._name = name
        self._stream = stream
        self._calls = 0

    def show(self, progress: Progress) -> None:
        """Show the progress; called once a second."""
        self._calls += 1
        if self._stream.isatty():
            self._write(f"\r{self._name}: {progress_text(progress)}\x1b[K")
        elif self._calls % 5 == 0:
            self._write(f"{self._name}: {progress_text(progress)}\n")

    def end(self, progress: Progress) -> None:
        """Show the end of the recording."""
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
    """The progress as one line."""
    parts = [f"{progress.frames} frames", f"{progress.dropped} dropped"]
    if progress.lost:
        parts.append(f"{progress.lost} lost by the camera")
    parts += [f"queue {progress.waiting}/{progress.capacity}", f"{progress.bytes_per_s * 1e-6:.1f} MB/s"]
    parts.append(f"{megabytes(progress.free_bytes)} free")
    if progress.disk_s < (math.inf if progress.left_s is None else progress.left_s):
        parts.append(f"disk full in {progress.disk_s:.0f} s")
    elif progress.left_s is not None:
        parts.append(f"{progress.left_s:.0f} s left")
    return ", ".join(parts)


def megabytes(count: int) -> str:
    """A number of bytes as MB or GB."""
    return f"{count * 1e-9:.1f} GB" if count >= 10**9 else f"{count * 1e-6:.1f} MB"


RESERVE_BYTES = 200_000_000  # a system without any room left cannot even be logged in to
ENCODERS = 4
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")  # Linux: a new one at every start of the machine


class _Waiting(NamedTuple):
    """A frame on its way to the disk; its pixels are with the encoder."""

    seq: int
    t_ns: int
    illumination: Illumination
    png: Future[bytes]


class Recorder:
    """Writer of the frames it is offered; each count is written by one thread alone."""

    def __init__(
        self,
        folder: Path,
        manifest: Manifest,
        camera: str,
        length: Length,
        show: Callable[[Progress], None] = lambda _progress: None,
        reserve_bytes: int = RESERVE_BYTES,
        # a quarter of the smallest slave's memory; at 640x480, 90 Hz it bridges 1.5 s
        queue_bytes: int = 128_000_000,
        free_bytes: Callable[[Path], int] = lambda folder: shutil.disk_usage(folder).free,
        encoders: int = ENCODERS,
        reserve_option: str = "--reserve-mb",
    ) -> None:
        """Make the recording in the new or empty `folder`, and start the threads.

        `show` is called once a second, on a thread of its own; `reserve_bytes` stay free on the disk; `queue_bytes`
        are for frames that wait, of which two fit in any case; `encoders` at most, and one a core; `reserve_option`
        is for errors.

        Raises:
            RecordingError: The folder holds something, or cannot be written.
        """
        self._writer = RecordingWriter(folder, manifest)
        self._folder, self._camera, self._length = folder, manifest.cameras[camera], length
        self._name, self._show, self._reserve, self._free = camera, show, reserve_bytes, free_bytes
        self._reserve_option = reserve_option
        frame_bytes = self._camera.width_px * self._camera.height_px * (1 if is_grey(manifest, camera) else 3)
        self._capacity = max(queue_bytes // frame_bytes, 2)
        self._waiting: queue.Queue[_Waiting | None] = queue.Queue(self._capacity)
        self._encoders = ThreadPoolExecutor(min(encoders, os.cpu_count() or 1), f"{camera} png")
        self._taken = self._refused = self._lost = 0  # by the camera's thread
        self._first_ns = self._last_ns = 0
        self._last_seq: int | None = None
        self._frames = self._unwritten = self._bytes = 0  # by the writer
        self._bytes_per_s = 0.0  # by the one that shows
        self._closing = threading.Event()
        self.failure: RecordingError | None = None
        self._threads = [
            threading.Thread(target=work, name=f"{camera} {work.__name__}", daemon=True)
            for work in (self._write_all, self._show_all)
        ]
        for thread in self._threads:
            thread.start()

    @property
    def wants_more(self) -> bool:
        """Whether the length is not reached, and nothing has failed."""
        return self.failure is None and self._left_s() != 0.0

    def offer(self, frame: Frame) -> None:
        """Take a frame, or count it as dropped; never wait. Ignored after the end.

        Raises:
            RecordingError: The image is not of the size given by the camera file.
        """
        size = (self._camera.height_px, self._camera.width_px)
        if frame.image.shape[:2] != size or frame.image.dtype != np.uint8:
            height, width = frame.image.shape[:2]
            raise RecordingError(
                f"camera {self._name!r} gives {width}x{height} px of {frame.image.dtype}, its file says "
                f"{size[1]}x{size[0]} px of uint8; nobody could replay that"
            )
        if self._last_seq is None:
            self._first_ns = frame.t_ns
        else:
            self._lost += max(frame.seq - self._last_seq - 1, 0)
        self._last_seq, self._last_ns = frame.seq, frame.t_ns
        if not self.wants_more:
            return
        if self._waiting.full():  # only this thread puts, so there is still room below
            self._refused += 1
            return
        png = self._encoders.submit(encode_png, frame.image)
        self._waiting.put_nowait(_Waiting(frame.seq, frame.t_ns, frame.illumination, png))
        self._taken += 1

    def progress(self) -> Progress:
        """The progress now, from any thread."""
        try:
            free = self._free(self._folder)
        except OSError:
            free = 0  # the disk is gone; the writer will report it
        room = max(free - self._reserve, 0)
        return Progress(
            self._frames,
            self._refused + self._unwritten,
            self._lost,
            self._waiting.qsize(),
            self._capacity,
            self._bytes,
            self._bytes_per_s,
            free,
            (self._last_ns - self._first_ns) * 1e-9,
            self._left_s(),
            room / self._bytes_per_s if self._bytes_per_s > 0.0 else float("inf"),
        )

    def close(self) -> None:
        """Write what waits and end; one without any frame is removed. Safe to call twice."""
        if not self._closing.is_set():
            self._closing.set()
            self._waiting.put(None)
        for thread in self._threads:
            thread.join()
        self._encoders.shutdown()
        self._writer.discard()

    def _left_s(self) -> float | None:
        elapsed_s = (self._last_ns - self._first_ns) * 1e-9
        return self._length.left_s(elapsed_s, self._taken, self._camera.frame_rate_hz)

    def _write_all(self) -> None:
        while (frame := self._waiting.get()) is not None:
            if self.failure is not None:
                frame.png.cancel()
                self._unwritten += 1
                continue
            try:
                self._write(frame, frame.png.result())
            except RecordingError as error:
                self.failure = error
                self._unwritten += 1

    def _write(self, frame: _Waiting, png: bytes) -> None:
        """Write one frame; `RecordingError`: no room, at first for all that is to come."""
        try:
            free = self._free(self._folder)
        except OSError as error:
            raise RecordingError(f"{self._folder}: the disk is gone: {error.strerror}") from error
        expected = self._length.expected(self._camera.frame_rate_hz)
        if self._frames == 0 and expected is not None and expected * len(png) > free - self._reserve:
            fit = max(free - self._reserve, 0) // len(png)
            raise RecordingError(
                f"{self._folder}: {expected} frames of {megabytes(len(png))} need {megabytes(expected * len(png))}, "
                f"{megabytes(free)} are free and {megabytes(self._reserve)} stay free ({self._reserve_option}): "
                f"make room, or record at most {fit} frames ({fit / self._camera.frame_rate_hz:.1f} s)"
            )
        if free - len(png) < self._reserve:
            raise RecordingError(
                f"{self._folder}: ended after {self._frames} frames: {megabytes(free)} are free on the disk and "
                f"{megabytes(self._reserve)} stay free ({self._reserve_option})"
            )
        self._writer.add(self._name, frame.seq, frame.t_ns, frame.illumination, png)
        self._frames += 1
        self._bytes += len(png)

    def _show_all(self) -> None:
        since_ns, before = time.monotonic_ns(), 0
        while not self._closing.wait(1.0):
            now_ns, written = time.monotonic_ns(), self._bytes
            self._bytes_per_s = (written - before) * 1e9 / max(now_ns - since_ns, 1)
            since_ns, before = now_ns, written
            self._show(self.progress())


def feed(source: FrameSource, recorder: Recorder, stop: threading.Event) -> None:
    """Offer every frame until the length or the source ends, or `stop` is set."""
    while not stop.is_set() and recorder.wants_more and (frame := source.read()) is not None:
        recorder.offer(frame)


def clock_of(clock: Clock, simulated: str = "") -> RecordedClock | None:
    """Clock of a recording; `simulated`: how it differs from the machine's."""
    try:
        boot = BOOT_ID.read_text().strip()
    except OSError:
        return None
    readings: list[tuple[int, int]] = []
    for _ in range(8):
        before_ns, wall_ns, after_ns = clock.now_ns(), time.time_ns(), clock.now_ns()
        readings.append((after_ns - before_ns, wall_ns - (before_ns + after_ns) // 2))
    return RecordedClock(id=boot + simulated, wall_ahead_ns=min(readings)[1])  # of the shortest look
