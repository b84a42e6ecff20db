"""Open what options name: files, clocks, keys; camera, IMU, tracker, lights.

No driver is chosen silently: a name that is not in `slave.drivers`, or a place that is not of its form, is an error
of its class that lists what there is. A driver is imported where it is opened, so other commands start without its
library. What is no recording is opened again when it was lost, until `stop` is set; `connection_lost` is called when
that, or opening, takes time. A file or key that is not as it must be raises the `PhalanxError` of its kind.
"""

import argparse
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from common.calibration import CameraCalibration, ImuCalibration, RigCalibration, load
from common.calibration.object_profile import ObjectProfile
from common.calibration.strobe import StrobeCalibration
from common.clock import Clock, SkewedClock, SystemClock
from common.errors import CalibrationError, CameraError, ImuError, LightsError, PhalanxError, TrackerError
from common.imu.fusion import OrientationFilter
from slave.cameras.grey import Pixels
from slave.cameras.opencv import OpencvCamera
from slave.cameras.picamera2 import Picamera2Camera
from slave.cameras.picamera2_settings import Picamera2Options
from slave.drivers import CAMERAS, IMUS, LIGHTS, REAL_IMUS, REAL_TRACKERS, SWITCHED_LIGHTS, TRACKERS
from slave.lights.interlock import Interlock
from slave.reconnect import ReconnectingCamera, ReconnectingDriver, ReconnectingTracker
from slave.service import LOST_PATIENCE_S, ConnectionLost, ConnectionLostFor, nobody
from slave.sources import FrameSource, ImuSource, TrackerSource

if TYPE_CHECKING:
    from common.bus.keys import Access
    from common.link.datagram import LinkKey
    from slave.lights.strobed import SimulatedStrobe

DEFAULT_RIG = "desk"
DEFAULT_TREE = Path("calib_json")


def rig_of(options: argparse.Namespace, typical: str = DEFAULT_RIG) -> RigCalibration:
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
    return options.calibration or DEFAULT_TREE


def rig_path(options: argparse.Namespace, typical: str = DEFAULT_RIG) -> Path:
    """The rig file; of the rig `typical` if none is named."""
    return tree_of(options) / "rigs" / f"{options.rig or typical}.json"


def camera_path(options: argparse.Namespace, camera: str) -> Path:
    """The file of a camera."""
    return tree_of(options) / "cameras" / f"{camera}.json"


def world_of(options: argparse.Namespace, rig: RigCalibration) -> tuple[Path, RigCalibration, str, int]:
    """Folder and rig of the simulated world, and name and seed of its scene.

    See `slave.commands.simulated.world_of`.
    """
    from slave.commands.simulated import world_of as world

    return *world(tree_of(options), rig, options.truth, options.truth_rig), options.scene, options.seed


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


SYNTHETIC = "synthetic"
REAL_CAMERAS = ("picamera2", "v4l2", "opencv")


def driver_of(option: str, value: str, forms: str, error: type[PhalanxError]) -> tuple[str, str]:
    """Name and place of a `value` NAME[:PLACE] that must be one of the `forms`."""
    name, colon, place = value.partition(":")
    for form in forms.split(" | "):
        known, optional, _ = form.partition("[:")
        if optional and name == known:
            return name, place
        known, needs, _ = form.partition(":")
        if name == known and needs == colon and bool(place) == bool(needs):
            return name, place
    raise error(f"{option} {value}: no such driver; there are {forms}")


