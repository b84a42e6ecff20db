"""A rig of real slaves for tests of the checklist: simulated cameras, an IMU and a master, and its list on the bus."""

import json
import shutil
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bench.report import CALIBRATION
from bench.rigs.local import UP_S, Rig, RigError, until
from common.errors import BusError
from common.messages import Checklist
from common.messages.streams import MASTER
from tests.faults.relay import UdpRelay

MARKER_HZ, WRIST_HZ = 12.0, 30.0  # slow enough for two busy cores to draw all pictures in time
_BEGIN_S = 4.0
Key = tuple[str, str]


class Lists:
    """What the master published: every list with the moment of its arrival, and how often the master reported."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._came: list[tuple[float, frozenset[Key]]] = []
        self.reports = 0
        self.sentences: dict[Key, tuple[str, str]] = {}

    def now(self) -> frozenset[Key]:
        """Return code and subject of what the newest list has."""
        with self._lock:
            return self._came[-1][1] if self._came else frozenset()

    def empty_since(self, began: float) -> float | None:
        """Return since when the list has been empty, `began` if none came; None: it is not empty now."""
        with self._lock:
            since = None if self._came else began
            for came, keys in reversed(self._came):
                if keys:
                    break
                since = came
            return since

    def since(self, moment: float) -> list[tuple[float, frozenset[Key]]]:
        """Return the lists that came after a moment of `time.monotonic`."""
        with self._lock:
            return [one for one in self._came if one[0] >= moment]

    def keep(self, message: object) -> None:
        if isinstance(message, Checklist):
            keys = frozenset((item.code, item.subject) for item in message.items)
            with self._lock:
                self._came.append((time.monotonic(), keys))
            self.sentences |= {(one.code, one.subject): (one.sentence, one.fix) for one in message.items}
        else:
            self.reports += 1


class SlavesRig(Rig):
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
            RigError: It does not come up.
        """
        super().__init__(folder)
        self._rig, self._environments = rig, environments or {}
        self.slaves, self.master, self.system = folder / "slaves", folder / "master", folder / "system"
        _write_trees(self.slaves, self.master, rig)
        file = read(self.slaves / "rigs" / f"{rig}.json")
        cameras, imu = file["cameras"], file.get("imu")
        self.faults = {name: folder / f"faults-{name}.json" for name in cameras}
        zone = self.system / "sys/class/thermal/thermal_zone0"
        zone.mkdir(parents=True)
        (zone / "type").write_text("cpu-thermal\n")
        self.warm(48.0)
        self.disk(9000.0)
        self._epoch_ns = time.monotonic_ns() + round(_BEGIN_S * 1e9)
        self.relay, self.lists = UdpRelay(self.beacon_port), Lists()
        self.closing.append(self.relay.close)
        try:
            beacon, own = "{}:{}".format(*self.relay.beacon), self._environments.get(MASTER, {})
            self.start_master(self.master, [rig], beacon=beacon, **own)
            for name in (*cameras, *([] if imu is None else [imu["name"]])):
                self.start_slave(name)
            self.join()
            self.read("checklist", self.lists.keep)
            self.read("health", self.lists.keep, MASTER)
            if not until(self._tracking, UP_S):
                raise RigError(f"rig {rig}: no poses; logs are in {folder}")
        except BaseException:
            self.close()
            raise

    def start_slave(self, name: str) -> None:
        """Start the process of one camera, or of the IMU."""
        kind = ["run", "--imu", "synthetic"]
        if name in self.faults:
            kind = ["run", "--camera", "synthetic", "--faults", str(self.faults[name])]
        scene = [
            "--scene-epoch-ns",
            str(self._epoch_ns),
            "--calibration",
            str(self.slaves),
            "--rig",
            self._rig,
        ]
        link = ["--bind", "127.0.0.1", "--beacon-port", str(self.beacon_port)]
        own = {"PHALANX_SYSTEM_ROOT": str(self.system), **self._environments.get(name, {})}
        self.start(name, "slave", *kind, "--name", name, *scene, *link, **own)

    def warm(self, celsius: float) -> None:
        """Have the slaves' computer so warm."""
        _put(self.system / "sys/class/thermal/thermal_zone0/temp", f"{celsius * 1e3:.0f}\n")

    def disk(self, free_mb: float) -> None:
        """Have so much room on the slaves' disk."""
        _put(self.system / "disk_free_mb", f"{free_mb:g}\n")

    def fault(self, camera: str, **faults: object) -> None:
        """Put a camera wrong (`slave.cameras.synthetic.Faults`); nothing: it is well again."""
        _put(self.faults[camera], json.dumps(faults))

    def _tracking(self) -> bool:
        try:
            return self.counts().get("poses", 0) > 2 * MARKER_HZ
        except BusError:
            return False


def read(path: Path) -> Any:
    """Return a calibration file as it is."""
    return json.loads(path.read_text())


def write(path: Path, content: object) -> None:
    """Replace a calibration file at once."""
    _put(path, json.dumps(content))


def measured(day: str) -> dict[str, object]:
    """Return the provenance of something that was measured on a day."""
    date, residual = f"{day}T12:00:00Z", {"rms_px": 0.1}
    return {"date": date, "tool": "rehearsal", "data": ["none"], "residual": residual, "note": ""}


def _write_trees(slaves: Path, master: Path, name: str) -> None:
    """Write both sides' files: slower cameras, an IMU on the hand, dates of measurements that fit together."""
    shutil.copytree(CALIBRATION, slaves)
    rig_path = slaves / "rigs" / f"{name}.json"
    rig = read(rig_path)
    wrist = rig["kind"] == "wrist"
    for camera in rig["cameras"]:
        path, rate_hz = slaves / "cameras" / f"{camera}.json", WRIST_HZ if wrist else MARKER_HZ
        dated = {"intrinsics": measured("2026-01-10")}
        write(path, {**read(path), "frame_rate_hz": rate_hz, "provenance": dated})
    if wrist:
        rig["imu"] = None
    else:
        rig["provenance"] = {"T_rig_camera": measured("2026-01-11")}
        rig["imu"] = read(slaves / "rigs/wrist.json")["imu"]
    write(rig_path, rig)
    shutil.copytree(slaves, master)


def _put(path: Path, text: str) -> None:
    """Replace a file at once: nobody reads half of it."""
    new = path.with_name(path.name + ".new")
    new.write_text(text)
    new.replace(path)
