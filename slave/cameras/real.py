"""The real cameras behind `--camera`: their options on the command line, and how they are opened, and opened again."""

import argparse
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path

from common.calibration import CameraCalibration
from common.clock import Clock
from common.errors import CameraError
from slave.cameras.grey import Pixels
from slave.cameras.picamera2 import Picamera2Camera
from slave.cameras.picamera2_settings import Picamera2Options
from slave.cameras.reconnecting import ReconnectingCamera
from slave.cameras.v4l2 import V4l2Camera, V4l2Options
from slave.service import LOST_PATIENCE_S, ConnectionLost, nobody
from slave.sources import FrameSource

CAMERAS = "picamera2[:INDEX] | v4l2[:DEVICE]"
DRIVERS = ("picamera2", "v4l2")
# Option -> its driver and the value that means "not given".
OPTIONS: dict[str, tuple[str, object]] = {
    "sync": ("picamera2", "off"),
    "sync_timeout": ("picamera2", 60.0),
    "control": ("v4l2", []),
    "allow_missing": ("v4l2", []),
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the real cameras."""
    parser.add_argument(
        "--luma",
        action="store_true",
        help="wrist device with a colour camera (without infrared filter): its luma in place of grey frames of a "
        "monochrome sensor; it is not linear in the light",
    )
    pi = parser.add_argument_group("Pi camera (picamera2)")
    pi.add_argument(
        "--sync",
        choices=("off", "server", "client"),
        default="off",
        help="frames in step with other Pi cameras: one leads, the others follow; start clients first",
    )
    pi.add_argument(
        "--sync-timeout",
        type=float,
        default=60.0,
        metavar="S",
        help="how long to wait for them (default: %(default)s)",
    )
    usb = parser.add_argument_group("USB camera (v4l2)")
    usb.add_argument(
        "--control",
        action="append",
        default=[],
        metavar="NAME=N",
        help="fix a control in codes of its maker, for example gain=32; may be repeated",
    )
    usb.add_argument(
        "--allow-missing",
        action="append",
        default=[],
        metavar="NAME",
        help="exposure | gain | white_balance: the camera lacks this control, and that is known; may be repeated",
    )


def open_real(
    driver: str,
    options: argparse.Namespace,
    camera: CameraCalibration,
    clock: Clock,
    stop: threading.Event | None,
    *,
    wrist: bool = False,
    connection_lost: ConnectionLost = nobody,
) -> FrameSource | None:
    """Open the camera that `--camera DRIVER[:PLACE]` names.

    Args:
        driver: The value of `--camera`.
        options: What `add_options` added.
        camera: The camera file.
        clock: The slave's clock.
        stop: Set when the slave is to end; until then a lost camera is opened again. None: losing it is an error.
        wrist: Whether it is the camera of a wrist device, whose frames are grey.
        away: Told when it takes time to open it, now or again.

    Returns:
        The camera, or None if the driver is none of a real camera.

    Raises:
        CameraError: An option is of another driver or makes no sense, or the camera cannot be opened.
    """
    kind, _, place = driver.partition(":")
    pixels = _pixels(kind, options.luma, wrist)
    for name, (owner, unset) in OPTIONS.items():
        if owner != kind and getattr(options, name) != unset:
            flag = "--" + name.replace("_", "-")
            raise CameraError(f"{flag} is an option of --camera {owner}, not of {driver}: leave it away")
    if kind == "picamera2":
        pi = Picamera2Options(_index(place), options.sync, options.sync_timeout, pixels=pixels)
        if options.sync != "off":  # the others may have to be started first
            connection_lost = partial(connection_lost, patience_s=LOST_PATIENCE_S + options.sync_timeout)
            connection_lost("opens the camera, in step with others")
        return persistent(
            lambda file: Picamera2Camera(file, pi, clock, stop), camera, clock, stop, connection_lost
        )
    if kind == "v4l2":
        usb = V4l2Options(_path(place), _controls(options.control), tuple(options.allow_missing), pixels)
        return persistent(lambda file: V4l2Camera(file, usb, clock), camera, clock, stop, connection_lost)
    return None


def _pixels(kind: str, as_luma: bool, wrist: bool) -> Pixels:
    if as_luma and kind not in DRIVERS:
        raise CameraError(
            f"--luma is an option of --camera {' and '.join(DRIVERS)}, not of {kind}: leave it away"
        )
    if as_luma and not wrist:
        raise CameraError(
            "--luma: makes grey frames for a wrist device; this rig looks for painted markers, by colour"
        )
    if wrist:
        return Pixels.LUMA if as_luma else Pixels.GREY
    return Pixels.COLOUR


def persistent(
    opener: Callable[[CameraCalibration], FrameSource],
    camera: CameraCalibration,
    clock: Clock,
    stop: threading.Event | None,
    connection_lost: ConnectionLost,
) -> FrameSource:
    """Open a camera that is opened again whenever it is lost, until `stop` is set; None: losing it is an error.

    Raises:
        CameraError: It cannot be opened the first time.
    """
    return (
        opener(camera) if stop is None else ReconnectingCamera(opener, camera, clock, stop, connection_lost)
    )


def _index(place: str) -> int:
    if place and not place.isdecimal():
        raise CameraError(
            f"--camera picamera2:{place}: the part behind the colon is a number, 0 for the first camera"
        )
    return int(place or "0")


def _path(place: str) -> Path:
    return Path(f"/dev/video{place or '0'}" if place.isdecimal() or not place else place)


def _controls(texts: list[str]) -> dict[str, int]:
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
