"""Map a camera file to libcamera's controls, and import picamera2.

picamera2 and libcamera come with the Raspberry Pi's system, not from the package registry, so they are imported when
a camera is opened and their absence is an error that states how to install them. Names and meanings were read in
picamera2 0.3.38 (picamera2.py, request.py, controls.py) and in libcamera's control_ids_*.yaml.

Tolerances. libcamera programs exposure and frame duration in whole rows, rounding down, so one row is allowed. It
programs the analogue gain in codes of the sensor: OV5647 has steps of 1/16, IMX219 has 256 / (256 - code), that is
steps of gain² / 256, the others are finer (libcamera, src/ipa/rpi/cam_helper). What rounding takes away it gives back
as digital gain behind the sensor, which may therefore exceed 1 by as much, and not by more. Colour gains come back as
they were written, but for the fixed point of the image processor. A lens moves in steps of about 0.03 dioptres
(IMX708: 480 steps for 15 dioptres). The view may be off by a hundredth: image processors round it. What cannot be
used, is out of range or missing raises `CameraError`, which states what to do.
"""

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, cast

import numpy.typing as npt

from common.calibration import CameraCalibration
from common.errors import CameraError
from slave.cameras.grey import Pixels
from slave.cameras.settings import Setting, as_values

INSTALL = (
    "install it with `sudo apt install python3-picamera2 --no-install-recommends` (Raspberry Pi OS, 64 bit) and make "
    "the virtual environment with `python3 -m venv --system-site-packages`, so that it sees the system's packages"
)


class Request(Protocol):
    """One captured frame (`CompletedRequest`); released, its buffers go back."""

    def make_array(self, name: str) -> npt.NDArray[Any]:
        """Copy the stream `name`; rows of RGB come without padding, of YUV420 with it."""
        ...

    def get_metadata(self) -> Mapping[str, object]:
        """What the sensor and the image processor really did for this frame."""
        ...

    def release(self) -> None:
        """Give the buffers back."""
        ...


class Library(Protocol):
    """An open camera: the class `picamera2.Picamera2`."""

    @property
    def sensor_modes(self) -> Sequence[Mapping[str, Any]]:
        """Modes of the sensor; the first call configures each of them in turn."""
        ...

    @property
    def camera_controls(self) -> Mapping[str, tuple[Any, Any, Any]]:
        """Control -> (lowest, highest, default), for the configured mode."""
        ...

    @property
    def camera_properties(self) -> Mapping[str, object]:
        """Model, pixel array size and more."""
        ...

    def create_video_configuration(self, **parts: Any) -> dict[str, Any]:
        """Configuration of `main`, `lores`, `raw`, `sensor`, `controls` and more."""
        ...

    def configure(self, camera_config: dict[str, Any]) -> None:
        """Apply a configuration."""
        ...

    def camera_configuration(self) -> Mapping[str, Any]:
        """The configuration as the camera took it: size, format, stride of each stream."""
        ...

    def start(self) -> None:
        """Start the camera with the controls of the configuration."""
        ...

    def set_controls(self, controls: Mapping[str, Any]) -> None:
        """Change controls of the running camera, from any thread; shown frames later."""
        ...

    def capture_request(self, wait: float) -> Request:
        """Next frame. Raises `TimeoutError` after `wait` seconds; the job stays queued."""
        ...

    def cancel_all_and_flush(self) -> None:
        """Forget queued jobs; needed before `close` when a capture timed out."""
        ...

    def close(self) -> None:
        """Stop and give the camera back."""
        ...


@dataclass(frozen=True, slots=True)
class Enums:
    """Values of libcamera's enumerations; None where this version lacks them."""

    noise_reduction_off: object
    af_manual: object
    sync_server: object | None
    sync_client: object | None


