"""Options of `phalanx deploy`, `rollback`, `uninstall`, `fleet` and `wheels`, and what they mean."""

import argparse
import socket
from collections.abc import Callable
from pathlib import Path

from deploy.checks import check_reach, check_wish, default_keys
from deploy.deployment import Reached, reach_of
from deploy.one_host import Wish
from deploy.sender_check import WAIT_SENDERS_S, Ears
from deploy.targets import DeployError, RigFile, read_rig

_DEADLINE_S = 900.0
_READY_S = 90.0
BEACON_PORT, DATA_PORT, BUS_PORT = 47800, 47801, 47802
AddParser = Callable[..., argparse.ArgumentParser]  # of the command line
_EVERYWHERE = "255.255.255.255"  # of the network that --master is in

_DEPLOY_EXAMPLES = """examples:
  phalanx deploy pi-left.local pi-right.local --master 192.168.1.2
        the cameras of rig desk in their order: left, then right; the second run changes nothing
  phalanx deploy left=pi@10.0.0.11 right=pi@10.0.0.12 --master 10.0.0.2 --options 'left=--sync server' \\
      --options 'right=--sync client'
        who is who by name, and with options of `phalanx-slave run`
  phalanx deploy left+right=cm5.local --master 10.0.0.2 --camera left=picamera2:0 --camera right=picamera2:1
        two cameras of one machine
  phalanx deploy pi-wrist.local --rig wrist --role wrist --imu lsm6dsox:1:0x6a --lights gpio:0:17,27 --master 10.0.0.2
        a wrist device: its camera and its IMU
  phalanx deploy pi-left.local pi-right.local --master 192.168.1.2 --dry-run
        what would be done; nothing is written, here or there
"""
_ROLLBACK_EXAMPLES = """examples:
  phalanx rollback pi-left.local pi-right.local
        programs, options, keys and calibration as they were before the last deployment that changed something
  phalanx rollback pi-left.local --dry-run
"""
_UNINSTALL_EXAMPLES = """examples:
  phalanx uninstall pi-left.local pi-right.local
        services, programs, keys and calibration are gone; what apt brought stays
  phalanx uninstall pi-left.local --dry-run
"""
_WHEELS_EXAMPLES = """examples:
  phalanx wheels wheels                   for Raspberry Pi OS Trixie; then phalanx-slave install --wheelhouse wheels
  phalanx wheels wheels --python 3.11 --with simplejpeg           for Bookworm, whose own was built for numpy 1
  phalanx deploy HOST --master HOST --wheelhouse wheels           on a PC that has no network then
"""
_FLEET_EXAMPLES = """examples:
  phalanx fleet                           once, as a table
  phalanx fleet --watch                   again each second
  phalanx fleet --bus tls/192.168.1.2:47802 --keys ~/.config/phalanx/keys
"""


def add_commands(add_parser: AddParser, calibration: Path) -> None:
    """Add `deploy`, `rollback`, `uninstall`, `fleet` and `wheels`."""
    _add_deploy(add_parser, calibration)
    rollback = _command(
        add_parser,
        "rollback",
        "machines back to what they had before the last deployment",
        "One step back. It waits until what was before is ready; the release that is left is removed.",
        _ROLLBACK_EXAMPLES,
    )
    rollback.add_argument("hosts", nargs="+", metavar="HOST", help="by ssh")
    _reach(rollback)
    uninstall = _command(
        add_parser,
        "uninstall",
        "slaves from their machines again",
        "Leaves nothing of ours there.",
        _UNINSTALL_EXAMPLES,
    )
    uninstall.add_argument("hosts", nargs="+", metavar="HOST", help="by ssh")
    _reach(uninstall)
    _add_fleet(add_parser)
    _add_wheels(add_parser)


def _add_deploy(add_parser: AddParser, calibration: Path) -> None:
    deploy = _command(
        add_parser,
        "deploy",
        "slaves to their machines by ssh",
        "Installs a slave for each camera as a service of its machine, and waits until it streams.\nGoes back to what "
        "was before where it does not. Needs ssh and rsync here, ssh, Python 3.11\nand systemd there.",
        _DEPLOY_EXAMPLES,
    )
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
    for name, metavar, what in (
        ("camera", "[NAME=]DRIVER", "as `phalanx-slave run --camera` has it (default: picamera2)"),
        ("options", "[NAME=]TEXT", "more options of `phalanx-slave run` or `imu`, of NAME or of all"),
        (
            "overlay",
            "NAME",
            "dtoverlay in config.txt, for cameras that a Raspberry Pi does not find by itself",
        ),
    ):
        deploy.add_argument(f"--{name}", action="append", default=[], metavar=metavar, help=what)
    deploy.add_argument("--imu", metavar="DRIVER", help="as `phalanx-slave imu --imu` has it")
    deploy.add_argument("--lights", metavar="DRIVER", help="as `phalanx-slave run --lights` has it")
    deploy.add_argument(
        "--calibration", type=Path, default=calibration, metavar="DIR", help="default: %(default)s"
    )
    _keys(deploy, "keys folder; made if it is missing")
    deploy.add_argument(
        "--wheelhouse", type=Path, metavar="DIR", help="use these wheels (default: download them)"
    )
    deploy.add_argument("--no-apt", action="store_true", help="install no packages of the system there")
    deploy.add_argument(
        "--no-wait", action="store_true", help="do not wait for datagrams, only until slaves are ready"
    )
    deploy.add_argument("--ready-s", type=float, default=_READY_S, metavar="S", help=argparse.SUPPRESS)
    deploy.add_argument("--hear-s", type=float, default=WAIT_SENDERS_S, metavar="S", help=argparse.SUPPRESS)
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


