"""Opening of the camera of `run` and `record`.

The lights of a wrist device are opened with it.
"""

import argparse
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

from common.calibration import CameraCalibration, RigCalibration
from common.clock import Clock
from common.errors import CameraError
from slave import devices
from slave.commands.options import epoch_of, world_of
from slave.drivers import CAMERAS
from slave.service import ConnectionLost, nobody
from slave.sources import FrameSource

if TYPE_CHECKING:
    from slave.lights.simulated import SimulatedStrobe


def open_lit(
    options: argparse.Namespace,
    rig: RigCalibration,
    camera: CameraCalibration,
    clock: Clock,
    true_clock: Clock,
    stop: threading.Event | None = None,
    connection_lost: ConnectionLost = nobody,
) -> FrameSource:
    """Open the camera, and the lights of a wrist device.

    The lights are dark before the camera is opened.

    Args:
        options: Of `run` or `record`.
        rig: Whose camera it is.
        camera: The camera file.
        clock: The slave's clock.
        true_clock: What the simulated world goes by.
        stop: Set when the slave is to end; until then a camera that is lost is opened again. None: losing it is an
            error.
        away: Called when it takes time to open it, now or again.

    Raises:
        CameraError: There is no such driver, or the camera cannot be opened.
        LightsError: The lights are not given, do not fit, or cannot be opened.
        CalibrationError: A file of the simulated world is missing or broken.
    """
    lights = devices.choose_lights(options.lights, rig, str(options.camera))
    if lights is None or (
        lights == devices.SYNTHETIC and options.scene == "board"
    ):  # a simulated board is not lit
        return _open(options, rig, camera, clock, true_clock, stop, connection_lost)
    from slave.lights.controller import StrobeController
    from slave.lights.simulated import SimulatedStrobe
    from slave.lights.strobed import StrobedCamera, schedule_of

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
    connection_lost: ConnectionLost,
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
    if kind == "synthetic" and not folder:
        return _open_synthetic(options, rig, camera, clock, true_clock, stop, connection_lost, lights)
    raise CameraError(f"--camera {options.camera}: no such driver; there are {CAMERAS}")


def _open_synthetic(
    options: argparse.Namespace,
    rig: RigCalibration,
    camera: CameraCalibration,
    clock: Clock,
    true_clock: Clock,
    stop: threading.Event | None,
    connection_lost: ConnectionLost,
    lights: "SimulatedStrobe | None",
) -> FrameSource:
    from slave.cameras.synthetic import SyntheticCamera
    from slave.simulated import FrameClock, scene_of

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
    from slave.cameras.faulty import FaultyCamera, Frozen

    frozen = Frozen()

    return devices.reconnecting_camera(
        lambda file: FaultyCamera(draw(file), file, options.faults, frozen),
        camera,
        clock,
        stop,
        connection_lost,
    )
