"""The slave's command line as text: commands, options, help. Each command's help shows its own examples."""

import argparse
import math
from collections.abc import Callable
from pathlib import Path

from slave.cameras import real
from slave.doctor import options as doctor
from slave.imu import opening
from slave.install import arguments as install
from slave.lights.opening import CHOICES, SWITCHED
from slave.objects import opening as trackers

ABOUT = (
    "The slave stands beside a camera: it finds the painted markers, or the fingers before a wrist device, and sends\n"
    "where they are.\n"
    "Images leave it only as small previews, on request, while somebody looks."
)
# Command -> what it is for, in the list of commands; and its examples.
HELP = {
    "run": (
        "detect live and send",
        """\
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
  phalanx-slave run --name left --rig desk --camera picamera2 --raw-folder recordings --key-file rig.key
        keeps raw frames while it tracks whenever `phalanx-master record FILE --raw` asks; docs/recording.md
""",
    ),
    "imu": (
        "send what an IMU measures",
        """\
  phalanx-slave imu --name imu --rig wrist --imu synthetic --bind 127.0.0.1 --key-file rig.key
        waits for the master's start, then sends one sealed datagram per sample: that of the simulated hand; with
        cameras in other processes, all with the same --scene, --seed and --scene-epoch-ns
  phalanx-slave imu --list
        says which serial ports and I2C buses there are, then ends
  phalanx-slave imu --name imu --rig wrist --imu ximu3:/dev/serial/by-id/PORT --key-file rig.key
        an x-IMU3 on USB; on the pins of a Pi: ximu3:/dev/serial0@115200; docs/imu.md says what is set and checked
  phalanx-slave imu --name imu --rig wrist --imu lsm6dsox:1:0x6a --key-file rig.key
        an LSM6DSOX on I2C bus 1 of a Pi
""",
    ),
    "tracker": (
        "send where a Vive tracker is",
        """\
  phalanx-slave tracker tracker --rig desk-tracker --device openvr --key-file rig.key
        by SteamVR on this PC: needs the extra `vive` and SteamVR running; docs/tracker.md
  phalanx-slave tracker tracker --rig desk-tracker --device survive --serial LHR-1A2B3C4D --key-file rig.key
        by libsurvive: starts survive-cli and reads its lines
  phalanx-slave tracker tracker --rig desk-tracker --device survive:walk.rec.gz --key-file rig.key
        what survive-cli --record wrote, at its pace
  phalanx-slave tracker tracker --rig desk-tracker --device synthetic --scene object --bind 127.0.0.1 --key-file rig.key
        a tracker on the object of the simulated scene
""",
    ),
    "lights": (
        "budget and test of laser and LEDs",
        """\
  phalanx-slave lights --rig wrist
        what the strobe of a rig may do, and what share of every limit for eyes and supply that is
  phalanx-slave lights --rig wrist --lights gpio:0:17,27 --blink 3
        three seconds of laser and LEDs in turn, as before a camera, within the limits; gpio:0:17/low,27 where low is on
  phalanx-slave lights --rig wrist --lights i2c:1:0x63 --off
        dark, whatever was before: for a service that ends the slave by force
""",
    ),
    "record": (
        "raw frames to disk",
        """\
  phalanx-slave record --name left --rig desk --camera synthetic --seconds 10 -o recordings/wave-left
        without master or network; one folder per camera
  phalanx-slave record --name wrist --rig wrist --camera synthetic --imu ximu3:/dev/ttyACM0 --seconds 10 -o out
        the rig's IMU beside the camera, as imu.csv on the clock of the frames
""",
    ),
    "join": (
        "one recording of several cameras",
        """\
  phalanx-slave join recordings/wave-left recordings/wave-right -o recordings/wave
        one recording of all cameras, for `phalanx replay` and the calibrations
  phalanx-slave join recordings/grasp-left recordings/grasp-right recordings/grasp-wrist -o recordings/grasp
        of marker cameras and a wrist device: one of kind both
""",
    ),
    "detect": (
        "detect in a recording",
        """\
  phalanx-slave detect recordings/wave --camera left --calibration calib_json -o detections_left.npz
        offline: every frame of one camera, the same bytes on every run; of a rig whose objects have tags those, too:
        tags_left.npz beside it
  phalanx-slave detect recordings/curl --camera wrist --calibration calib_json -o detections_wrist.npz
        of a wrist device: laser points and fingertips of every strobed triple; the hand is DIR/hands/RIG'S HAND.json
""",
    ),
    "install": (install.PURPOSE, install.EXAMPLES),
    "doctor": (
        "what of this device is well, and what is not",
        """\
  sudo phalanx-slave doctor
        on a device with a service: machine, clock, libraries, keys, devices, camera, service, and whether its master
        is heard; each line ok, warn or fail, with what mends it; exit 1 where something fails
  phalanx-slave doctor --name left --rig desk --camera v4l2 --calibration calib_json --keys keys --master pc.local
        before it is installed; as root it sees the keys, as another user the rest
  phalanx-slave doctor --json
        the same for programs; docs/doctor.md
""",
    ),
    "colours": (
        "colours of the markers",
        """\
  phalanx-slave colours recordings/paints --camera left -o calib_json/cameras/left.json
        HSV ranges from one click per marker, or, without clicks, from a few seconds of the moving hand;
        prints what collides with what
  phalanx-slave colours recordings/paints --camera right --like calib_json/cameras/left.json -o right.json
        the same, the names taken from a camera file that has them
""",
    ),
}
CAMERAS = f"{real.CAMERAS} | synthetic | replay:FOLDER"
BEACON_PORT = 47800
BOTH = "grasp | both-poses | both-curl | both-travel | both-moves | gestures"  # the same motion for both kinds of rig


