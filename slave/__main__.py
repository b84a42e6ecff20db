"""The slave's command line; the only place that names concrete drivers."""

import argparse
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.clock import Clock, SkewedClock, SystemClock
from common.errors import CalibrationError, CameraError, LightsError, PhalanxError, RecordingError
from common.object_profile import ObjectProfile
from slave.arguments import CAMERAS, parser
from slave.cameras import real
from slave.cameras.source import FrameSource
from slave.lights.opening import SWITCHED, SYNTHETIC, choose, limits_for, open_guarded
from slave.service import COMPILE_S, Away, Service, nobody

if TYPE_CHECKING:
    from common.keys import Access
    from slave.cameras.synthetic import LitBy
    from slave.imu.recording import ImuRecorder
    from slave.imu.source import ImuSource
    from slave.objects.source import TrackerSource
    from slave.raw import RawSettings

PROGRESS_EVERY = 500  # frames


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return the exit code: 0 done, 1 something the user can mend, 2 wrong usage."""
    options = parser().parse_args(arguments)
    cv2.setNumThreads(1)  # small windows are faster on one thread, and the other cores stay free
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s: %(message)s", stream=sys.stderr)
    try:
        return COMMANDS[options.command](options)
    except PhalanxError as error:
        print(f"phalanx-slave: {error}", file=sys.stderr)
        Service(os.environ).failed(str(error))
        return 1
    except KeyboardInterrupt:  # while detecting offline; a live run ends by its event
        return 130


def _run(options: argparse.Namespace) -> int:
    # Imported here: `detect` and `colours` need neither sockets nor zenoh, and start twice as fast.
    from slave.live import run_live
    from slave.markers import engine as marker_engine
    from slave.tuning import CameraFiles
    from slave.uplink import Uplink
    from slave.wrist import engine as wrist_engine

    stop, service = threading.Event(), Service(os.environ)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda _number, _frame: stop.set())
    if options.engine == "numba":
        service.starting(COMPILE_S)
    rig, camera = _calibration(options)
    files = CameraFiles(*_paths(options), camera, rig, objects=tuple(_objects(options, rig).values()))
    if rig.kind == "wrist" and options.colours != "none":  # with none, fingers need not be known
        hand_path = options.calibration / "hands" / f"{rig.hand}.json"
        files = replace(files, hand_path=hand_path, hand=load(hand_path, HandProfile))
    true_clock = SystemClock()
    clock = SkewedClock(round(options.clock_offset_ms * 1e6), options.clock_ppm, true_clock)
    key, access = _secrets(options)
    raw = _raw_settings(options, true_clock)
    engine = (wrist_engine if rig.kind == "wrist" else marker_engine).engine_named(options.engine)
    source = _lit_source(options, rig, camera, clock, true_clock, stop, service.away)
    uplink = Uplink(options.name, key, clock, options.beacon_port, options.bind)

    def say(line: str) -> None:
        print(f"{options.name}: {line}", flush=True)

    run_live(
        options.name, files, source, uplink, clock, options.colours, engine, stop, say, service, access, raw
    )
    return 0


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
    return RawSettings(folder, round(options.raw_reserve_mb * 1e6), _skewed(options, true_clock))


def _secrets(options: argparse.Namespace) -> "tuple[bytes, Access]":
    """The rig key, and how this device comes to the bus.

    Raises:
        PhalanxError: There is no rig key, or the keys folder has no certificate of this device.
    """
    from common.keys import access_of, rig_key

    access = access_of(os.environ, options.name, options.keys, options.open)
    if access.folder is not None:
        access.identity()  # said now, not when a master is heard
    return rig_key(os.environ, options.key_file, options.keys), access


def _skewed(options: argparse.Namespace, true_clock: Clock) -> str:
    """How the slave's clock differs from the machine's, for whoever compares two recordings; empty: not at all."""
    skewed = f" {options.clock_offset_ms:+g} ms" if options.clock_offset_ms else ""
    return skewed + (f" {options.clock_ppm:+g} ppm from {true_clock.now_ns()}" if options.clock_ppm else "")


def _imu(options: argparse.Namespace) -> int:
    from slave.imu.live import run_live
    from slave.imu.opening import open_real, orientation_of
    from slave.imu.synthetic import SyntheticImu
    from slave.simulated import imu_of
    from slave.uplink import Uplink

    rig = load(options.calibration / "rigs" / f"{options.rig}.json", RigCalibration)
    if rig.imu is None or options.name != rig.imu.name:
        has = "it has none" if rig.imu is None else f"its IMU is {rig.imu.name!r}"
        raise CalibrationError(f"rig {rig.name!r} has no IMU {options.name!r}; {has}")
    orientation = orientation_of(rig.imu)
    true_clock = SystemClock()
    clock = SkewedClock(round(options.clock_offset_ms * 1e6), options.clock_ppm, true_clock)
    key, access = _secrets(options)

    def say(line: str) -> None:
        print(f"{options.name}: {line}", flush=True)

    service = Service(os.environ, noun="samples")
    with _stop_by_signal() as stop:
        if options.imu == "synthetic":
            epoch_ns = true_clock.now_ns() if options.scene_epoch_ns is None else options.scene_epoch_ns
            imu = imu_of(options.imu, *_world(options, rig), options.scene, options.seed)
            source: ImuSource = SyntheticImu(imu, epoch_ns, clock, stop)
        else:
            source = open_real(options.name, options.imu, rig.imu.rate_hz, clock, stop, service.away)
        uplink = Uplink(options.name, key, clock, options.beacon_port, options.bind)
        run_live(options.name, source, orientation, uplink, clock, stop, say, service, access)
    return 0


def _tracker(options: argparse.Namespace) -> int:
    from slave.objects.live import run_live
    from slave.objects.opening import object_with, open_real
    from slave.uplink import Uplink

    rig = load(options.calibration / "rigs" / f"{options.rig}.json", RigCalibration)
    profile = object_with(options.calibration, rig, options.name)
    true_clock = SystemClock()
    clock = SkewedClock(round(options.clock_offset_ms * 1e6), options.clock_ppm, true_clock)
    key, access = _secrets(options)

    def say(line: str) -> None:
        print(f"{options.name}: {line}", flush=True)

    service = Service(os.environ, noun="poses")
    with _stop_by_signal() as stop:
        if options.device == "synthetic":
            from slave.objects.synthetic import SyntheticTracker
            from slave.simulated import tracker_of

            epoch_ns = true_clock.now_ns() if options.scene_epoch_ns is None else options.scene_epoch_ns
            tracker = tracker_of(*_world(options, rig), options.scene, options.seed, profile)
            source: TrackerSource = SyntheticTracker(options.name, tracker, epoch_ns, clock, stop)
        else:
            named = options.device, options.serial, options.program
            source = open_real(options.name, *named, clock, stop, service.away)
        try:
            uplink = Uplink(options.name, key, clock, options.beacon_port, options.bind)
        except PhalanxError:
            source.close()
            raise
        recorded = options.device.startswith("survive:")
        run_live(options.name, source, uplink, clock, stop, say, service, access, recorded)
    return 0


def _calibration(options: argparse.Namespace) -> tuple[RigCalibration, CameraCalibration]:
    camera_path, rig_path = _paths(options)
    rig = load(rig_path, RigCalibration)
    if options.name not in rig.cameras:
        raise CalibrationError(
            f"rig {rig.name!r} has no camera {options.name!r}; it has {', '.join(rig.cameras)}"
        )
    return rig, load(camera_path, CameraCalibration)


def _world(options: argparse.Namespace, rig: RigCalibration) -> tuple[Path, RigCalibration]:
    """Folder and rig of the files that say how the simulated world is."""
    from slave.simulated import world_of

    return world_of(options.calibration, rig, options.truth, options.truth_rig)


def _objects(options: argparse.Namespace, rig: RigCalibration) -> dict[str, ObjectProfile]:
    """The objects of the rig, by name."""
    folder: Path = options.calibration / "objects"
    return {name: load(folder / f"{name}.json", ObjectProfile) for name in rig.objects}


def _paths(options: argparse.Namespace) -> tuple[Path, Path]:
    """The camera file and the rig file."""
    folder: Path = options.calibration
    return folder / "cameras" / f"{options.name}.json", folder / "rigs" / f"{options.rig}.json"


def _lit_source(
    options: argparse.Namespace,
    rig: RigCalibration,
    camera: CameraCalibration,
    clock: Clock,
    true_clock: Clock,
    stop: threading.Event | None = None,
    away: Away = nobody,
) -> FrameSource:
    """Open the camera as `_source` does, and the lights of a wrist device, which are dark before it is opened."""
    lights = choose(options.lights, rig, str(options.camera))
    if lights is None or (lights == SYNTHETIC and options.scene == "board"):  # a simulated board is not lit
        return _source(options, rig, camera, clock, true_clock, stop, away=away)
    from slave.lights.controller import StrobeController
    from slave.lights.simulated import SimulatedStrobe
    from slave.lights.strobed import StrobedCamera, schedule_of

    limits, schedule = limits_for(lights, rig), schedule_of(rig, camera)
    if lights == SYNTHETIC:
        strobe = SimulatedStrobe(schedule, limits)
        source = _source(options, rig, camera, clock, true_clock, stop, strobe)
        return StrobedCamera(source, camera, rig, strobe)
    guard = open_guarded(lights, rig)
    try:
        source = _source(options, rig, camera, clock, true_clock, stop, away=away)
    except PhalanxError:
        guard.close()
        raise
    return StrobedCamera(source, camera, rig, StrobeController(schedule, guard, clock))


def _source(
    options: argparse.Namespace,
    rig: RigCalibration,
    camera: CameraCalibration,
    clock: Clock,
    true_clock: Clock,
    stop: threading.Event | None = None,
    lights: "LitBy | None" = None,
    away: Away = nobody,
) -> FrameSource:
    """Open the camera; with `stop`, a real one that is lost later is opened again until that is set."""
    wrist = rig.kind == "wrist"
    found = real.open_real(options.camera, options, camera, clock, stop, wrist=wrist, away=away)
    if found is not None:
        return found
    kind, _, folder = str(options.camera).partition(":")
    if kind == "replay" and folder:
        from slave.cameras.replay import ReplayCamera

        return ReplayCamera(Path(folder), options.name, paced=True, clock=clock)
    if kind == "synthetic" and not folder:
        from slave.cameras.synthetic import SyntheticCamera
        from slave.simulated import FrameClock, scene_of

        scene = scene_of(*_world(options, rig), options.scene, options.seed)
        epoch_ns = true_clock.now_ns() if options.scene_epoch_ns is None else options.scene_epoch_ns
        late_ns = round(options.start_offset_ms * 1e6)
        waits = isinstance(true_clock, FrameClock)
        sleep = true_clock.sleep if isinstance(true_clock, FrameClock) else time.sleep

        def draw(file: CameraCalibration) -> SyntheticCamera:
            return SyntheticCamera(
                scene, file, epoch_ns, clock, late_ns, true_clock, sleep, lights, live=not waits
            )

        if getattr(options, "faults", None) is None:
            return draw(camera)
        from slave.cameras.faulty import FaultyCamera

        return real.lasting(
            lambda file: FaultyCamera(draw(file), file, options.faults), camera, clock, stop, away
        )
    raise CameraError(f"--camera {options.camera}: no such driver; there are {CAMERAS}")


def _lights(options: argparse.Namespace) -> int:
    from slave.lights.report import blink, budget

    rig = load(options.calibration / "rigs" / f"{options.rig}.json", RigCalibration)
    camera = load(options.calibration / "cameras" / f"{rig.cameras[0]}.json", CameraCalibration)
    if not (options.blink or options.off):
        print(budget(rig, camera))
        return 0
    if options.lights is None:
        raise LightsError(f"--blink and --off need the lights: --lights {SWITCHED}")
    with _stop_by_signal() as stop:
        guard = open_guarded(options.lights, rig)  # dark from here on
        try:
            if options.blink:
                print(budget(rig, camera), flush=True)
                blink(guard, rig, camera, stop, options.blink)
        finally:
            guard.close()
    events = ", ".join(f"{event} {count}" for event, count in guard.events().items())
    print(events if options.blink else "dark")
    return 0


def _record(options: argparse.Namespace) -> int:
    from common.frame_recording import Manifest
    from common.frame_writing import refuse_occupied
    from slave.progress import Length, ProgressDisplay
    from slave.recorder import Recorder, clock_of, feed
    from slave.simulated import FrameClock, add_imu, imu_of

    rig, camera = _calibration(options)
    files = {n: options.calibration / "cameras" / f"{n}.json" for n in rig.cameras}
    true_clock: Clock = SystemClock()
    if options.scene_epoch_ns is None:
        options.scene_epoch_ns = true_clock.now_ns()
    if options.every_frame:
        if options.camera != "synthetic":
            raise CameraError(f"--every-frame: only a synthetic camera can wait, not {options.camera}")
        true_clock = FrameClock(options.scene_epoch_ns)
    clock = SkewedClock(round(options.clock_offset_ms * 1e6), options.clock_ppm, true_clock)
    skewed = (" as frames are drawn" if options.every_frame else "") + _skewed(options, true_clock)
    manifest = Manifest(
        version=1,
        kind=rig.kind,
        cameras={n: load(path, CameraCalibration) for n, path in files.items()},
        rig=rig,
        note=options.note,
        clock=clock_of(clock, skewed),
        objects=_objects(options, rig),
    )
    refuse_occupied(options.output)  # before a camera is opened
    imu = None
    if options.imu == "synthetic":
        imu = imu_of(str(options.camera), *_world(options, rig), options.scene, options.seed)
    display = ProgressDisplay(options.name, sys.stderr)
    with _imu_beside(options, rig, clock) as beside:
        source = _lit_source(options, rig, camera, clock, true_clock)
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
                if beside is not None:
                    beside.start(options.output)
                with _stop_by_signal() as stop:
                    feed(source, recorder, stop)
            finally:
                recorder.close()
                done = recorder.progress()
                display.end(done)
        finally:
            source.close()
        if beside is not None and done.frames:
            beside.keep()
    if imu is not None and done.frames:
        add_imu(options.output, imu, options.scene_epoch_ns, clock)
    os.sync()  # what was said to be recorded is there, also when the power goes now
    failure = recorder.failure or (None if beside is None else beside.failure)
    if failure is not None:
        raise failure
    if not done.frames:
        raise CameraError(f"camera {options.name!r} gave no frame; nothing was recorded")
    print(f"{options.name}: recorded in {options.output}", flush=True)
    return 0


@contextmanager
def _imu_beside(
    options: argparse.Namespace, rig: RigCalibration, clock: Clock
) -> "Generator[ImuRecorder | None, None, None]":
    """A real IMU of the rig that is recorded with a camera, if one is asked for."""
    if options.imu is None or options.imu == "synthetic":
        yield None
        return
    from slave.imu.opening import open_real, orientation_of
    from slave.imu.recording import ImuRecorder

    if rig.imu is None:
        raise CalibrationError(f"rig {rig.name!r}: imu: missing; there is none to record")
    orientation, stop = orientation_of(rig.imu), threading.Event()
    beside = ImuRecorder(
        open_real(rig.imu.name, options.imu, rig.imu.rate_hz, clock, stop), orientation, stop
    )
    try:
        yield beside
    finally:
        counts = beside.close()
        print(", ".join(f"{event} {count}" for event, count in counts.items()), file=sys.stderr)


@contextmanager
def _stop_by_signal() -> Generator[threading.Event, None, None]:
    """An event that Ctrl-C and a stop by the system set, for as long as the block runs."""
    stop = threading.Event()
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda _number, _frame: stop.set()) for number in numbers]
    try:
        yield stop
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def _join(options: argparse.Namespace) -> int:
    from slave.join import join_recordings

    def progress(done: int, total: int) -> None:
        if done % PROGRESS_EVERY == 0:
            print(f"{done} of {total} frames", file=sys.stderr)

    counts = join_recordings(options.recordings, options.output, options.by_wall_clock, progress)
    print(f"{options.output}: " + ", ".join(f"{name} {count} frames" for name, count in counts.items()))
    return 0


def _detect(options: argparse.Namespace) -> int:
    from common.frame_recording import MANIFEST, Manifest
    from slave.cameras.replay import is_grey
    from slave.offline import detect_recording, save_detections, tag_collector

    def progress(done: int, total: int) -> None:
        if done % PROGRESS_EVERY == 0 or done == total:
            print(f"{options.camera}: {done} of {total} frames", file=sys.stderr)

    if is_grey(load(options.recording / MANIFEST, Manifest), options.camera):
        return _detect_wrist(options, progress)
    if options.hand is not None:
        raise CalibrationError(
            f"--hand: camera {options.camera!r} sees markers; only a wrist camera knows a hand"
        )
    tags = tag_collector(options.recording, options.camera, options.calibration)
    found = detect_recording(options.recording, options.camera, options.calibration, progress, tags)
    save_detections(options.output, found)
    if tags is not None:
        save_detections(options.output.parent / f"tags_{options.camera}.npz", tags.all())
    return 0


def _detect_wrist(options: argparse.Namespace, progress: Callable[[int, int], None]) -> int:
    from slave.offline import save_detections
    from slave.wrist.offline import detect_wrist_recording

    done = detect_wrist_recording(
        options.recording, options.camera, options.calibration, options.hand, progress
    )
    print(f"{options.camera}: {done.summary()}", file=sys.stderr)
    save_detections(options.output, done.detections)
    return 0


def _install(options: argparse.Namespace) -> int:
    from slave.install.command import run

    return run(options, lambda line: print(line, flush=True))


def _doctor(options: argparse.Namespace) -> int:
    from common.machine import program
    from slave.doctor.command import examine
    from slave.doctor.finding import as_json, as_text, exit_code
    from slave.doctor.system import System

    findings = list(examine(options, System.here()))
    print(as_json(findings, program()) if options.json else as_text(findings))
    return exit_code(findings)


def _colours(options: argparse.Namespace) -> int:
    from slave.markers.colours import report
    from slave.offline import calibrate_colours

    table = calibrate_colours(
        options.recording,
        options.camera,
        options.output,
        auto=options.auto,
        like=options.like,
        hand=options.hand,
        say=lambda text: print(text, file=sys.stderr),
    )
    print(report(table))
    return 0


COMMANDS = {
    "run": _run,
    "imu": _imu,
    "tracker": _tracker,
    "lights": _lights,
    "record": _record,
    "join": _join,
    "detect": _detect,
    "install": _install,
    "doctor": _doctor,
    "colours": _colours,
}


if __name__ == "__main__":
    sys.exit(main())