def open_camera(
    driver: str,
    options: argparse.Namespace,
    camera: CameraCalibration,
    clock: Clock,
    stop: threading.Event | None,
    *,
    wrist: bool = False,
    connection_lost: ConnectionLostFor = nobody,
) -> FrameSource | None:
    """Open the real camera that `driver` names; None: it is no real one.

    Losing it without `stop` is an error.
    """
    kind, _, place = driver.partition(":")
    pixels = _pixels(kind, options.luma, wrist)
    # Option -> its driver, and the value that means "not given".
    owners: dict[str, tuple[tuple[str, ...], object]] = {
        "sync": (("picamera2",), "off"),
        "sync_timeout": (("picamera2",), 60.0),
        "control": (("v4l2", "opencv"), []),
        "allow_missing": (("v4l2", "opencv"), []),
    }
    for name, (owned, not_given) in owners.items():
        if kind not in owned and getattr(options, name) != not_given:
            flag = "--" + name.replace("_", "-")
            raise CameraError(
                f"{flag} is an option of --camera {' and '.join(owned)}, not of {driver}: leave it away"
            )
    opener: Callable[[CameraCalibration], FrameSource]
    patience_s = LOST_PATIENCE_S
    if kind == "picamera2":
        if place and not place.isdecimal():
            raise CameraError(
                f"--camera {driver}: the part behind the colon is a number, 0 for the first camera"
            )
        pi = Picamera2Options(int(place or "0"), options.sync, options.sync_timeout, pixels=pixels)
        if options.sync != "off":  # the others may have to be started first
            patience_s += options.sync_timeout
            connection_lost("opens the camera, in step with others", patience_s)
        opener = lambda file: Picamera2Camera(file, pi, clock, stop)  # noqa: E731
    elif kind == "v4l2":
        from slave.cameras.v4l2 import V4l2Camera, V4l2Options, device_path

        codes = _codes(options.control)
        usb = V4l2Options(device_path(place), codes, tuple(options.allow_missing), pixels)
        opener = lambda file: V4l2Camera(file, usb, clock)  # noqa: E731
    elif kind == "opencv":
        if not place.isdecimal():
            raise CameraError(f"--camera {driver}: write opencv:INDEX, 0 for the first camera")
        codes, missing = _codes(options.control), tuple(options.allow_missing)
        opener = lambda file: OpencvCamera(file, int(place), codes, missing, clock, pixels)  # noqa: E731
    else:
        return None
    return _reconnecting(opener, camera, clock, stop, lambda what: connection_lost(what, patience_s))


def _reconnecting(
    opener: Callable[[CameraCalibration], FrameSource],
    camera: CameraCalibration,
    clock: Clock,
    stop: threading.Event | None,
    connection_lost: ConnectionLost,
) -> FrameSource:
    if stop is None:
        return opener(camera)
    return ReconnectingCamera(opener, camera, clock, stop, connection_lost)


