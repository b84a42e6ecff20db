"""Check the camera, and what devices the service may open.

The camera opens, has every setting of its file with all automatics off, and delivers frames. One that the running
service has cannot be opened a second time: its frames are asked for, and of a V4L2 camera the automatics are read.
"""

import argparse
import contextlib
import math
import stat
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from common.calibration import CameraCalibration, RigCalibration, load
from common.calibration.camera import Sensor, sensor_files
from common.clock import SystemClock
from common.errors import CalibrationError, CameraError, PhalanxError
from slave.cameras.picamera2 import offered
from slave.cameras.picamera2_streams import SensorMode, choose_mode, choose_raw_mode
from slave.cameras.settings import Setting, differences
from slave.cameras.v4l2 import device_path
from slave.cameras.v4l2_abi import KernelDevice
from slave.cameras.v4l2_controls import AUTOMATICS, read_back, read_controls
from slave.cameras.v4l2_formats import Offer, choose_offer, read_offers
from slave.commands import devices
from slave.doctor.host import Finding, System, fail, ok, unseen, warn
from slave.shared import shared_camera

GROUPS = ("video", "dialout", "i2c", "gpio")  # SupplementaryGroups of the unit; a test compares them
DMA_HEAP = "/dev/dma_heap"
SYSUSERS = "sudo systemd-sysusers (with /etc/sysusers.d/phalanx.conf), then restart the service"
I2C_ON = "dtparam=i2c_arm=on in /boot/firmware/config.txt, then restart the Pi"
RULE = (
    'a udev rule, for example SUBSYSTEM=="dma_heap", GROUP="video", MODE="0660" (package raspberrypi-sys-mods of '
    "Raspberry Pi OS has it)"
)


def check_groups(system: System) -> Finding:
    """Check that all groups of the unit exist: else systemd does not start it."""
    there = _group_ids(system)
    if missing := [name for name in GROUPS if name not in there]:
        return fail("groups", f"missing: {', '.join(missing)}; the service ends with 216/GROUP", SYSUSERS)
    return ok("groups", ", ".join(GROUPS))


def check_devices(system: System, slave: argparse.Namespace) -> Iterator[Finding]:
    """The devices that a slave with these options opens."""
    for check, place, fix in _places(slave):
        yield _open_to_service(system, check, place, fix)
    if str(slave.camera).partition(":")[0] == "picamera2":
        yield _dma_heap(system)


def _places(slave: argparse.Namespace) -> Iterator[tuple[str, str, str]]:
    """Name, path and advice of each device."""
    kind, _, place = str(slave.camera or "").partition(":")
    if kind == "v4l2":
        fix = "plug the camera in; `v4l2-ctl --list-devices` shows where it is"
        yield "camera device", str(device_path(place)), fix
    kind, _, place = str(slave.imu or "").partition(":")
    if kind == "ximu3":
        fix = "plug it in; `phalanx-slave doctor --ports` shows the ports"
        yield "IMU device", place.partition("@")[0], fix
    elif kind == "lsm6dsox":
        yield "IMU bus", f"/dev/i2c-{place.partition(':')[0]}", I2C_ON
    kind, _, place = str(slave.lights or "").partition(":")
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
        text = f"{place}: {stat.filemode(status.st_mode)}, not of a group of the service"
        return fail(check, text, f"a udev rule that gives it to one of {', '.join(GROUPS)}")
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
    return mode & 0o006 == 0o006 or (group in ids.values() and mode & 0o060 == 0o060)


def _group_ids(system: System) -> dict[str, int]:
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


def check_camera(slave: argparse.Namespace, taken: bool) -> Iterator[Finding]:
    """Check files and device of a camera; `taken`: the service runs, and has it."""
    try:
        file = load(slave.calibration / "cameras" / f"{slave.name}.json", CameraCalibration)
        rig = load(slave.calibration / "rigs" / f"{slave.rig}.json", RigCalibration)
    except PhalanxError as error:
        if isinstance(error.__cause__, PermissionError):
            yield unseen("camera file", f"{slave.calibration}: only root may look: sudo phalanx-slave doctor")
        else:
            yield fail("camera file", str(error), "copy calib_json from the PC, or give --calibration DIR")
        return
    if slave.name not in rig.cameras:
        there = ", ".join(rig.cameras)
        yield fail("camera file", f"rig {rig.name!r} has no camera {slave.name!r}", f"its cameras: {there}")
        return
    yield ok("camera file", f"{file.width_px}x{file.height_px} at {file.frame_rate_hz:g} Hz, rig {rig.name}")
    kind, _, place = str(slave.camera).partition(":")
    if kind not in devices.REAL_CAMERAS:
        yield unseen("camera", f"{slave.camera}: no device")
        return
    if taken and kind == "v4l2":
        with contextlib.suppress(OSError, CameraError):  # `_automatics` says what is wrong
            yield from _offers(slave)
        yield _automatics(device_path(place))
    yield from _opened(slave, file, taken, wrist=rig.kind == "wrist")