def _add_fleet(add_parser: AddParser) -> None:
    fleet = _command(
        add_parser,
        "fleet",
        "how all machines of a rig are",
        "A row for each camera and IMU that has keys or reports itself: machine, version,\ntemperature, clock, rate.",
        _FLEET_EXAMPLES,
    )
    _keys(fleet, "keys folder")
    fleet.add_argument("--bus", metavar="ENDPOINT", help="of the master (default: of this machine)")
    fleet.add_argument("--watch", action="store_true", help="again each second, until Ctrl-C")
    fleet.add_argument("--json", action="store_true", help="as JSON")


def _add_wheels(add_parser: AddParser) -> None:
    wheels = _command(
        add_parser,
        "wheels",
        "all that a slave needs, as files, for machines without a network",
        "Downloads for another machine what a slave needs, and adds Phalanx itself.",
        _WHEELS_EXAMPLES,
    )
    wheels.add_argument("folder", type=Path, metavar="DIR", help="new or empty")
    wheels.add_argument(
        "--machine", choices=("aarch64", "x86_64"), default="aarch64", help="default: %(default)s"
    )
    wheels.add_argument(
        "--python", default="3.13", metavar="VERSION", help="of that machine (default: %(default)s)"
    )
    wheels.add_argument(
        "--with",
        dest="more",
        action="append",
        default=[],
        metavar="REQUIREMENT",
        help="one more; once for each",
    )


def rig_of(options: argparse.Namespace) -> RigFile:
    """The rig, which has to be of the role that was said.

    Raises:
        DeployError: It is not, or lacks an option.
    """
    rig = read_rig(options.calibration, options.rig)
    if options.role is not None and (options.role == "wrist") != (rig.kind == "wrist"):
        raise DeployError(f"--role {options.role}: rig {rig.name!r} is of kind {rig.kind!r}")
    return rig


def wish_of(options: argparse.Namespace, rig: RigFile) -> Wish:
    """What is wanted on the machines."""
    check_wish(options, rig)
    handed = [
        word
        for name in ("camera", "options", "overlay")
        for one in getattr(options, name)
        for word in (f"--{name}={one}",)
    ]
    handed += [
        f"--{name}={value}"
        for name in ("role", "imu", "lights")
        if (value := getattr(options, name)) is not None
    ]
    return Wish(
        options.master,
        rig,
        options.calibration,
        options.keys,
        tuple(handed),
        tuple(options.camera),
        options.wheelhouse,
        not options.no_apt,
        options.dry_run,
        options.ready_s,
    )


def ears_of(options: argparse.Namespace) -> Ears | None:
    """How first datagrams are heard: here, or at the master of another machine."""
    if options.no_wait:
        return None
    address = _here(options.master)
    bus_host = "127.0.0.1" if address else options.master
    words = ["--rig", options.rig, "--calibration", str(options.calibration)]
    words += ["--bus", options.bus or f"tls/{bus_host}:{BUS_PORT}"]
    words += ["--bind", options.bind or f"{address or '0.0.0.0'}:{DATA_PORT}"]
    default = "127.255.255.255" if (address or "").startswith("127.") else _EVERYWHERE
    words += ["--beacon", options.beacon or f"{default}:{BEACON_PORT}"]
    return Ears(tuple(words), options.keys, options.wait_senders_s)


def reached_of(options: argparse.Namespace) -> Reached:
    """How the machines are reached."""
    check_reach(options)
    return Reached(
        reach_of(options.user, options.port, options.identity, options.ssh_option), options.deadline
    )


def _here(master: str) -> str | None:
    """The address of `--master`, if it is one of this machine's.

    Raises:
        DeployError: The name is not known.
    """
    try:
        address = str(socket.getaddrinfo(master, None, socket.AF_INET)[0][4][0])
    except OSError as error:
        raise DeployError(f"--master {master}: {error.strerror}; give its address") from error
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((address, 0))
        except OSError:
            return None
    return address


def _command(
    add_parser: AddParser,
    name: str,
    brief: str,
    whole: str,
    examples: str,
) -> argparse.ArgumentParser:
    return add_parser(
        name,
        help=brief,
        description=whole,
        epilog=examples,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def _keys(command: argparse.ArgumentParser, what: str) -> None:
    command.add_argument(
        "--keys", type=Path, default=default_keys(), metavar="DIR", help=f"{what} (default: %(default)s)"
    )


def _reach(command: argparse.ArgumentParser) -> None:
    command.add_argument("--dry-run", action="store_true", help="write nothing, say what would be done")
    command.add_argument(
        "--deadline", type=_seconds, default=_DEADLINE_S, metavar="S", help="for all (default: %(default)g)"
    )
    command.add_argument("--user", metavar="USER", help="of ssh; root, or one with passwordless sudo")
    command.add_argument("--port", type=int, metavar="PORT", help="of ssh")
    command.add_argument("--identity", type=Path, metavar="FILE", help="private key of ssh")
    command.add_argument(
        "--ssh-option",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="as `ssh -o` has it; ~/.ssh/config holds, too",
    )


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text}: must be a number") from error
    if not 0.0 < value < 1e6:
        raise argparse.ArgumentTypeError(f"{text}: must be positive")
    return value