def open_library(index: int) -> tuple[Library, Enums]:
    """Open the camera with number `index`."""
    try:
        picamera2 = cast(Any, importlib.import_module("picamera2"))
        controls = cast(Any, importlib.import_module("libcamera")).controls
    except (ImportError, ValueError) as error:  # ValueError: a numpy that simplejpeg was not built for
        raise CameraError(
            f"--camera picamera2: the system's picamera2 cannot be used ({error}); {INSTALL}"
        ) from error
    cameras = cast(Sequence[Mapping[str, object]], picamera2.Picamera2.global_camera_info())
    if not 0 <= index < len(cameras):
        there = ", ".join(f"{i} ({camera.get('Model', '?')})" for i, camera in enumerate(cameras)) or "none"
        raise CameraError(
            f"--camera picamera2:{index}: no such camera; there are: {there}. Check the cable with the Pi switched "
            "off, then `rpicam-hello --list-cameras`"
        )
    try:
        library = cast(Library, picamera2.Picamera2(index))
    except RuntimeError as error:
        from slave.cameras.v4l2_abi import users_of  # of Linux, as is libcamera

        raise CameraError(
            f"--camera picamera2:{index}: cannot be opened ({error.__cause__ or error}); "
            f"{users_of(Path('/dev/media*'))}; else restart the Pi"
        ) from error
    sync = getattr(getattr(controls, "rpi", None), "SyncModeEnum", None)
    return library, Enums(
        controls.draft.NoiseReductionModeEnum.Off,
        controls.AfModeEnum.Manual,
        getattr(sync, "Server", None),
        getattr(sync, "Client", None),
    )


Sync = Literal["off", "server", "client"]
LIVE_CONTROLS = ("ExposureTime", "AnalogueGain", "ColourGains")  # that may change while frames come,
RATE_CONTROL = "FrameDurationLimits"  # and this one where cameras run free


@dataclass(frozen=True, slots=True)
class Picamera2Options:
    """What is not in the camera file."""

    index: int = 0  # number of the camera on this Pi
    sync: Sync = "off"  # whether frames follow another camera's ("client"), lead ("server") or run free
    sync_timeout_s: float = 60.0  # how long to wait for the others [s]
    lores: tuple[int, int] | None = None  # of a second, small YUV420 image of each frame: width, height [px]
    pixels: Pixels = Pixels.COLOUR


def controls(
    camera: CameraCalibration, options: Picamera2Options, enums: Enums, available: Mapping[str, object]
) -> dict[str, Any]:
    """Controls of the configuration, by libcamera's names; `available`: what it has."""
    period_us = round(1e6 / camera.frame_rate_hz)
    if camera.exposure_us >= period_us:
        raise CameraError(
            f"exposure_us {camera.exposure_us:g} does not fit into a frame of {period_us} us (frame_rate_hz "
            f"{camera.frame_rate_hz:g}); lower one of them in the camera file"
        )
    asked: dict[str, Any] = {
        "AeEnable": False,
        "AwbEnable": False,
        "ExposureTime": round(camera.exposure_us),
        "AnalogueGain": camera.analogue_gain,
        "ColourGains": camera.colour_gains,
        "FrameDurationLimits": (period_us, period_us),
    }
    if options.pixels is not Pixels.COLOUR and "ColourGains" not in available:
        if camera.colour_gains != (1.0, 1.0):
            raise CameraError("colour_gains: its sensor has no colours: write [1, 1] into the camera file")
        del asked["AwbEnable"], asked["ColourGains"]
    if "NoiseReductionMode" in available:  # a camera without it has none to switch off
        asked["NoiseReductionMode"] = enums.noise_reduction_off
    asked |= _focus(camera, enums, available) | _sync(options, enums, available)
    missing = [name for name in asked if name not in available]
    if missing:
        raise CameraError(
            f"it has no control {', '.join(missing)}, which the camera file needs (a monochrome camera has no colour "
            "gains, and sees no coloured markers); use another camera, or update libcamera"
        )
    return asked


def _focus(camera: CameraCalibration, enums: Enums, available: Mapping[str, object]) -> dict[str, Any]:
    if "AfMode" not in available:
        if camera.focus_m is not None:
            raise CameraError(
                f"focus_m {camera.focus_m:g}: it has no focus motor; turn its lens, and leave focus_m out of the file"
            )
        return {}
    if camera.focus_m is None:
        raise CameraError(
            "it has a focus motor, which would move: write the distance in focus into the camera file, for example "
            '"focus_m": 0.6'
        )
    return {"AfMode": enums.af_manual, "LensPosition": 1.0 / camera.focus_m}  # dioptres


