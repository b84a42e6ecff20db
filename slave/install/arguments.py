"""Define the arguments of the installer, and the plan that they make.

The plan is which slaves of a rig this machine runs, and how. A slave which only runs loads no other file of the
installer. What does not fit raises `InstallError`.
"""

from __future__ import annotations

import argparse
import json
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, cast


class InstallError(Exception):
    """Not possible: one line, why and what to do. The machine is as it was before."""


class NotReadyError(InstallError):
    """What was installed does not run."""


STATE = "/var/lib/phalanx"  # the unit's StateDirectory
CALIBRATION = f"{STATE}/calib_json"
READY_S, SETTLE_S = 90.0, 2.0
OF_DEVICE = ("pem", "key", "secret")  # endings of the keys of one device
_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
# what an environment file of systemd takes as it stands
_UNQUOTED = re.compile(r"[A-Za-z0-9_@%+=:,./\[\]-]+")
_HOST = re.compile(r"[A-Za-z0-9.:-]+")


@dataclass(frozen=True, slots=True)
class Sender:
    """One process of this machine."""

    name: str  # camera or IMU, as the rig's file calls it
    options: tuple[str, ...]  # of `phalanx-slave run`
    # command of `phalanx-slave` that makes the lights dark after it has ended; empty: it has none
    stop_post: tuple[str, ...] = ()

    @property
    def unit(self) -> str:
        """Its service."""
        return f"phalanx-slave@{self.name}.service"

    @property
    def environment(self) -> str:
        """Text of /etc/phalanx/NAME.env."""
        return (
            "# Written by the installer of Phalanx; `phalanx fleet deploy` writes it again.\n"
            f"PHALANX_OPTIONS={' '.join(self.options)}\n"
            f"PHALANX_STOP_POST={' '.join(self.stop_post)}\n"
        )


