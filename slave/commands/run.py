"""`phalanx-slave run`: detect and send in real time.

It detects markers, or fingers before a wrist device, and sends where they are; or it sends the data of another
sensor.
"""

import argparse
import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2

from common.calibration import HandProfile, load
from common.clock import Clock, SystemClock
from common.command_line import UsageError
from common.errors import CalibrationError, RecordingError
from common.terminal import echo
from slave.commands.camera import open_lit
from slave.commands.options import (
    camera_of,
    camera_path,
    clock_of,
    objects_of,
    rig_path,
    secrets_of,
    skew_of,
    tree_of,
)
from slave.service import COMPILE_S, Service
from slave.stopping import stop_on_signals

if TYPE_CHECKING:
    from slave.raw import RawSettings
    from slave.tuning import CameraFiles


def run(options: argparse.Namespace) -> int:
    """Send what a camera, an IMU or a tracker measures; or detect in a recording.

    Raises:
        UsageError: The name is missing, or an option is of another sensor.
        PhalanxError: A file, the device, its lights, a key or the network is not as it must be.
    """
    if options.output is not None and options.camera is None:
        raise UsageError("-o writes what is detected in a recording: --camera replay:FOLDER")
    if options.imu is not None:
        from slave.commands.imu import send_imu

        return send_imu(options)
    if options.name is None:
        raise UsageError("say which camera or tracker of the rig this is: --name NAME")
    if options.tracker is not None:
        from slave.commands.tracker import send_tracker

        return send_tracker(options)
    cv2.setNumThreads(1)  # small windows are faster on one thread, and the other cores stay free
    if options.output is not None:
        from slave.commands.detect import detect

        return detect(options)
    if options.hand is not None:
        raise UsageError("--hand is for -o; a slave that sends knows the hand of its rig")
    return send_camera(options)


def send_camera(options: argparse.Namespace) -> int:
    """Detect and send until stopped.

    Raises:
        PhalanxError: A file, the camera, its lights, a key or the network is not as it must be.
    """
    # Imported here: to detect in a recording needs neither sockets nor zenoh, and starts twice as fast.
    from slave.live import send_detections
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

    def print_line(line: str) -> None:
        echo(f"{options.name}: {line}")

    sender = Sender(options.name, uplink, clock, stop, print_line, service, access)
    send_detections(sender, files, source, options.colours, options.scan, engine, raw)
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
    hand_path = tree_of(options) / "hands" / f"{rig.hand}.json"
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
