"""State of the console holds the newest messages and the last minute.

Threads read the bus: the newest message of each sender, the gestures that last and the last ones reported,
and the figures of the last minute (latency, rates, loss, clocks, temperature). All is bounded. The pages show
it and hold no data.
"""

import math
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np

from common.bus.bus import Bus
from common.calibration import CameraCalibration, RigCalibration, load
from common.errors import CalibrationError
from common.messages import Checklist, Contact, Gesture, HandPose, Health, Message, ObjectPose, Preview
from common.messages.streams import MASTER, sender_of
from master.commands.options import HERE_BEACON, HERE_BIND, HERE_BUS
from master.console.controls import InUse, Tuner, full_frame_uv
from master.console.link import Link, PictureSizes, PreviewLeases
from master.console.local import LocalProcesses
from master.run.process import join_bus

SPAN_S = 60.0
STEP_S = 0.5
MAX_SERIES = 256  # senders times quantities; what is beyond is not kept
_CAMERA_HZ, _RECEIVED = "camera_hz.", ".received"
_CLOCK = {".clock_offset_us": ("offset_ms", 1e-3), ".clock_sigma_us": ("offset_sigma_us", 1.0)}


class History:
    """Holds rows of the last minute: when [s], and name -> value.

    Names: `latency_p50_ms`, `latency_p99_ms`, `poses_per_s`, and with the name of a sender behind them
    `rate_hz.`, `lost_per_s.`, `offset_ms.`, `offset_sigma_us.`, `celsius.`. What is not known is absent.
    """

    def __init__(self) -> None:
        self._rows: deque[tuple[float, dict[str, float]]] = deque(maxlen=round(SPAN_S / STEP_S))
        self._counts: dict[str, tuple[int, int, float]] = {}

    def push(self, t_s: float, latencies_ms: Sequence[float], health: Mapping[str, Health]) -> None:
        """Add the row of `t_s` [s], of any clock that only rises.

        `latencies_ms` are of the poses since the last row, `health` the newest report of each process that is
        alive.
        """
        row: dict[str, float] = {}
        before = self._rows[-1][0] if self._rows else None
        if latencies_ms:
            p50, p99 = np.percentile(latencies_ms, [50, 99])
            row |= {"latency_p50_ms": float(p50), "latency_p99_ms": float(p99)}
        if before is not None and t_s > before:
            row["poses_per_s"] = len(latencies_ms) / (t_s - before)
        for source, report in health.items():
            row |= _of_master(report) if source == MASTER else _of_sender(source, report)
            if source == MASTER:
                row |= self._counted(report)
        self._rows.append((t_s, dict(list(row.items())[:MAX_SERIES])))

    def names(self, prefix: str) -> list[str]:
        """All series whose name begins so, sorted."""
        return sorted({name for _, row in self._rows for name in row if name.startswith(prefix)})

    def series(self, name: str) -> list[tuple[float, float]]:
        """(age [s] <= 0, value) of one series, oldest first."""
        rows = list(self._rows)
        return [(t_s - rows[-1][0], row[name]) for t_s, row in rows if name in row]

    def latest(self, name: str) -> float | None:
        """The newest value, or None."""
        rows = list(self._rows)
        return rows[-1][1].get(name) if rows else None

    def _counted(self, report: Health) -> dict[str, float]:
        """Return each camera's frames and each sender's lost messages per second.

        A count of the master that is absent is 0: what never happened it does not report.
        """
        out: dict[str, float] = {}
        for count in report.counts:
            name = count.removesuffix(_RECEIVED)
            if name == count:
                continue
            out[f"lost_per_s.{name}"] = self._increase(report, f"{name}.lost")
            if _CAMERA_HZ + name in report.metrics:
                out[f"rate_hz.{name}"] = self._increase(report, count)
        return {name: rate for name, rate in out.items() if not math.isnan(rate)}

    def _increase(self, report: Health, name: str) -> float:
        """What a count grew by per second, between two reports; NaN: not known yet."""
        now = report.counts.get(name, 0)
        then_ns, then, rate = self._counts.get(name, (report.t_ns, now, math.nan))
        count_ns = 900_000_000  # of a master that reports once a second
        if report.t_ns - then_ns >= count_ns:
            rate = max(0, now - then) * 1e9 / (report.t_ns - then_ns)
            then_ns, then = report.t_ns, now
        if report.t_ns < then_ns:  # another master
            then_ns, then = report.t_ns, now
        if name in self._counts or len(self._counts) < MAX_SERIES:
            self._counts[name] = (then_ns, then, rate)
        return rate


def _of_master(report: Health) -> dict[str, float]:
    out: dict[str, float] = {}
    for name, value in report.metrics.items():
        for suffix, (quantity, factor) in _CLOCK.items():
            if name.endswith(suffix):
                out[f"{quantity}.{name.removesuffix(suffix)}"] = factor * value
    return out


def _of_sender(source: str, report: Health) -> dict[str, float]:
    hot = [value for name, value in report.metrics.items() if "celsius" in name]
    return {f"celsius.{source}": max(hot)} if hot else {}


