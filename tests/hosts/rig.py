"""The rig of the two hosts: small simulated cameras, keys, a master on this machine, and the commands."""

import json
import os
import shutil
import subprocess
import sys
import time
import zipfile
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from tests.hosts.fleet import MASTER_PORT, Fleet

ROOT = Path(__file__).resolve().parents[2]
UP_S = 300.0  # for a master to start that compiles its kernels first, on a busy machine
SCALE, RATE_HZ = 0.5, 30.0  # two cameras are rendered on the processor that also has master and deployment
BEACON_PORT, BUS_PORT = 47800, 47802


@dataclass(frozen=True)
class Ran:
    """A command that has ended.

    Attributes:
        seconds: How long it took, and when it began [s, time.monotonic].
    """

    code: int
    out: str
    err: str
    began: float
    seconds: float

    def __str__(self) -> str:
        return f"exit {self.code} after {self.seconds:.1f} s\n--- stdout\n{self.out}\n--- stderr\n{self.err}"


class Rig:
    """The rig `desk` with its cameras left and right on the hosts of these names; holds the process of the master."""

    def __init__(self, fleet: Fleet, folder: Path) -> None:
        """Write its calibration and keys; nothing is started."""
        self.fleet, self.folder = fleet, folder
        self.source = copied_source(folder / "source")
        self.calibration = small_calibration(ROOT / "calib_json", folder / "calib_json")
        self.keys = folder / "keys"
        self.cache = folder / "cache"
        self.bus = f"tls/{fleet.address}:{BUS_PORT}"
        self.version = version("phalanx-hand")
        self._master: subprocess.Popen[str] | None = None
        made = self.program(
            "master", "fleet", "keys", str(self.keys), "--make", *_each("--device", fleet.hosts)
        )
        assert made.code == 0, f"no keys: {made}"

    def start_master(self) -> None:
        """Start the master, and wait until it listens: `deploy` takes the place of one that is not there yet."""
        bind = f"{self.fleet.address}:{MASTER_PORT}"
        beacon = f"{self.fleet.broadcast}:{BEACON_PORT}"
        command = [
            sys.executable,
            "-m",
            "master",
            "run",
            "--rig",
            "desk",
            "--calibration",
            str(self.calibration),
        ]
        where = ["--keys", str(self.keys), "--beacon", beacon, "--bind", bind, "--bus", self.bus]
        files = ["--summary", str(self.folder / "summary.json")]
        log = (self.folder / "master.log").open("a")
        began = log.tell()
        self._master = subprocess.Popen(
            [*command, *where, *files],
            text=True,
            stdout=log,
            stderr=log,
            cwd=self.source,
            env=self.environment,
        )
        self.fleet.undo.later("kill process", str(self._master.pid))
        output, end = self.folder / "master.log", time.monotonic() + UP_S
        while "listening on" not in output.read_text()[began:]:
            assert self._master.poll() is None, output.read_text()[-2000:]
            assert time.monotonic() < end, "the master does not listen"
            time.sleep(0.1)

    def stop_master(self) -> dict[str, object]:
        """End it as Ctrl-C does; return its summary."""
        assert self._master is not None
        self._master.send_signal(2)
        code = self._master.wait(30)
        self._master = None
        assert code == 0, f"the master ended with {code}:\n{(self.folder / 'master.log').read_text()[-2000:]}"
        return json.loads((self.folder / "summary.json").read_text())

    def close(self) -> None:
        """End the master, whatever state it is in."""
        if self._master is not None:
            self._master.kill()
            self._master.wait()

    @property
    def targets(self) -> tuple[str, ...]:
        """Both hosts, as `phalanx fleet deploy` takes them."""
        return tuple(f"{name}={host.login}" for name, host in self.fleet.hosts.items())

    def deploy(self, *more: str, targets: tuple[str, ...] | None = None, timeout_s: float = 240.0) -> Ran:
        """Run `phalanx fleet deploy` for both hosts, or for some of them, with more options."""
        return self.program(*self.deploy_words(*more, targets=targets), timeout_s=timeout_s)

    def deploy_words(self, *more: str, targets: tuple[str, ...] | None = None) -> tuple[str, ...]:
        """The same as words of a command line behind `python -m`."""
        where = ["--master", self.fleet.address, "--rig", "desk", "--calibration", str(self.calibration)]
        what = ["--keys", str(self.keys), "--bus", self.bus, "--camera", "synthetic", "--no-apt"]
        what += ["--beacon", f"{self.fleet.broadcast}:{BEACON_PORT}", *self.fleet.ssh_options]
        hosts = self.targets if targets is None else targets
        return ("master", "fleet", "deploy", *hosts, *where, *what, *more)

    def rollback(self, *more: str) -> Ran:
        """Run `phalanx fleet rollback` for both hosts."""
        hosts = [host.login for host in self.fleet.hosts.values()]
        return self.program("master", "fleet", "rollback", *hosts, *more, *self.fleet.ssh_options)

    def uninstall(self) -> Ran:
        """Run `phalanx fleet uninstall` for both hosts."""
        hosts = [host.login for host in self.fleet.hosts.values()]
        return self.program("master", "fleet", "uninstall", *hosts, *self.fleet.ssh_options)

    def program(self, package: str, *arguments: str, timeout_s: float = 180.0) -> Ran:
        """Run `phalanx` (package master) or `phalanx-slave` (slave) as a user would, and wait for its end.

        Raises:
            subprocess.TimeoutExpired: It was still running after `timeout_s`, so it has no deadline of its own.
        """
        begin = time.monotonic()
        ran = subprocess.run(
            [sys.executable, "-m", package, *arguments],
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
            cwd=self.source,
            env=self.environment,
            stdin=subprocess.DEVNULL,
            start_new_session=True,  # nobody can be asked
        )
        return Ran(ran.returncode, ran.stdout, ran.stderr, begin, time.monotonic() - begin)

    @property
    def environment(self) -> dict[str, str]:
        """Of its programs."""
        return os.environ | {"XDG_CACHE_HOME": str(self.cache), "PYTHONPATH": str(self.source)}


