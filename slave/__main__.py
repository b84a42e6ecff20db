"""The slave's command line; the only place that names concrete drivers."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import cv2

from common.errors import PhalanxError

PROGRESS_EVERY = 500  # frames
ABOUT = "The slave stands beside a camera: it finds the painted markers and sends their centroids, never images."
EXAMPLES = """examples:
  phalanx-slave colours recordings/paints --camera left -o calib_json/cameras/left.json
        one click per marker in, HSV ranges out; prints what collides with what
  phalanx-slave detect recordings/wave --camera left --calibration calib_json -o detections_left.npz
        offline: every frame of one camera, the same bytes on every run
  phalanx-slave run --name left --camera replay:recordings/wave --calibration calib_json --key-file rig.key
        live: waits for the master's start, then sends one sealed datagram per frame
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return the exit code: 0 done, 1 something the user can mend, 2 wrong usage."""
    options = _parser().parse_args(arguments)
    cv2.setNumThreads(1)  # one thread of its own is faster for small windows, and leaves the other cores alone
    try:
        return {"run": _run, "detect": _detect, "colours": _colours}[options.command](options)
    except PhalanxError as error:
        print(f"phalanx-slave: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130


def _run(options: argparse.Namespace) -> int:
    from slave.live import LiveOptions, run_live  # imported here: `detect` needs neither zenoh nor sockets

    return run_live(LiveOptions.of(options))


def _detect(options: argparse.Namespace) -> int:
    from slave.offline import detect_recording, save_detections

    def progress(done: int, total: int) -> None:
        if done % PROGRESS_EVERY == 0 or done == total:
            print(f"{options.camera}: {done} of {total} frames", file=sys.stderr)

    found = detect_recording(options.recording, options.camera, options.calibration, progress)
    save_detections(options.output, found)
    return 0


def _colours(options: argparse.Namespace) -> int:
    from slave.offline import calibrate_colours
    from slave.markers.colours import report

    rows = calibrate_colours(options.recording, options.camera, options.output)
    print(report(rows))
    return 0


def _parser() -> argparse.ArgumentParser:
    keep = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="phalanx-slave", description=ABOUT, epilog=EXAMPLES, formatter_class=keep)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    detect = commands.add_parser("detect", help="find the markers in a recording, offline", epilog=EXAMPLES, formatter_class=keep)
    detect.add_argument("recording", type=Path, metavar="RECORDING", help="folder with recording.json and frames.csv")
    detect.add_argument("--camera", required=True, metavar="NAME")
    detect.add_argument("--calibration", type=Path, metavar="DIR", help="calib_json tree; its cameras/NAME.json gives the colours")
    detect.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="detections_NAME.npz")
    colours = commands.add_parser("colours", help="HSV ranges from the clicks of a recording", epilog=EXAMPLES, formatter_class=keep)
    colours.add_argument("recording", type=Path, metavar="RECORDING", help="folder whose recording.json has clicks")
    colours.add_argument("--camera", required=True, metavar="NAME")
    colours.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="camera file to write, `markers` filled")
    return parser


if __name__ == "__main__":
    sys.exit(main())
