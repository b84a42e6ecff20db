"""Options of several commands: rig, link, camera, simulated world."""

from argparse import ArgumentParser
from collections.abc import Callable
from pathlib import Path

from common.option_types import number, port
from slave.drivers import LIGHTS

BEACON_PORT = 47800
BOTH = "grasp | both-poses | both-curl | both-travel | both-moves | gestures"  # the same motion for both kinds of rig
_finite = number()


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
    link("--beacon-port", type=port, default=BEACON_PORT, metavar="PORT", help="default: %(default)s")
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
    pi(
        "--sync",
        choices=("off", "server", "client"),
        default="off",
        help="frames in step with other Pi cameras: one leads, the others follow; start clients first",
    )
    pi(
        "--sync-timeout",
        type=float,
        default=60.0,
        metavar="S",
        help="how long to wait for them (default: %(default)s)",
    )
    usb = command.add_argument_group("USB camera (v4l2)").add_argument
    usb(
        "--control",
        action="append",
        default=[],
        metavar="NAME=N",
        help="fix a control in codes of its maker, for example gain=32; may be repeated",
    )
    usb(
        "--allow-missing",
        action="append",
        default=[],
        metavar="NAME",
        help="exposure | gain | white_balance: the camera lacks this control, and that is known; may be repeated",
    )


def add_simulated(command: ArgumentParser) -> None:
    """Which scene a simulated sensor senses, and by what clock."""
    add: Callable[..., object] = command.add_argument_group("synthetic camera, IMU or tracker").add_argument
    add(
        "--scene",
        default="standard",
        metavar="NAME",
        help=f"standard | lights | poses | hand-routine | object | leap:FILE.npz | {BOTH} | board | card; before a "
        f"wrist device standard | curl | subject | poses | spread | random | {BOTH}, each with @dark | @indoor | "
        "@bright | @sun, or board",
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
    add(
        "--clock-offset-ms",
        type=_finite,
        default=0.0,
        metavar="X",
        help="this machine's clock is ahead (default: %(default)g)",
    )
    add(
        "--clock-ppm",
        type=_finite,
        default=0.0,
        metavar="Y",
        help="and gains on the true one (default: %(default)g)",
    )
    add(
        "--start-offset-ms",
        type=_finite,
        default=0.0,
        metavar="Z",
        help="frames of a synthetic camera come later (default: %(default)g)",
    )
