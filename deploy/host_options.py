"""What the options of `phalanx fleet deploy`, `rollback` and `uninstall` mean."""

import argparse
import socket

from deploy.checks import check_reach, check_wish
from deploy.deployment import Reached, reach_of
from deploy.one_host import Wish
from deploy.sender_check import Ears
from deploy.targets import DeployError, RigFile, read_rig

_EVERYWHERE = "255.255.255.255"  # of the network that --master is in


def rig_of(options: argparse.Namespace) -> RigFile:
    """Return the rig, which must have the requested role.

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
    """Return how first datagrams are received.

    Here, or at the master of another machine.
    """
    if options.no_wait:
        return None
    address = _here(options.master)
    bus_host = "127.0.0.1" if address else options.master
    words = ["--rig", options.rig, "--calibration", str(options.calibration)]
    beacon_port, data_port, bus_port = 47800, 47801, 47802
    words += ["--bus", options.bus or f"tls/{bus_host}:{bus_port}"]
    words += ["--bind", options.bind or f"{address or '0.0.0.0'}:{data_port}"]
    default = "127.255.255.255" if (address or "").startswith("127.") else _EVERYWHERE
    words += ["--beacon", options.beacon or f"{default}:{beacon_port}"]
    return Ears(tuple(words), options.keys, options.wait_s)


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
