"""Options of `phalanx-slave run`."""

from argparse import ArgumentParser
from pathlib import Path

from common.option_types import megabytes
from slave.cli.options import add_camera, add_link, add_place, add_simulated
from slave.drivers import CAMERAS, IMUS, SCANS, TRACKERS


def run(command: ArgumentParser) -> None:
    """Send what a camera, an IMU or a tracker measures.

    Detects markers, or fingers before a wrist device, in the frames of a camera, and sends where they are; or sends
    what an IMU measures, or where a tracker on an object is. It waits for the master's start; then one sealed datagram
    for each frame, sample or pose.

    With -o it detects in all frames of a recording instead, and sends nothing: no clock, the same bytes on every run.

    Examples:
      phalanx-slave run --name left --rig desk --camera picamera2 --keys keys
      phalanx-slave run --name left --rig desk --camera v4l2:/dev/v4l/by-id/CAM --control gain=32 --key-file rig.key
            with a USB camera; docs/cameras.md states which settings are fixed and checked
      PHALANX_RIG_KEY=$(cat rig.key) phalanx-slave run --name left --rig desk --camera replay:recordings/wave
            a recording in place of a camera
      phalanx-slave run --name left --rig desk --camera synthetic --bind 127.0.0.1 --key-file rig.key
            without hardware: renders the standard scene in real time
      phalanx-slave run --name left --camera synthetic --calibration new --truth calib_json --key-file rig.key
            a simulated camera that knows neither lens nor place nor colours yet, to practise setting it up
      phalanx-slave run --name wrist --rig wrist --camera synthetic --scene grasp --scene-epoch-ns N --key-file rig.key
            the camera of a wrist device, docs/wrist.md: the same hand as cameras of rig desk with the same scene, seed
            and epoch; what they lose it still sees
      phalanx-slave run --name left --rig desk --camera picamera2 --colours none --key-file rig.key
            before there are colours: for `phalanx calibrate cameras capture`
      phalanx-slave run --name left --rig desk --camera picamera2 --scan windows --key-file rig.key
            only windows about the markers are scanned: for a board or a rate at which whole frames do not fit
      phalanx-slave run --name left --rig desk --camera picamera2 --raw-folder recordings --key-file rig.key
            keeps raw frames while it tracks whenever `phalanx record FILE --raw` asks; docs/recording.md
      phalanx-slave run --rig wrist --imu ximu3:/dev/serial/by-id/PORT --key-file rig.key
            an x-IMU3 on USB; on the pins of a Pi: ximu3:/dev/serial0@115200; docs/imu.md lists what is set and checked
      phalanx-slave run --rig wrist --imu lsm6dsox:1:0x6a --key-file rig.key
            an LSM6DSOX on I2C bus 1 of a Pi; `phalanx-slave doctor --ports` lists ports and buses
      phalanx-slave run --name tracker --rig desk-tracker --tracker openvr --key-file rig.key
            by SteamVR on this PC: needs the extra `vive` and SteamVR running; docs/tracker.md
      phalanx-slave run --name tracker --rig desk-tracker --tracker survive --serial LHR-1A2B3C4D --key-file rig.key
            by libsurvive: starts survive-cli and reads its lines; survive:walk.rec.gz: what it recorded, at its pace
      phalanx-slave run --name left --camera replay:recordings/wave --calibration calib_json -o detections_left.npz
            offline: every frame of one camera; of a rig whose objects have tags those, too: tags_left.npz beside it;
            of a wrist device laser points and fingertips of every strobe cycle. All cameras, and then the hand:
            `phalanx replay`
    """
    add_place(
        command,
        "camera, IMU or tracker of this slave, as the rig's files call it (default: the rig's IMU)",
        "calib_json; with -o what the recording has",
    )
    sensor = command.add_mutually_exclusive_group(required=True)
    sensor.add_argument("--camera", metavar="DRIVER", help=CAMERAS)
    sensor.add_argument("--imu", metavar="DRIVER", help=IMUS)
    sensor.add_argument("--tracker", metavar="SYSTEM", help=TRACKERS)
    add_link(command)
    _add_detection(command)
    add_camera(command)
    vive = command.add_argument_group("tracker").add_argument
    vive(
        "--serial",
        metavar="SERIAL",
        help="which device: its serial number (LHR-...), for survive also its name there (WM0, T20); not needed if "
        "there is one only",
    )
    vive("--program", default="survive-cli", metavar="PATH", help="survive-cli (default: that on the path)")
    add_simulated(command)


def _add_detection(command: ArgumentParser) -> None:
    """What is done with the frames of a camera."""
    add = command.add_argument_group("detection").add_argument
    add(
        "--colours",
        choices=("follow", "fixed", "none"),
        default="follow",
        help="whether the colours of markers follow changes of the light (default: %(default)s; docs/light.md); none: "
        "detect nothing, while the lens or the place of a camera is calibrated",
    )
    add(
        "--engine",
        choices=("numpy", "numba"),
        default="numpy",
        help="what detects markers, or fingers before a wrist device: numba is several times faster, needs the extra "
        "`fast` (default: %(default)s)",
    )
    add(
        "--scan",
        choices=SCANS,
        default="auto",
        help="where markers are looked for: in the full frame; in windows about where they are expected, and strip by "
        "strip where one is lost, which takes a lost marker a few frames more; auto: in the full frame as long as that "
        "fits the time of a frame (default: %(default)s; docs/cameras.md)",
    )
    add(
        "-o",
        "--output",
        type=Path,
        metavar="FILE",
        help="detect in all frames of --camera replay:FOLDER, and write detections_NAME.npz; nothing is sent",
    )
    add(
        "--hand",
        type=Path,
        metavar="FILE",
        help="with -o, for a wrist device: hand profile (default: DIR/hands/RIG'S HAND.json)",
    )
    add(
        "--raw-folder",
        type=Path,
        metavar="DIR",
        help="keep raw frames there, lossless, while it tracks, when `phalanx record FILE --raw` asks for them: a new "
        "folder each time (docs/recording.md)",
    )
    add(
        "--raw-reserve-mb",
        type=megabytes,
        default=200.0,
        metavar="MB",
        help="stay free on its disk (default: %(default)g)",
    )
    add(
        "--faults",
        type=Path,
        metavar="FILE",
        help="of a synthetic camera: what is wrong with it, JSON, read again whenever it changes (docs/checklist.md)",
    )
