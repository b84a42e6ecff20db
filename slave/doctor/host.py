"""Examine the host, and say what is wrong with its fix.

System, board, Python, disk, heat, supply; the clock, which matters for cameras in step and for people who read logs
(Phalanx itself measures the clocks of its link); the service as systemd reports it; and the libraries, imported by
the service's own Python, for those of another do not help it. A check that was not made is reported as such. A test
supplies a `System` of its own: files below a root, and programs that answer.
"""

import os
import platform
import re
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path

import msgspec

from common.machine import ROOT, Machine, Program
from slave.install.probe import NEWEST, OLDEST
from slave.install.systemd import finished


class Verdict(StrEnum):
    """How bad it is."""

    OK = "ok"
    WARN = "warn"
    FAIL = "fail"
    UNSEEN = "not looked at"


@dataclass(frozen=True, slots=True)
class Finding:
    """One check."""

    check: str  # what was looked at, in two or three words
    verdict: Verdict
    text: str  # what was seen; of what was not looked at, why not
    fix: str = ""  # what mends it; empty where nothing needs to be mended


def ok(check: str, text: str) -> Finding:
    """All is well."""
    return Finding(check, Verdict.OK, text)


def warn(check: str, text: str, fix: str) -> Finding:
    """It works, but not as well as it could."""
    return Finding(check, Verdict.WARN, text, fix)


def fail(check: str, text: str, fix: str) -> Finding:
    """The slave will not work like this."""
    return Finding(check, Verdict.FAIL, text, fix)


def unseen(check: str, why: str) -> Finding:
    """It was not looked at."""
    return Finding(check, Verdict.UNSEEN, why)


def exit_code(findings: Sequence[Finding]) -> int:
    """1 where something fails, else 0."""
    return int(any(one.verdict is Verdict.FAIL for one in findings))


def as_text(findings: Sequence[Finding]) -> str:
    """One line per check, the fix below it; checks that were not made come last."""
    seen = [one for one in findings if one.verdict is not Verdict.UNSEEN]
    width = max((len(one.check) for one in findings), default=0)
    lines: list[str] = []
    for one in seen:
        lines.append(f"{one.verdict:<5}{one.check:<{width}}  {one.text}")
        if one.fix:
            lines.append(f"     {'':<{width}}  -> {one.fix}")
    if skipped := [one for one in findings if one.verdict is Verdict.UNSEEN]:
        lines.append("not looked at:")
        lines += [f"     {one.check:<{width}}  {one.text}" for one in skipped]
    count = {verdict: sum(one.verdict is verdict for one in seen) for verdict in Verdict}
    lines.append(f"{count[Verdict.OK]} ok, {count[Verdict.WARN]} to look at, {count[Verdict.FAIL]} wrong")
    return "\n".join(lines)


def as_json(findings: Sequence[Finding], program: Program) -> str:
    """{"host", "version", "ok", "findings": [{"check", "verdict", "text", "fix"}]}."""
    report = {
        "host": program.host,
        "version": program.version,
        "ok": exit_code(findings) == 0,
        "findings": [asdict(one) for one in findings],
    }
    return msgspec.json.format(msgspec.json.encode(report)).decode()


@dataclass(frozen=True, slots=True)
class Ran:
    """Output of a program."""

    code: int | None  # its exit code, negative for a signal; None: it is not there, or did not end in time
    out: str
    error: str  # its standard error, or why there is no code


Run = Callable[[Sequence[str], float], Ran]


def run(command: Sequence[str], timeout_s: float) -> Ran:
    """Run a program that asks for nothing."""
    try:
        done = finished(command, timeout_s)
    except FileNotFoundError:
        return Ran(None, "", f"there is no {command[0]}")
    except subprocess.TimeoutExpired as error:
        so_far = error.stdout.decode(errors="replace") if isinstance(error.stdout, bytes) else ""
        return Ran(None, so_far, f"{command[0]}: no end after {timeout_s:.0f} s")
    except OSError as error:
        return Ran(None, "", f"{command[0]}: {error.strerror}")
    return Ran(done.returncode, done.stdout, done.stderr)


