"""Message recorder with a bounded queue.

One thread writes what is offered and monitors the disk.

    threads of the bus ── offer ──▶ bounded queue ──▶ writer ──▶ file
                            └ queue full: dropped, and counted by stream

Whoever offers never waits for the disk. Where less than a reserve would be left of it, where it is full or gone, the
recording ends with what was written, and `failure` states why.
"""

import queue
import shutil
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from common.errors import RecordingError
from common.messages import Message, Preview, Still
from common.recording.messages import MessageWriter

_POLL_S = 0.25  # so often the disk is looked at, and what waits in a chunk given to it


@dataclass(frozen=True, slots=True)
class Progress:
    """How a recording is.

    Attributes:
        seconds: From the first message to the last that was taken [s].
        written_bytes: The file so far.
        bytes_per_s: Over a second or more, the last that is over.
        free_bytes: Free on the disk.
        waiting: Messages in the queue.
        counts: Stream -> messages written.
        dropped: Stream -> messages that did not fit the queue, or came out of it after a failure.
    """

    seconds: float
    written_bytes: int
    bytes_per_s: float
    free_bytes: int
    waiting: int
    counts: dict[str, int]
    dropped: dict[str, int]


class MessageRecorder:
    """Writer of offered messages.

    Holds the queue, its thread, and the counts, each written by one thread alone.
    """

    def __init__(
        self,
        writer: MessageWriter,
        folder: Path,
        # a system without any room left cannot even be logged in to
        reserve_bytes: int = 200_000_000,
        # messages that may wait for the disk: some seconds
        depth: int = 20_000,
        free_bytes: Callable[[Path], int] = lambda folder: shutil.disk_usage(folder).free,
    ) -> None:
        """Start the thread.

        Args:
            writer: Of the file; closed by `close`.
            folder: Where the file stands.
            reserve_bytes: Stays free on its disk.
            depth: Messages that may wait.
            free_bytes: What is free on the disk of a folder.
        """
        self._writer, self._folder, self._reserve, self._free = writer, folder, reserve_bytes, free_bytes
        self._waiting: queue.Queue[tuple[str, Message, int]] = queue.Queue(depth)
        self._lock = threading.Lock()
        self._dropped: Counter[str] = Counter()
        self._counts: Counter[str] = Counter()
        self._first_ns: int | None = None
        self._last_ns = 0
        self._shown, self._bytes_per_s = (time.monotonic(), 0), 0.0
        self._closing = threading.Event()
        self.failure: RecordingError | None = None
        self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
        self._thread.start()

    def offer(self, stream: str, message: Message, t_ns: int) -> None:
        """Take a message that came at `t_ns`, or count it as dropped.

        Never waits. Any thread may call it.
        """
        # and no picture is taken where so many wait: they would fill the memory
        pictures = isinstance(message, Preview | Still) and self._waiting.qsize() >= 100
        if self.failure is None and not self._closing.is_set() and not pictures:
            try:
                self._waiting.put_nowait((stream, message, t_ns))
            except queue.Full:
                pass
            else:
                return
        with self._lock:
            self._dropped[stream] += 1

    @property
    def seconds(self) -> float:
        """From the first message to the last that was taken [s]."""
        with self._lock:
            return 0.0 if self._first_ns is None else (self._last_ns - self._first_ns) * 1e-9

    def progress(self) -> Progress:
        """How it is now."""
        try:
            free = self._free(self._folder)
        except OSError:
            free = 0  # the disk is gone; the writer will report it
        with self._lock:
            now, written = time.monotonic(), self._writer.bytes_written
            before, had = self._shown
            rate_s = 0.9
            if now - before >= rate_s:  # several may ask; nobody shortens the time of another
                self._shown, self._bytes_per_s = (now, written), (written - had) / (now - before)
            return Progress(
                0.0 if self._first_ns is None else (self._last_ns - self._first_ns) * 1e-9,
                written,
                self._bytes_per_s,
                free,
                self._waiting.qsize(),
                dict(self._counts),
                dict(self._dropped),
            )

    def close(self) -> None:
        """Write what waits and end the file.

        `failure` states if that failed. Safe to call twice.
        """
        self._closing.set()
        self._thread.join()

    def _work(self) -> None:
        looked = 0.0
        while not (self._closing.is_set() and self._waiting.empty()):
            try:
                if time.monotonic() - looked > _POLL_S:
                    looked = time.monotonic()
                    self._look()
                self._write_next()
            except RecordingError as error:
                self.failure = error
                break
        try:
            self._writer.close()
        except RecordingError as error:
            self.failure = error
        with self._lock:
            while not self._waiting.empty():
                self._dropped[self._waiting.get_nowait()[0]] += 1

    def _write_next(self) -> None:
        try:
            stream, message, t_ns = self._waiting.get(timeout=_POLL_S)
        except queue.Empty:
            self._writer.flush()  # nothing comes: what is there need not wait for company
            return
        with self._lock:
            self._counts[stream] += 1
            self._first_ns = t_ns if self._first_ns is None else self._first_ns
            self._last_ns = max(self._last_ns, t_ns)
        self._writer.write(stream, message, t_ns)

    def _look(self) -> None:
        """End in time.

        Raises:
            RecordingError: No more room beside the reserve.
        """
        try:
            free = self._free(self._folder)
        except OSError as error:
            raise RecordingError(f"{self._folder}: the disk is gone: {error.strerror}") from error
        if free < self._reserve:
            raise RecordingError(
                f"{self._folder}: recording ended: {free * 1e-6:.0f} MB are free on the disk and"
                f" {self._reserve * 1e-6:.0f} MB stay free (--reserve-mb)"
            )