@dataclass(frozen=True, slots=True)
class Drivers:
    """Opens the devices, real or not, that the options of a command name for a rig.

    Attributes:
        clock: The slave's.
        true_clock: The machine's, or that of a scene that waits for who draws it.
        stop: Ends the waiting for a lost device; None: losing the camera is an error.
    """

    options: argparse.Namespace
    rig: RigCalibration
    clock: SkewedClock
    true_clock: Clock
    stop: threading.Event | None = None
    connection_lost: ConnectionLostFor = nobody

    @classmethod
    def running(
        cls,
        options: argparse.Namespace,
        rig: RigCalibration,
        stop: threading.Event,
        connection_lost: ConnectionLostFor,
    ) -> "Drivers":
        """Those of a slave that runs until `stop`."""
        true_clock = SystemClock()
        return cls(options, rig, clock_of(options, true_clock), true_clock, stop, connection_lost)

    @property
    def epoch_ns(self) -> int:
        """Scene time 0 on the true clock [ns]."""
        epoch_ns: int | None = self.options.scene_epoch_ns
        return self.true_clock.now_ns() if epoch_ns is None else epoch_ns

    def camera(self, camera: CameraCalibration) -> FrameSource:
        """Open the camera, and before it, dark, the lights of a wrist device."""
        rig, lights = self.rig, choose_lights(self.options.lights, self.rig, str(self.options.camera))
        # a simulated board is not lit
        if lights is None or (lights == SYNTHETIC and self.options.scene == "board"):
            return self._camera(camera)
        from slave.lights.strobed import SimulatedStrobe, StrobedCamera, StrobeProcess, schedule_of

        limits, schedule = light_limits(lights, rig), schedule_of(rig, camera)
        if lights == SYNTHETIC:
            strobe = SimulatedStrobe(schedule, limits)
            return StrobedCamera(self._camera(camera, strobe), camera, rig, strobe)
        process = StrobeProcess(lights, rig, camera, self.clock)
        try:
            source = self._camera(camera)
        except Exception:
            process.close()
            raise
        return StrobedCamera(source, camera, rig, process)

    def _camera(self, camera: CameraCalibration, lights: "SimulatedStrobe | None" = None) -> FrameSource:
        options, clock, wrist = self.options, self.clock, self.rig.kind == "wrist"
        driver, stop = str(options.camera), self.stop
        found = open_camera(
            driver, options, camera, clock, stop, wrist=wrist, connection_lost=self.connection_lost
        )
        if found is not None:
            return found
        kind, _, folder = driver.partition(":")
        if kind == "replay" and folder:
            from slave.cameras.replay import ReplayCamera

            return ReplayCamera(Path(folder), options.name, paced=True, clock=clock)
        if kind != SYNTHETIC or folder:
            raise CameraError(f"--camera {driver}: no such driver; there are {CAMERAS}")
        from slave.cameras.synthetic import FaultyCamera, Frozen, SyntheticCamera
        from slave.commands.simulated import FrameClock, scene_of

        scene, epoch_ns = scene_of(*world_of(options, self.rig)), self.epoch_ns
        late_ns = round(options.start_offset_ms * 1e6)
        waits = isinstance(self.true_clock, FrameClock)
        sleep = self.true_clock.sleep if isinstance(self.true_clock, FrameClock) else time.sleep

        def draw(file: CameraCalibration) -> SyntheticCamera:
            return SyntheticCamera(
                scene, file, epoch_ns, clock, late_ns, self.true_clock, sleep, lights, live=not waits
            )

        if getattr(options, "faults", None) is None:
            return draw(camera)
        frozen = Frozen()
        return _reconnecting(
            lambda file: FaultyCamera(draw(file), file, options.faults, frozen),
            camera,
            clock,
            stop,
            self._lost,
        )

    def _lost(self, what: str) -> None:
        self.connection_lost(what, LOST_PATIENCE_S)

    def imu(self, imu: ImuCalibration) -> ImuSource:
        """Open the IMU of the rig, at the rate that this needs."""
        clock, stop = self.clock, threading.Event() if self.stop is None else self.stop
        if self.options.imu == SYNTHETIC:
            from slave.commands.simulated import SyntheticSensor, imu_of

            sensor = imu_of(SYNTHETIC, *world_of(self.options, self.rig))
            return SyntheticSensor(sensor.sample, sensor.rate_hz, self.epoch_ns, clock, stop)
        kind, place = driver_of("--imu", self.options.imu, IMUS, ImuError)
        opener: Callable[[], ImuSource]
        if kind == "ximu3":
            from slave.imu import ximu3

            port = ximu3.SerialPlace.of(place)
            true_hz = ximu3.SAMPLE_RATE_HZ / ximu3.divisor(imu.rate_hz)
            opener = lambda: ximu3.Ximu3Imu(imu.name, port, imu.rate_hz, clock, stop)  # noqa: E731
        elif kind == "lsm6dsox":
            from slave.imu import lsm6dsox

            wires = lsm6dsox.I2cPlace.of(place)
            true_hz = lsm6dsox.rate_of(imu.rate_hz).rate_hz
            opener = lambda: lsm6dsox.Lsm6dsoxImu(imu.name, wires, imu.rate_hz, clock, stop)  # noqa: E731
        else:
            raise ImuError(f"--imu {self.options.imu}: is no real IMU; there are {REAL_IMUS}")
        return ReconnectingDriver("IMU", opener, clock, stop, self._lost, rate_hz=true_hz)

    def tracker(self, profile: ObjectProfile) -> TrackerSource:
        """Open the tracker on an object."""
        options, clock, name, serial = self.options, self.clock, self.options.name, self.options.serial
        stop = threading.Event() if self.stop is None else self.stop
        if options.tracker == SYNTHETIC:
            from slave.commands.simulated import TRACKER_HZ, SyntheticSensor, poses_of, tracker_of

            measure = poses_of(name, tracker_of(*world_of(options, self.rig), profile))
            return SyntheticSensor(measure, TRACKER_HZ, self.epoch_ns, clock, stop)
        kind, path = driver_of("--tracker", options.tracker, TRACKERS, TrackerError)
        opener: Callable[[], TrackerSource]
        if kind == "survive" and path:
            from slave.objects.survive import SurviveFile

            return SurviveFile(name, serial, Path(path), clock, stop)
        if kind == "survive":
            from slave.objects.survive import SurviveTracker

            opener = lambda: SurviveTracker(name, serial, clock, stop, options.program)  # noqa: E731
        elif kind == "openvr":
            from slave.objects.openvr_tracker import OpenVrTracker

            opener = lambda: OpenVrTracker(name, serial, clock, stop)  # noqa: E731
        else:
            raise TrackerError(f"--tracker {options.tracker}: is no real tracker; there are {REAL_TRACKERS}")
        return ReconnectingTracker(name, opener, clock, stop, self._lost)