@dataclass(frozen=True, slots=True)
class System:
    """A computer: its files below `root`, and what runs a program for some seconds."""

    root: Path
    environment: Mapping[str, str]
    run: Run = run

    @classmethod
    def here(cls, environment: Mapping[str, str] = os.environ) -> "System":
        """This computer, or the files that `PHALANX_SYSTEM_ROOT` names."""
        return cls(Path(environment.get(ROOT, "/")), environment)

    def path(self, place: str | Path) -> Path:
        """Where `/place` of the computer is."""
        return self.root / str(place).lstrip("/")

    def text(self, place: str) -> str | None:
        """Content of a file without end of line and NUL (of the device tree), or None."""
        try:
            return self.path(place).read_text(errors="replace").strip("\0\n ")
        except OSError:
            return None


def pairs(text: str, between: str = "=") -> dict[str, str]:
    """Lines of NAME=VALUE, or with another sign between the two."""
    return {name: value for name, _, value in (line.partition(between) for line in text.splitlines())}


RELEASES = ("bookworm", "trixie")  # of Debian, and of the Raspberry Pi OS made from it
STATE = "/var/lib/phalanx"
# Raspberry Pi documentation, "vcgencmd get_throttled": bit -> its meaning; the same 16 bits higher: since the start.
BITS = {
    0: "under-voltage",
    1: "processor frequency capped",
    2: "throttled",
    3: "soft temperature limit",
}
COOL = "better cooling: a heat sink, a fan, air around it"
SUPPLY = "a stronger power supply, a shorter or thicker cable"


def check_host(system: System) -> Iterator[Finding]:
    """Everything that is neither a device nor a program of ours."""
    machine, bits = platform.machine(), struct.calcsize("P") * 8
    if bits == 64:
        yield ok("64 bit", machine)
    else:
        os_64 = "install the 64-bit Raspberry Pi OS (Lite)"
        yield fail("64 bit", f"{machine}, this Python has {bits} bit", os_64)
    text = system.text("/etc/os-release") or ""
    stated = dict(re.findall(r'^(\w+)="?([^"\n]*)"?$', text, re.MULTILINE))
    name = stated.get("PRETTY_NAME", "unknown")
    if stated.get("VERSION_CODENAME") in RELEASES:
        yield ok("system", name)
    else:
        tried = f"Raspberry Pi OS or Debian {' or '.join(RELEASES)}"
        yield warn("system", f"{name}: not tried with it", tried)
    model = system.text("/sys/firmware/devicetree/base/model")
    yield unseen("board", "no device tree: not a Raspberry Pi") if model is None else ok("board", model)
    version = platform.python_version()
    if OLDEST <= sys.version_info[:2] <= NEWEST:
        yield ok("Python", f"{version} in {sys.prefix}")
    else:
        yield fail("Python", version, "Python 3.11 to 3.14")
    yield from _metrics(system)
    yield _memory_limit(system)
    yield _throttled(system)


def _metrics(system: System) -> Iterator[Finding]:
    folder = system.path(STATE) if os.access(system.path(STATE), os.X_OK) else system.root
    metrics = Machine(folder, system.environment).metrics()
    free_mb = metrics.get("disk_free_mb")
    if free_mb is None:
        yield unseen("disk", f"{folder}: not known")
    elif free_mb < 500.0:
        level = fail if free_mb < 100.0 else warn
        delete = "delete recordings or old releases in /opt/phalanx/releases"
        yield level("disk", f"{free_mb:.0f} MB free", delete)
    else:
        yield ok("disk", f"{free_mb / 1000.0:.1f} GB free")
    now, limit = metrics.get("temperature_c"), metrics.get("temperature_limit_c")
    if now is None or limit is None:
        yield unseen("temperature", "no sensor with a limit")
    elif now >= limit:
        yield warn("temperature", f"{now:.0f} °C, it slows down from {limit:.0f} °C on", COOL)
    else:
        yield ok("temperature", f"{now:.0f} °C, limit {limit:.0f} °C")


def _memory_limit(system: System) -> Finding:
    """Whether the kernel keeps MemoryMax; Raspberry Pi OS's only where asked to."""
    controllers = system.text("/sys/fs/cgroup/cgroup.controllers")
    if controllers is None:
        return unseen("memory limit", "no control groups of version 2 here")
    if "memory" in controllers.split():
        return ok("memory limit", "the kernel keeps it")
    return warn(
        "memory limit",
        "the kernel does not keep the unit's MemoryMax",
        "write cgroup_enable=memory at the end of the one line of /boot/firmware/cmdline.txt, and restart the machine",
    )


