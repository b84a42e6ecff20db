"""The recorder writes messages to a file while slaves keep their raw frames.

Whoever offers never waits for the disk (`Worker`); what its queue has no room for is counted by stream. Where
less than a reserve would be left of the disk, where it is full or gone, the recording ends with what was
written, and `failure` states why.

Each camera's slave is asked for raw frames again and again, on a thread of its own: it goes on for as long as
it is asked, so that a recorder that was killed, or lost its master, leaves ended recordings behind. A camera
that refuses is reported, and asked no more; the recording of messages goes on in any case.
"""

import json
import shutil
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from common.bus.bus import Bus
from common.errors import BusError, CalibrationError, RecordingError
from common.messages import Command, Health, Message, Preview, Still
from common.messages.command_bodies import RawRequest, raw_name, refuse_strange
from common.recording.messages import MessageWriter
from master.outputs.worker import Worker

_POLL_S = 0.25  # so often the disk is looked at, and what waits in a chunk given to it


@dataclass(frozen=True, slots=True)
class Progress:
    """How a recording is."""

    seconds: float  # from the first message to the last that was taken [s]
    written_bytes: int
    bytes_per_s: float  # over a second or more, the last that is over
    free_bytes: int
    waiting: int  # messages in the queue
    counts: dict[str, int]  # stream -> messages written
    # stream -> messages that did not fit the queue, or came out of it after a failure
    dropped: dict[str, int]


class MessageRecorder:
    """Writer of offered messages; each count is written by one thread alone."""

    def __init__(
        self,
        writer: MessageWriter,
        folder: Path,
        reserve_bytes: int = 200_000_000,
        depth: int = 20_000,
        free_bytes: Callable[[Path], int] = lambda folder: shutil.disk_usage(folder).free,
    ) -> None:
        """Start the thread.

        Args:
            writer: Of the file in `folder`; closed by `close`.
            reserve_bytes: Stays free on its disk: a full system cannot even be logged in to.
            depth: Messages that may wait for the disk: some seconds.
            free_bytes: What is free on the disk of a folder.
        """
        self._writer, self._folder, self._reserve, self._free = writer, folder, reserve_bytes, free_bytes
        self._lock = threading.RLock()
        self._dropped: Counter[str] = Counter()
        self._counts: Counter[str] = Counter()
        self._first_ns: int | None = None
        self._last_ns = 0
        self._shown, self._bytes_per_s = (time.monotonic(), 0), 0.0
        self.failure: RecordingError | None = None
        self._worker = Worker[tuple[str, Message, int]]("recorder", self._work, depth)
        self._worker.start()

    def offer(self, stream: str, message: Message, t_ns: int) -> None:
        """Take a message of any thread, or count it as dropped; never wait."""
        # no picture is taken where so many wait: they would fill the memory
        refused = isinstance(message, Preview | Still) and self._worker.waiting >= 100
        if refused or self.failure is not None or self._worker.offer((stream, message, t_ns)) is not None:
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
                self.seconds,
                written,
                self._bytes_per_s,
                free,
                self._worker.waiting,
                dict(self._counts),
                dict(self._dropped),
            )

    def close(self) -> None:
        """Write what waits and end the file, see `failure`. Safe to call twice."""
        self._worker.close()

    def _work(self) -> None:
        looked = 0.0
        try:
            while self._worker.waiting or not self._worker.closing:
                if time.monotonic() - looked > _POLL_S:
                    looked = time.monotonic()
                    self._look()
                if (offered := self._worker.take(_POLL_S)) is not None:
                    self._write(*offered)
                else:
                    self._writer.flush()  # nothing comes: what is there need not wait for company
        except RecordingError as error:
            self.failure = error
        try:
            self._writer.close()
        except RecordingError as error:
            self.failure = error
        with self._lock:
            self._dropped.update(stream for stream, _, _ in self._worker.clear())

    def _write(self, stream: str, message: Message, t_ns: int) -> None:
        with self._lock:
            self._counts[stream] += 1
            self._first_ns = t_ns if self._first_ns is None else self._first_ns
            self._last_ns = max(self._last_ns, t_ns)
        self._writer.write(stream, message, t_ns)

    def _look(self) -> None:
        """End in time; RecordingError: no more room beside the reserve."""
        try:
            free = self._free(self._folder)
        except OSError as error:
            raise RecordingError(f"{self._folder}: the disk is gone: {error.strerror}") from error
        if free < self._reserve:
            raise RecordingError(
                f"{self._folder}: recording ended: {free * 1e-6:.0f} MB are free on the disk and"
                f" {self._reserve * 1e-6:.0f} MB stay free (--reserve-mb)"
            )


LEASE_S = 10.0
_ASK_S = 3.0
_STOP_S = 30.0  # what waits for a slow disk is written first


