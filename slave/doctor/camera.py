"""Checks of the camera itself.

It opens, has every setting of its file with all automatics off, and delivers frames.

One that the running service has cannot be opened a second time. Of a V4L2 camera the automatics are read all the same;
of another it is reported that it was not checked.
"""

import argparse
import threading
from collections.abc import Iterator
from pathlib import Path

from common.calibration import CameraCalibration, RigCalibration, load
from common.clock import SystemClock
from common.errors import PhalanxError
from slave import devices
from slave.cameras.settings import Setting, differences
from slave.cameras.v4l2 import device_path
from slave.cameras.v4l2_abi import KernelDevice
from slave.cameras.v4l2_controls import AUTOMATICS, read_back, read_controls
from slave.doctor.finding import Finding, fail, ok, unseen


def check_camera(slave: argparse.Namespace, taken: bool) -> Iterator[Finding]:
    """Files and device of a camera.

    Args:
        slave: Options of `phalanx-slave run`.
        taken: Whether the service runs, and has it.
    """
    try:
        file = load(slave.calibration / "cameras" / f"{slave.name}.json", CameraCalibration)
        rig = load(slave.calibration / "rigs" / f"{slave.rig}.json", RigCalibration)
    except PhalanxError as error:
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
    elif not taken:
        yield _opened(slave, file, wrist=rig.kind == "wrist")
    elif kind == "v4l2":
        yield _automatics(device_path(place))
    else:
        yield unseen(
            "camera", "the running service has it, and read its settings back; else: systemctl stop it first"
        )


def _opened(slave: argparse.Namespace, file: CameraCalibration, *, wrist: bool) -> Finding:
    """Open the camera as the slave does and read some frames.

    Each setting is written and read back first.
    """
    found: list[Finding] = []

    def look() -> None:
        try:
            camera = devices.open_camera(str(slave.camera), slave, file, SystemClock(), None, wrist=wrist)
            assert camera is not None  # its driver is a real one
            try:
                frames = 10
                seen = sum(camera.read() is not None for _ in range(frames))
            finally:
                camera.close()
        except PhalanxError as error:
            found.append(fail("camera", str(error), "as the error states; docs/cameras.md has the rest"))
        else:
            found.append(ok("camera", f"opens, has its settings, automatics off, {seen} frames read"))

    # In a thread of its own: a library that hangs must not hold up the other checks.
    thread = threading.Thread(target=look, name="doctor camera", daemon=True)
    thread.start()
    given_up_s = 30.0
    thread.join(given_up_s)
    if not found:
        fix = "check the cable with the power off; restart the Pi"
        return fail("camera", f"no answer of its driver in {given_up_s:.0f} s", fix)
    return found[0]


def _automatics(path: Path) -> Finding:
    """Which automatics of a V4L2 camera are on."""
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
        return fail(
            "camera", f"automatics are on: {', '.join(on)}", "restart the service; stop other programs"
        )
    return ok("camera", f"the service has it; {len(there)} automatics, all off")
