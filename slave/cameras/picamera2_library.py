"""Interface of picamera2 and libcamera as far as Phalanx uses it.

It is given as types; this is the one place that imports them.

Both come with the Raspberry Pi's system, not from the package registry, so they are imported when a camera is
opened and their absence is an error that states how to install them. The names and meanings below were read in
picamera2 0.3.38 (picamera2.py, request.py, controls.py) and in libcamera's control_ids_*.yaml.
"""

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, cast

import numpy.typing as npt

from common.errors import CameraError

INSTALL = (
    "install it with `sudo apt install python3-picamera2 --no-install-recommends` (Raspberry Pi OS, 64 bit) and make "
    "the virtual environment with `python3 -m venv --system-site-packages`, so that it sees the system's packages"
)


class Request(Protocol):
    """One captured frame (`CompletedRequest`).

    Its buffers go back to the camera when it is released.
    """

    def make_array(self, name: str) -> npt.NDArray[Any]:
        """Copy the stream `name`.

        The padding of rows is cut off for RGB, not for YUV420.
        """
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
        """Make a camera configuration for video.

        It is made from `main`, `lores`, `raw`, `sensor`, `controls`, `buffer_count`.
        """
        ...

    def configure(self, camera_config: dict[str, Any]) -> None:
        """Apply a configuration."""
        ...

    def camera_configuration(self) -> Mapping[str, Any]:
        """Return the configuration as the camera took it.

        It has size, format and stride of each stream.
        """
        ...

    def start(self) -> None:
        """Start the camera with the controls of the configuration."""
        ...

    def set_controls(self, controls: Mapping[str, Any]) -> None:
        """Change controls of the running camera, from any thread.

        Frames show the change some frames later.
        """
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
    """Values of libcamera's enumerations.

    None where this version of libcamera lacks them.
    """

    noise_reduction_off: object
    af_manual: object
    sync_server: object | None
    sync_client: object | None


def open_library(index: int) -> tuple[Library, Enums]:
    """Open the camera with number `index`.

    Raises:
        CameraError: No picamera2, no such camera, or another program has it. The text states what to do.
    """
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
        raise CameraError(
            f"--camera picamera2:{index}: cannot be opened ({error.__cause__ or error}); another program may "
            "have it: stop that, or restart the Pi"
        ) from error
    return library, _enums(controls)


def _enums(controls: Any) -> Enums:
    sync = getattr(getattr(controls, "rpi", None), "SyncModeEnum", None)
    return Enums(
        controls.draft.NoiseReductionModeEnum.Off,
        controls.AfModeEnum.Manual,
        getattr(sync, "Server", None),
        getattr(sync, "Client", None),
    )