@dataclass(slots=True)
class _Camera:
    """One camera: which folder of it is the present one, and how it is."""

    name: str
    number: int = 1
    begun: bool = False
    ended: int = 0  # by faults, as it reported last
    here: bool = False
    refused: bool = False
    silent: bool = False


class RawAsker:
    """Requester of the raw frames of all cameras of one recording."""

    def __init__(
        self,
        stem: str,
        cameras: Sequence[str],
        notify: Callable[[str], None],
        keep: Callable[[Health], None],
        period_s: float = 2.0,
    ) -> None:
        """Ask nothing yet.

        Args:
            stem: Name of the recording of messages.
            notify: Called with a line when something changes.
            keep: Given what a slave answers at beginning and end.

        Raises:
            RecordingError: A folder cannot have the name that follows from the stem.
        """
        try:
            for camera in cameras:
                refuse_strange(raw_name(stem, camera), "--raw: folder")
        except CalibrationError as error:
            raise RecordingError(f"{error}: name the recording otherwise") from error
        self._stem, self._notify, self._keep, self._period_s = stem, notify, keep, period_s
        self._cameras = [_Camera(name) for name in cameras]
        self._closing = threading.Event()
        self._threads: list[threading.Thread] = []

    def attach(self, bus: Bus) -> None:
        """Ask by this connection, which must stay open until `detach` or `end`."""
        self._closing.clear()
        self._threads = [
            threading.Thread(target=self._work, args=(camera, bus), name=f"raw {camera.name}", daemon=True)
            for camera in self._cameras
        ]
        for thread in self._threads:
            thread.start()

    def detach(self) -> None:
        """Stop asking; raw recordings then end by themselves. Safe to call twice."""
        self._closing.set()
        for thread in self._threads:
            thread.join()
        self._threads = []

    def end(self, bus: Bus) -> None:
        """End the raw recordings of all present cameras together; print their state."""
        self.detach()
        there = [camera for camera in self._cameras if camera.begun and camera.here]
        threads = [threading.Thread(target=self._end, args=(camera, bus), daemon=True) for camera in there]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    def _folder(self, camera: _Camera) -> str:
        return raw_name(self._stem, camera.name, camera.number)

    def _work(self, camera: _Camera, bus: Bus) -> None:
        while not camera.refused:
            self._ask(camera, bus)
            if self._closing.wait(self._period_s):
                return

    def _ask(self, camera: _Camera, bus: Bus) -> None:
        request = RawRequest(name=self._folder(camera), lease_s=LEASE_S)
        try:
            answer = bus.ask(Command(camera.name, "raw", request.body()), _ASK_S)
        except BusError as error:
            camera.here = "refused" in str(error)  # one that refuses is there
            if camera.here:
                self._refused(camera, bus, error)
            elif not camera.silent:
                camera.silent = True
                self._notify(f"camera {camera.name} does not answer; its raw frames begin when it does")
            return
        camera.here, camera.silent, camera.ended = True, False, answer.counts.get("raw.ended", 0)
        if not camera.begun:
            camera.begun = True
            self._notify(f"camera {camera.name}: raw frames into {self._folder(camera)}")
            self._keep(answer)

    def _refused(self, camera: _Camera, bus: Bus, error: BusError) -> None:
        """Restart where the camera was away and has ended; else the refusal is final."""
        if camera.begun and self._was_absent(camera, bus):
            camera.begun, camera.number = False, camera.number + 1
            self._ask(camera, bus)
            return
        camera.refused = True
        verb = "ended" if camera.begun else "not recorded"
        self._notify(f"camera {camera.name}: raw frames {verb}: {error}")

    def _was_absent(self, camera: _Camera, bus: Bus) -> bool:
        """Whether it ended its recording for want of us, not for a fault of its own."""
        try:
            answer = bus.ask(Command(camera.name, "report"), _ASK_S)
        except BusError:
            return False
        return answer.counts.get("raw.ended", 0) <= camera.ended

    def _end(self, camera: _Camera, bus: Bus) -> None:
        try:
            answer = bus.ask(Command(camera.name, "raw_stop"), _STOP_S)
        except BusError as error:
            self._notify(f"camera {camera.name}: raw frames end within {LEASE_S:g} s by themselves: {error}")
            return
        self._keep(answer)
        frames, dropped = answer.counts.get("raw.frames", 0), answer.counts.get("raw.dropped", 0)
        self._notify(
            f"camera {camera.name}: {frames} raw frames, {dropped} dropped, in {self._folder(camera)}"
            f" ({answer.metrics.get('raw.megabytes', 0.0):.1f} MB)"
        )


def raw_text(stem: str, cameras: Sequence[str]) -> str:
    """Map each camera to its raw folder, as a recording of messages stores it."""
    return json.dumps({camera: raw_name(stem, camera) for camera in cameras})