def parser() -> argparse.ArgumentParser:
    """The parser of `phalanx-slave`; the command is in `command`."""
    whole = argparse.ArgumentParser(
        "phalanx-slave",
        description=ABOUT,
        epilog="`phalanx-slave COMMAND --help` shows its examples.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = whole.add_subparsers(dest="command", required=True, metavar="COMMAND")
    fill = {
        "run": _run,
        "imu": _imu,
        "tracker": _tracker,
        "lights": _lights,
        "record": _record,
        "join": _join,
        "detect": _detect,
        "install": install.add_install,
        "doctor": _doctor,
        "colours": _colours,
    }
    for name, add_options in fill.items():
        purpose, examples = HELP[name]
        command = commands.add_parser(
            name,
            help=purpose,
            epilog=f"examples:\n{examples}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        add_options(command)
    return whole


def _run(run: argparse.ArgumentParser) -> None:
    _camera(run)
    _link(run)
    run.add_argument(
        "--faults",
        type=Path,
        metavar="FILE",
        help="of a synthetic camera: what is wrong with it, JSON, read again whenever it changes (docs/checklist.md)",
    )
    run.add_argument(
        "--colours",
        choices=("follow", "fixed", "none"),
        default="follow",
        help="whether the colours of markers follow changes of the light (default: %(default)s; docs/light.md); none: "
        "detect nothing, while the lens or the place of a camera is calibrated",
    )
    run.add_argument(
        "--engine",
        choices=("numpy", "numba"),
        default="numpy",
        help="what detects markers, or fingers before a wrist device: numba is several times faster, needs the extra "
        "`fast` (default: %(default)s)",
    )
    run.add_argument(
        "--raw-folder",
        type=Path,
        metavar="DIR",
        help="keep raw frames there, lossless, while it tracks, when `phalanx-master record FILE --raw` asks for them: "
        "a new folder each time (docs/recording.md)",
    )
    run.add_argument(
        "--raw-reserve-mb",
        type=_megabytes,
        default=200.0,
        metavar="MB",
        help="stay free on its disk (default: %(default)g)",
    )


def _imu(imu: argparse.ArgumentParser) -> None:
    _place(imu, "IMU of this slave, that of the rig")
    opening.add_options(imu)
    _link(imu)
    _simulated(imu.add_argument_group("synthetic IMU").add_argument)


def _tracker(tracker: argparse.ArgumentParser) -> None:
    tracker.add_argument("name", metavar="NAME", help="the `tracker` of an object of the rig")
    tracker.add_argument("--rig", default="desk", help="rig, a file in DIR/rigs (default: %(default)s)")
    tracker.add_argument("--calibration", type=Path, default=Path("calib_json"), metavar="DIR")
    trackers.add_options(tracker)
    _link(tracker)
    _simulated(tracker.add_argument_group("synthetic tracker").add_argument)


def _lights(lights: argparse.ArgumentParser) -> None:
    lights.add_argument(
        "--rig", default="wrist", help="rig, a file in DIR/rigs, with the key strobe (default: %(default)s)"
    )
    lights.add_argument("--calibration", type=Path, default=Path("calib_json"), metavar="DIR")
    lights.add_argument("--lights", metavar="DRIVER", help=SWITCHED)
    act = lights.add_mutually_exclusive_group()
    act.add_argument(
        "--blink", type=_positive, metavar="S", help="laser and LEDs in turn, for so many seconds"
    )
    act.add_argument("--off", action="store_true", help="switch both off")


def _record(record: argparse.ArgumentParser) -> None:
    _camera(record)
    record.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FOLDER", help="new or empty; one per camera"
    )
    record.add_argument("--seconds", type=_positive, metavar="S", help="default: until Ctrl-C")
    record.add_argument("--frames", type=_count, metavar="N", help="end after so many recorded frames")
    record.add_argument(
        "--imu",
        nargs="?",
        const="synthetic",
        metavar="DRIVER",
        help=f"what the rig's IMU says, too, as imu.csv: {opening.REAL}; without a driver, that of a synthetic camera",
    )
    record.add_argument(
        "--every-frame",
        action="store_true",
        help="a synthetic camera does not keep time but draws every frame, however long that takes; all cameras of one "
        "scene need the same --scene-epoch-ns",
    )
    record.add_argument("--note", default="", metavar="TEXT", help="kept in recording.json")
    record.add_argument(
        "--reserve-mb", type=_megabytes, default=200.0, metavar="MB", help="stay free (default: %(default)g)"
    )
    record.add_argument(
        "--queue-mb", type=_megabytes, default=128.0, metavar="MB", help="may wait (default: %(default)g)"
    )


def _join(join: argparse.ArgumentParser) -> None:
    join.add_argument("recordings", type=Path, nargs="+", metavar="RECORDING", help="one folder per camera")
    join.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER", help="new or empty")
    join.add_argument(
        "--by-wall-clock",
        action="store_true",
        help="recorded on several machines: trust their wall clocks (keep them together by NTP or PTP)",
    )


def _detect(detect: argparse.ArgumentParser) -> None:
    detect.add_argument(
        "recording", type=Path, metavar="RECORDING", help="folder with recording.json, frames.csv"
    )
    detect.add_argument("--camera", required=True, metavar="NAME")
    detect.add_argument(
        "--calibration",
        type=Path,
        metavar="DIR",
        help="its cameras/NAME.json gives the colours; for a wrist device its hands/ the hand",
    )
    detect.add_argument("--hand", type=Path, metavar="FILE", help="hand profile, for a wrist device")
    detect.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="detections_NAME.npz"
    )