def _throttled(system: System) -> Finding:
    flags = _flags(system)
    if flags is None:
        return unseen("throttling", "no Raspberry Pi firmware that reports it, no vcgencmd")
    now = [text for bit, text in BITS.items() if flags >> bit & 1]
    before = [text for bit, text in BITS.items() if flags >> (bit + 16) & 1 and text not in now]
    if not now and not before:
        return ok("throttling", "none since the start")
    stated = [*(f"{text} now" for text in now), *(f"{text} since the start" for text in before)]
    return warn("throttling", ", ".join(stated), SUPPLY if flags & (1 | 1 << 16) else COOL)


def _flags(system: System) -> int | None:
    """Status flags of the firmware: by vcgencmd, which knows all, else by sysfs."""
    asked = system.run(("vcgencmd", "get_throttled"), 5.0)
    if asked.code == 0 and (found := re.search(r"throttled=(0x[0-9a-fA-F]+)", asked.out)):
        return int(found[1], 16)
    flags = Machine(system.root, system.environment).metrics().get("throttled")
    return None if flags is None else int(flags)


INSTALL = (
    "sudo apt install chrony; the installer adds /etc/chrony/conf.d/phalanx.conf with the master's machine"
)


def check_clock(system: System, master: str | None) -> Iterator[Finding]:
    """What keeps the clock, and how well.

    `chronyc -c tracking` is a line of 14 fields (chronyc(1)); the offset is seconds that the system is ahead of NTP.
    """
    asked = system.run(("chronyc", "-c", "-n" if master is None else "-N", "tracking"), 5.0)
    if asked.code is None:
        yield _without_chrony(system)
        return
    fields = asked.out.strip().split(",")
    if asked.code != 0 or len(fields) != 14:
        stated = (asked.error or asked.out).strip().splitlines()[-1:] or ["no answer"]
        yield warn("clock", f"chronyd: {stated[0]}", "sudo systemctl enable --now chrony")
        return
    try:
        offset_s, rms_s = float(fields[4]), float(fields[6])
    except ValueError:
        yield warn("clock", f"chronyd reports {asked.out.strip()!r}", "sudo systemctl restart chrony")
        return
    yield _tracking(fields[1] or "nobody", fields[2], fields[13], offset_s, rms_s, master)


def _tracking(
    who: str, stratum: str, leap: str, offset_s: float, rms_s: float, master: str | None
) -> Finding:
    if leap == "Not synchronised":
        fix = "is the master's machine on, with `local stratum 8` and `allow` in its chrony.conf? `chronyc sources`"
        return warn("clock", "chrony has found no time yet", fix)
    stated = f"{offset_s * 1e6:+.0f} µs off {who} (stratum {stratum}), {rms_s * 1e6:.0f} µs in the mean"
    if (
        abs(offset_s) > 1e-3
    ):  # libcamera brings cameras in step by the system's clock: its error adds to theirs
        fix = "wait some minutes; then `chronyc sources -v`, or `sudo chronyc makestep`"
        return warn("clock", stated, fix)
    if master is not None and who != master:
        fix = "see /etc/chrony/conf.d/phalanx.conf, `chronyc sources`"
        return warn("clock", f"{stated}; not by {master}", fix)
    return ok("clock", stated)


def _without_chrony(system: System) -> Finding:
    asked = system.run(("timedatectl", "show", "--property=NTP", "--property=NTPSynchronized"), 5.0)
    if asked.code is None or asked.code != 0:
        return unseen("clock", "neither chronyc nor timedatectl answers")
    stated = pairs(asked.out)
    if stated.get("NTPSynchronized") == "yes":
        return warn("clock", "by NTP, but how far off is not known without chrony", INSTALL)
    return fail("clock", "nothing keeps it", INSTALL)


ASKED = ("LoadState", "ActiveState", "SubState", "UnitFileState", "NRestarts", "ExecMainStatus", "StatusText")
# Ends before the program begins (systemd.exec(5)): what is wrong, and what mends it.
BEFORE = {
    "203": ("its program cannot be run", "phalanx-slave install, or phalanx fleet deploy"),
    "216": ("a group of the unit is missing", "sudo systemd-sysusers"),
    "243": ("a key of /etc/phalanx/keys is missing", "phalanx fleet deploy brings the keys"),
}


