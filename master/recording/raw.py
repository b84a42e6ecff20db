"""Raw frames kept by every camera's slave beside a recording of messages.

Begun, kept going, and ended here.

A thread for each camera asks again and again: a slave goes on for as long as it is asked, so that a recorder that was
killed, or lost its master, leaves ended recordings behind. A camera that refuses is reported, and asked no more; the
recording of messages goes on in any case.
"""

import json
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from common.bus.bus import Bus
from common.errors import BusError, CalibrationError, RecordingError
from common.messages import Command, Health
from common.messages.raw_wish import RawWish, raw_name, refuse_strange

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
    """Requester of the raw frames of all cameras of one recording.

    Over all its connections. Holds the state of each camera.
    """

    def __init__(
        self,
        stem: str,
        cameras: Sequence[str],
        notify: Callable[[str], None],
        keep: Callable[[Health], None],
        period_s: float = 2.0,
    ) -> None:
        """Nothing is asked yet.

        Args:
            stem: Name of the recording of messages.
            cameras: Those of its rigs.
            say: Called with a line when something changes.
            keep: Given what a slave answers at beginning and end.
            period_s: Time between two questions [s].

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
        """Stop asking.

        Raw recordings that are running end by themselves, unless another connection asks. Safe to call twice.
        """
        self._closing.set()
        for thread in self._threads:
            thread.join()
        self._threads = []

    def end(self, bus: Bus) -> None:
        """End the raw recordings of all present cameras and print their state.

        All at the same time.
        """
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
        wish = RawWish(name=self._folder(camera), lease_s=LEASE_S)
        try:
            answer = bus.ask(Command(camera.name, "raw", wish.body()), _ASK_S)
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
        """Restart a camera's raw recording where it was away, or give up.

        Restarts where the camera was away and its recording has ended; else the refusal is final.
        """
        if camera.begun and self._was_away(camera, bus):
            camera.begun, camera.number = False, camera.number + 1
            self._ask(camera, bus)
            return
        camera.refused = True
        verb = "ended" if camera.begun else "not recorded"
        self._notify(f"camera {camera.name}: raw frames {verb}: {error}")

    def _was_away(self, camera: _Camera, bus: Bus) -> bool:
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
    """Return the cameras' raw folders as a recording of messages stores them.

    A map of camera to name.
    """
    return json.dumps({camera: raw_name(stem, camera) for camera in cameras})