STALE_S = 3.0  # what was not reported again for so long is no longer shown as present
KeyT = TypeVar("KeyT")
MessageT = TypeVar("MessageT", bound=Message)


class Newest(Generic[KeyT, MessageT]):
    """Newest message of each sender, at most 64, with its time of receipt."""

    def __init__(self) -> None:
        self._received: dict[KeyT, tuple[float, MessageT]] = {}

    def put(self, name: KeyT, message: MessageT, now_s: float | None = None) -> None:
        """Receive one message, at `now_s` [s], monotonic; by default now."""
        max_names = 64  # kept of each kind: a bus on which names are invented costs no memory
        if name in self._received or len(self._received) < max_names:
            self._received[name] = (time.monotonic() if now_s is None else now_s, message)

    def drop(self, name: KeyT) -> None:
        """Forget the message of one sender."""
        self._received.pop(name, None)

    def get(self, name: KeyT, within_s: float = STALE_S) -> MessageT | None:
        """The newest of one sender, unless it is older than `within_s`."""
        return self.present(within_s).get(name)

    def present(self, within_s: float = STALE_S, now_s: float | None = None) -> dict[KeyT, MessageT]:
        """Return the newest message of each sender received recently."""
        now_s = time.monotonic() if now_s is None else now_s
        return {
            name: one
            for name, (received_s, one) in list(self._received.items())
            if now_s - received_s < within_s
        }


KEPT = 30


class ReceivedGestures:
    """Newest message of each lasting gesture, and the last begins, ends and taps."""

    def __init__(self) -> None:
        self._held = Newest[tuple[str, str], Gesture]()
        self._events: deque[tuple[float, Gesture]] = deque(maxlen=KEPT)

    def push(self, gesture: Gesture, now_s: float) -> None:
        """Receive one message at `now_s` [s], monotonic."""
        key = (gesture.hand, gesture.kind)
        if gesture.phase != "update":
            self._events.append((now_s, gesture))
        if gesture.phase == "end":
            self._held.drop(key)
        else:
            self._held.put(key, gesture, now_s)

    def held(self, now_s: float | None = None) -> dict[tuple[str, str], Gesture]:
        """(hand, kind) -> what lasts at `now_s` [s], by default now."""
        hold_s = (
            0.5  # a gesture is repeated with every pose of its hand: not received for so long, it is over
        )
        return self._held.present(hold_s, now_s)

    def events(self) -> list[tuple[float, Gesture]]:
        """The last begins, ends and taps with their times of receipt, newest first."""
        return list(self._events)[::-1]


@dataclass(frozen=True, slots=True)
class ConsoleSettings:
    """How the console was started.

    Attributes:
        calibration: The calib_json tree that it shows and edits.
        rigs: Rigs of it that run; may be empty, and their files need not be there yet: then the page sets
            them up.
        bus: Endpoint of the master's bus.
        beacon, bind, key: ADDRESS:PORT for slaves and data, and rig key, of the processes that the page
            starts.
        port, host: Where the page is served; port 0: a free one.
        password_file: Asks for the password in it; None: elsewhere than on this machine one is made.
        open_links: The page may be plain where other machines reach it.
    """

    calibration: Path
    rigs: tuple[str, ...] = ()
    bus: str = HERE_BUS
    beacon: str = HERE_BEACON
    bind: str = HERE_BIND
    key: bytes | None = None
    port: int = 8080
    host: str = "127.0.0.1"
    password_file: Path | None = None
    open_links: bool = False


