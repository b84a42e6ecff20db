"""A machine that is a folder: files below a root, and a systemd of its own that says what is started and what runs."""

import argparse
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path

import pytest

from master.commands.keys import make
from slave.install import arguments, steps
from slave.install.arguments import InstallError, plan_of
from slave.install.command import calibration_of, keys_of
from slave.install.release import Source
from slave.install.systemd import Systemd

ROOT = Path(__file__).resolve().parents[3]
LOADED = (
    "live",
    "sender",
    "commands/__init__",
    "commands/devices",
    "commands/simulated",
)  # by a release that is looked at


@dataclass
class FakeSystemd:
    """Answers `systemctl` as far as an installer asks it.

    A release with a file BROKEN in it ends again and again, one with HANGS never gets ready.
    """

    root: Path
    asked: list[str] = field(default_factory=list[str])
    enabled: set[str] = field(default_factory=set[str])
    pids: dict[str, int] = field(default_factory=dict[str, int])
    restarts: dict[str, int] = field(default_factory=dict[str, int])
    now_s: float = 0.0
    start_s: float | None = None  # that the next show tells of a service that runs

    def run(self, words: Sequence[str]) -> str:
        self.asked.append(" ".join(words))
        if words[0] == "systemd-sysusers":
            lines = Path(words[1]).read_text().splitlines()
            groups = self.root / "etc/group"
            have = groups.read_text()
            new = [line.split()[1] for line in lines if line.startswith("g ")]
            groups.write_text(
                have + "".join(f"{one}:x:9{n}:\n" for n, one in enumerate(new) if f"{one}:" not in have)
            )
        if words[0] == "groupdel":
            groups = self.root / "etc/group"
            kept = [line for line in groups.read_text().splitlines() if not line.startswith(f"{words[1]}:")]
            groups.write_text("".join(f"{line}\n" for line in kept))
        if words[0] == "journalctl":
            return "Traceback (most recent call last):\nphalanx-slave: it is broken, as it was meant to be\n"
        return (
            self._systemctl([word for word in words[1:] if not word.startswith("--")])
            if words[0] == "systemctl"
            else ""
        )

    def _systemctl(self, words: list[str]) -> str:
        verb, units = words[0], words[1:]
        if verb == "show":
            return self._show(units[-1])
        for unit in units:
            if verb == "enable":
                self.enabled.add(unit)
            elif verb == "disable":
                if unit not in self.enabled and unit not in self.pids:
                    raise InstallError(f"Unit {unit} does not exist")
                self.enabled.discard(unit)
                self.pids.pop(unit, None)
            elif verb == "restart":
                self.pids[unit] = len(self.asked)
                self.restarts[unit] = 0
        return ""

    def _show(self, unit: str) -> str:
        current = (self.root / "opt/phalanx/current").resolve()
        broken, hangs = (any(current.rglob(name)) for name in ("BROKEN", "HANGS"))
        if unit in self.pids and broken:
            self.restarts[unit] += 1
        runs = unit in self.pids and not broken and not hangs
        state = ("active", "running") if runs else ("inactive", "dead")
        enabled = "enabled" if unit in self.enabled else "disabled"
        return (
            f"ActiveState={state[0]}\nSubState={state[1]}\nUnitFileState={enabled}\nMainPID={self.pids.get(unit, 0)}\n"
            f"NRestarts={self.restarts.get(unit, 0)}\nResult=exit-code\nExecMainStatus=1\n"
            + (f"ExecMainStartTimestampMonotonic=1\nActiveEnterTimestampMonotonic={1 + self.start_s * 1e6:.0f}\n"
               if self.start_s is not None else "")
        )  # fmt: skip

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


class Board:
    """The machine. Holds its root and its systemd, and what the installer said."""

    def __init__(self, root: Path, keys: Path) -> None:
        self.root, self.keys = root, keys
        for folder in (
            "etc/systemd/system",
            "etc/chrony/conf.d",
            "boot/firmware",
            "opt",
            "var/lib",
            "usr/local/bin",
        ):
            (root / folder).mkdir(parents=True)
        (root / "etc/group").write_text("root:x:0:\nvideo:x:44:\n")
        (root / "boot/firmware/config.txt").write_text("# of the system\ndtparam=audio=on\n")
        self.systemd = FakeSystemd(root)
        self.output: list[str] = []
        services = Systemd(self.systemd.run, lambda: self.systemd.now_s, self.systemd.sleep)
        self.machine = steps.Machine(root, services, self.output.append, 30.0, 2.0)

    def install(
        self,
        site: Path,
        *words: str,
        name: str = "left",
        keys: bool = True,
        calibration: Path | None = None,
        dry_run: bool = False,
    ) -> steps.Outcome:
        """Install what is in `site` with these options."""
        parser = argparse.ArgumentParser()
        arguments.add_install(parser)
        options = parser.parse_args(["--master", "10.0.0.2", "--name", name, "--camera", "synthetic", *words])
        plan = plan_of(
            options, calibration_of(calibration or ROOT / "calib_json"), keys_of(self.keys if keys else None)
        )
        source = Source(site, wheels=False)
        return steps.install(plan, source, source.name(), self.machine, dry_run)

    def files(self) -> dict[str, str]:
        """Path -> link target, or mode and hash, of all that is there but what releases have inside."""
        found: dict[str, str] = {}
        for path in sorted(self.root.rglob("*")):
            name = path.relative_to(self.root).as_posix()
            if name.startswith("opt/phalanx/releases/") and name.count("/") > 3:
                continue
            if path.is_symlink():
                found[name] = str(path.readlink())
            elif path.is_file():
                found[name] = f"{path.stat().st_mode:o} {sha256(path.read_bytes()).hexdigest()}"
            else:
                found[name] = f"{path.stat().st_mode:o}"
        return found


@pytest.fixture(scope="session")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A keys folder of a PC, for left, right and a wrist device."""
    folder = tmp_path_factory.mktemp("keys") / "keys"
    make(folder, ("left", "right", "wrist"), datetime.now(UTC))
    return folder


def site_of(folder: Path, version: str, broken: bool = False, text: str = "", hangs: bool = False) -> Path:
    """site-packages with a slave that does nothing."""
    package = folder / "slave"
    for room in ("imu", "commands"):
        (package / room).mkdir(parents=True)
    for name in ("__init__", *LOADED):
        (package / f"{name}.py").write_text(f'"""Nothing. {text}"""\n')
    (package / "__main__.py").write_text("def main():\n    return 0\n")
    info = folder / f"phalanx_hand-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: phalanx-hand\nVersion: {version}\n")
    (info / "RECORD").write_text("")
    for name in [name for name, is_so in (("BROKEN", broken), ("HANGS", hangs)) if is_so]:
        (package / name).write_text("")
    return folder


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """Version 1.0 of a slave that runs."""
    return site_of(tmp_path / "site", "1.0")


@pytest.fixture
def board(tmp_path: Path, keys: Path, monkeypatch: pytest.MonkeyPatch) -> Board:
    """A machine with nothing of ours on it. Its disk has all at once: nobody waits for that of this machine."""
    monkeypatch.setattr("slave.install.release.os.sync", lambda: None)
    own = tmp_path / "pc-keys"
    shutil.copytree(keys, own)
    return Board(tmp_path / "root", own)
