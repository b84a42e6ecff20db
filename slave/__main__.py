"""The slave's command line; the only place that names concrete drivers."""

import argparse
import gc
import logging
import math
import os
import signal
import sys
import threading
from collections.abc import Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import cv2

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.clock import Clock, SkewedClock, SystemClock
from common.errors import CalibrationError, CameraError, PhalanxError
from slave.cameras import real
from slave.cameras.source import FrameSource

ABOUT = (
    "The slave stands beside a camera: it finds the painted markers and sends their centroids.\n"
    "Images leave it only as small previews, on request, while somebody looks."
)
EXAMPLES = """examples:
  phalanx-slave colours recordings/paints --camera left -o calib_json/cameras/left.json
        HSV ranges from one click per marker, or, without clicks, from a few seconds of the moving hand;
        prints what collides with what
  phalanx-slave colours recordings/paints --camera right --like calib_json/cameras/left.json -o right.json
        the same, the names taken from a camera file that has them
  phalanx-slave detect recordings/wave --camera left --calibration calib_json -o detections_left.npz
        offline: every frame of one camera, the same bytes on every run
  PHALANX_RIG_KEY=$(cat rig.key) phalanx-slave run --name left --rig desk --camera replay:recordings/wave
        live: waits for the master's start, then sends one sealed datagram per frame
  phalanx-slave run --name left --rig desk --camera synthetic --bind 127.0.0.1 --key-file rig.key
        live without hardware: renders the standard scene in real time
  phalanx-slave run --name left --rig desk --camera v4l2:/dev/v4l/by-id/CAM --control gain=32 --key-file rig.key
        live with a USB camera; docs/cameras.md says which settings are fixed and checked
  phalanx-slave record --name left --rig desk --camera synthetic --seconds 10 -o recordings/wave-left
        raw frames to disk, without master or network; one folder per camera
  phalanx-slave join recordings/wave-left recordings/wave-right -o recordings/wave
        one recording of all cameras, for `phalanx replay` and the calibrations
"""
CAMERAS = f"{real.CAMERAS} | synthetic | replay:FOLDER"
PROGRESS_EVERY = 500  # frames
NO_REFERENCE = (
    "{}: markers: no reference_bgr_linear, so the colours do not follow the light; calibrate again with "
    "`phalanx-slave colours`, or say --colours fixed"
)
_LOG = logging.getLogger(__name__)
BEACON_PORT = 47800


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return the exit code: 0 done, 1 something the user can mend, 2 wrong usage."""
    options = _parser().parse_args(arguments)
    cv2.setNumThreads(1)  # small windows are faster on one thread, and the other cores stay free
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s: %(message)s", stream=sys.stderr)
    try:
        return COMMANDS[options.command](options)
    except PhalanxError as error:
        print(f"phalanx-slave: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:  # while detecting offline; a live run ends by its event
        return 130


def _run(options: argparse.Namespace) -> int:
    # Imported here: `detect` and `colours` need neither sockets nor zenoh, and start twice as fast.
    from common.keys import rig_key
    from common.zenoh_bus import ZenohBus
    from slave.app import run, wait_for_start
    from slave.light_report import LightReport
    from slave.markers.detector import MarkerDetector
    from slave.markers.engine import engine_named
    from slave.markers.following import FollowingDetector, detector_for
    from slave.preview import Previews
    from slave.report import Reporter
    from slave.tally import Tally
    from slave.uplink import Uplink

    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda _number, _frame: stop.set())
    rig, camera = _calibration(options)
    true_clock = SystemClock()
    clock = SkewedClock(round(options.clock_offset_ms * 1e6), options.clock_ppm, true_clock)
    key = rig_key(os.environ, options.key_file)
    engine = engine_named(options.engine)
    source = _source(options, rig, camera, clock, true_clock, stop)
    workers = ThreadPoolExecutor(1, thread_name_prefix=f"{options.name} colours")
    if options.colours == "follow":
        detector = detector_for(camera, rig.markers, workers, engine=engine, free=rig.free_markers)
    else:
        detector = MarkerDetector(camera, rig.markers, engine=engine, free=rig.free_markers)
    uplink = Uplink(options.name, key, clock, options.beacon_port, options.bind)
    tally = Tally(rig.markers)
    previews = Previews(options.name, clock)
    numbers, show = tally, previews.offer
    if isinstance(detector, FollowingDetector):
        numbers = LightReport(options.name, detector, tally, rig.markers, previews.offer)
        show = numbers.offer
    elif options.colours == "follow":
        _LOG.warning("%s", NO_REFERENCE.format(options.calibration / "cameras" / f"{options.name}.json"))
    reporter = Reporter(
        options.name,
        uplink,
        numbers,
        clock,
        lambda endpoint: ZenohBus(None, endpoint),
        stop.set,
        shown=previews,
    )
    try:
        gc.collect()
        gc.freeze()  # what lives until the end is never walked again: no pause in the loop
        print(f"{options.name}: ready, waiting for the master", flush=True)
        if wait_for_start(uplink, stop):
            run(source, detector, uplink, options.name, tally, stop, show)
    finally:
        reporter.close()
        previews.close()
        uplink.close()
        source.close()
        workers.shutdown(cancel_futures=True)
    print(f"{options.name}: {tally.counts()['frames']} frames, sent {uplink.counts['sent']}", flush=True)
    return 0


def _calibration(options: argparse.Namespace) -> tuple[RigCalibration, CameraCalibration]:
    rig = load(options.calibration / "rigs" / f"{options.rig}.json", RigCalibration)
    if options.name not in rig.cameras:
        raise CalibrationError(
            f"rig {rig.name!r} has no camera {options.name!r}; it has {', '.join(rig.cameras)}"
        )
    return rig, load(options.calibration / "cameras" / f"{options.name}.json", CameraCalibration)


def _source(
    options: argparse.Namespace,
    rig: RigCalibration,
    camera: CameraCalibration,
    clock: Clock,
    true_clock: Clock,
    stop: threading.Event | None = None,
) -> FrameSource:
    """Open the camera; with `stop`, a real one that is lost later is opened again until that is set."""
    if (found := real.open_real(options.camera, options, camera, clock, stop)) is not None:
        return found
    kind, _, folder = str(options.camera).partition(":")
    if kind == "replay" and folder:
        from slave.cameras.replay import ReplayCamera

        return ReplayCamera(Path(folder), options.name, paced=True, clock=clock)
    if kind == "synthetic" and not folder:
        from common.sim.scenes import scene_by_name
        from slave.cameras.synthetic import SyntheticCamera

        hand = load(options.calibration / "hands" / f"{rig.hand}.json", HandProfile)
        cameras = {
            n: load(options.calibration / "cameras" / f"{n}.json", CameraCalibration) for n in rig.cameras
        }
        scene = scene_by_name(options.scene, rig, cameras, hand, options.seed)
        epoch_ns = true_clock.now_ns() if options.scene_epoch_ns is None else options.scene_epoch_ns
        late_ns = round(options.start_offset_ms * 1e6)
        return SyntheticCamera(scene, camera.name, epoch_ns, clock, late_ns, true_clock)
    raise CameraError(f"--camera {options.camera}: no such driver; there are {CAMERAS}")


def _record(options: argparse.Namespace) -> int:
    from common.frame_recording import Manifest
    from common.frame_writing import refuse_occupied
    from slave.progress import Length, ProgressDisplay
    from slave.recorder import Recorder, clock_of, feed

    rig, camera = _calibration(options)
    files = {n: options.calibration / "cameras" / f"{n}.json" for n in rig.cameras}
    true_clock = SystemClock()
    clock = SkewedClock(round(options.clock_offset_ms * 1e6), options.clock_ppm, true_clock)
    skewed = f" {options.clock_offset_ms:+g} ms" if options.clock_offset_ms else ""
    skewed += f" {options.clock_ppm:+g} ppm from {true_clock.now_ns()}" if options.clock_ppm else ""
    manifest = Manifest(
        version=1,
        kind=rig.kind,
        cameras={n: load(path, CameraCalibration) for n, path in files.items()},
        rig=rig,
        note=options.note,
        clock=clock_of(clock, skewed),
    )
    refuse_occupied(options.output)  # before a camera is opened
    display = ProgressDisplay(options.name, sys.stderr)
    source = _source(options, rig, camera, clock, true_clock)
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
            with _stop_by_signal() as stop:
                feed(source, recorder, stop)
        finally:
            recorder.close()
            done = recorder.progress()
            display.end(done)
    finally:
        source.close()
    os.sync()  # what was said to be recorded is there, also when the power goes now
    if recorder.failure is not None:
        raise recorder.failure
    if not done.frames:
        raise CameraError(f"camera {options.name!r} gave no frame; nothing was recorded")
    print(f"{options.name}: recorded in {options.output}", flush=True)
    return 0


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
    from slave.offline import detect_recording, save_detections

    def progress(done: int, total: int) -> None:
        if done % PROGRESS_EVERY == 0 or done == total:
            print(f"{options.camera}: {done} of {total} frames", file=sys.stderr)

    found = detect_recording(options.recording, options.camera, options.calibration, progress)
    save_detections(options.output, found)
    return 0


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


COMMANDS = {"run": _run, "record": _record, "join": _join, "detect": _detect, "colours": _colours}


def _positive(text: str) -> float:
    value = float(text)
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text}: must be positive")
    return value


def _count(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text}: must be at least 1")
    return value


def _megabytes(text: str) -> float:
    value = float(text)
    if not 0.0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text}: must not be negative")
    return value


def _parser() -> argparse.ArgumentParser:
    keep = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        "phalanx-slave", description=ABOUT, epilog=EXAMPLES, formatter_class=keep
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    run = commands.add_parser("run", help="detect live and send", epilog=EXAMPLES, formatter_class=keep)
    _add_camera(run)
    run.add_argument(
        "--beacon-port", type=int, default=BEACON_PORT, metavar="PORT", help="default: %(default)s"
    )
    run.add_argument(
        "--bind", default="0.0.0.0", metavar="ADDRESS", help="own address (default: every network)"
    )
    run.add_argument(
        "--key-file", type=Path, metavar="FILE", help="rig key; default: environment PHALANX_RIG_KEY"
    )
    run.add_argument(
        "--colours",
        choices=("follow", "fixed"),
        default="follow",
        help="whether the colours follow changes of the light (default: %(default)s; docs/light.md)",
    )
    run.add_argument(
        "--engine",
        choices=("numpy", "numba"),
        default="numpy",
        help="what detects: numba is several times faster, needs the extra `fast` (default: %(default)s)",
    )

    record = commands.add_parser("record", help="raw frames to disk", epilog=EXAMPLES, formatter_class=keep)
    _add_camera(record)
    record.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FOLDER", help="new or empty; one per camera"
    )
    record.add_argument("--seconds", type=_positive, metavar="S", help="default: until Ctrl-C")
    record.add_argument("--frames", type=_count, metavar="N", help="end after so many recorded frames")
    record.add_argument("--note", default="", metavar="TEXT", help="kept in recording.json")
    record.add_argument(
        "--reserve-mb", type=_megabytes, default=200.0, metavar="MB", help="stay free (default: %(default)g)"
    )
    record.add_argument(
        "--queue-mb", type=_megabytes, default=128.0, metavar="MB", help="may wait (default: %(default)g)"
    )

    join = commands.add_parser(
        "join", help="one recording of several cameras", epilog=EXAMPLES, formatter_class=keep
    )
    join.add_argument("recordings", type=Path, nargs="+", metavar="RECORDING", help="one folder per camera")
    join.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER", help="new or empty")
    join.add_argument(
        "--by-wall-clock",
        action="store_true",
        help="recorded on several machines: trust their wall clocks (keep them together by NTP or PTP)",
    )

    detect = commands.add_parser(
        "detect", help="detect in a recording", epilog=EXAMPLES, formatter_class=keep
    )
    detect.add_argument(
        "recording", type=Path, metavar="RECORDING", help="folder with recording.json, frames.csv"
    )
    detect.add_argument("--camera", required=True, metavar="NAME")
    detect.add_argument(
        "--calibration", type=Path, metavar="DIR", help="its cameras/NAME.json gives the colours"
    )
    detect.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="detections_NAME.npz"
    )

    colours = commands.add_parser(
        "colours", help="colours of the markers", epilog=EXAMPLES, formatter_class=keep
    )
    colours.add_argument(
        "recording",
        type=Path,
        metavar="RECORDING",
        help="folder; with clicks in recording.json, or a few seconds of the moving, open hand",
    )
    colours.add_argument("--camera", required=True, metavar="NAME")
    colours.add_argument(
        "--auto",
        action="store_true",
        help="from all frames though there are clicks, which then only name paints",
    )
    colours.add_argument(
        "--like",
        type=Path,
        metavar="CAMERA.json",
        help="from all frames; names by the hues of this camera file",
    )
    colours.add_argument(
        "--hand",
        type=Path,
        metavar="HAND.json",
        help="from all frames; names by the shape of this hand, which checks those of --like "
        "(default: calib_json/hands/, the rig's hand)",
    )
    colours.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="camera file to write"
    )
    return parser


def _add_camera(parser: argparse.ArgumentParser) -> None:
    """All that `_calibration` and `_source` ask for."""
    parser.add_argument("--name", required=True, help="camera of this slave, a member of the rig")
    parser.add_argument("--rig", default="desk", help="rig, a file in DIR/rigs (default: %(default)s)")
    parser.add_argument("--calibration", type=Path, default=Path("calib_json"), metavar="DIR")
    parser.add_argument("--camera", required=True, metavar="DRIVER", help=CAMERAS)
    real.add_options(parser)
    sim = parser.add_argument_group("synthetic camera")
    sim.add_argument("--scene", default="standard", metavar="NAME", help="standard | lights | leap:FILE.npz")
    sim.add_argument("--seed", type=int, default=7)
    sim.add_argument(
        "--scene-epoch-ns", type=int, metavar="N", help="CLOCK_MONOTONIC at scene time 0; default: now"
    )
    sim.add_argument(
        "--clock-offset-ms", type=float, default=0.0, metavar="X", help="this machine's clock is ahead"
    )
    sim.add_argument("--clock-ppm", type=float, default=0.0, metavar="Y", help="and gains on the true one")
    sim.add_argument("--start-offset-ms", type=float, default=0.0, metavar="Z", help="its frames come later")


if __name__ == "__main__":
    sys.exit(main())
