"""The slave's command line; the only place that names concrete drivers."""

import argparse
import gc
import logging
import os
import signal
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

import cv2

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.clock import Clock, SkewedClock, SystemClock
from common.errors import CalibrationError, CameraError, PhalanxError
from slave.cameras.source import FrameSource

ABOUT = (
    "The slave stands beside a camera: it finds the painted markers and sends their centroids.\n"
    "Images leave it only as small previews, on request, while somebody looks."
)
EXAMPLES = """examples:
  phalanx-slave colours recordings/paints --camera left -o calib_json/cameras/left.json
        one click per marker in, HSV ranges out; prints what collides with what
  phalanx-slave detect recordings/wave --camera left --calibration calib_json -o detections_left.npz
        offline: every frame of one camera, the same bytes on every run
  PHALANX_RIG_KEY=$(cat rig.key) phalanx-slave run --name left --rig desk --camera replay:recordings/wave
        live: waits for the master's start, then sends one sealed datagram per frame
  phalanx-slave run --name left --rig desk --camera synthetic --bind 127.0.0.1 --key-file rig.key
        live without hardware: renders the standard scene in real time
"""
CAMERAS = "synthetic | replay:FOLDER"
PROGRESS_EVERY = 500  # frames
BEACON_PORT = 47800


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return the exit code: 0 done, 1 something the user can mend, 2 wrong usage."""
    options = _parser().parse_args(arguments)
    cv2.setNumThreads(1)  # small windows are faster on one thread, and the other cores stay free
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s: %(message)s", stream=sys.stderr)
    try:
        return {"run": _run, "detect": _detect, "colours": _colours}[options.command](options)
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
    from slave.markers.detector import MarkerDetector
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
    source = _source(options, rig, camera, clock, true_clock)
    detector = MarkerDetector(camera, rig.markers)
    uplink = Uplink(options.name, key, clock, options.beacon_port, options.bind)
    tally = Tally(rig.markers)
    previews = Previews(options.name, clock)
    reporter = Reporter(
        options.name,
        uplink,
        tally,
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
            run(source, detector, uplink, options.name, tally, stop, previews.offer)
    finally:
        reporter.close()
        previews.close()
        uplink.close()
        source.close()
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
) -> FrameSource:
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

    print(report(calibrate_colours(options.recording, options.camera, options.output)))
    return 0


def _parser() -> argparse.ArgumentParser:
    keep = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        "phalanx-slave", description=ABOUT, epilog=EXAMPLES, formatter_class=keep
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    run = commands.add_parser("run", help="detect live and send", epilog=EXAMPLES, formatter_class=keep)
    run.add_argument("--name", required=True, help="camera of this slave, a member of the rig")
    run.add_argument("--rig", default="desk", help="rig, a file in DIR/rigs (default: %(default)s)")
    run.add_argument("--calibration", type=Path, default=Path("calib_json"), metavar="DIR")
    run.add_argument("--camera", required=True, metavar="DRIVER", help=CAMERAS)
    run.add_argument(
        "--beacon-port", type=int, default=BEACON_PORT, metavar="PORT", help="default: %(default)s"
    )
    run.add_argument(
        "--bind", default="0.0.0.0", metavar="ADDRESS", help="own address (default: every network)"
    )
    run.add_argument(
        "--key-file", type=Path, metavar="FILE", help="rig key; default: environment PHALANX_RIG_KEY"
    )
    sim = run.add_argument_group("synthetic camera")
    sim.add_argument("--scene", default="standard", metavar="NAME", help="standard | leap:FILE.npz")
    sim.add_argument("--seed", type=int, default=7)
    sim.add_argument(
        "--scene-epoch-ns", type=int, metavar="N", help="CLOCK_MONOTONIC at scene time 0; default: now"
    )
    sim.add_argument(
        "--clock-offset-ms", type=float, default=0.0, metavar="X", help="this machine's clock is ahead"
    )
    sim.add_argument("--clock-ppm", type=float, default=0.0, metavar="Y", help="and gains on the true one")
    sim.add_argument("--start-offset-ms", type=float, default=0.0, metavar="Z", help="its frames come later")

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
        "colours", help="colours from clicks", epilog=EXAMPLES, formatter_class=keep
    )
    colours.add_argument(
        "recording", type=Path, metavar="RECORDING", help="folder; recording.json has clicks"
    )
    colours.add_argument("--camera", required=True, metavar="NAME")
    colours.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="camera file to write"
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
