"""Define the options of the slave's commands; their docstrings are the help."""

import re
from argparse import ArgumentParser, ArgumentTypeError
from collections.abc import Callable
from pathlib import Path

from common.command_line import count, megabytes, number, port, positive
from slave.drivers import CAMERAS, IMU_UNITS, IMUS, LIGHTS, REAL_IMUS, SCANS, SWITCHED_LIGHTS, TRACKERS

BEACON_PORT = 47800
_START = "UDP port of the master's start (default: %(default)s)"
BOTH = "grasp | both-poses | both-curl | both-travel | both-moves | gestures"  # the same motion for both kinds of rig


def add_place(command: ArgumentParser, who: str, calibration: str = "calib_json", rig: str = "desk") -> None:
    """Add who this slave is, of which rig, and where its files are."""
    command.add_argument("--name", metavar="NAME", help=who)
    command.add_argument("--rig", metavar="NAME", help=f"rig, a file in DIR/rigs (default: {rig})")
    command.add_argument(
        "--calibration", type=Path, metavar="DIR", help=f"calib_json tree (default: {calibration})"
    )


def add_link(command: ArgumentParser) -> None:
    """How it finds its master."""
    link = command.add_argument_group("master").add_argument
    link("--beacon-port", type=port, default=BEACON_PORT, metavar="PORT", help=_START)
    link("--bind", default="0.0.0.0", metavar="ADDRESS", help="own address (default: every network)")
    link(
        "--keys",
        type=Path,
        metavar="DIR",
        help="keys folder of this device: rig key and certificate (docs/keys.md); default: environment PHALANX_KEYS",
    )
    link("--key-file", type=Path, metavar="FILE", help="rig key alone; default: environment PHALANX_RIG_KEY")
    link(
        "--open",
        action="store_true",
        help="join the bus of a master that is not encrypted: only in a closed laboratory; also PHALANX_OPEN=1",
    )


def add_camera(command: ArgumentParser) -> None:
    """How a camera is opened, and the lights of a wrist device."""
    command.add_argument(
        "--lights",
        metavar="DRIVER",
        help=f"who switches laser and LEDs of a wrist device: {LIGHTS} (docs/safety.md); the last two: the camera's "
        "own strobe output, or another controller. Before a synthetic camera synthetic (default) or camera",
    )
    command.add_argument(
        "--luma",
        action="store_true",
        help="wrist device with a colour camera (without infrared filter): its luma in place of grey frames of a "
        "monochrome sensor; it is not linear in the light",
    )
    pi = command.add_argument_group("Pi camera (picamera2)").add_argument
    text = "frames in step with other Pi cameras: one leads, the others follow; start clients first"
    pi("--sync", choices=("off", "server", "client"), default="off", help=text)
    text = "how long to wait for them (default: %(default)s)"
    pi("--sync-timeout", type=float, default=60.0, metavar="S", help=text)
    usb = command.add_argument_group("USB camera (v4l2; opencv, on macOS and Windows)").add_argument
    for name, metavar, text in (
        ("--control", "NAME=N", "fix a control in codes of its maker, for example gain=32"),
        (
            "--allow-missing",
            "NAME",
            "exposure | gain | white_balance: the camera lacks this control, and that is known",
        ),
    ):
        usb(name, action="append", default=[], metavar=metavar, help=f"{text}; may be repeated")


