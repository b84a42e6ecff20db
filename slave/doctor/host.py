"""Checks of the machine itself.

64 bit, which system on which board, Python, disk space, heat, supply.
"""

import platform
import re
import struct
import sys
from collections.abc import Iterator

from common.machine import Machine
from slave.doctor.finding import Finding, fail, ok, unseen, warn
from slave.doctor.system import System

RELEASES = {"trixie": "13", "bookworm": "12"}  # of Debian, and of the Raspberry Pi OS made from it
PYTHONS = ((3, 11), (3, 13))
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
    yield _bits()
    yield _release(system)
    yield _board(system)
    yield _python()
    yield from _metrics(system)
    yield _memory_limit(system)
    yield _throttled(system)


def _bits() -> Finding:
    machine, bits = platform.machine(), struct.calcsize("P") * 8
    if bits != 64:
        return fail(
            "64 bit", f"{machine}, this Python has {bits} bit", "install the 64-bit Raspberry Pi OS (Lite)"
        )
    return ok("64 bit", machine)


def _release(system: System) -> Finding:
    text = system.text("/etc/os-release") or ""
    stated = dict(re.findall(r'^(\w+)="?([^"\n]*)"?$', text, re.MULTILINE))
    name = stated.get("PRETTY_NAME", "unknown")
    if stated.get("VERSION_CODENAME") in RELEASES:
        return ok("system", name)
    return warn(
        "system", f"{name}: not tried with it", f"Raspberry Pi OS or Debian {' or '.join(sorted(RELEASES))}"
    )


def _board(system: System) -> Finding:
    model = system.text("/sys/firmware/devicetree/base/model")
    return unseen("board", "no device tree: not a Raspberry Pi") if model is None else ok("board", model)


def _python() -> Finding:
    version = platform.python_version()
    if not PYTHONS[0] <= sys.version_info[:2] <= PYTHONS[1]:
        return fail("Python", version, "Python 3.11 to 3.13")
    return ok("Python", f"{version} in {sys.prefix}")


def _metrics(system: System) -> Iterator[Finding]:
    folder = system.path(STATE) if system.path(STATE).is_dir() else system.root
    metrics = Machine(folder, system.environment).metrics()
    free_mb = metrics.get("disk_free_mb")
    few_mb, no_mb = 500.0, 100.0
    if free_mb is None:
        yield unseen("disk", f"{folder}: not known")
    elif free_mb < few_mb:
        level = fail if free_mb < no_mb else warn
        yield level(
            "disk", f"{free_mb:.0f} MB free", "delete recordings or old releases in /opt/phalanx/releases"
        )
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
    """Whether the kernel keeps the unit's MemoryMax.

    That of Raspberry Pi OS does so only where it is asked to.
    """
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
    since = 16
    before = [text for bit, text in BITS.items() if flags >> (bit + since) & 1 and text not in now]
    if not now and not before:
        return ok("throttling", "none since the start")
    stated = [*(f"{text} now" for text in now), *(f"{text} since the start" for text in before)]
    fix = SUPPLY if flags & (1 | 1 << since) else COOL
    return warn("throttling", ", ".join(stated), fix)


def _flags(system: System) -> int | None:
    """Read the status flags of the firmware.

    vcgencmd is asked, which knows all of them on every board; else those of sysfs are read.
    """
    asked = system.run(("vcgencmd", "get_throttled"), 5.0)
    if asked.code == 0 and (found := re.search(r"throttled=(0x[0-9a-fA-F]+)", asked.out)):
        return int(found[1], 16)
    flags = Machine(system.root, system.environment).metrics().get("throttled")
    return None if flags is None else int(flags)
