"""Options of `phalanx demo` and of the remote fleet commands."""

import argparse
import os
from argparse import ArgumentParser
from pathlib import Path

from deploy.deployment import WAIT_SENDERS_S


def add_demo(demo: ArgumentParser) -> None:
    """Start a complete synthetic system: slaves, one master and the viewer.

    A slave with a synthetic camera for each camera of the rigs, one for each IMU and tracker, one master for all of
    them and the viewer.

    Examples:
      phalanx demo                                  two simulated cameras and the master, in the Rerun viewer
      phalanx demo --console --seconds 600          the console in a browser instead: watch, tune and record the demo
      phalanx demo --headless --seconds 60          without a screen: a picture, an .rrd and the figures
      phalanx demo --wrist                          a simulated wrist device in their place: laser, LEDs, camera, IMU
      phalanx demo --scene grasp                    both at once; a hand closes round a bar: cameras lose its fingers
      phalanx demo --scene grasp --rig desk-back3   the same without the wrist device, to compare
      phalanx demo --scene object                   a wand of painted beads travels before the cameras
      phalanx demo --scene grasp --rig desk-cube    the bar has a cube of tags: where it is, and which fingers touch it
      phalanx demo --scene gestures --seconds 80 --bus tcp/127.0.0.1:47802
                                                    pinches, dials, taps and pointing, against the gestures really made
    """
    view = demo.add_mutually_exclusive_group()
    view.add_argument(
        "--headless", action="store_true", help="no viewer; hand.png and run.rrd are always written"
    )
    view.add_argument("--web", action="store_true", help="the viewer as a page on 127.0.0.1, not a window")
    view.add_argument(
        "--console",
        action="store_true",
        help="the console in the viewer's place: its address is printed, open it in a browser",
    )
    demo.add_argument(
        "--seconds", type=_seconds, default=30.0, metavar="N", help="length (default: %(default)s)"
    )
    demo.add_argument("--json", type=Path, metavar="FILE", help="write the summary to FILE as well")
    demo.add_argument(
        "--out", type=Path, default=Path("out/demo"), metavar="DIR", help="results (default: %(default)s)"
    )
    _add_calibration(demo)
    _add_scene(demo)


def _add_scene(demo: ArgumentParser) -> None:
    """What is simulated, and where it can be read."""
    rig = demo.add_mutually_exclusive_group()
    rig.add_argument(
        "--rig",
        dest="rigs",
        action="append",
        metavar="NAME",
        help="once for each that runs; default: desk, for scenes of both kinds desk-back3 (three markers on the back "
        "determine how the palm lies) and wrist-back3 of the same hand, for object desk-wand, for gestures desk4, "
        "for two hands (--scene hands) desk-both; "
        "desk-fabrik is desk with the card's line alone; desk-cube and desk-tracker track objects, too; "
        "--rig desk --rig wrist has one hand",
    )
    rig.add_argument(
        "--wrist", dest="rigs", action="store_const", const=["wrist"], help="the wrist device: --rig wrist"
    )
    demo.add_argument(
        "--bus",
        metavar="ENDPOINT",
        help="where other programs of this machine can read along, as tcp/127.0.0.1:47802 (default: any free port, "
        "encrypted)",
    )
    demo.add_argument("--seed", type=int, default=7, help="of the scene (default: %(default)s)")
    demo.add_argument(
        "--scene",
        default="standard",
        help="standard, lights (it changes), poses, hand-routine (of calibrate hand), object (that is tracked, on its "
        "way), or leap:FILE.npz; of a wrist device "
        "standard, curl, subject, poses, spread or random; of both kinds of rig at once grasp, gestures, both-poses, "
        "both-curl, both-travel or both-moves; the last two kinds each with @dark, @indoor, @bright or @sun",
    )