def _doctor(command: argparse.ArgumentParser) -> None:
    doctor.add_options(command, BEACON_PORT)


def _colours(colours: argparse.ArgumentParser) -> None:
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


def _camera(command: argparse.ArgumentParser) -> None:
    """All that opening a camera asks for."""
    _place(command, "camera of this slave, a member of the rig")
    command.add_argument("--camera", required=True, metavar="DRIVER", help=CAMERAS)
    command.add_argument(
        "--lights",
        metavar="DRIVER",
        help=f"who switches laser and LEDs of a wrist device: {CHOICES} (docs/safety.md); the last two: the camera's "
        "own strobe output, or another controller. Before a synthetic camera synthetic (default) or camera",
    )
    real.add_options(command)
    sim = command.add_argument_group("synthetic camera")
    _simulated(sim.add_argument)
    sim.add_argument(
        "--start-offset-ms", type=_number, default=0.0, metavar="Z", help="its frames come later"
    )


def _place(command: argparse.ArgumentParser, who: str) -> None:
    """Who this slave is, and whose."""
    command.add_argument("--name", required=True, help=who)
    command.add_argument("--rig", default="desk", help="rig, a file in DIR/rigs (default: %(default)s)")
    command.add_argument("--calibration", type=Path, default=Path("calib_json"), metavar="DIR")