def _offers(slave: argparse.Namespace) -> Iterator[Finding]:
    """What the camera can do, and which shipped files fit it."""
    kind, _, place = str(slave.camera).partition(":")
    files, broken = dict[str, tuple[CameraCalibration, Sensor]](), ""
    try:
        files |= {n: (one, one.sensor) for n, one in sensor_files(slave.calibration).items() if one.sensor}
    except CalibrationError as error:
        broken = str(error)
    if kind == "picamera2":
        model, modes = offered(int(place) if place.isdecimal() else 0)
        own = {name: one for name, one in files.items() if one[1].fits(model)}
        text = "; ".join(mode.text(modes) + _angle(mode, own.values()) for mode in modes)
        offers = ()
    else:
        device = KernelDevice(device_path(place))
        try:
            offers = read_offers(device, (0, 0))
        finally:
            device.close()
        model, modes, text = "by its driver", (), "; ".join(offer.text() for offer in offers)
        own = {name: one for name, one in files.items() if one[1].driver == kind}
    yield ok("camera modes", f"{model}: {text}")
    fit = [name for name, one in own.items() if _fits(*one, modes, offers)]
    if broken:
        yield fail("camera files", broken, "copy calib_json/cameras from the PC again")
    elif fit:
        yield ok("camera files", f"shipped ones that fit: {', '.join(fit)}")
    else:
        fix = "write one of a mode above, as docs/cameras.md has it"
        yield warn("camera files", f"none of {slave.calibration}/cameras fits this camera", fix)


def _fits(
    file: CameraCalibration, sensor: Sensor, modes: Sequence[SensorMode], offers: Sequence[Offer]
) -> bool:
    """Whether the drivers would open the camera with this file."""
    size, rate_hz = (file.width_px, file.height_px), file.frame_rate_hz
    try:
        if sensor.driver == "v4l2":
            choose_offer(offers, size, rate_hz)
        elif sensor.colours:
            choose_mode(modes, rate_hz, size, sensor)
        else:
            choose_raw_mode(modes, rate_hz, size)
    except CameraError:
        return False
    return True


def _angle(mode: SensorMode, own: Iterable[tuple[CameraCalibration, Sensor]]) -> str:
    """What a mode sees through the lens of the shipped files, where there are any."""
    for file, sensor in own:
        focal_px = sensor.nominal.fx_px * sensor.crop_px[2] / file.width_px
        across, down = (2.0 * math.degrees(math.atan(0.5 * side / focal_px)) for side in mode.crop[2:])
        return f", {across:.0f} x {down:.0f} deg"
    return ""


def _opened(slave: argparse.Namespace, file: CameraCalibration, taken: bool, *, wrist: bool) -> list[Finding]:
    """Open the camera as the slave does, or ask who has it, and read some frames."""
    found: list[Finding] = []

    def look() -> None:
        text = "the running service has it, and gave {} frames of it"
        with contextlib.suppress(OSError, CameraError):  # opening it says what is wrong
            found.extend(() if taken else _offers(slave))
        try:
            camera = shared_camera(slave, None, None)
            if camera is None and taken:
                found.append(unseen("camera", "the running service has it, and does not share its frames"))
                return
            if camera is None:
                camera = devices.open_camera(str(slave.camera), slave, file, SystemClock(), None, wrist=wrist)
                text = "opens, has its settings, automatics off, {} frames read"
            assert camera is not None  # its driver is a real one
            with contextlib.closing(camera):
                seen = sum(camera.read() is not None for _ in range(10))
        except PhalanxError as error:
            found.append(fail("camera", str(error), "as the error states; docs/cameras.md has the rest"))
        else:
            found.append(ok("camera", text.format(seen)))

    # In a thread of its own: a library that hangs must not hold up the other checks.
    thread = threading.Thread(target=look, name="doctor camera", daemon=True)
    thread.start()
    given_up_s = 30.0
    thread.join(given_up_s)
    if thread.is_alive():
        fix = "check the cable with the power off; restart the Pi"
        return [*found, fail("camera", f"no answer of its driver in {given_up_s:.0f} s", fix)]
    return found


def _automatics(path: Path) -> Finding:
    try:
        device = KernelDevice(path)
    except OSError as error:
        return fail("camera", f"{path}: {error.strerror}", "plug it in, or stop the program that has it")
    try:
        controls = read_controls(device)
        there = [Setting(name, (off,), 0.0, "", "") for name, off in AUTOMATICS.items() if name in controls]
        on = differences(there, read_back(device, controls, there))
    except OSError as error:
        return fail("camera", f"{path}: cannot be asked: {error.strerror}", "unplug it and plug it in again")
    finally:
        device.close()
    if on:
        fix = "restart the service; stop other programs"
        return fail("camera", f"automatics are on: {', '.join(on)}", fix)
    return ok("camera", f"the service has it; {len(there)} automatics, all off")