def add_simulated(command: ArgumentParser) -> None:
    """Which scene a simulated sensor senses, and by what clock."""
    add: Callable[..., object] = command.add_argument_group("synthetic camera, IMU or tracker").add_argument
    add(
        "--scene",
        default="standard",
        metavar="NAME",
        help=f"standard | lights | poses | hand-routine | object | leap:FILE.npz | {BOTH} | hands | board | card; "
        f"before a wrist device standard | curl | subject | poses | spread | random | {BOTH}, each with @dark | "
        "@indoor | @bright | @sun, or board",
    )
    add("--seed", type=int, default=7, metavar="N", help="of the scene (default: %(default)s)")
    add(
        "--truth",
        type=Path,
        metavar="DIR",
        help="calib_json tree that describes the simulated world: lenses, places, paints, hand; this slave goes on "
        "using --calibration, where they may be unknown (default: it uses the truth)",
    )
    add("--truth-rig", metavar="NAME", help="the rig in it, a file in DIR/rigs (default: of the same name)")
    add("--scene-epoch-ns", type=int, metavar="N", help="CLOCK_MONOTONIC at scene time 0; default: now")
    for name, metavar, text in (
        ("--clock-offset-ms", "X", "this machine's clock is ahead"),
        ("--clock-ppm", "Y", "and gains on the true one"),
        ("--start-offset-ms", "Z", "frames of a synthetic camera come later"),
    ):
        add(name, type=number(), default=0.0, metavar=metavar, help=f"{text} (default: %(default)g)")


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
    text = "stay free on its disk (default: %(default)g)"
    add("--raw-reserve-mb", type=megabytes, default=200.0, metavar="MB", help=text)
    add(
        "--faults",
        type=Path,
        metavar="FILE",
        help="of a synthetic camera: what is wrong with it, JSON, read again whenever it changes (docs/checklist.md)",
    )


def record(command: ArgumentParser) -> None:
    """Write raw frames of a camera to disk, and a real IMU beside it.

    Without master or network: one folder per camera. Or makes a recording of those of several cameras (--join), of
    videos or pictures that other programs made (--from), or imu.csv of the table of an IMU (--imu-csv).

    Examples:
      phalanx-slave record --name left --rig desk --camera synthetic --seconds 10 -o recordings/wave-left
      phalanx-slave record --name left --camera service --seconds 10 -o recordings/wave-left
            what the running slave sees, while it tracks; docs/recording.md
      phalanx-slave record --name wrist --rig wrist --camera synthetic --imu ximu3:/dev/ttyACM0 --seconds 10 -o out
            the rig's IMU beside the camera, as imu.csv on the clock of the frames
      phalanx-slave record --join recordings/wave-left recordings/wave-right -o recordings/wave
            one recording of all cameras, for `phalanx replay` and the calibrations
      phalanx-slave record --join recordings/grasp-left recordings/grasp-right recordings/grasp-wrist -o grasp
            of marker cameras and a wrist device: one of kind both
      phalanx-slave record --from left.mp4 right.mp4 --calibration calib_json -o recordings/wave
            videos named as the cameras of the rig; `phalanx replay left.mp4 right.mp4 ...` does this by itself
      phalanx-slave record --from takes/7 --calibration calib_json --times takes/7/times.csv -o recordings/take7
            a folder with a video, or a folder of pictures, for each camera; times.csv: camera,frame,time (seconds)
      phalanx-slave record --from left=GOPR0012.MP4 right=GOPR0944.MP4 --calibration calib_json -o recordings/gopro
            whose each one is, where its name does not state it
      phalanx-slave record --imu-csv walk.csv --gyro-unit deg/s -o recordings/walk
            reads a CSV with a header (docs/imu.md), reports its rate, gaps, bias and orientation, and writes imu.csv;
            against a quaternion in it, how right the tilt is. Without -o it is only looked at
    """
    what = command.add_mutually_exclusive_group(required=True)
    text = f"{CAMERAS} | service; the last: what the running slave NAME has, with its files"
    what.add_argument("--camera", metavar="DRIVER", help=text)
    what.add_argument(
        "--join", type=Path, nargs="+", metavar="RECORDING", help="recordings to join, one folder per camera"
    )
    what.add_argument(
        "--from",
        dest="foreign",
        nargs="+",
        metavar="[NAME=]PATH",
        help="a video or a folder of pictures for each camera NAME (default: that of its name, else in the order of "
        "the rig), or a folder of these",
    )
    what.add_argument(
        "--imu-csv", type=Path, metavar="FILE", help="a CSV with a header: time, rates, forces of an IMU"
    )
    command.add_argument(
        "-o", "--output", type=Path, metavar="FOLDER", help="new or empty; with --from also a former one"
    )
    add_place(
        command,
        "camera of this slave, a member of the rig; with --imu-csv its IMU (default: imu)",
        rig="desk; with --from the one with these cameras",
    )
    command.add_argument("--seconds", type=positive, metavar="S", help="default: until Ctrl-C")
    command.add_argument("--frames", type=count, metavar="N", help="end after so many recorded frames")
    command.add_argument(
        "--imu",
        nargs="?",
        const="synthetic",
        metavar="DRIVER",
        help=f"samples of the rig's IMU, too, as imu.csv: {REAL_IMUS}; without a driver, that of a synthetic camera",
    )
    command.add_argument(
        "--every-frame",
        action="store_true",
        help="a synthetic camera does not keep time but draws every frame, however long that takes; all cameras of one "
        "scene need the same --scene-epoch-ns",
    )
    command.add_argument("--note", default="", metavar="TEXT", help="kept in recording.json")
    for name, default, text in (("--reserve-mb", 200.0, "stay free"), ("--queue-mb", 128.0, "may wait")):
        text = f"{text} (default: %(default)g)"
        command.add_argument(name, type=megabytes, default=default, metavar="MB", help=text)
    command.add_argument(
        "--by-wall-clock",
        action="store_true",
        help="of --join: recorded on several machines: trust their wall clocks (keep them together by NTP or PTP)",
    )
    command.add_argument(
        "--times",
        type=Path,
        metavar="FILE.csv",
        help="of --from: when each frame was taken: camera,frame,time; frames from 0, time in seconds, or t_ns "
        "(default: NAME.csv beside NAME.mp4, without the camera; else the video's time stamps, else the frame rate)",
    )
    table = command.add_argument_group("table of an IMU (--imu-csv)").add_argument
    for measured, units in IMU_UNITS.items():
        text = f"unit of {measured} where the header does not say it"
        table(f"--{measured}-unit", choices=units, help=text)
    text = "samples per second of a table without a column of time"
    table("--rate-hz", type=positive, metavar="HZ", help=text)
    add_camera(command)
    add_simulated(command)