def _sync(options: Picamera2Options, enums: Enums, available: Mapping[str, object]) -> dict[str, Any]:
    if options.sync == "off":
        return {}
    mode = enums.sync_server if options.sync == "server" else enums.sync_client
    if mode is None or "SyncMode" not in available:
        raise CameraError(
            f"--sync {options.sync}: this libcamera cannot synchronise cameras; update the system "
            "(`sudo apt full-upgrade`), or leave --sync away: the master brings free-running cameras to one time"
        )
    # The number of frames until "ready" is set by the server (control_ids_rpi.yaml, SyncFrames); libcamera's default:
    # the server notifies the clients every 30 frames, so each receives it three times
    return {"SyncMode": mode} | ({"SyncFrames": 100} if options.sync == "server" else {})


def check_ranges(asked: Mapping[str, Any], available: Mapping[str, tuple[Any, Any, Any]]) -> None:
    """Refuse what libcamera would clip: not within (lowest, highest, default)."""
    wrong: list[str] = []
    for name in ("ExposureTime", "AnalogueGain", "ColourGains", "FrameDurationLimits", "LensPosition"):
        if name not in asked:
            continue
        low, high = (as_values(bound) for bound in available[name][:2])
        values = as_values(asked[name])
        if not (low and high and values):  # a range without numbers constrains nothing; reading back will
            continue
        if not all(low[0] <= value <= high[0] for value in values):
            wrong.append(
                f"{name} {', '.join(f'{v:g}' for v in values)} is not within {low[0]:g} to {high[0]:g}"
            )
    if wrong:
        raise CameraError(f"in this mode {'; '.join(wrong)}: change the camera file")


def wanted_settings(
    camera: CameraCalibration, available: Mapping[str, object], pixels: Pixels = Pixels.COLOUR
) -> tuple[Setting, ...]:
    """The values that the metadata of a frame must have, with tolerances as above."""
    # where the camera file states 0: no official sensor needs longer for a row at video rates
    row_us = camera.row_time_us if camera.row_time_us > 0.0 else 30.0
    # a hundredth of the exposure is below the noise of an 8-bit pixel
    exposure = row_us + 0.01 * camera.exposure_us
    gain = max(1.0 / 16.0, camera.analogue_gain**2 / 256.0)
    digital = exposure / camera.exposure_us + gain / camera.analogue_gain
    rate = f"frame_rate_hz {camera.frame_rate_hz:g}"
    wanted = [
        Setting("ExposureTime", (camera.exposure_us,), exposure, "us", "exposure_us"),
        Setting("AnalogueGain", (camera.analogue_gain,), gain, "", "analogue_gain"),
        Setting("DigitalGain", (1.0,), digital, "", "no brightening behind the sensor"),
        Setting("FrameDuration", (1e6 / camera.frame_rate_hz,), row_us + 1.0, "us", rate),
    ]
    if pixels is Pixels.COLOUR or "ColourGains" in available:
        wanted.append(Setting("ColourGains", camera.colour_gains, 0.01, "", "colour_gains"))
    if camera.sensor is not None and pixels is not Pixels.GREY and "ScalerCrop" in available:
        crop = camera.sensor.crop_px
        wanted.append(
            Setting("ScalerCrop", tuple(map(float, crop)), 0.01 * crop[2], "px", "sensor.crop_px: the view")
        )
    if "AfMode" in available and camera.focus_m is not None:
        wanted.append(Setting("LensPosition", (1.0 / camera.focus_m,), 0.05, "dioptres", "focus_m"))
    return tuple(wanted)


def read_figures(metadata: Mapping[str, object]) -> dict[str, float]:
    """Settings in the metadata, by the names of `common.calibration.camera_settings`."""
    found: dict[str, float] = {}
    for name, metrics in (
        ("ExposureTime", ("exposure_us",)),
        ("AnalogueGain", ("analogue_gain",)),
        ("DigitalGain", ("digital_gain",)),
        ("ColourGains", ("red_gain", "blue_gain")),
        ("LensPosition", ("focus_dioptres",)),
        ("SensorTemperature", ("sensor_celsius",)),
    ):
        values = as_values(metadata.get(name))
        if values is not None and len(values) == len(metrics):
            found |= dict(zip(metrics, values, strict=True))
    duration = as_values(metadata.get("FrameDuration"))
    if duration is not None and duration[0] > 0.0:
        found["frame_rate_hz"] = 1e6 / duration[0]
    return found