def copied_source(folder: Path) -> Path:
    """The project's programs as they are now: whoever works on them meanwhile makes no other release of them.

    What is compiled comes along, so that the master is not compiled once more.
    """
    for package in ("common", "deploy", "master", "slave"):
        shutil.copytree(ROOT / package, folder / package)
    shutil.copy(ROOT / "constraints.txt", folder)
    return folder


def small_calibration(source: Path, folder: Path) -> Path:
    """Copy a calib_json tree, the cameras left and right with a picture of half the size at 30 Hz."""
    shutil.copytree(source, folder)
    for name in ("left", "right"):
        file = folder / "cameras" / f"{name}.json"
        camera = json.loads(file.read_text())
        for key in ("width_px", "height_px"):
            camera[key] = int(camera[key] * SCALE)
        lens = camera["intrinsics"]
        for key in ("fx_px", "fy_px"):
            lens[key] *= SCALE
        for key in ("cx_px", "cy_px"):
            lens[key] = (lens[key] + 0.5) * SCALE - 0.5  # pixel 0 is centred at 0
        file.write_text(json.dumps(camera | {"frame_rate_hz": RATE_HZ}, indent=1))
    file = (
        folder / "rigs/desk.json"
    )  # its laws of depth are of disparities [px], which have half the size, too
    rig = json.loads(file.read_text())
    rig["power_law"]["k_m"] *= SCALE ** -rig["power_law"]["z"]
    for key in ("a_m_px", "x0_px"):
        rig["affine_disparity"][key] *= SCALE
    file.write_text(json.dumps(rig, indent=1))
    return folder


def changed_wheels(cache: Path, folder: Path, new: str, replaced: dict[str, str]) -> Path:
    """A folder with the wheels that were gathered, ours as another version and with other text in some of its files.

    Args:
        cache: Where `phalanx fleet deploy` gathers them.
        folder: To be made.
        new: Version of our wheel in it.
        replaced: File of the wheel -> its whole new text.
    """
    folder.mkdir()
    gathered = list(cache.rglob("*.whl"))
    (ours,) = (wheel for wheel in gathered if wheel.name.startswith("phalanx_hand-"))
    for wheel in set(gathered) - {ours}:
        (folder / wheel.name).hardlink_to(wheel)
    old = ours.name.split("-")[1]
    with (
        zipfile.ZipFile(ours) as read,
        zipfile.ZipFile(folder / ours.name.replace(old, new), "w") as write,
    ):
        absent = set(replaced) - set(read.namelist())
        assert not absent, f"not in the wheel: {absent}"
        for name in read.namelist():
            text = replaced[name].encode() if name in replaced else read.read(name)
            if name.endswith("/METADATA"):
                text = text.replace(f"\nVersion: {old}\n".encode(), f"\nVersion: {new}\n".encode(), 1)
            if not name.endswith("/RECORD"):
                write.writestr(name.replace(f"-{old}.dist-info", f"-{new}.dist-info"), text)
        write.writestr(f"phalanx_hand-{new}.dist-info/RECORD", "")
    return folder


def _each(option: str, values: object) -> list[str]:
    return [word for value in values for word in (option, str(value))]  # type: ignore[attr-defined]