def colours(command: ArgumentParser) -> None:
    """Find the marker colours of a camera in a recording.

    Writes its camera file, and reports which markers and things look alike.

    Examples:
      phalanx-slave colours recordings/paints --camera left -o calib_json/cameras/left.json
            HSV ranges from one click per marker, or, without clicks, from a few seconds of the moving hand;
            prints which markers and things look alike
      phalanx-slave colours left.mp4 --camera left --calibration calib_json -o calib_json/cameras/left.json \\
          --click thumb=312,204 --click index=350,122 --click middle=371,101 --click ring=395,117 \\
          --click little=420,150 --click back=360,260
            the same of a video or a folder of pictures: one pixel (column,row) on each marker in its first picture
      phalanx-slave colours recordings/paints --camera right --like calib_json/cameras/left.json -o right.json
            the same, the names taken from a camera file that has them
    """
    command.add_argument(
        "recording",
        type=Path,
        metavar="RECORDING",
        help="folder; with clicks in recording.json, or a few seconds of the moving, open hand; or a video or a folder "
        "of pictures, with --calibration",
    )
    command.add_argument("--camera", required=True, metavar="NAME", help="camera of the recording")
    command.add_argument(
        "--click",
        action="append",
        type=click,
        default=[],
        metavar="MARKER=U,V",
        help="a pixel on a marker in the first picture, column and row from the top left; once for each marker",
    )
    text = "from all frames though there are clicks, which then only name paints"
    command.add_argument("--auto", action="store_true", help=text)
    text = "of a video or pictures: rig in DIR/rigs (default: the one with the camera)"
    command.add_argument("--rig", metavar="NAME", help=text)
    by_shape = (
        "from all frames; names by the shape of this hand, which checks those of --like "
        "(default: calib_json/hands/, the rig's hand)"
    )
    for name, metavar, text in (
        ("--calibration", "DIR", "of a video or pictures: calib_json tree with the camera"),
        ("--like", "CAMERA.json", "from all frames; names by the hues of this camera file"),
        ("--hand", "HAND.json", by_shape),
    ):
        command.add_argument(name, type=Path, metavar=metavar, help=text)
    command.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="camera file to write"
    )


