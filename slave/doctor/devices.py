"""Checks of what the service may open.

Its groups, the devices that its options name, the buffers of libcamera.
"""

import argparse
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path

from slave.doctor.finding import Finding, fail, ok, unseen
from slave.doctor.system import System

GROUPS = ("video", "dialout", "i2c", "gpio")  # SupplementaryGroups of the unit; a test compares them
DMA_HEAP = "/dev/dma_heap"
SYSUSERS = "sudo systemd-sysusers (with /etc/sysusers.d/phalanx.conf), then restart the service"
I2C_ON = "dtparam=i2c_arm=on in /boot/firmware/config.txt, then restart the Pi"
RULE = (
    'a udev rule, for example SUBSYSTEM=="dma_heap", GROUP="video", MODE="0660" (package raspberrypi-sys-mods of '
    "Raspberry Pi OS has it)"
)


def check_groups(system: System) -> Finding:
    """Check that all groups of the unit exist.

    systemd starts the unit only if none is missing.
    """
    there = _group_ids(system)
    if missing := [name for name in GROUPS if name not in there]:
        return fail("groups", f"missing: {', '.join(missing)}; the service ends with 216/GROUP", SYSUSERS)
    return ok("groups", ", ".join(GROUPS))


def check_devices(system: System, slave: argparse.Namespace) -> Iterator[Finding]:
    """The devices that a slave with these options opens."""
    for check, place, fix in _places(slave):
        yield _open_to_service(system, check, place, fix)
    if str(getattr(slave, "camera", "")).partition(":")[0] == "picamera2":
        yield _dma_heap(system)


def _places(slave: argparse.Namespace) -> Iterator[tuple[str, str, str]]:
    """Name, path and advice of each device."""
    kind, _, place = str(getattr(slave, "camera", None) or "").partition(":")
    if kind == "v4l2":
        path = f"/dev/video{place or '0'}" if place.isdecimal() or not place else place
        yield "camera device", path, "plug the camera in; `v4l2-ctl --list-devices` shows where it is"
    kind, _, place = str(getattr(slave, "imu", None) or "").partition(":")
    if kind == "ximu3":
        yield (
            "IMU device",
            place.partition("@")[0],
            "plug it in; `phalanx-slave doctor --ports` shows the ports",
        )
    elif kind == "lsm6dsox":
        yield "IMU bus", f"/dev/i2c-{place.partition(':')[0]}", I2C_ON
    kind, _, place = str(getattr(slave, "lights", None) or "").partition(":")
    if kind == "gpio":
        chip = place.partition(":")[0]
        path = chip if "/" in chip else f"/dev/gpiochip{chip}" if chip.isdecimal() else f"/dev/{chip}"
        yield "lights", path, "`gpiodetect` lists the chips"
    elif kind == "i2c":
        yield "lights", f"/dev/i2c-{place.partition(':')[0]}", I2C_ON


def _open_to_service(system: System, check: str, place: str, fix: str) -> Finding:
    path = system.path(place)
    try:
        status = path.stat()
    except OSError as error:
        return fail(check, f"{place}: {error.strerror}", fix)
    if not _may_open(status.st_mode, status.st_gid, _group_ids(system)):
        mode = stat.filemode(status.st_mode)
        return fail(
            check,
            f"{place}: {mode}, not of a group of the service",
            f"a udev rule that gives it to one of {', '.join(GROUPS)}",
        )
    return ok(check, f"{place}, open to the service")


def _dma_heap(system: System) -> Finding:
    folder = system.path(DMA_HEAP)
    heaps = sorted(folder.iterdir()) if folder.is_dir() else []
    if not heaps:
        fix = "the kernel of Raspberry Pi OS; libcamera takes its buffers from there"
        return fail("dma_heap", f"{DMA_HEAP}: none", fix)
    ids = _group_ids(system)
    usable = [one.name for one in heaps if _may_open(one.stat().st_mode, one.stat().st_gid, ids)]
    if not usable:
        return fail("dma_heap", f"{DMA_HEAP}: not of a group of the service", RULE)
    return ok("dma_heap", f"{', '.join(usable)}, open to the service")


def _may_open(mode: int, group: int, ids: Mapping[str, int]) -> bool:
    """Whether a user who is only in the groups of the service may read and write."""
    everybody = stat.S_IROTH | stat.S_IWOTH
    groups = stat.S_IRGRP | stat.S_IWGRP
    return mode & everybody == everybody or (group in ids.values() and mode & groups == groups)


def _group_ids(system: System) -> dict[str, int]:
    """Those groups of the service that exist."""
    found: dict[str, int] = {}
    for line in (system.text("/etc/group") or "").splitlines():
        name, _, rest = line.partition(":")
        number = rest.split(":")[1:2]
        if name in GROUPS and number and number[0].isdecimal():
            found[name] = int(number[0])
    return found


def cameras_of(system: System) -> Finding:
    """Which V4L2 devices there are."""
    folder = system.path("/sys/class/video4linux")
    found = [f"{one.name} ({_name(one)})" for one in sorted(folder.glob("video*"))] if folder.is_dir() else []
    return ok("video devices", ", ".join(found)) if found else unseen("video devices", "the kernel has none")


def _name(device: Path) -> str:
    try:
        return (device / "name").read_text(errors="replace").strip()
    except OSError:
        return "?"
