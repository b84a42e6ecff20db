"""Run `phalanx-slave record`: raw frames of a camera, or existing data, to disk.

A file, device or disk that is not as it must be, or no frame, raises its `PhalanxError`.
"""

import argparse
import os
import sys
import threading
from collections.abc import Generator
from contextlib import closing, contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
from msgspec import structs

from common.calibration import CameraCalibration, RigCalibration, load
from common.clock import Clock, SystemClock
from common.command_line import UsageError, echo, remark
from common.errors import CalibrationError, CameraError, PhalanxError
from slave.commands.devices import (
    Drivers,
    camera_of,
    camera_path,
    clock_of,
    objects_of,
    orientation_of,
    skew_of,
    world_of,
)
from slave.commands.join import import_foreign, join
from slave.commands.run import import_table_of_imu
from slave.drivers import SERVICE
from slave.service import stop_by_signal
from slave.shared import SharedCamera, shared_camera

if TYPE_CHECKING:
    from common.recording.frame_recording import Manifest
    from slave.imu.recording import ImuRecorder
    from slave.recorder import Progress


def run(options: argparse.Namespace) -> int:
    """Record a camera, or make a recording of what is there already."""
    if options.imu_csv is not None:
        return import_table_of_imu(options)
    if options.output is None:
        raise UsageError("say where the recording goes: -o FOLDER")
    if options.join is not None:
        return join(options)
    if options.foreign is not None:
        return import_foreign(options)
    if options.name is None:
        raise UsageError("say which camera of the rig this is: --name NAME")
    cv2.setNumThreads(1)  # small windows are faster on one thread, and the other cores stay free
    return record_camera(options)


def record_camera(options: argparse.Namespace) -> int:
    """Record until the length is reached or until stopped; raises as `run`."""
    from common.recording.frame_writing import refuse_occupied
    from slave.commands.simulated import add_imu, imu_of

    if options.camera == SERVICE and options.calibration is None and options.rig is None:
        with closing(SharedCamera(options.name)) as shared:  # whose files are those of the recording
            manifest, camera = structs.replace(shared.manifest, note=options.note), shared.camera
        assert manifest.rig is not None  # of a running slave
        drivers = _drivers(options, manifest.rig)
    else:
        rig, camera = camera_of(options)
        drivers = _drivers(options, rig)
        manifest = _manifest(drivers)
    refuse_occupied(options.output)  # before a camera is opened
    imu = None
    if options.imu == "synthetic":
        imu = imu_of(str(options.camera), *world_of(options, drivers.rig))
    with _imu_recorder(drivers) as imu_recorder:
        done, failure = _record(drivers, camera, manifest, imu_recorder)
        if imu_recorder is not None and done.frames:
            imu_recorder.keep()
    if imu is not None and done.frames:
        add_imu(options.output, imu, options.scene_epoch_ns, drivers.clock)
    # what was reported as recorded is on the disk, also when the power goes now
    getattr(os, "sync", lambda: None)()
    if failure is None and imu_recorder is not None:
        failure = imu_recorder.failure
    if failure is not None:
        raise failure
    if not done.frames:
        raise CameraError(f"camera {options.name!r} gave no frame; nothing was recorded")
    echo(f"{options.name}: recorded in {options.output}")
    return 0


def _drivers(options: argparse.Namespace, rig: RigCalibration) -> Drivers:
    from slave.commands.simulated import FrameClock

    true_clock: Clock = SystemClock()
    if options.scene_epoch_ns is None:
        options.scene_epoch_ns = true_clock.now_ns()
    if options.every_frame:
        if options.camera != "synthetic":
            raise CameraError(f"--every-frame: only a synthetic camera can wait, not {options.camera}")
        true_clock = FrameClock(options.scene_epoch_ns)
    return Drivers(options, rig, clock_of(options, true_clock), true_clock)


def _manifest(drivers: Drivers) -> "Manifest":
    from common.recording.frame_recording import Manifest
    from slave.recorder import clock_of as recorded_clock

    options, rig = drivers.options, drivers.rig
    skewed = skew_of(options, drivers.true_clock)
    if options.every_frame:
        skewed = f" as frames are drawn{skewed}"
    return Manifest(
        version=1,
        kind=rig.kind,
        cameras={name: load(camera_path(options, name), CameraCalibration) for name in rig.cameras},
        rig=rig,
        note=options.note,
        clock=recorded_clock(drivers.clock, skewed),
        objects=objects_of(options, rig),
    )


def _record(
    drivers: Drivers, camera: CameraCalibration, manifest: "Manifest", imu_recorder: "ImuRecorder | None"
) -> "tuple[Progress, PhalanxError | None]":
    """Record to the end; how much, and the error that ended it early, if any."""
    from slave.recorder import Length, ProgressDisplay, Recorder, feed

    options, stop = drivers.options, threading.Event()
    display = ProgressDisplay(options.name, sys.stderr)
    source = shared_camera(options, camera, stop) or drivers.camera(camera)
    try:
        recorder = Recorder(
            options.output,
            manifest,
            options.name,
            Length(options.seconds, options.frames),
            display.show,
            round(options.reserve_mb * 1e6),
            round(options.queue_mb * 1e6),
        )
        try:
            if imu_recorder is not None:
                imu_recorder.start(options.output)
            with stop_by_signal(stop):
                feed(source, recorder, stop)
        finally:
            recorder.close()
            done = recorder.progress()
            display.end(done)
    finally:
        source.close()
    return done, recorder.failure


@contextmanager
def _imu_recorder(drivers: Drivers) -> "Generator[ImuRecorder | None, None, None]":
    if drivers.options.imu in (None, "synthetic"):
        yield None
        return
    from slave.imu.recording import ImuRecorder

    imu = drivers.rig.imu
    if imu is None:
        raise CalibrationError(f"rig {drivers.rig.name!r}: imu: missing; there is none to record")
    orientation, stop = orientation_of(imu), threading.Event()
    imu_recorder = ImuRecorder(replace(drivers, stop=stop).imu(imu), orientation, stop)
    try:
        yield imu_recorder
    finally:
        counts = imu_recorder.close()
        remark(", ".join(f"{event} {count}" for event, count in counts.items()))
