"""`phalanx-slave run`: finds markers, or fingers before a wrist device, live, and sends where they are."""

import argparse
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from common.calibration import HandProfile, load
from common.clock import Clock, SystemClock
from common.errors import CalibrationError, RecordingError
from slave.commands.camera import add_camera, open_lit
from slave.commands.options import (
    add_link,
    camera_of,
    camera_path,
    clock_of,
    megabytes,
    objects_of,
    rig_path,
    secrets_of,
    skew_of,
)
from slave.markers.scan_choice import SCANS
from slave.service import COMPILE_S, Service
from slave.stopping import stop_on_signals

if TYPE_CHECKING:
    from slave.raw import RawSettings
    from slave.tuning import CameraFiles

PURPOSE = "detect live and send"
EXAMPLES = """\
  PHALANX_RIG_KEY=$(cat rig.key) phalanx-slave run --name left --rig desk --camera replay:recordings/wave
        waits for the master's start, then sends one sealed datagram per frame
  phalanx-slave run --name left --rig desk --camera synthetic --bind 127.0.0.1 --key-file rig.key
        without hardware: renders the standard scene in real time
  phalanx-slave run --name left --rig desk --camera synthetic --calibration new --truth calib_json --key-file rig.key
        a simulated camera that knows neither lens nor place nor colours yet, to practise setting it up
  phalanx-slave run --name wrist --rig wrist --camera synthetic --bind 127.0.0.1 --key-file rig.key
        the camera of a wrist device, docs/wrist.md
  phalanx-slave run --name wrist --rig wrist --camera synthetic --scene grasp --scene-epoch-ns N --key-file rig.key
        the same hand as cameras of rig desk with the same scene, seed and epoch: what they lose it still sees
  phalanx-slave run --name left --rig desk --camera picamera2 --colours none --key-file rig.key
        before there are colours: for `phalanx-master calibrate capture`
  phalanx-slave run --name left --rig desk --camera v4l2:/dev/v4l/by-id/CAM --control gain=32 --key-file rig.key
        with a USB camera; docs/cameras.md says which settings are fixed and checked
  phalanx-slave run --name left --rig desk --camera picamera2 --scan windows --key-file rig.key
        only windows about the markers are scanned: for a board or a rate at which whole frames do not fit
  phalanx-slave run --name left --rig desk --camera picamera2 --raw-folder recordings --key-file rig.key
        keeps raw frames while it tracks whenever `phalanx-master record FILE --raw` asks; docs/recording.md
"""


def add_options(command: argparse.ArgumentParser) -> None:
    """The options of `run`."""
    add_camera(command)
    add_link(command)
    command.add_argument(
        "--faults",
        type=Path,
        metavar="FILE",
        help="of a synthetic camera: what is wrong with it, JSON, read again whenever it changes (docs/checklist.md)",
    )
    command.add_argument(
        "--colours",
        choices=("follow", "fixed", "none"),
        default="follow",
        help="whether the colours of markers follow changes of the light (default: %(default)s; docs/light.md); none: "
        "detect nothing, while the lens or the place of a camera is calibrated",
    )
    command.add_argument(
        "--engine",
        choices=("numpy", "numba"),
        default="numpy",
        help="what detects markers, or fingers before a wrist device: numba is several times faster, needs the extra "
        "`fast` (default: %(default)s)",
    )
    command.add_argument(
        "--scan",
        choices=SCANS,
        default="auto",
        help="where markers are looked for: in the full frame; in windows about where they are expected, and strip by "
        "strip where one is lost, which takes a lost marker a few frames more; auto: in the full frame as long as that "
        "fits the time of a frame (default: %(default)s; docs/cameras.md)",
    )
    command.add_argument(
        "--raw-folder",
        type=Path,
        metavar="DIR",
        help="keep raw frames there, lossless, while it tracks, when `phalanx-master record FILE --raw` asks for them: "
        "a new folder each time (docs/recording.md)",
    )
    command.add_argument(
        "--raw-reserve-mb",
        type=megabytes,
        default=200.0,
        metavar="MB",
        help="stay free on its disk (default: %(default)g)",
    )


def run(options: argparse.Namespace, notify: Callable[[str], None]) -> int:
    """Detect and send until it is told to end.

    Raises:
        PhalanxError: A file, the camera, its lights, a key or the network is not as it must be.
    """
    # Imported here: `detect` and `colours` need neither sockets nor zenoh, and start twice as fast.
    from slave.live import send_camera
    from slave.markers import engine as marker_engine
    from slave.sender import Sender
    from slave.uplink import Uplink
    from slave.wrist import engine as wrist_engine

    stop, service = stop_on_signals(), Service(os.environ)
    if options.engine == "numba":
        service.starting(COMPILE_S)
    files = _files(options)
    true_clock = SystemClock()
    clock = clock_of(options, true_clock)
    key, access = secrets_of(options)
    raw = _raw_settings(options, true_clock)
    engine = (wrist_engine if files.rig.kind == "wrist" else marker_engine).engine_named(options.engine)
    source = open_lit(options, files.rig, files.camera, clock, true_clock, stop, service.connection_lost)
    uplink = Uplink(options.name, key, clock, options.beacon_port, options.bind)

    def tell(line: str) -> None:
        notify(f"{options.name}: {line}")

    sender = Sender(options.name, uplink, clock, stop, tell, service, access)
    send_camera(sender, files, source, options.colours, options.scan, engine, raw)
    return 0


def _files(options: argparse.Namespace) -> "CameraFiles":
    """The files that are followed while it runs."""
    from slave.tuning import CameraFiles

    rig, camera = camera_of(options)
    if rig.kind == "wrist" and options.scan == "windows":
        raise CalibrationError(f"--scan windows: camera {options.name!r} of a wrist device sees no markers")
    objects = tuple(objects_of(options, rig).values())
    files = CameraFiles(camera_path(options, options.name), rig_path(options), camera, rig, objects=objects)
    if rig.kind != "wrist" or options.colours == "none":  # with none, fingers need not be known
        return files
    hand_path = options.calibration / "hands" / f"{rig.hand}.json"
    return replace(files, hand_path=hand_path, hand=load(hand_path, HandProfile))


def _raw_settings(options: argparse.Namespace, true_clock: Clock) -> "RawSettings | None":
    """Where raw frames go, if they are kept; the folder is there from here on."""
    from slave.raw import RawSettings

    folder: Path | None = options.raw_folder
    if folder is None:
        return None
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(f"--raw-folder {folder}: cannot make it: {error.strerror}") from error
    return RawSettings(folder, round(options.raw_reserve_mb * 1e6), skew_of(options, true_clock))