class ConsoleState:
    """Link to the bus, newest messages, the last minute's figures, local processes."""

    def __init__(self, settings: ConsoleSettings, open_bus: Callable[[], Bus] | None = None) -> None:
        """Begin to listen; `open_bus` opens another bus than that of the settings."""
        self.settings = settings
        self.history = History()
        self.received_gestures = ReceivedGestures()
        self.local = LocalProcesses()
        self._poses, self._health = Newest[str, HandPose](), Newest[str, Health]()
        self._objects, self._contacts = Newest[str, ObjectPose](), Newest[str, Contact]()
        self._previews, self._checklists = Newest[str, Preview](), Newest[str, Checklist]()
        self._latencies_ms: deque[float] = deque(maxlen=4096)
        self._closing = threading.Event()
        self._sizes = PictureSizes(self.camera)
        streams = ("hand", "object", "contact", "gesture", "health", "checklist", "preview")
        self.link = Link(open_bus or (lambda: join_bus(settings.bus)), streams, self.on_message)
        self._preview_leases = PreviewLeases(self.link.ask)
        self._tuners: dict[str, Tuner] = {}
        self._sampler = threading.Thread(target=self._sample, name="console history", daemon=True)
        self._sampler.start()

    @property
    def alive(self) -> frozenset[str]:
        """Names of the processes on the bus."""
        return self.link.alive

    @property
    def poses(self) -> dict[str, HandPose]:
        """Return each hand's newest pose, of those received within 3 s."""
        return self._poses.present()

    @property
    def objects(self) -> dict[str, ObjectPose]:
        """Return each object's newest pose, of those received within 3 s."""
        return self._objects.present()

    @property
    def contacts(self) -> dict[str, Contact]:
        """Return the newest contact per HAND/OBJECT, of those received within 3 s."""
        return self._contacts.present()

    @property
    def health(self) -> dict[str, Health]:
        """Return each process's newest report, of those received within 3 s."""
        return self._health.present()

    @property
    def checklist(self) -> Checklist | None:
        """What is not as it should be; None if no master reports it."""
        return self._checklists.get(MASTER)

    @property
    def gestures(self) -> dict[tuple[str, str], Gesture]:
        """(hand, kind) -> the gesture that lasts now."""
        return self.received_gestures.held()

    def preview(self, camera: str) -> Preview | None:
        """The newest picture of a camera, unless it is older than 3 s."""
        return self._previews.get(camera)

    def look(self, camera: str, mask: tuple[str, ...] = ()) -> None:
        """Request a camera's preview for 3 s, with these markers tinted. Never waits."""
        self._preview_leases.look(camera, mask)

    def preview_error(self, camera: str) -> str:
        """Return why a camera that is looked at shows no picture; empty while it does."""
        return self._sizes.error(camera) or self._preview_leases.error(camera)

    def tuner(self, camera: str) -> Tuner:
        """Return a camera's tuner, one for all pages: all revert to the same settings."""
        if camera not in self._tuners:
            self._tuners[camera] = Tuner(camera, self.link.ask, self.camera_path(camera))
        return self._tuners[camera]

    def pick(self, camera: str, marker: str, x: float, y: float, t_ns: int) -> InUse:
        """Sample a marker's colour at a place in a camera's picture, in shares of it.

        Raises:
            PhalanxError: The camera's file is missing or broken, or as of `Tuner.pick`.
        """
        file = self.camera(camera)
        return self.tuner(camera).pick(marker, full_frame_uv(x, y, file.width_px, file.height_px), t_ns)

    def start(self, name: str, *words: str) -> None:
        """Start a command of `phalanx` on this machine as the process `name`.

        Raises:
            PhalanxError: It cannot be started.
        """
        self.local.start(name, [sys.executable, "-m", "master", *words])

    @property
    def rig_names(self) -> tuple[str, ...]:
        """Those that run; when none was named: `desk`, once it is there."""
        return self.settings.rigs or (("desk",) if self.rig_path("desk").exists() else ())

    def rig_path(self, rig: str) -> Path:
        """The file of a rig."""
        return self.settings.calibration / "rigs" / f"{rig}.json"

    def camera_path(self, camera: str) -> Path:
        """The file of a camera, on this machine."""
        return self.settings.calibration / "cameras" / f"{camera}.json"

    def rigs(self) -> dict[str, RigCalibration]:
        """Return the rigs whose files are valid; the Set-up page shows the others."""
        found: dict[str, RigCalibration] = {}
        for name in self.rig_names:
            try:
                found[name] = load(self.rig_path(name), RigCalibration)
            except CalibrationError:
                continue
        return found

    def cameras(self) -> tuple[str, ...]:
        """Return the cameras of the rigs, or without rigs those that report as cameras."""
        named = tuple(dict.fromkeys(camera for rig in self.rigs().values() for camera in rig.cameras))
        return named or tuple(sorted(name for name, one in self.health.items() if "frames" in one.counts))

    def markers_of(self, camera: str) -> tuple[str, ...]:
        """Markers of the rigs of a camera."""
        return tuple(name for rig in self.rigs().values() if camera in rig.cameras for name in rig.markers)

    def camera(self, name: str) -> CameraCalibration:
        """The file of a camera on this machine.

        Raises:
            CalibrationError: It is missing or broken.
        """
        return load(self.camera_path(name), CameraCalibration)

    def close(self) -> None:
        """End what the console started, and leave the bus. Safe to call twice."""
        self._closing.set()
        self.local.close()
        self.link.close()
        self._sampler.join()

    def on_message(self, message: Message) -> None:
        """Take one message from the bus; from any thread."""
        name = sender_of(message)
        match message:
            case HandPose():
                self._latencies_ms.append(message.latency_ns * 1e-6)
                self._poses.put(name, message)
            case Health():
                self._health.put(name, message)
            case ObjectPose():
                self._objects.put(name, message)
            case Contact():
                self._contacts.put(f"{message.hand}/{message.object}", message)
            case Gesture():
                self.received_gestures.push(message, time.monotonic())
            case Preview():
                if self._sizes.fits(message):
                    self._previews.put(name, message)
            case Checklist():
                self._checklists.put(name, message)
            case _:
                pass

    def _sample(self) -> None:
        while not self._closing.wait(STEP_S):
            taken = [self._latencies_ms.popleft() for _ in range(len(self._latencies_ms))]
            self.history.push(time.monotonic(), taken, self.health)