def _link(command: argparse.ArgumentParser) -> None:
    """How it finds its master."""
    command.add_argument(
        "--beacon-port", type=_port, default=BEACON_PORT, metavar="PORT", help="default: %(default)s"
    )
    command.add_argument(
        "--bind", default="0.0.0.0", metavar="ADDRESS", help="own address (default: every network)"
    )
    command.add_argument(
        "--keys",
        type=Path,
        metavar="DIR",
        help="keys folder of this device: rig key and certificate (docs/keys.md); default: environment PHALANX_KEYS",
    )
    command.add_argument(
        "--key-file", type=Path, metavar="FILE", help="rig key alone; default: environment PHALANX_RIG_KEY"
    )
    command.add_argument(
        "--open",
        action="store_true",
        help="join the bus of a master that is not encrypted: only in a closed laboratory; also PHALANX_OPEN=1",
    )


def _simulated(add: Callable[..., argparse.Action]) -> None:
    """Which scene a simulated sensor senses, and by what clock."""
    add(
        "--scene",
        default="standard",
        metavar="NAME",
        help=f"standard | lights | poses | hand-routine | object | leap:FILE.npz | {BOTH} | board; before a "
        f"wrist device standard | curl | wearer | poses | spread | {BOTH}, each with @dark | @indoor | @bright | @sun, "
        "or board",
    )
    add("--seed", type=int, default=7)
    add(
        "--truth",
        type=Path,
        metavar="DIR",
        help="calib_json tree that says how the simulated world is: lenses, places, paints, hand; this slave goes on "
        "believing --calibration, where they may be unknown (default: it believes the truth)",
    )
    add("--truth-rig", metavar="NAME", help="the rig in it, a file in DIR/rigs (default: of the same name)")
    add("--scene-epoch-ns", type=int, metavar="N", help="CLOCK_MONOTONIC at scene time 0; default: now")
    add("--clock-offset-ms", type=_number, default=0.0, metavar="X", help="this machine's clock is ahead")
    add("--clock-ppm", type=_number, default=0.0, metavar="Y", help="and gains on the true one")


def _positive(text: str) -> float:
    value = _number(text)
    if not 0.0 < value:
        raise argparse.ArgumentTypeError(f"{text}: must be positive")
    return value


def _port(text: str) -> int:
    if not text.isdecimal() or not 0 < int(text) < 65536:
        raise argparse.ArgumentTypeError(f"{text}: must be a port, 1 to 65535")
    return int(text)


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text}: must be a whole number, at least 1")
    return int(text)


def _megabytes(text: str) -> float:
    value = _number(text)
    if not 0.0 <= value:
        raise argparse.ArgumentTypeError(f"{text}: must not be negative")
    return value


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError as error:  # argparse would tell the name of the function
        raise argparse.ArgumentTypeError(f"{text}: must be a number") from error
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text}: must be a finite number")
    return value
