"""A rig of real processes for the rehearsal of the checklist: slaves with simulated cameras, an IMU and a master,
started by their own command lines; and its list, as it comes over the bus."""

import json
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bench.local_rig import free_port, join_bus, until
from bench.udp_relay import UdpRelay
from common.errors import BusError, PhalanxError
from common.messages import Checklist, Command, Health
from common.streams import MASTER
from common.zenoh_bus import ZenohBus

ROOT = Path(__file__).resolve().parents[1]
MARKER_HZ, WRIST_HZ = 12.0, 30.0  # slow enough for two busy cores to draw all pictures in time
UP_S = 90.0
_BEGIN_S = 4.0
Key = tuple[str, str]


class RehearsalError(PhalanxError):
    """A process did not come up, or a list does not come."""


class Lists:
    """What the master published. Holds every list with the moment of its arrival, and how often the master reported."""

    def __init__(self, bus: ZenohBus) -> None:
        """Listen from now on, on a thread of its own."""
        self._lists, self._health = (
            bus.subscribe("checklist", depth=64),
            bus.subscribe("health", MASTER, depth=64),
        )
        self._lock = threading.Lock()
        self._came: list[tuple[float, frozenset[Key]]] = []
        self._closing = threading.Event()
        self.reports = 0
        self.sentences: dict[Key, tuple[str, str]] = {}
        threading.Thread(target=self._hear, daemon=True).start()

    def now(self) -> frozenset[Key]:
        """Code and subject of what the newest list has."""
        with self._lock:
            return self._came[-1][1] if self._came else frozenset()

    def since(self, moment: float) -> list[tuple[float, frozenset[Key]]]:
        """The lists that came after a moment of `time.monotonic`."""
        with self._lock:
            return [one for one in self._came if one[0] >= moment]

    def close(self) -> None:
        """Listen no more."""
        self._closing.set()

    def _hear(self) -> None:
        while not self._closing.is_set():
            told = self._lists.get(0.05)
            if isinstance(told, Checklist):
                with self._lock:
                    keys = frozenset((item.code, item.subject) for item in told.items)
                    self._came.append((time.monotonic(), keys))
                self.sentences |= {(one.code, one.subject): (one.sentence, one.fix) for one in told.items}
            while isinstance(self._health.get(0.0), Health):
                self.reports += 1


