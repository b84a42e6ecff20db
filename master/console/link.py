"""Link connects the console to the bus and leases camera previews.

It reopens by itself whenever a master comes or goes. Previews are requested while somebody looks; one that
claims to be larger than the camera's own picture is not shown.
"""

import threading
import time
from collections.abc import Callable, Sequence

from common.bus.bus import Bus, Subscription
from common.calibration import CameraCalibration
from common.errors import BusError, CalibrationError
from common.messages import Command, Health, Message, Preview
from common.messages.command_bodies import PreviewRequest
from common.messages.picture_size import Size, jpeg_size

POLL_S = 0.5  # between two looks at who is alive
ANSWER_S = 20.0  # a slow camera shows its new settings after some seconds

Take = Callable[[Message], None]


class Link:
    """Bus connection, and which processes are alive; one thread updates both."""

    def __init__(self, open_bus: Callable[[], Bus], streams: Sequence[str], take: Take) -> None:
        """Begin to connect.

        `open_bus` raises `BusError` while nobody listens there. `take` gets each message of `streams`, of
        each on a thread of its own; must not raise.
        """
        self._open_bus, self._streams, self._take = open_bus, streams, take
        self._bus: Bus | None = None
        self._alive: frozenset[str] = frozenset()
        self._reason = "not connected yet"
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._work, name="console link", daemon=True)
        self._thread.start()

    @property
    def up(self) -> bool:
        """Whether somebody is reached."""
        return bool(self._alive)

    @property
    def alive(self) -> frozenset[str]:
        """Names of the processes that are reached."""
        return self._alive

    @property
    def reason(self) -> str:
        """Why nobody is reached; empty while somebody is."""
        return "" if self.up else self._reason

    def ask(self, command: Command, timeout_s: float = ANSWER_S) -> Health:
        """Send a command and wait for the answer; never on the thread of the page.

        Raises:
            BusError: There is no bus, nobody answered in time, or the target refused; the text states which.
        """
        bus = self._bus
        if bus is None:
            raise BusError(f"no answer from {command.target!r} to {command.verb!r}: {self._reason}")
        return bus.ask(command, timeout_s)

    def close(self) -> None:
        """Leave the bus. Safe to call twice."""
        self._closing.set()
        self._thread.join(2.0 * ANSWER_S)

    def _work(self) -> None:
        while not self._closing.is_set():
            try:
                bus = self._open_bus()
            except BusError as error:
                self._reason = str(error)
                self._closing.wait(POLL_S)
                continue
            try:
                self._wait(bus)
            finally:
                self._bus, self._alive = None, frozenset()
                bus.close()

    def _wait(self, bus: Bus) -> None:
        """Read and look around until the others are gone or the console ends."""
        ended = threading.Event()
        depth = 64
        inboxes = [bus.subscribe(stream, depth=depth) for stream in self._streams]
        readers = [
            threading.Thread(target=self._read, args=(inbox, ended), name=f"read {stream}", daemon=True)
            for stream, inbox in zip(self._streams, inboxes, strict=True)
        ]
        for reader in readers:
            reader.start()
        self._bus = bus
        empty = 0
        try:
            missed_polls = 4  # so often nobody was alive: the connection is made anew
            while empty < missed_polls and not self._closing.is_set():
                self._alive = bus.alive()
                empty = 0 if self._alive else empty + 1
                self._closing.wait(POLL_S)
            self._reason = "the master is gone"
        except BusError as error:
            self._reason = str(error)
        finally:
            ended.set()
            for inbox in inboxes:
                inbox.close()
            for reader in readers:
                reader.join(2.0)

    def _read(self, inbox: Subscription, ended: threading.Event) -> None:
        while not ended.is_set():
            message = inbox.get(0.2)
            if message is not None:
                self._take(message)


class PreviewLeases:
    """Until when each camera is looked at; one thread per camera while it is."""

    def __init__(self, ask: Callable[[Command, float], Health]) -> None:
        self._ask = ask
        self._lock = threading.Lock()
        self._until: dict[str, dict[tuple[str, ...], float]] = {}
        self._threads: dict[str, threading.Thread] = {}
        self._errors: dict[str, str] = {}

    def look(self, camera: str, mask: tuple[str, ...] = ()) -> None:
        """Request a camera's preview for 3 s, with these markers tinted. Never waits."""
        with self._lock:
            lease_s = 3.0  # so long a lease holds: whoever still looks renews it before
            self._until.setdefault(camera, {})[mask] = time.monotonic() + lease_s
            if camera not in self._threads:
                thread = threading.Thread(
                    target=self._work, args=(camera,), name=f"look {camera}", daemon=True
                )
                self._threads[camera] = thread
                thread.start()

    def error(self, camera: str) -> str:
        """Why there is no picture of `camera`; empty while it answers."""
        return self._errors.get(camera, "")

    @property
    def looked_at(self) -> frozenset[str]:
        """Cameras that somebody looks at."""
        return frozenset(self._threads)

    def _work(self, camera: str) -> None:
        while (mask := self._mask(camera)) is not None:
            body = PreviewRequest(mask=mask, found=True).body() if mask else ""
            try:
                self._ask(Command(camera, "preview", body), 1.5)
                self._errors.pop(camera, None)
            except BusError as error:
                self._errors[camera] = str(error)
            ask_every_s = 1.0  # a camera shows itself for 3 s after each request
            time.sleep(ask_every_s)

    def _mask(self, camera: str) -> tuple[str, ...] | None:
        """Return all markers to tint; None when nobody looks, which ends the thread."""
        with self._lock:
            now = time.monotonic()
            wanted = {mask: until for mask, until in self._until.get(camera, {}).items() if until > now}
            self._until[camera] = wanted
            if not wanted:
                del self._threads[camera], self._until[camera]
                self._errors.pop(camera, None)
                return None
            return tuple(dict.fromkeys(name for mask in wanted for name in mask))


class PictureSizes:
    """Compares the sizes [px] of previews with those of the camera files."""

    def __init__(self, camera: Callable[[str], CameraCalibration]) -> None:
        """Compare with the files that `camera` reads, which raises a `CalibrationError`."""
        self._camera = camera
        self._known: dict[str, tuple[float, Size | None]] = {}
        self._refused: dict[str, str] = {}

    def fits(self, preview: Preview) -> bool:
        """Whether a preview is no larger than the size in its camera's file, if known."""
        width, height = jpeg_size(preview.jpeg)
        most = self._size(preview.camera)
        if most is None or (width <= most[0] and height <= most[1]):
            self._refused.pop(preview.camera, None)
            return True
        self._refused[preview.camera] = (
            f"{preview.camera}: its picture claims {width} x {height} px, its camera file here says "
            f"{most[0]} x {most[1]}: deploy the file again, or see what runs there"
        )
        return False

    def error(self, camera: str) -> str:
        """Why its last preview was refused; empty where it was not."""
        return self._refused.get(camera, "")

    def _size(self, name: str) -> Size | None:
        poll_s = 2.0  # a camera file is not read more often
        read_s, size = self._known.get(name, (-poll_s, None))
        if time.monotonic() - read_s < poll_s:
            return size
        try:
            file = self._camera(name)
            size = file.width_px, file.height_px
        except CalibrationError:
            size = None  # not calibrated yet, or half written
        most = 64  # cameras: a bus on which names are invented costs no memory
        if name in self._known or len(self._known) < most:
            self._known[name] = time.monotonic(), size
        return size
