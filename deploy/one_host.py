"""Deployment steps on one machine.

Look at it, bring packages, wheels and files, install; or take back, or remove.
"""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

from deploy.bundle import BUNDLE, bundle, command
from deploy.remote import Remote
from deploy.targets import DeployError, RigFile, Target
from deploy.wheelhouse import Kind, wheelhouse

STAGE = "/opt/phalanx/wheels"  # of root; the installer removes it
_PICAMERA2 = "picamera2"  # the default of cameras


@dataclass(frozen=True, slots=True)
class Wish:
    """What the user wants on all machines.

    Attributes:
        master: Host name or address of the PC.
        rig: The rig's file.
        calibration: calib_json tree of the PC.
        keys: Keys folder of the PC.
        options: Of the installer, handed on.
        cameras: Their drivers as given: DRIVER or NAME=DRIVER.
        wheels: Folder of wheels; None: they are downloaded.
        apt: Whether packages of the system are installed.
        dry_run: Write nothing.
        ready_s: How long slaves may take until they are ready.
    """

    master: str
    rig: RigFile
    calibration: Path
    keys: Path | None
    options: tuple[str, ...]
    cameras: tuple[str, ...]
    wheels: Path | None
    apt: bool
    dry_run: bool
    ready_s: float

    def driver(self, names: Sequence[str]) -> str:
        """Return the driver of the cameras among `names`.

        It decides what their machine has to have; empty: none of them is a camera.

        Of several, picamera2 asks for the most.
        """
        drivers: list[str] = []
        for name in [one for one in names if one in self.rig.cameras]:
            pairs_of = [one.partition("=") for one in self.cameras]
            own = [driver if whose == name else whose + sign + driver for whose, sign, driver in pairs_of
                   if whose == name or whose not in self.rig.names]  # fmt: skip
            drivers.append(own[-1] if own else _PICAMERA2)
        return next((one for one in drivers if one.startswith(_PICAMERA2)), (drivers or [""])[0])