def imu_places() -> str:
    """Where an IMU may be: serial ports and I2C buses, as text for people."""
    from slave.imu import lsm6dsox, ximu3

    ports = [f"  ximu3:{line}" for line in ximu3.ports()] or ["  none"]
    buses = [f"  lsm6dsox:{bus}" for bus in lsm6dsox.buses()] or ["  none (on a Pi: dtparam=i2c_arm=on)"]
    return "\n".join(["serial ports:", *ports, "I2C buses:", *buses])


def orientation_of(imu: ImuCalibration) -> OrientationFilter:
    """The filter that adds the orientation; the rig must not trust its heading."""
    if imu.heading_sigma_rad is not None:
        raise CalibrationError(
            f"imu.heading_sigma_rad: {imu.heading_sigma_rad:g}, but an orientation from rates and forces has no "
            "heading that means anything in the rig: set it to null, then tilt alone is used"
        )
    return OrientationFilter(imu.rate_hz)


def object_with(calibration: Path, rig: RigCalibration, name: str) -> ObjectProfile:
    """The object of a rig on which the tracker `name` sits, or `CalibrationError`."""
    profiles = [load(calibration / "objects" / f"{one}.json", ObjectProfile) for one in rig.objects]
    for profile in profiles:
        if profile.tracker == name:
            return profile
    there = ", ".join(f"{one.tracker!r} on {one.name}" for one in profiles if one.tracker is not None)
    raise CalibrationError(
        f"rig {rig.name!r}: no object has the tracker {name!r}; there is {there or 'none'}: name it under `tracker` of "
        "calib_json/objects/OBJECT.json, and the object under `objects` of the rig"
    )


def choose_lights(lights: str | None, rig: RigCalibration, camera: str) -> str | None:
    """What lights the frames; None: the slave switches nothing."""
    kind = camera.partition(":")[0]
    if rig.kind != "wrist" or kind == "replay":
        if lights is not None:
            what = "a recording is lit already" if kind == "replay" else f"rig {rig.name!r} sees markers"
            raise LightsError(f"--lights {lights}: {what}; only the camera of a wrist device has lights")
        return None
    if lights is None:
        if kind == SYNTHETIC:
            return SYNTHETIC
        raise LightsError(
            f"rig {rig.name!r} is a wrist device: say who switches its laser and LEDs, --lights {LIGHTS};"
            " the last two: the camera's own strobe output, or another controller, within limits of its own"
        )
    if lights in ("camera", "external"):
        return None
    if lights == SYNTHETIC and kind != SYNTHETIC:
        raise LightsError(f"--lights synthetic: lights nothing before --camera {camera}; there are {LIGHTS}")
    if lights != SYNTHETIC:
        if kind == SYNTHETIC:
            raise LightsError(f"--lights {lights}: a simulated hand is lit by synthetic, or by camera")
        driver_of("--lights", lights, LIGHTS, LightsError)
    return lights


def light_limits(lights: str, rig: RigCalibration) -> StrobeCalibration:
    """The limits within which lights are switched."""
    if rig.strobe is None:
        raise LightsError(
            f"--lights {lights}: rig {rig.name!r}: strobe: missing; laser and LEDs are only switched within limits:"
            " power, pulse, duty (docs/safety.md); --lights camera where others switch them"
        )
    return rig.strobe


def open_lights(lights: str, rig: RigCalibration) -> Interlock:
    """Open real lights, dark, within the limits of the rig file."""
    strobe = light_limits(lights, rig)
    driver_of("--lights", lights, LIGHTS, LightsError)
    from slave.lights.strobed import switched_lights

    if (driver := switched_lights(lights, strobe)) is None:
        raise LightsError(f"--lights {lights}: the slave does not switch these; it does {SWITCHED_LIGHTS}")
    return Interlock(driver, strobe)


def _pixels(kind: str, as_luma: bool, wrist: bool) -> Pixels:
    if as_luma and kind not in ("picamera2", "v4l2"):
        raise CameraError(f"--luma is an option of --camera picamera2 and v4l2, not of {kind}: leave it away")
    if as_luma and not wrist:
        raise CameraError(
            "--luma: makes grey frames for a wrist device; this rig looks for painted markers, by colour"
        )
    if wrist:
        return Pixels.LUMA if as_luma else Pixels.GREY
    return Pixels.COLOUR


def _codes(texts: list[str]) -> dict[str, int]:
    """Control -> code of `--control NAME=NUMBER`."""
    found: dict[str, int] = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            number = int(value)
        except ValueError as error:
            raise CameraError(f"--control {text}: write NAME=NUMBER, for example gain=32") from error
        if name in found:
            raise CameraError(f"--control {name} is given twice")
        found[name] = number
    return found
