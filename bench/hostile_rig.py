"""A running master that honest devices feed and stolen devices attack.

The stolen ones say what they like; the rig measures what is lost by it.

One hand before three cameras, of which two are honest; an object with a tracker; a second hand with a wrist device that
has a camera and an IMU. The master is `phalanx run`, each stolen device a process (`bench.hostile_sender`).
"""

import json
import os
import secrets
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from bench.detections_sender import send
from bench.local_rig import free_port, join_bus, until
from bench.processes import footprint
from bench.scale_rig import ROOM, detections_of, room
from common.bus.bus import Subscription
from common.clock import SystemClock
from common.errors import BusError, PhalanxError
from common.messages import Command, HandPose, Health
from common.messages.streams import MASTER
from master.rig.files import load_setup
from slave.uplink import Uplink

ROOT = Path(__file__).resolve().parents[1]
RATE_HZ = 30.0
HAND = "default-right"
HONEST, WRIST_RIG = ("cam00", "cam01"), "wrist-left"
STOLEN: Mapping[str, str] = {
    "cam02": ROOM,
    "wrist": WRIST_RIG,
    "imu": WRIST_RIG,
    "tracker": ROOM,
}  # device -> rig
UP_S = 60.0


class HostileRigError(PhalanxError):
    """Something did not come up."""


def scratch_tree(folder: Path) -> Path:
    """Write the calibration files of such a rig; return where they are."""
    tree = room(folder, 3, RATE_HZ)
    path = tree / "rigs" / f"{ROOM}.json"
    tracked = json.loads((tree / "rigs" / "desk-tracker.json").read_text())
    rig = json.loads(path.read_text())
    rig |= {"objects": tracked["objects"], "T_rig_tracking": tracked["T_rig_tracking"]}
    path.write_text(json.dumps(rig, indent=1) + "\n")
    return tree


@dataclass(frozen=True, slots=True)
class Phase:
    """What was measured from one moment to another.

    Attributes:
        seconds: How long it was.
        lost: Share of the honest cameras' periods without a pose.
        reports: How many reports of the master came.
        silent_s: The longest time without one.
        undecodable: Messages of the master that a reader could not decode.
        lines_per_s: Lines of its log.
        grown_mb: How much more memory it has that is no file's.
        threads_ended: How many of Python's threads fewer it has.
        cpu: Cores that the master took.
        waited: Cores that it would have taken besides, had the machine had them free.
    """

    seconds: float
    lost: float
    reports: int
    silent_s: float
    undecodable: int
    lines_per_s: float
    grown_mb: float
    threads_ended: int
    cpu: float
    waited: float


class _Reader:
    """Receive the messages of one stream.

    Holds a thread and what `keep` makes of each message.
    """

    def __init__(self, inbox: Subscription, keep: Callable[[object], None]) -> None:
        self.inbox, self._keep, self._closing = inbox, keep, threading.Event()
        threading.Thread(target=self._read, daemon=True).start()

    def close(self) -> None:
        self._closing.set()
        self.inbox.close()

    def _read(self) -> None:
        while not self._closing.is_set():
            if (message := self.inbox.get(0.1)) is not None:
                self._keep(message)