class Rig:
    """Processes of one rig, and the files with which they can be put wrong. Close it in any case.

    Attributes:
        slaves, master: The calib_json trees of both sides.
        faults: Of each camera the file of its faults.
        system: What the slaves take for the root of their computer.
        relay: The network.
        lists: The checklist.
    """

    def __init__(
        self, folder: Path, rig: str, environments: Mapping[str, Mapping[str, str]] | None = None
    ) -> None:
        """Start a rig of the tree in `calib_json`: its cameras, its IMU if it has one, and a master.

        Args:
            folder: For its files.
            rig: Its name.
            environments: Process -> what it has in its environment besides.

        Raises:
            RehearsalError: It does not come up.
        """
        self._folder, self._rig, self._environments = folder, rig, environments or {}
        self.slaves, self.master, self.system = folder / "slaves", folder / "master", folder / "system"
        folder.mkdir(parents=True)
        self._write_trees()
        file = self.read(self.slaves / "rigs" / f"{rig}.json")
        self.cameras: list[str] = file["cameras"]
        self.imu: str | None = None if file.get("imu") is None else file["imu"]["name"]
        self.faults = {name: folder / f"faults-{name}.json" for name in self.cameras}
        zone = self.system / "sys/class/thermal/thermal_zone0"
        zone.mkdir(parents=True)
        (zone / "type").write_text("cpu-thermal\n")
        self.warm(48.0)
        self.disk(9000.0)
        self._beacon = free_port(socket.SOCK_DGRAM)
        self._end = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        self._key = {"PHALANX_RIG_KEY": secrets.token_hex(32), "PYTHONUNBUFFERED": "1"}
        self._epoch_ns = time.monotonic_ns() + round(_BEGIN_S * 1e9)
        self.relay = UdpRelay(self._beacon)
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.lists: Lists
        self._bus: ZenohBus | None = None
        try:
            self._start()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End all processes."""
        if self._bus is not None:
            self.lists.close()
            self._bus.close()
        for process in self.processes.values():
            process.send_signal(signal.SIGCONT)
            process.kill()
            process.wait()
        self.relay.close()

    def start_slave(self, name: str) -> None:
        """Start the process of one camera, or of the IMU."""
        link = ["--bind", "127.0.0.1", "--beacon-port", str(self._beacon)]
        scene = [
            "--scene-epoch-ns",
            str(self._epoch_ns),
            "--calibration",
            str(self.slaves),
            "--rig",
            self._rig,
        ]
        kind = ["imu", "--imu", "synthetic"]
        if name in self.faults:
            kind = ["run", "--camera", "synthetic", "--faults", str(self.faults[name])]
        self._popen(
            name, ["slave", *kind, "--name", name, *scene, *link], {"PHALANX_SYSTEM_ROOT": str(self.system)}
        )

    def ask(self, target: str, verb: str, body: str = "") -> Health:
        """Command a process.

        Raises:
            BusError: It refuses.
        """
        assert self._bus is not None
        return self._bus.ask(Command(target, verb, body), 20.0)

    def warm(self, celsius: float) -> None:
        """Have the slaves' computer so warm."""
        _put(self.system / "sys/class/thermal/thermal_zone0/temp", f"{celsius * 1e3:.0f}\n")

    def disk(self, free_mb: float) -> None:
        """Have so much room on the slaves' disk."""
        _put(self.system / "disk_free_mb", f"{free_mb:g}\n")

    def fault(self, camera: str, **faults: object) -> None:
        """Put a camera wrong (`slave.cameras.faulty.Faults`); nothing: it is well again."""
        _put(self.faults[camera], json.dumps(faults))

    @staticmethod
    def read(path: Path) -> Any:
        """A calibration file as it is."""
        return json.loads(path.read_text())

    @staticmethod
    def write(path: Path, content: object) -> None:
        """Replace a calibration file at once."""
        _put(path, json.dumps(content))

    def _start(self) -> None:
        place = ["--rig", self._rig, "--calibration", str(self.master), "--bus", self._end]
        link = ["--beacon", "{}:{}".format(*self.relay.beacon), "--bind", "127.0.0.1:0"]
        self._popen("master", ["master", "run", *place, *link], {})
        for name in (*self.cameras, *([] if self.imu is None else [self.imu])):
            self.start_slave(name)
        self._bus = join_bus(self._end, UP_S)
        self.lists = Lists(self._bus)
        if not until(lambda: self._tracking(), UP_S):
            raise RehearsalError(f"rig {self._rig}: no poses; logs are in {self._folder}")

    def _tracking(self) -> bool:
        try:
            return self.ask(MASTER, "report").counts.get("poses", 0) > 2 * MARKER_HZ
        except BusError:
            return False

    def _popen(self, name: str, command: list[str], environment: Mapping[str, str]) -> None:
        log = (self._folder / f"{name}.log").open("ab")
        process = subprocess.Popen(
            [sys.executable, "-m", *command],
            cwd=ROOT,
            env={**os.environ, **self._key, **environment, **self._environments.get(name, {})},
            stdout=log,
            stderr=subprocess.STDOUT,
        )
        self.processes[name] = process

    def _write_trees(self) -> None:
        """Both sides' files: slower cameras, an IMU on the hand, and dates of measurements that fit together."""
        shutil.copytree(ROOT / "calib_json", self.slaves)
        rig_path = self.slaves / "rigs" / f"{self._rig}.json"
        rig = self.read(rig_path)
        wrist = rig["kind"] == "wrist"
        for name in rig["cameras"]:
            path = self.slaves / "cameras" / f"{name}.json"
            dated = {"intrinsics": measured("2026-01-10")}
            rate = {"frame_rate_hz": WRIST_HZ if wrist else MARKER_HZ}
            self.write(path, {**self.read(path), **rate, "provenance": dated})
        if wrist:
            rig["imu"] = None
        else:
            rig["provenance"] = {"T_rig_camera": measured("2026-01-11")}
            rig["imu"] = self.read(self.slaves / "rigs/wrist.json")["imu"]
        self.write(rig_path, rig)
        shutil.copytree(self.slaves, self.master)


def measured(day: str) -> dict[str, object]:
    """The provenance of something that was measured on a day."""
    return {
        "date": f"{day}T12:00:00Z",
        "tool": "rehearsal",
        "data": ["none"],
        "residual": {"rms_px": 0.1},
        "note": "",
    }


def _put(path: Path, text: str) -> None:
    """Replace a file at once: nobody reads half of it."""
    new = path.with_name(path.name + ".new")
    new.write_text(text)
    new.replace(path)