@dataclass(slots=True)
class Host:
    """One machine while it is deployed to.

    Attributes:
        target: Which, and for what.
        remote: How it is reached.
        notify: Called with one line a step.
        sudo: Whether root is reached by sudo.
        changed: Whether something was changed, which can be taken back.
        reboot: Whether it runs only after it was restarted.
        start_s: How long its slaves took to start before [s]; None: none runs.
        known: Machines that were looked at, and by which name; the same of all of a command.
    """

    target: Target
    remote: Remote
    notify: Callable[[str], None]
    sudo: bool = False
    changed: bool = False
    reboot: bool = False
    start_s: float | None = None
    known: dict[str, str] = field(default_factory=dict[str, str])

    def deploy(self, wish: Wish) -> None:
        """Bring it to what is wanted.

        Raises:
            DeployError: It failed; the machine is as before.
        """
        camera = wish.driver(self.target.names)
        picamera2 = camera.startswith(_PICAMERA2)
        facts = self.look(camera, wish.apt)
        self._packages(facts, wish, picamera2)
        old = facts["codename"] == "bookworm"  # whose simplejpeg was built for numpy 1
        kind = Kind(
            str(facts["machine"]),
            ".".join(str(part) for part in cast(list[int], facts["python"])),
            ("simplejpeg",) if picamera2 and old else (),
            ("wrist",) if wish.rig.kind == "wrist" else (),
        )
        wheels = wheelhouse(kind, wish.wheels, self.notify)
        there = wheels.release in cast(list[str], facts["releases"])
        stage = f"{STAGE}/{wheels.release}"
        if not there:
            self.notify(f"{'would send' if wish.dry_run else 'sending'} {wheels.size_mb:.0f} MB of wheels")
        if not there and not wish.dry_run:
            self.remote.send(wheels.files, stage, self.sudo)
        words = ["install", "--json", "--bundle", BUNDLE, "--master", wish.master, "--rig", wish.rig.name]
        words += [
            "--release",
            wheels.release,
            "--wheelhouse",
            stage,
            "--ready-s",
            str(wish.ready_s),
            *wish.options,
        ]
        words += [word for name in self.target.names for word in ("--name", name)]
        words += ["--dry-run"] if wish.dry_run else []
        packed = bundle(wish.keys, self.target.names, wish.calibration, wish.rig)
        done = self._act(words, packed)
        self.changed = bool(done.get("changed")) or bool(done.get("restarted"))
        self.reboot = bool(done.get("reboot"))
        self.notify(str(done["text"]))

    def look(self, camera: str = "", apt: bool = True) -> dict[str, object]:
        """What it is like.

        Raises:
            DeployError: It is not reached, or nothing can be installed there.
        """
        lines: list[tuple[float, str]] = []
        probe_s = 60.0
        code = self.remote.run(
            command(["probe", camera, *([] if apt else ["--no-apt"])], sudo=False),
            _plain_bundle(),
            lambda line: lines.append((time.time(), line)),
            probe_s,
        )
        results = [(at, found) for at, line in lines if (found := _result(line)) is not None]
        if code != 0 or not results:
            raise DeployError(f"cannot look at it: {lines[-1][1] if lines else f'python3 ended with {code}'}")
        arrived, facts = results[-1]
        if facts["why_not"] is not None:
            raise DeployError(str(facts["why_not"]))
        first = self.known.setdefault(str(facts["boot_id"]), self.target.host)
        if first != self.target.host:
            raise DeployError(f"is the same machine as {first}: write NAME+NAME=HOST for two cameras of one")
        self.sudo = facts["user"] != "root"
        self.start_s = cast("float | None", facts["start_s"])
        python = ".".join(str(part) for part in cast(list[int], facts["python"]))
        self.notify(f"{facts['model']}, {facts['os']}, {facts['machine']}, Python {python}")
        ahead_s = cast(int, facts["t_unix_ns"]) * 1e-9 - arrived
        clock_s = 0.5  # from here on it is reported
        if abs(ahead_s) > clock_s:
            self.notify(
                f"its clock is {ahead_s:+.1f} s from this one; chrony brings it here, if this machine answers"
            )
        return facts

    def roll_back(self, dry_run: bool = False) -> str:
        """Let it go back to what was before; the text of what is there now.

        Raises:
            DeployError: There was nothing before, or it does not run.
        """
        words = ["install", "--json", "--rollback", *(["--dry-run"] if dry_run else [])]
        return str(self._act(words, _plain_bundle())["text"])

    def uninstall(self, dry_run: bool) -> None:
        """Take everything of ours away.

        Raises:
            DeployError: It failed.
        """
        self.look()
        words = ["install", "--json", "--uninstall", *(["--dry-run"] if dry_run else [])]
        self.notify(str(self._act(words, _plain_bundle())["text"]))

    def _packages(self, facts: dict[str, object], wish: Wish, picamera2: bool) -> None:
        """Install the packages that the system lacks, or report what it lacks.

        Raises:
            DeployError: apt failed, or it cannot be done without.
        """
        there = cast(list[str], facts["packages"])
        wanted = ["rsync", "chrony", *(["python3-picamera2"] if picamera2 else [])]
        missing = [name for name in wanted if name not in there]
        if not missing:
            return
        if wish.apt and not wish.dry_run:
            self._act(["packages", *missing], _plain_bundle())
            return
        self.notify(f"{'would install' if wish.apt else 'not installed'}: {' '.join(missing)}")

    def _act(self, words: Sequence[str], packed: bytes) -> dict[str, object]:
        """Run the installer there; its result.

        Raises:
            DeployError: It failed; its own line states why.
        """
        result: dict[str, object] = {}
        last = ""

        def on_line(line: str) -> None:
            nonlocal last
            if (found := _result(line)) is not None:
                result.update(found)
            else:
                last = line
                self.notify(line)

        code = self.remote.run(command(words, self.sudo), packed, on_line)
        if "error" in result:
            raise DeployError(str(result["error"]))
        if code != 0 or not result:
            raise DeployError(last.removeprefix("! ") or f"the installer ended with {code}")
        return result


def _result(line: str) -> dict[str, object] | None:
    """Parse what the installer found or did.

    None: the line is another, or the link broke within it.
    """
    if not line.startswith('{"result"'):
        return None
    try:
        return cast(dict[str, object], json.loads(line)["result"])
    except ValueError:
        return None


def _plain_bundle() -> bytes:
    """The installer alone."""
    return bundle(None, (), None, None)