def click(text: str) -> tuple[str, tuple[float, float]]:
    """A marker and a pixel (u, v) on it, from MARKER=U,V.

    Raises:
        ArgumentTypeError: The text is not MARKER=U,V.
    """
    found = re.fullmatch(r"([^=]+)=(\d+(?:\.\d+)?),(\d+(?:\.\d+)?)", text)
    if found is None:
        raise ArgumentTypeError(f"{text!r}: expected MARKER=U,V, such as thumb=312,204")
    return found[1], (float(found[2]), float(found[3]))


def doctor(command: ArgumentParser) -> None:
    """Check this device: a line each of what is well, and of what is not.

    Machine, clock, libraries, keys, devices, camera, service, and whether its master is received; each line ok, warn or
    fail, with what mends it; exit 1 where something fails.

    With --lights it looks at laser and LEDs of a wrist device alone: what the strobe of a rig may do, and what share of
    every limit for eyes and supply that is; and switches them, if asked to.

    Examples:
      sudo phalanx-slave doctor
            on a device with a service
      phalanx-slave doctor --name left --rig desk --camera v4l2 --calibration calib_json --keys keys --master pc.local
            before it is installed; as root it sees the keys, as another user the rest
      phalanx-slave doctor --json
            the same for programs; docs/doctor.md
      phalanx-slave doctor --ports
            where an IMU may be connected: serial ports and I2C buses
      phalanx-slave doctor --rig wrist --lights
            the budget of a rig
      phalanx-slave doctor --rig wrist --lights gpio:0:17,27 --blink 3
            three seconds of laser and LEDs in turn, as before a camera, within the limits; gpio:0:17/low,27 where low
            is on
      phalanx-slave doctor --rig wrist --lights i2c:1:0x63 --off
            dark, whatever was before: for a service that ends the slave by force
    """
    command.add_argument("--name", help="slave to look at (default: all that are installed here)")
    command.add_argument("--rig", metavar="NAME", help="its rig (default: as installed; with --lights wrist)")
    text = "its camera, as `run` has it (default: as installed)"
    command.add_argument("--camera", metavar="DRIVER", help=text)
    text = "calib_json (default: as installed; with --lights calib_json)"
    command.add_argument("--calibration", type=Path, metavar="DIR", help=text)
    command.add_argument("--keys", type=Path, metavar="DIR", help="keys folder (default: /etc/phalanx/keys)")
    command.add_argument("--master", metavar="HOST", help="the PC whose beacon and clock are expected")
    command.add_argument("--beacon-port", type=int, default=BEACON_PORT, metavar="PORT", help=_START)
    command.add_argument("--json", action="store_true", help="for programs")
    command.add_argument("--ports", action="store_true", help="list where an IMU may be connected, and end")
    lights = command.add_argument_group("laser and LEDs of a wrist device").add_argument
    lights(
        "--lights",
        nargs="?",
        const="",
        metavar="DRIVER",
        help=f"the budget of the rig's strobe; with a driver, {SWITCHED_LIGHTS}, they can be switched",
    )
    lights("--blink", type=positive, metavar="S", help="laser and LEDs in turn, for so many seconds")
    lights("--off", action="store_true", help="switch both off")