def add_deploy(deploy: ArgumentParser) -> None:
    """Install a slave for each camera as a service of its machine.

    Waits until it streams, and goes back to what was before where it does not. Needs ssh and rsync here, ssh, Python
    3.11 and systemd there.

    Examples:
      phalanx fleet deploy pi-left.local pi-right.local --master 192.168.1.2
            the cameras of rig desk in their order: left, then right; the second run changes nothing
      phalanx fleet deploy left=pi@10.0.0.11 right=pi@10.0.0.12 --master 10.0.0.2 --options 'left=--sync server' \\
          --options 'right=--sync client'
            who is who by name, and with options of `phalanx-slave run`
      phalanx fleet deploy left+right=cm5.local --master 10.0.0.2 --camera left=picamera2:0 --camera right=picamera2:1
            two cameras of one machine
      phalanx fleet deploy pi-wrist.local --rig wrist --imu lsm6dsox:1:0x6a --lights gpio:0:17,27 --master 10.0.0.2
            a wrist device: its camera and its IMU
      phalanx fleet deploy pi-left.local pi-right.local --master 192.168.1.2 --dry-run
            what would be done; nothing is written, here or there
    """
    deploy.add_argument(
        "hosts",
        nargs="+",
        metavar="[NAME=]HOST",
        help="by ssh; NAME is a camera of the rig, NAME+NAME several (default: cameras in the order of the rig; its "
        "IMU goes with its first camera)",
    )
    deploy.add_argument("--master", required=True, metavar="HOST", help="this PC, as the machines reach it")
    deploy.add_argument("--rig", default="desk", help="a file of DIR/rigs (default: %(default)s)")
    deploy.add_argument("--role", choices=("camera", "wrist"), help="checked against the rig, if given")
    overlay = "dtoverlay in config.txt, for cameras that a Raspberry Pi does not find by itself"
    for name, metavar, what in (
        ("camera", "[NAME=]DRIVER", "as `phalanx-slave run --camera` has it (default: picamera2)"),
        ("options", "[NAME=]TEXT", "more options of `phalanx-slave run`, of NAME or of all"),
        ("overlay", "NAME", overlay),
    ):
        deploy.add_argument(f"--{name}", action="append", default=[], metavar=metavar, help=what)
    deploy.add_argument("--imu", metavar="DRIVER", help="as `phalanx-slave run --imu` has it")
    deploy.add_argument("--lights", metavar="DRIVER", help="as `phalanx-slave run --lights` has it")
    _add_calibration(deploy)
    keys = Path(os.environ.get("PHALANX_KEYS") or Path.home() / ".config/phalanx/keys")
    text = "keys folder; made if it is missing (default: %(default)s)"
    deploy.add_argument("--keys", type=Path, default=keys, metavar="DIR", help=text)
    deploy.add_argument(
        "--wheelhouse", type=Path, metavar="DIR", help="use these wheels (default: download them)"
    )
    deploy.add_argument("--no-apt", action="store_true", help="install no packages of the system there")
    deploy.add_argument(
        "--no-wait", action="store_true", help="do not wait for datagrams, only until slaves are ready"
    )
    deploy.add_argument("--ready-s", type=float, default=90.0, metavar="S", help=argparse.SUPPRESS)
    deploy.add_argument("--wait-s", type=float, default=WAIT_SENDERS_S, metavar="S", help=argparse.SUPPRESS)
    deploy.add_argument(
        "--beacon", metavar="ADDRESS:PORT", help="where slaves listen for the start (default: broadcast)"
    )
    deploy.add_argument(
        "--bind", metavar="ADDRESS:PORT", help="where datagrams come (default: port 47801 of --master)"
    )
    deploy.add_argument(
        "--bus", metavar="ENDPOINT", help="bus of the master, if it runs (default: that of --master)"
    )
    _reach(deploy)


def add_rollback(rollback: ArgumentParser) -> None:
    """Put machines back to what they had before the last deployment.

    It waits until their slaves are ready again, and removes the release that it left.

    Examples:
      phalanx fleet rollback pi-left.local pi-right.local
            programs, options, keys and calibration as they were before the last deployment that changed something
      phalanx fleet rollback pi-left.local --dry-run
    """
    _add_hosts(rollback)


def add_uninstall(uninstall: ArgumentParser) -> None:
    """Remove slaves from their machines, with all that they brought.

    Examples:
      phalanx fleet uninstall pi-left.local pi-right.local
            services, programs, keys and calibration are gone; what apt brought stays
      phalanx fleet uninstall pi-left.local --dry-run
    """
    _add_hosts(uninstall)


def add_wheels(wheels: ArgumentParser) -> None:
    """Download what a slave needs on another machine, and add Phalanx itself.

    Examples:
      phalanx fleet wheels wheels           for Raspberry Pi OS Trixie; then phalanx-slave install --wheelhouse wheels
      phalanx fleet wheels wheels --python 3.11 --with simplejpeg        for Bookworm, whose own was built for numpy 1
      phalanx fleet deploy HOST --master HOST --wheelhouse wheels           on a PC that has no network then
    """
    wheels.add_argument("folder", type=Path, metavar="DIR", help="new or empty folder for them")
    wheels.add_argument(
        "--machine", choices=("aarch64", "x86_64"), default="aarch64", help="default: %(default)s"
    )
    wheels.add_argument(
        "--python", default="3.13", metavar="VERSION", help="of that machine (default: %(default)s)"
    )
    text = "one package more; once for each"
    wheels.add_argument("--with", dest="more", action="append", default=[], metavar="REQUIREMENT", help=text)


def calibration_tree() -> Path:
    """The calib_json of the working directory, else the one beside the source."""
    here = Path("calib_json")
    return here if here.is_dir() else Path(__file__).resolve().parent.parent / "calib_json"


def _add_calibration(command: ArgumentParser) -> None:
    text = "calib_json tree (default: %(default)s)"
    command.add_argument("--calibration", type=Path, default=calibration_tree(), metavar="DIR", help=text)


def _add_hosts(command: ArgumentParser) -> None:
    command.add_argument("hosts", nargs="+", metavar="HOST", help="by ssh")
    _reach(command)


def _reach(command: ArgumentParser) -> None:
    command.add_argument("--dry-run", action="store_true", help="write nothing, print what would be done")
    text = "longest time for all machines (default: %(default)g)"
    command.add_argument("--deadline", type=_seconds, default=1800.0, metavar="S", help=text)
    command.add_argument("--user", metavar="USER", help="of ssh; root, or one with sudo")
    command.add_argument("--port", type=int, metavar="PORT", help="of ssh")
    command.add_argument("--identity", type=Path, metavar="FILE", help="private key of ssh")
    text = "as `ssh -o` has it; ~/.ssh/config holds, too"
    command.add_argument("--ssh-option", action="append", default=[], metavar="NAME=VALUE", help=text)


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError as error:  # argparse would print the name of the function
        raise argparse.ArgumentTypeError(f"{text}: must be a number") from error
    if not 0.0 < value < 1e6:
        raise argparse.ArgumentTypeError(f"{text}: must be positive")
    return value
