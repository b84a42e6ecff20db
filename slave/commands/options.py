"""Open what the options of several commands name: files, clocks, keys, camera.

A file, key or device that is not as it must be raises the `PhalanxError` of its kind.
"""

import argparse
import os
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

from common.calibration import CameraCalibration, RigCalibration, load
from common.calibration.object_profile import ObjectProfile
from common.clock import Clock, SkewedClock
from common.errors import CalibrationError, CameraError
from slave.commands import devices
from slave.drivers import CAMERAS
from slave.service import LOST_PATIENCE_S, ConnectionLostFor, nobody
from slave.sources import FrameSource

if TYPE_CHECKING:
    from common.bus.keys import Access
    from common.link.datagram import LinkKey
    from slave.lights.strobed import SimulatedStrobe

USUAL_RIG = "desk"
USUAL_TREE = Path("calib_json")


def rig_of(options: argparse.Namespace, typical: str = USUAL_RIG) -> RigCalibration:
    """The rig; `typical` if none is named."""
    return load(rig_path(options, typical), RigCalibration)


def camera_of(options: argparse.Namespace) -> tuple[RigCalibration, CameraCalibration]:
    """The rig, and the camera of this slave."""
    rig = rig_of(options)
    if options.name not in rig.cameras:
        raise CalibrationError(
            f"rig {rig.name!r} has no camera {options.name!r}; it has {', '.join(rig.cameras)}"
        )
    return rig, load(camera_path(options, options.name), CameraCalibration)


def objects_of(options: argparse.Namespace, rig: RigCalibration) -> dict[str, ObjectProfile]:
    """The objects of the rig, by name."""
    return {name: load(tree_of(options) / "objects" / f"{name}.json", ObjectProfile) for name in rig.objects}


def tree_of(options: argparse.Namespace) -> Path:
    """The calib_json tree."""
    return options.calibration or USUAL_TREE


def rig_path(options: argparse.Namespace, typical: str = USUAL_RIG) -> Path:
    """The rig file; of the rig `typical` if none is named."""
    return tree_of(options) / "rigs" / f"{options.rig or typical}.json"


def camera_path(options: argparse.Namespace, camera: str) -> Path:
    """The file of a camera."""
    return tree_of(options) / "cameras" / f"{camera}.json"


def world_of(options: argparse.Namespace, rig: RigCalibration) -> tuple[Path, RigCalibration]:
    """Folder and rig of the simulated world; see `slave.commands.simulated.world_of`."""
    from slave.commands.simulated import world_of as world

    return world(tree_of(options), rig, options.truth, options.truth_rig)


def epoch_of(options: argparse.Namespace, true_clock: Clock) -> int:
    """Scene time 0 on the true clock [ns]."""
    return true_clock.now_ns() if options.scene_epoch_ns is None else options.scene_epoch_ns


def clock_of(options: argparse.Namespace, true_clock: Clock) -> SkewedClock:
    """The slave's clock, which a simulated machine may have ahead of the true one."""
    return SkewedClock(round(options.clock_offset_ms * 1e6), options.clock_ppm, true_clock)


def skew_of(options: argparse.Namespace, true_clock: Clock) -> str:
    """How the slave's clock differs from the machine's, to compare recordings by."""
    skewed = f" {options.clock_offset_ms:+g} ms" if options.clock_offset_ms else ""
    return skewed + (f" {options.clock_ppm:+g} ppm from {true_clock.now_ns()}" if options.clock_ppm else "")


def secrets_of(options: argparse.Namespace) -> "tuple[LinkKey, Access]":
    """What this device seals its datagrams by, and how it comes to the bus."""
    from common.bus.keys import access_of, link_key

    access = access_of(os.environ, options.name, options.keys, options.open)
    if access.folder is not None:
        access.identity()  # reported now, not when a master is received
    return link_key(os.environ, options.key_file, options.keys, options.name), access


def open_lit(
    options: argparse.Namespace,
    rig: RigCalibration,
    camera: CameraCalibration,
    clock: Clock,
    true_clock: Clock,
    stop: threading.Event | None = None,
    connection_lost: ConnectionLostFor = nobody,
) -> FrameSource:
    """Open the camera, and before it, dark, the lights of a wrist device."""
    lights = devices.choose_lights(options.lights, rig, str(options.camera))
    if lights is None or (
        lights == devices.SYNTHETIC and options.scene == "board"
    ):  # a simulated board is not lit
        return _open(options, rig, camera, clock, true_clock, stop, connection_lost)
    from slave.lights.controller import StrobeController
    from slave.lights.strobed import SimulatedStrobe, StrobedCamera, schedule_of

    limits, schedule = devices.light_limits(lights, rig), schedule_of(rig, camera)
    if lights == devices.SYNTHETIC:
        strobe = SimulatedStrobe(schedule, limits)
        source = _open(options, rig, camera, clock, true_clock, stop, nobody, strobe)
        return StrobedCamera(source, camera, rig, strobe)
    interlock = devices.open_lights(lights, rig)
    try:
        source = _open(options, rig, camera, clock, true_clock, stop, connection_lost)
    except Exception:
        interlock.close()
        raise
    return StrobedCamera(source, camera, rig, StrobeController(schedule, interlock, clock))


def _open(
    options: argparse.Namespace,
    rig: RigCalibration,
    camera: CameraCalibration,
    clock: Clock,
    true_clock: Clock,
    stop: threading.Event | None,
    connection_lost: ConnectionLostFor,
    lights: "SimulatedStrobe | None" = None,
) -> FrameSource:
    found = devices.open_camera(
        options.camera,
        options,
        camera,
        clock,
        stop,
        wrist=rig.kind == "wrist",
        connection_lost=connection_lost,
    )
    if found is not None:
        return found
    kind, _, folder = str(options.camera).partition(":")
    if kind == "replay" and folder:
        from slave.cameras.replay import ReplayCamera

        return ReplayCamera(Path(folder), options.name, paced=True, clock=clock)
    if kind != "synthetic" or folder:
        raise CameraError(f"--camera {options.camera}: no such driver; there are {CAMERAS}")
    from slave.cameras.synthetic import FaultyCamera, Frozen, SyntheticCamera
    from slave.commands.simulated import FrameClock, scene_of

    scene = scene_of(*world_of(options, rig), options.scene, options.seed)
    epoch_ns = epoch_of(options, true_clock)
    late_ns = round(options.start_offset_ms * 1e6)
    waits = isinstance(true_clock, FrameClock)
    sleep = true_clock.sleep if isinstance(true_clock, FrameClock) else time.sleep

    def draw(file: CameraCalibration) -> SyntheticCamera:
        return SyntheticCamera(
            scene, file, epoch_ns, clock, late_ns, true_clock, sleep, lights, live=not waits
        )

    if getattr(options, "faults", None) is None:
        return draw(camera)
    frozen = Frozen()
    return devices.reconnecting_camera(
        lambda file: FaultyCamera(draw(file), file, options.faults, frozen),
        camera,
        clock,
        stop,
        lambda what: connection_lost(what, LOST_PATIENCE_S),
    )