@dataclass(frozen=True, slots=True)
class Plan:
    """What is to be on this machine."""

    master: str  # host name or address of the machine whose master it sends to; the clock follows it
    senders: tuple[Sender, ...]
    calibration: Mapping[str, bytes]  # path below calib_json -> content
    # File name -> content: rig.key, ca.pem, device-NAME.pem, .key, .secret. Empty: those that are there stay
    keys: Mapping[str, bytes]
    boot: tuple[str, ...] = ()  # lines of config.txt that are needed
    picamera2: bool = False  # whether a camera is opened by picamera2, which comes by apt


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add what states what a machine is to run, here and in `phalanx fleet deploy`."""
    parser.add_argument(
        "--master", metavar="HOST", help="host name or address of the PC, whose clock is followed"
    )
    parser.add_argument("--rig", default="desk", help="a file in calib_json/rigs (default: %(default)s)")
    parser.add_argument("--role", choices=("camera", "wrist"), help="checked against the rig, if given")
    served = (
        "camera or IMU of the rig that this machine serves; once for each (default: all of the rig, if it has one "
        "camera)"
    )
    more = "more options of `phalanx-slave run`, of NAME or of all: --options 'left=--sync server'"
    overlay = (
        "dtoverlay of the camera in config.txt, for those that a Raspberry Pi does not find by itself: imx296"
    )
    for name, dest, metavar, text in (
        ("--name", "names", "NAME", served),
        (
            "--camera",
            "cameras",
            "[NAME=]DRIVER",
            "as `phalanx-slave run --camera` has it (default: picamera2)",
        ),
        ("--options", "more", "[NAME=]TEXT", more),
        ("--overlay", "overlays", "NAME", overlay),
    ):
        parser.add_argument(name, dest=dest, action="append", default=[], metavar=metavar, help=text)
    parser.add_argument("--imu", metavar="DRIVER", help="as `phalanx-slave run --imu` has it")
    parser.add_argument("--lights", metavar="DRIVER", help="as `phalanx-slave run --lights` has it")


def plan_of(options: argparse.Namespace, calibration: Mapping[str, bytes], keys: Mapping[str, bytes]) -> Plan:
    """What the options ask for.

    `calibration` (path below calib_json -> content) has the whole tree or what the rig needs; `keys` (file name ->
    content) a folder of a PC or of a device.
    """
    if not _HOST.fullmatch(options.master or ""):
        given = f" {options.master}" if options.master else ""
        raise InstallError(f"--master{given}: give the host name or the address of the PC")
    rig = _rig(calibration, options.rig)
    names = tuple(options.names) or _only(rig, options.rig)
    senders = tuple(_sender(name, rig, options) for name in names)
    if len(set(names)) < len(names):
        raise InstallError(f"--name {' --name '.join(names)}: one stands twice")
    everybody = _names(rig)
    drivers = [_of(n, options.cameras, everybody) or "picamera2" for n in names if n in rig["cameras"]]
    return Plan(
        options.master,
        senders,
        _needed(calibration, options.rig, rig),
        _of_device(keys, names),
        _boot(options, drivers),
        any(driver.partition(":")[0] == "picamera2" for driver in drivers),
    )


def _sender(name: str, rig: dict[str, Any], options: argparse.Namespace) -> Sender:
    if not _NAME.fullmatch(name):
        raise InstallError(f"--name {name!r}: letters, digits, - and _ only")
    place = ["--name", name, "--rig", options.rig, "--calibration", CALIBRATION]
    names = _names(rig)  # options given for another machine's camera are not for this one
    more: list[str] = []
    for text in _all_of(name, options.more, names):
        try:
            more += shlex.split(text)
        except ValueError as error:
            raise InstallError(f"--options {text!r}: {error}") from error
    is_wrist = rig.get("kind") == "wrist"
    if options.role is not None and (options.role == "wrist") != is_wrist:
        raise InstallError(f"--role {options.role}: rig {options.rig!r} is one of kind {rig.get('kind')!r}")
    stop_post: list[str] = []
    if name in rig["cameras"]:
        camera = _of(name, options.cameras, names) or "picamera2"
        words = [*place, "--camera", camera]
        if is_wrist and options.lights is not None:
            words += ["--lights", options.lights]
            if options.lights.partition(":")[0] in ("gpio", "i2c"):
                stop_post = ["doctor", "--rig", options.rig, "--calibration", CALIBRATION]
                stop_post += ["--lights", options.lights, "--off"]
        elif is_wrist and not camera.startswith(("synthetic", "replay")):
            raise InstallError(
                f"rig {options.rig!r} is a wrist device: say who switches its lights, --lights DRIVER"
            )
    elif name == (rig.get("imu") or {}).get("name"):
        if options.imu is None:
            raise InstallError(
                f"{name!r} is the IMU of rig {options.rig!r}: say which one it is, --imu DRIVER"
            )
        words = [*place, "--imu", options.imu]
    else:
        there = ", ".join(names)
        raise InstallError(f"rig {options.rig!r} has no camera or IMU {name!r}; it has {there}")
    words += more
    for word in [*words, *stop_post]:
        if not _UNQUOTED.fullmatch(word):
            raise InstallError(f"{word!r}: blanks and quotes cannot be in an option of a service")
    return Sender(name, tuple(words), tuple(stop_post))


def _rig(calibration: Mapping[str, bytes], name: str) -> dict[str, Any]:
    file = f"rigs/{name}.json"
    if file not in calibration:
        there = sorted(path[5:-5] for path in calibration if path.startswith("rigs/"))
        raise InstallError(f"calib_json/{file}: no such rig; there are {', '.join(there) or 'none'}")
    try:
        rig = cast(dict[str, Any], json.loads(calibration[file]))
        _names(rig)
    except (ValueError, RecursionError, KeyError, TypeError, AttributeError) as error:
        raise InstallError(f"calib_json/{file}: cannot read the rig ({error})") from error
    return rig


def _names(rig: dict[str, Any]) -> list[str]:
    imu = cast("dict[str, object]", rig.get("imu") or {}).get("name")
    return [str(name) for name in rig["cameras"]] + ([str(imu)] if imu else [])


def _only(rig: dict[str, Any], name: str) -> tuple[str, ...]:
    if len(rig["cameras"]) > 1:
        raise InstallError(
            f"rig {name!r} has {', '.join(_names(rig))}: say which of them this is, --name NAME"
        )
    return tuple(_names(rig))


def _needed(calibration: Mapping[str, bytes], name: str, rig: dict[str, Any]) -> dict[str, bytes]:
    """The files of this rig and of sensors, and nobody else's hand."""
    files = [f"rigs/{name}.json", *(f"cameras/{camera}.json" for camera in rig["cameras"])]
    files += [f"hands/{rig['hand']}.json"] if rig.get("hand") else []
    files += [f"objects/{one}.json" for one in cast("list[str]", rig.get("objects") or [])]
    files += [name for name in calibration if fnmatch(name, "cameras/*-*x*.json")]
    if missing := [file for file in files if file not in calibration]:
        raise InstallError(f"calib_json/{missing[0]}: missing; rig {name!r} needs it")
    return {file: calibration[file] for file in files}