def check_unit(system: System, name: str) -> tuple[Finding, bool]:
    """The service of the slave `name`, and whether it runs and so has its device."""
    unit, check = f"phalanx-slave@{name}.service", "service"
    asked = system.run(("systemctl", "show", unit, *(f"--property={one}" for one in ASKED)), 10.0)
    if asked.code != 0:
        return unseen(check, f"{unit}: systemd does not answer here"), False
    stated = pairs(asked.out)
    if stated.get("LoadState") != "loaded":
        install = "phalanx-slave install --master HOST, or phalanx fleet deploy from the PC"
        return warn(check, f"{unit}: not installed", install), False
    state, status = stated.get("ActiveState", ""), stated.get("ExecMainStatus", "")
    restarts, words = stated.get("NRestarts", "0"), stated.get("StatusText", "")
    log = f"journalctl -u {unit} -n 50"
    if state == "active":
        if restarts != "0":
            return warn(check, f"{words}; restarted {restarts} times since it was started", log), True
        if stated.get("UnitFileState") != "enabled":
            return warn(check, f"{words}; not started at boot", f"sudo systemctl enable {unit}"), True
        return ok(check, words or "active"), True
    if state == "inactive":
        return fail(check, f"{unit}: stopped", f"sudo systemctl start {unit}"), False
    why, fix = BEFORE.get(status, (words or f"it ended with {status}", log))
    runs = state == "activating" and stated.get("SubState") == "start"
    return fail(check, f"{state}, {restarts} restarts: {why}", fix), runs


def check_strobe(system: System, name: str) -> Finding:
    """Whether the running service's strobe has the real-time priority it asks for."""
    unit, check = f"phalanx-slave@{name}.service", "strobe"
    asked = system.run(("systemctl", "show", unit, "--property=ControlGroup"), 10.0)
    group = f"sys/fs/cgroup/{pairs(asked.out).get('ControlGroup', '')}/cgroup.procs"
    stats = [system.text(f"proc/{pid}/stat") for pid in (system.text(group) or "").split()]
    # proc_pid_stat(5): field 40 is the priority, 3 the first behind the name in brackets
    found = [int(text.rpartition(")")[2].split()[37]) for text in stats if text]
    if not found:
        return unseen(check, "the service does not run, or this system has no control groups of version 2")
    if max(found) == 0:
        fix = f"phalanx fleet deploy writes {unit}.d/strobe.conf, which allows it; then restart the service"
        return warn(check, "no real-time priority: frames stay dark where other work makes it late", fix)
    return ok(check, f"its process has real-time priority {max(found)}")


CURRENT = "/opt/phalanx/current"
TIMEOUT_S = 60.0  # numpy and cv2 from a cold SD card
NEEDED = ("numpy", "cv2", "zenoh", "cryptography", "msgspec")
# One name after another, each printed before the next is tried: one that crashes prints nothing.
PROBE = """
import ctypes, importlib, sys
for name in sys.argv[1:]:
    try:
        if name == "libstdc++":
            ctypes.CDLL("libstdc++.so.6")
            said = "yes"
        else:
            said = "yes " + str(getattr(importlib.import_module(name), "__version__", ""))
    except BaseException as error:
        said = "no " + type(error).__name__ + ": " + str(error)
    print(name, " ".join(said.split()), flush=True)
"""
FIXES = {
    "picamera2": "sudo apt install python3-picamera2 --no-install-recommends; the service's environment must see the "
    "system's packages (python3 -m venv --system-site-packages), and not bring a numpy of another major version",
    "libstdc++": "sudo apt install libstdc++6",
    "numba": "pip install 'phalanx-hand[fast]' into the service's environment, or leave --engine numba away",
    "gpiod": "sudo apt install python3-libgpiod, version 2",
}


def check_programs(system: System, extra: Sequence[str]) -> Iterator[Finding]:
    """Whether the service's Python can import what a slave needs, and `extra`."""
    python = system.path(CURRENT) / "bin/python"
    if python.exists():
        where = f"in {CURRENT}"
    else:
        python, where = sys.executable, "in the doctor's own environment"
        yield warn(
            "installed",
            f"no {CURRENT}: it is asked {where}",
            "phalanx-slave install --master HOST, or phalanx fleet deploy from the PC",
        )
    names = ("libstdc++", *NEEDED, *extra)
    asked = system.run((str(python), "-c", PROBE, *names), TIMEOUT_S)
    stated = pairs(asked.out, " ")
    for name in names:
        fix = FIXES.get(
            name, f"install again: the service's environment {where} lacks it, or has it for another Python"
        )
        if name not in stated:
            end = asked.error.strip().splitlines()[-1:] or [f"it ended with {asked.code}"]
            yield fail(name, f"crashed while it was imported {where}: {end[0]}", fix)
            return
        found, _, text = stated[name].partition(" ")
        yield ok(name, text or "there") if found == "yes" else fail(name, f"{text} ({where})", fix)
