"""Run `phalanx-slave run`: detect or measure live, and send.

A camera, an IMU or a tracker; also `record --imu-csv`, which imports a table of IMU samples. A file, key, device or
network that is not as it must be raises its `PhalanxError`.
"""

import argparse
import os
import threading
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2

from common.calibration import HandProfile, load
from common.clock import Clock, SystemClock
from common.command_line import UsageError, echo
from common.errors import CalibrationError, PhalanxError, RecordingError
from common.imu.csv_table import ACCEL, GYRO, MAG, TIME
from slave.commands import devices
from slave.commands.devices import (
    Drivers,
    camera_of,
    camera_path,
    objects_of,
    rig_of,
    rig_path,
    secrets_of,
    skew_of,
    tree_of,
)
from slave.service import COMPILE_S, Service, stop_by_signal

if TYPE_CHECKING:
    from common.bus.keys import Access
    from common.link.datagram import LinkKey
    from slave.raw import RawSettings
    from slave.sender import Sender
    from slave.tuning import CameraFiles

DEFAULT_NAME = "imu"


def send_imu(options: argparse.Namespace) -> int:
    """Send samples until stopped."""
    from slave.sender import send_samples

    rig = rig_of(options)
    if options.name is None:
        options.name = DEFAULT_NAME if rig.imu is None else rig.imu.name
    if rig.imu is None or options.name != rig.imu.name:
        has = "it has none" if rig.imu is None else f"its IMU is {rig.imu.name!r}"
        raise CalibrationError(f"rig {rig.name!r} has no IMU {options.name!r}; {has}")
    orientation = devices.orientation_of(rig.imu)
    secrets, service = secrets_of(options), Service(os.environ, noun="samples")
    with stop_by_signal() as stop:
        drivers = Drivers.running(options, rig, stop, service.connection_lost)
        source = drivers.imu(rig.imu)
        send_samples(_sender(options, secrets, drivers.clock, stop, service), source, orientation)
    return 0


def import_table_of_imu(options: argparse.Namespace) -> int:
    """Report what is in the table of an IMU, and write imu.csv if a folder is given."""
    from common.imu.csv_table import read_csv
    from slave.imu.recording import import_table

    units = {what: unit for what in (TIME, GYRO, ACCEL, MAG) if (unit := getattr(options, f"{what}_unit"))}
    table = read_csv(options.imu_csv, units, options.rate_hz)
    import_table(table, options.name or DEFAULT_NAME, options.output, echo)
    return 0


def send_tracker(options: argparse.Namespace) -> int:
    """Send poses until stopped."""
    from slave.sender import send_poses

    rig = rig_of(options)
    profile = devices.object_with(tree_of(options), rig, options.name)
    secrets, service = secrets_of(options), Service(os.environ, noun="poses")
    with stop_by_signal() as stop:
        drivers = Drivers.running(options, rig, stop, service.connection_lost)
        source = drivers.tracker(profile)
        try:
            sender = _sender(options, secrets, drivers.clock, stop, service)
        except PhalanxError:
            source.close()
            raise
        send_poses(sender, source, recorded=options.tracker.startswith("survive:"))
    return 0


def run(options: argparse.Namespace) -> int:
    """Send what a camera, an IMU or a tracker measures; or detect in a recording."""
    if options.output is not None and options.camera is None:
        raise UsageError("-o writes what is detected in a recording: --camera replay:FOLDER")
    if options.imu is not None:
        return send_imu(options)
    if options.name is None:
        raise UsageError("say which camera or tracker of the rig this is: --name NAME")
    if options.tracker is not None:
        return send_tracker(options)
    cv2.setNumThreads(1)  # small windows are faster on one thread, and the other cores stay free
    if options.output is not None:
        from slave.commands.offline import detect

        return detect(options)
    if options.hand is not None:
        raise UsageError("--hand is for -o; a slave that sends knows the hand of its rig")
    return send_camera(options)


def send_camera(options: argparse.Namespace) -> int:
    """Detect and send until stopped."""
    from slave.live import send_detections
    from slave.markers import engine as marker_engine
    from slave.shared import opened_by
    from slave.wrist import engine as wrist_engine

    service = Service(os.environ)
    if options.engine == "numba":
        service.starting(COMPILE_S)
    with stop_by_signal() as stop:
        files, secrets = _files(options), secrets_of(options)
        raw = _raw_settings(options)
        engine = (wrist_engine if files.rig.kind == "wrist" else marker_engine).engine_named(options.engine)
        drivers = Drivers.running(options, files.rig, stop, service.connection_lost)
        source = drivers.camera(files.camera)
        sender = _sender(options, secrets, drivers.clock, stop, service)
        opened, skewed = opened_by(options), skew_of(options, SystemClock())
        send_detections(sender, files, source, options.colours, options.scan, engine, raw, opened, skewed)
    return 0


def _sender(
    options: argparse.Namespace,
    secrets: "tuple[LinkKey, Access]",
    clock: Clock,
    stop: threading.Event,
    service: Service,
) -> "Sender":
    # Imported here: to detect in a recording needs neither sockets nor zenoh, and starts twice as fast.
    from slave.sender import Sender
    from slave.uplink import Uplink

    (key, access), name = secrets, options.name
    uplink = Uplink(name, key, clock, options.beacon_port, options.bind)
    return Sender(name, uplink, clock, stop, lambda line: echo(f"{name}: {line}"), service, access)


def _files(options: argparse.Namespace) -> "CameraFiles":
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


def _raw_settings(options: argparse.Namespace) -> "RawSettings | None":
    """Where raw frames go, if they are kept; the folder is there from here on."""
    from slave.raw import RawSettings

    folder: Path | None = options.raw_folder
    if folder is None:
        return None
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(f"--raw-folder {folder}: cannot make it: {error.strerror}") from error
    return RawSettings(folder, round(options.raw_reserve_mb * 1e6), skew_of(options, SystemClock()))
