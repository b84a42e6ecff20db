"""Record raw frames to disk while the slave goes on detecting.

    raw         begin a recording of raw frames, or ask for it to go on (body: `command_bodies.RawRequest`)
    raw_stop    end it; the answer comes when every frame that waited is written

What is written is a folder as `phalanx-slave record` makes it, by the same recorder. The loop hands a frame over when
it comes back for the next one: what was found in it is out by then. It never waits, and no fault of the disk reaches
it: the recording ends with what was complete, is counted and logged.
"""

import logging
import os
import shutil
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from common.calibration import CameraCalibration, load
from common.clock import Clock
from common.errors import CalibrationError, RecordingError
from common.messages.command_bodies import RawRequest
from common.recording.frame_recording import Manifest
from slave.recorder import ENCODERS, RESERVE_BYTES, Length, Recorder, clock_of, megabytes
from slave.sources import Frame, FrameSource, Reporting
from slave.tuning import CameraFiles

GONE_S = 10.0  # a master that was away for so long ends it: nobody else could
RESERVE_OPTION = "--raw-reserve-mb"
NO_FOLDER = "{}: this slave keeps no raw frames: start it with `phalanx-slave run ... --raw-folder DIR`"
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class RawSettings:
    """Where raw frames go."""

    folder: Path  # where each recording is a folder
    reserve_bytes: int = RESERVE_BYTES  # stays free on its disk
    skewed: str = ""  # how the slave's clock differs from the machine's; empty: it is the machine's


