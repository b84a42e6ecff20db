"""A rig of real processes for faults of links and processes: two cameras, a master, and a program on its bus.

The cameras are processes of their own (`bench.faults_sender`), with clocks seconds apart; the master is
`phalanx run`; between them lies a relay that can be made worse.
"""

import json
import os
import secrets
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from bench.faults_poses import Judge, Pace, Poses, pace_of, steady_from
from bench.local_rig import free_port, join_bus, until
from bench.processes import footprint
from bench.udp_relay import UdpRelay
from common.errors import BusError, PhalanxError
from common.messages import Checklist, Command, Health
from common.messages.streams import MASTER

ROOT = Path(__file__).resolve().parents[1]
CAMERAS = ("left", "right")
RATE_HZ = 30.0
CLOCK_S = {"left": 3.0, "right": -5.0}
LATE_MS = {"left": 0.0, "right": 5.0}
UP_S = 60.0


class FaultRigError(PhalanxError):
    """Something did not come up."""


class FaultRig:
    """Holds the processes, the relay, and what came over the bus. Close it in any case.

    Attributes:
        relay: Between the cameras and the master.
        processes: Name -> process, each of them alive or not.
        poses: What came.
        master_options: More options of the master's command line, used at its next start.
        pace: What is steady for this rig: nominal, or its own where a machine has other things to do (`own_pace`).
    """

    def __init__(
        self, folder: Path, master_options: Sequence[str] = (), environment: dict[str, str] | None = None
    ) -> None:
        """Start everything and wait until it tracks; logs are files of the folder.

        Raises:
            FaultRigError: It does not within a minute.
        """
        self.folder, self.master_options, self.pace = folder, tuple(master_options), Pace(RATE_HZ)
        self.folder.mkdir(parents=True, exist_ok=True)
        self._files = _slower(self.folder / "calib_json")
        self.key = secrets.token_hex(32)
        self._environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", **(environment or {})}
        self.port, self.bus_port = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_STREAM)
        self.master_port = free_port(socket.SOCK_DGRAM)
        self.epoch_ns = time.monotonic_ns()
        self.processes: dict[str, subprocess.Popen[str]] = {}
        self.relay = UdpRelay(self.port, seed=11)
        self._closing: list[Callable[[], None]] = [self.relay.close]
        try:
            self._begin()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End all processes."""
        for process in self.processes.values():
            end(process)
        while self._closing:
            self._closing.pop()()

    def start_camera(
        self, camera: str, name: str | None = None, *, key: str | None = None, options: Sequence[str] = ()
    ) -> None:
        """Start the process of a camera, known as `name`, and return when it listens.

        Raises:
            FaultRigError: It ended at once.
        """
        name, log = name or camera, self.folder / f"{name or camera}.log"
        before = log.read_text().count("ready") if log.exists() else 0
        place = [camera, str(self.port), str(self.epoch_ns), str(RATE_HZ)]
        skew = ["--late-ms", str(LATE_MS[camera]), "--clock-s", str(CLOCK_S[camera])]
        self._start(name, ["-m", "bench.faults_sender", *place, *skew, *options], key or self.key)
        process = self.processes[name]
        if not until(lambda: log.read_text().count("ready") > before or process.poll() is not None, UP_S):
            raise FaultRigError(f"{name} does not come up: {log}")

    def start_master(self) -> None:
        """Start the master, and return when it listens.

        Raises:
            FaultRigError: It ended at once.
        """
        log = self.folder / "master.log"
        before = log.read_text().count("listening on") if log.exists() else 0
        beacon, bind = "{}:{}".format(*self.relay.beacon), f"127.0.0.1:{self.master_port}"
        place = ["--rig", "desk", "--calibration", str(self._files), "--bus", self.endpoint]
        link = ["--beacon", beacon, "--bind", bind]
        self._start(MASTER, ["-m", "master", "run", *place, *link, *self.master_options], self.key)
        process = self.processes[MASTER]
        if not until(
            lambda: log.read_text().count("listening on") > before or process.poll() is not None, UP_S
        ):
            raise FaultRigError(f"the master does not come up: {log}")

    @property
    def endpoint(self) -> str:
        """Of the master's bus."""
        return f"tcp/127.0.0.1:{self.bus_port}"

    def kill(self, name: str) -> None:
        """As the kernel does it."""
        self.processes[name].kill()
        self.processes[name].wait()

    def send_line(self, name: str, line: str) -> None:
        """Notify a line to a camera's process."""
        pipe = self.processes[name].stdin
        assert pipe is not None
        pipe.write(line + "\n")
        pipe.flush()

    def counts(self) -> dict[str, int]:
        """What the master counted since it began."""
        return dict(self.bus.ask(Command(MASTER, "report"), 10.0).counts)

    def report(self) -> Health:
        """Of the master."""
        return self.bus.ask(Command(MASTER, "report"), 10.0)

    def listed(self) -> frozenset[tuple[str, str]]:
        """Code and subject of what the newest checklist has that has come."""
        while isinstance(reported := self._lists.get(0.0), Checklist):
            self._listed = frozenset((item.code, item.subject) for item in reported.items)
        return self._listed

    def anonymous_mb(self) -> float:
        """Memory of the master that is no file's [MB]."""
        return footprint(self.processes[MASTER].pid).anonymous_mb

    def steady_after(self, moment_s: float, patience_s: float = 20.0) -> float | None:
        """How long after a moment poses came steadily and right again [s]; None: not within the patience."""
        found: list[float] = []

        def steady() -> bool:
            at = steady_from(self.poses.since(moment_s), moment_s, self.pace)
            found.extend([] if at is None else [at - moment_s])
            return bool(found)

        return found[0] if until(steady, patience_s) else None

    def own_pace(self, seconds: float = 1.0) -> Pace:
        """Measure how poses come while nothing is wrong; what is steady is measured against that from now on."""
        began = time.monotonic()
        time.sleep(seconds)
        ended = time.monotonic()
        self.pace = pace_of(self.poses.since(began, ended), began, ended, RATE_HZ)
        return self.pace

    def _begin(self) -> None:
        self.start_master()
        for camera in CAMERAS:
            self.start_camera(camera)
        self.bus = join_bus(self.endpoint, UP_S)
        self._closing.append(self.bus.close)
        self._lists, self._listed = self.bus.subscribe("checklist", depth=64), frozenset[tuple[str, str]]()
        self.poses = Poses(self.bus, Judge(self.epoch_ns))
        self._closing.append(self.poses.close)
        if not until(lambda: len(self.poses.since(0.0)) > RATE_HZ, UP_S):
            raise FaultRigError(f"no poses; logs are in {self.folder}")
        self.steady_after(time.monotonic())  # a machine that has other things to do may never be

    def _start(self, name: str, command: list[str], key: str) -> None:
        if (old := self.processes.get(name)) is not None:
            end(old)
        with (self.folder / f"{name}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen(
                [sys.executable, *command],
                cwd=ROOT,
                env={**self._environment, "PHALANX_RIG_KEY": key},
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=subprocess.STDOUT,
                text=True,
            )


def _slower(folder: Path) -> Path:
    """The project's files, with cameras as slow as ours."""
    shutil.copytree(ROOT / "calib_json", folder)
    for camera in CAMERAS:
        path = folder / "cameras" / f"{camera}.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"frame_rate_hz": RATE_HZ}))
    return folder


def end(process: subprocess.Popen[str]) -> None:
    """End a process that may stand still, or be gone."""
    if process.stdin is not None:
        with suppress(BrokenPipeError):
            process.stdin.close()
    process.kill()
    process.wait()


def asked(rig: FaultRig) -> dict[str, int]:
    """The counts, or none while the master is away."""
    try:
        return rig.counts()
    except BusError:
        return {}