class HostileRig:
    """Holds the master, the two honest cameras, and what came over the bus.

    Close it in any case.

    Attributes:
        tree: The calibration files of all.
        key: Rig key, hexadecimal.
        port: Of the beacons.
        log: What the master wrote.
        master: Its process.
    """

    def __init__(self, folder: Path) -> None:
        """Start it and wait until the honest hand is tracked.

        Raises:
            HostileRigError: It is not within a minute.
        """
        folder.mkdir(parents=True, exist_ok=True)
        self.tree, self.key, self.log = scratch_tree(folder), secrets.token_hex(32), folder / "master.log"
        self.port, self._bus_port = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_STREAM)
        self._stop, self._closing = threading.Event(), list[Callable[[], None]]()
        self._lock = threading.Lock()
        self._poses_ns: list[int] = []
        self._reports_s: list[float] = []
        self.newest: Health | None = None
        self.master = self._start_master()
        try:
            self._begin()
        except BaseException:
            self.close()
            raise

    @property
    def endpoint(self) -> str:
        """Of the master's bus."""
        return f"tcp/127.0.0.1:{self._bus_port}"

    @property
    def environment(self) -> dict[str, str]:
        """Of every process of the rig."""
        return {
            **os.environ,
            "OPENBLAS_NUM_THREADS": "1",
            "PYTHONUNBUFFERED": "1",
            "PHALANX_RIG_KEY": self.key,
        }

    def close(self) -> None:
        """End everything."""
        self._stop.set()
        while self._closing:
            self._closing.pop()()
        self.master.kill()
        self.master.wait()

    def alive(self) -> bool:
        """Whether the master's process is."""
        return self.master.poll() is None

    def ask(self, timeout_s: float = 10.0) -> Health | None:
        """The master's report, or None if it does not answer."""
        try:
            return self.bus.ask(Command(MASTER, "report"), timeout_s)
        except BusError:
            return None

    def begin(self) -> Callable[[], Phase]:
        """Begin to measure; what is returned ends it and says what was measured."""
        began, log = time.monotonic(), len(self.log.read_bytes())
        before, threads = footprint(self.master.pid), self._threads()
        refused, waited_s = self._undecodable(), self._waited_s()

        def end() -> Phase:
            ended = time.monotonic()
            lines = self.log.read_bytes()[log:].count(b"\n")
            after = footprint(self.master.pid) if self.alive() else before
            with self._lock:
                came = [began, *(at for at in self._reports_s if began <= at < ended), ended]
            return Phase(
                ended - began,
                self.lost(began, ended),
                len(came) - 2,
                max(b - a for a, b in pairwise(came)),
                self._undecodable() - refused,
                lines / (ended - began),
                after.anonymous_mb - before.anonymous_mb,
                threads - self._threads(),
                (after.cpu_s - before.cpu_s) / (ended - began),
                (self._waited_s() - waited_s) / (ended - began),
            )

        return end

    def lost(self, began_s: float, ended_s: float) -> float:
        """Share of the periods between two moments without the honest hand's pose.

        NaN where there is no period.
        """
        period_ns, first, last = 1e9 / RATE_HZ, round(began_s * RATE_HZ) + 1, round(ended_s * RATE_HZ) - 8
        with self._lock:
            solved = {round((t_ns - self._phase_ns) / period_ns) for t_ns in self._poses_ns}
        periods = range(first, last)
        return sum(one not in solved for one in periods) / len(periods)

    def start_stolen(self, name: str, count: int, per_s: float, seed: int) -> subprocess.Popen[str]:
        """Start a stolen device; it sends when it is told a line."""
        place = [name, str(self.tree), STOLEN[name], str(self.port), self.endpoint]
        attack = [str(count), str(per_s), str(seed)]
        return subprocess.Popen(
            [sys.executable, "-m", "bench.hostile_sender", *place, *attack],
            cwd=ROOT, env=self.environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip

    def command(self, *arguments: str) -> tuple[int, bytes]:
        """Run a command of `phalanx` on this master's bus.

        Returns its exit code and what it wrote.
        """
        done = subprocess.run(
            [sys.executable, "-m", "master", *arguments, "--bus", self.endpoint],
            cwd=ROOT, env=self.environment, capture_output=True, timeout=UP_S, check=False,
        )  # fmt: skip
        return done.returncode, done.stdout + done.stderr

    def _threads(self) -> int:
        """Number of the master's Python threads: unlike zenoh's, named as the process."""
        folder = Path(f"/proc/{self.master.pid}")
        try:
            own = (folder / "comm").read_text()
            return sum((one / "comm").read_text() == own for one in (folder / "task").iterdir())
        except OSError:
            return 0

    def _waited_s(self) -> float:
        """Time that threads of the master waited for a processor [s].

        Summed over all threads since they began, while they were ready to run.
        """
        try:
            tasks = [one / "schedstat" for one in Path(f"/proc/{self.master.pid}/task").iterdir()]
            return 1e-9 * sum(int(one.read_text().split()[1]) for one in tasks)
        except OSError:
            return 0.0

    def _undecodable(self) -> int:
        return sum(reader.inbox.refused for reader in self._readers)

    def _start_master(self) -> subprocess.Popen[bytes]:
        place = ["--rig", ROOM, "--rig", WRIST_RIG, "--calibration", str(self.tree), "--bus", self.endpoint]
        link = ["--beacon", f"127.255.255.255:{self.port}", "--bind", "127.0.0.1:0", "--start-timeout-s", "1"]
        with self.log.open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-m", "master", "run", *place, *link],
                cwd=ROOT, env=self.environment, stdout=log, stderr=subprocess.STDOUT,
            )  # fmt: skip

    def _begin(self) -> None:
        self._start_cameras()
        self.bus = join_bus(self.endpoint, UP_S)
        self._readers = [
            _Reader(self.bus.subscribe("hand", HAND, depth=256), self._keep),
            _Reader(self.bus.subscribe("health", MASTER, depth=64), self._keep),
            _Reader(self.bus.subscribe("checklist", MASTER, depth=64), self._keep),
        ]
        self._closing += [self.bus.close, *(reader.close for reader in self._readers)]
        if not until(lambda: len(self._poses_ns) > 3 * RATE_HZ or not self.alive(), UP_S) or not self.alive():
            raise HostileRigError(f"no poses: {self.log.read_text()[-2000:]}")
        self._phase_ns = self._poses_ns[-1] % (1e9 / RATE_HZ)

    def _start_cameras(self) -> None:
        """The two honest ones, a thread each."""
        setup = load_setup(self.tree, ROOM)
        seen, key = detections_of(setup, RATE_HZ), bytes.fromhex(self.key)
        for k, name in enumerate(HONEST):
            uplink = Uplink(name, key, SystemClock(), self.port, "127.0.0.1")
            place = (name, seen[name], uplink, 0.01 * k, self._stop, RATE_HZ)
            thread = threading.Thread(target=send, args=place, daemon=True)
            thread.start()
            self._closing += [uplink.close, thread.join]

    def _keep(self, message: object) -> None:
        with self._lock:
            if isinstance(message, HandPose):
                self._poses_ns.append(message.t_ns)
            elif isinstance(message, Health):
                self.newest = message
                self._reports_s.append(time.monotonic())