class RawFrames(Reporting):
    """Answers "raw" and "raw_stop", and counts, for `slave.report.Reporter`."""

    def __init__(
        self,
        camera: str,
        settings: RawSettings | None,
        files: Callable[[], CameraFiles],
        clock: Clock,
        here: Callable[[], bool],
        free_bytes: Callable[[Path], int] = lambda folder: shutil.disk_usage(folder).free,
    ) -> None:
        """Record nothing yet; without `settings` both commands are refused."""
        self._camera, self._settings, self._files, self._clock = camera, settings, files, clock
        self._here, self._free = here, free_bytes
        self._command_lock = threading.Lock()  # of commands, and of whoever looks
        self._lock = threading.Lock()  # the loop's: held for as long as a frame is handed over
        self._recorder: Recorder | None = None
        self._last: Recorder | None = None
        self._name = ""
        self._lease_s = self._until = self._here_at = 0.0
        self._fault: RecordingError | None = None  # by the loop: an image that does not fit
        self._failure: RecordingError | None = None  # why the recording of that name ended
        self._closer: threading.Thread | None = None
        self._ended = 0

    def offer(self, frame: Frame) -> None:
        """Take a frame while something is recorded. Never waits, never raises."""
        idle = self._recorder is None
        if idle:
            return
        with self._lock:
            recorder = self._recorder
            if recorder is None or self._fault is not None:  # ended meanwhile, or about to be
                return
            try:
                recorder.offer(frame)
            except RecordingError as error:
                self._fault = error

    def commands(self) -> dict[str, Callable[[str], dict[str, float]]]:
        """Verb -> handler: takes the body, returns metrics, may raise `PhalanxError`."""
        return {"raw": self._raw, "raw_stop": self._raw_stop}

    def counts(self) -> dict[str, int]:
        """`raw.frames`, `raw.dropped` of the last recording; `raw.ended` by a fault."""
        if self._settings is None:
            return {}
        now = None if (last := self._last) is None else last.progress()
        frames, dropped = (0, 0) if now is None else (now.frames, now.dropped)
        return {"raw.frames": frames, "raw.dropped": dropped, "raw.ended": self._ended}

    def metrics(self) -> dict[str, float]:
        """`raw.megabytes` of the last recording; `raw.on`: whether frames are taken now."""
        if self._settings is None:
            return {}
        written = 0 if (last := self._last) is None else last.progress().written_bytes
        return {"raw.megabytes": round(written * 1e-6, 3), "raw.on": float(self._recorder is not None)}

    def look(self) -> None:
        """End a recording that failed, is unwanted, or has lost its master."""
        with self._command_lock:
            self._look()

    def close(self) -> None:
        """End the recording. Safe to call twice."""
        with self._command_lock:
            self._end("the slave ends")
            self._join()

    def _raw(self, body: str) -> dict[str, float]:
        settings = self._wanted("raw")
        request = RawRequest.of(body)
        with self._command_lock:
            self._look()
            if self._recorder is None:
                if self._failure is not None and request.name == self._name:
                    raise RecordingError(f"raw: {self._failure}")
                self._begin(request, settings)
            elif request.name != self._name:
                raise RecordingError(
                    f"raw: {settings.folder / self._name} is being recorded: raw_stop ends it"
                )
            self._lease_s, self._until = request.lease_s, time.monotonic() + request.lease_s
        return self.metrics()

    def _raw_stop(self, body: str) -> dict[str, float]:
        self._wanted("raw_stop")
        if body:
            raise CalibrationError("raw_stop: takes no body")
        with self._command_lock:
            self._look()
            self._end("raw_stop")
            self._join()
        return self.metrics()

    def _wanted(self, verb: str) -> RawSettings:
        if self._settings is None:
            raise RecordingError(NO_FOLDER.format(verb))
        return self._settings

    def _begin(self, request: RawRequest, settings: RawSettings) -> None:
        self._join()
        try:
            free = self._free(settings.folder)
        except OSError as error:
            raise RecordingError(f"raw: {settings.folder}: {error.strerror}") from error
        if free < settings.reserve_bytes:
            raise RecordingError(
                f"raw: {settings.folder}: {megabytes(free)} are free on the disk and "
                f"{megabytes(settings.reserve_bytes)} stay free ({RESERVE_OPTION}): make room"
            )
        recorder = Recorder(
            settings.folder / request.name,
            self.manifest(settings.skewed),
            self._camera,
            Length(),
            reserve_bytes=settings.reserve_bytes,
            free_bytes=self._free,
            encoders=max(min(ENCODERS, (os.cpu_count() or 1) - 1), 1),  # a core stays with the loop
            reserve_option=RESERVE_OPTION,
        )
        self._name, self._failure, self._fault, self._here_at = request.name, None, None, time.monotonic()
        self._last = self._recorder = recorder
        _LOG.info("raw frames into %s", settings.folder / request.name)

    def manifest(self, skewed: str) -> Manifest:
        """Of a recording that begins now; `skewed` as of `RawSettings`."""
        files = self._files()
        others = {n: files.camera_path.with_name(f"{n}.json") for n in files.rig.cameras if n != self._camera}
        try:
            cameras = {name: load(path, CameraCalibration) for name, path in others.items()}
        except CalibrationError as error:
            raise CalibrationError(
                f"raw: a recording carries the files of all cameras of rig {files.rig.name!r}: {error}"
            ) from error
        return Manifest(
            version=1,
            kind=files.rig.kind,
            cameras={name: cameras.get(name, files.camera) for name in files.rig.cameras},
            rig=files.rig,
            clock=clock_of(self._clock, skewed),
            objects={profile.name: profile for profile in files.objects},
        )

    def _look(self) -> None:
        recorder, now_s = self._recorder, time.monotonic()
        if recorder is None:
            return
        if self._here():
            self._here_at = now_s
        if (failure := recorder.failure or self._fault) is not None:
            self._failure = failure
            self._ended += 1
            _LOG.warning("raw frames ended: %s", failure)
            self._end("a fault")
        elif self._lease_s and now_s > self._until:
            self._end(f"nobody has asked for more within {self._lease_s:g} s")
        elif now_s > self._here_at + GONE_S:
            self._end("the master is gone")

    def _end(self, why: str) -> None:
        """Stop taking frames; a thread of its own writes what waits."""
        with self._lock:
            recorder, self._recorder = self._recorder, None
        if recorder is None:
            return

        def close() -> None:
            recorder.close()
            now = recorder.progress()
            _LOG.info("raw frames: %d recorded, %d dropped; ended: %s", now.frames, now.dropped, why)

        self._closer = threading.Thread(target=close, name=f"{self._camera} raw", daemon=True)
        self._closer.start()

    def _join(self) -> None:
        closer, self._closer = self._closer, None
        if closer is not None:
            closer.join()


class RawProbe:
    """Camera that offers each frame when the loop comes back for the next one."""

    def __init__(self, source: FrameSource, *offers: Callable[[Frame], None]) -> None:
        self._source, self._offers = source, offers
        self._last: Frame | None = None

    def read(self) -> Frame | None:
        """The next frame (see `FrameSource.read`)."""
        self.flush()
        self._last = self._source.read()
        return self._last

    def flush(self) -> None:
        """Offer the frame that the loop is at; called once the loop has ended."""
        last, self._last = self._last, None
        if last is not None:
            for offer in self._offers:
                offer(last)

    def close(self) -> None:
        """Give the device back."""
        self._source.close()