def wanted_keys(names: Sequence[str]) -> list[str]:
    """The files of keys that a machine of these senders has."""
    return ["rig.key", "ca.pem", *(f"device-{name}.{kind}" for name in names for kind in OF_DEVICE)]


def _of_device(keys: Mapping[str, bytes], names: Sequence[str]) -> dict[str, bytes]:
    """What of a keys folder belongs on this machine, under its names there."""
    if not keys:
        return {}
    found = {name: keys[name] for name in ("rig.key", "ca.pem") if name in keys}
    for name in names:
        for kind in OF_DEVICE:
            theirs = (f"device-{name}.{kind}", f"devices/{name}.{kind}", f"device.{kind}")
            content = next((keys[one] for one in theirs if one in keys), None)
            if content is not None:
                found[f"device-{name}.{kind}"] = content
    if missing := [one for one in wanted_keys(names) if one not in found]:
        raise InstallError(
            f"keys: no {missing[0]}; make them on the PC: phalanx fleet keys DIR --make --device {names[0]}"
        )
    return found


def _boot(options: argparse.Namespace, drivers: Sequence[str]) -> tuple[str, ...]:
    lines: list[str] = []
    if options.overlays:
        lines += ["camera_auto_detect=0", *(f"dtoverlay={one}" for one in options.overlays)]
    elif any(driver.startswith("picamera2") for driver in drivers):
        lines.append("camera_auto_detect=1")
    if any((one or "").startswith(("lsm6dsox", "i2c")) for one in (options.imu, options.lights)):
        lines.append("dtparam=i2c_arm=on")
    if "/dev/serial0" in (options.imu or ""):
        lines.append("enable_uart=1")
    return tuple(lines)


def _of(name: str, texts: Sequence[str], names: Sequence[str]) -> str | None:
    return (_all_of(name, texts, names) or [None])[-1]


def _all_of(name: str, texts: Sequence[str], names: Sequence[str]) -> list[str]:
    pairs = [text.split("=", 1) if text.partition("=")[0] in names else [name, text] for text in texts]
    return [text for whose, text in pairs if whose == name]


def add_install(parser: argparse.ArgumentParser) -> None:
    """Install slaves as services of this machine, each with what it needs; as root.

    Examples:
      sudo phalanx-slave install --master 192.168.1.2 --rig desk --name left --keys keys --calibration calib_json
            on the Raspberry Pi itself, out of an environment that sees the system's packages (docs/deploy.md); keys and
            calib_json are copied from the PC. From the PC, for all machines at once: phalanx fleet deploy
      sudo phalanx-slave install --master 192.168.1.2 --rig wrist --imu lsm6dsox:1 --lights gpio:0:17,27 --keys keys
            a wrist device: its camera and its IMU, each a service
      sudo phalanx-slave install --master 192.168.1.2 --rig desk --name left --dry-run
            only print what would be changed; the keys that are there stay
      sudo phalanx-slave install --rollback
            go back to what was before the last installation
      sudo phalanx-slave install --uninstall
            take everything away again but the packages of apt
    """
    add_options(parser)
    parser.add_argument(
        "--keys", type=Path, metavar="DIR", help="keys folder of the PC; default: those that are there stay"
    )
    parser.add_argument(
        "--calibration", type=Path, default=Path("calib_json"), metavar="DIR", help="default: %(default)s"
    )
    text = "install these wheels (default: what this command runs from)"
    parser.add_argument("--wheelhouse", type=Path, metavar="DIR", help=text)
    parser.add_argument("--no-apt", action="store_true", help="install no packages of the system")
    parser.add_argument("--dry-run", action="store_true", help="write nothing; report what would be changed")
    ends = parser.add_mutually_exclusive_group()
    text = "go back to release, options, keys and calibration as they were before the last installation"
    ends.add_argument("--rollback", action="store_true", help=text)
    ends.add_argument("--uninstall", action="store_true", help="take everything away again")
    text = "until slaves are ready (default: %(default)g)"
    parser.add_argument("--ready-s", type=float, default=READY_S, metavar="S", help=text)
    parser.add_argument("--settle-s", type=float, default=SETTLE_S, help=argparse.SUPPRESS)
    parser.add_argument("--root", type=Path, default=Path("/"), help=argparse.SUPPRESS)
    parser.add_argument("--bundle", type=Path, help=argparse.SUPPRESS)  # keys and calibration, from the PC
    parser.add_argument("--release", help=argparse.SUPPRESS)
    parser.add_argument("--json", action="store_true", help=argparse.SUPPRESS)
