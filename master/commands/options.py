"""Options that several commands of the master share.

Also what the texts behind them mean.

`--keys` and `--open` mean the same as their environment variables, and set them: programs that a command starts by
itself, such as the recorder, or what the console's page begins, belong to the same rig.
"""

import argparse
import os
import re
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path

from common.command_line import number
from common.errors import PhalanxError

CALIB_JSON = Path("calib_json")
HERE_BEACON, HERE_BIND = "127.255.255.255:47800", "127.0.0.1:47801"
HERE_BUS = "here"  # of this machine; encrypted where there are keys
_KEYS, _OPEN, _RIG_KEY = "PHALANX_KEYS", "PHALANX_OPEN", "PHALANX_RIG_KEY"
_SITE = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}")


def add_rigs(command: ArgumentParser) -> None:
    """Rigs that run together; `rigs_of` gives them."""
    command.add_argument(
        "--rig",
        action="append",
        metavar="NAME",
        help="a file of CALIBRATION/rigs, without .json; once for each that runs (default: desk)",
    )


def rigs_of(options: Namespace) -> list[str]:
    """The rigs of `add_rigs`."""
    return options.rig or ["desk"]


def add_rig(command: ArgumentParser) -> None:
    """One rig."""
    command.add_argument(
        "--rig",
        default="desk",
        metavar="NAME",
        help="a file of CALIBRATION/rigs, without .json (default: %(default)s)",
    )


def add_recording_rig(command: ArgumentParser) -> None:
    """The rig of a recording."""
    command.add_argument(
        "--rig", metavar="NAME", help="a file of CALIBRATION/rigs (default: the recording's own rig)"
    )


def add_calibration(command: ArgumentParser, folders: str = "rigs/, cameras/ and hands/") -> None:
    """The calib_json tree."""
    command.add_argument(
        "--calibration",
        type=Path,
        default=CALIB_JSON,
        metavar="DIR",
        help=f"folder with {folders} (default: %(default)s)",
    )


def add_hand(command: ArgumentParser) -> None:
    """The hand profile."""
    command.add_argument(
        "--hand", type=Path, metavar="FILE", help="hand profile (default: the one that the rig names)"
    )


def add_bus(command: ArgumentParser) -> None:
    """The bus, and the keys that it may need."""
    command.add_argument(
        "--bus",
        type=bus_end,
        default=HERE_BUS,
        metavar="ENDPOINT",
        help="endpoint of the bus; tls/ needs keys, docs/keys.md (default: tls/127.0.0.1:47802 where there are keys, "
        "else tcp/127.0.0.1:47802)",
    )
    add_keys(command)


def add_keys(command: ArgumentParser) -> None:
    """The keys folder, and leave to send plain text."""
    command.add_argument(
        "--keys",
        action=_UseKeys,
        default=argparse.SUPPRESS,
        metavar="DIR",
        help=f"keys folder, docs/keys.md (default: the variable {_KEYS})",
    )
    command.add_argument(
        "--open",
        action=_UseOpen,
        nargs=0,
        default=argparse.SUPPRESS,
        help="let the bus leave this machine as plain text, tcp/, for whoever is in the network: only in a closed "
        f"laboratory; also {_OPEN}=1",
    )


def add_site(command: ArgumentParser) -> None:
    """Which site is read, where the bus is that of a router."""
    command.add_argument(
        "--site",
        type=site_name,
        metavar="NAME",
        help="which site is read, where --bus is a router of several (docs/scale.md)",
    )


def add_link(command: ArgumentParser) -> None:
    """Add the options of the link to the slaves.

    Where slaves receive the start signal, where their datagrams arrive, and by which key these are sealed.
    """
    command.add_argument(
        "--beacon",
        default=HERE_BEACON,
        metavar="ADDRESS:PORT",
        help="where slaves listen for the start (default: %(default)s)",
    )
    command.add_argument(
        "--bind",
        default=HERE_BIND,
        metavar="ADDRESS:PORT",
        help="own address for the data datagrams (default: %(default)s)",
    )
    command.add_argument(
        "--key-file",
        type=Path,
        metavar="FILE",
        help=f"file of the rig key alone (default: {_RIG_KEY}, then --keys)",
    )


def add_out(command: ArgumentParser) -> None:
    """The tree of the results."""
    command.add_argument(
        "--out", type=Path, metavar="DIR", help="tree to write the files into; may be the one in use"
    )


def add_json(command: ArgumentParser) -> None:
    """A file for the numbers."""
    command.add_argument(
        "--json", dest="json_file", type=Path, metavar="FILE", help="write the numbers to this file"
    )


def add_picture(command: ArgumentParser, what: str) -> None:
    """A file for a picture of `what`."""
    command.add_argument("--picture", type=Path, metavar="FILE", help=f"draw {what} in this .png")


def add_joints(command: ArgumentParser) -> None:
    """Names of joints in a motion capture."""
    command.add_argument(
        "--joints",
        type=Path,
        metavar="FILE",
        help='JSON of names in a motion capture: {"index-finger-tip": "NAME", ...}, null: not there',
    )


def add_span(command: ArgumentParser, whole: str, end: str) -> None:
    """Add the options that select a part of `whole`.

    The option `end` gives where the part ends.
    """
    command.add_argument(
        "--from",
        dest="from_s",
        type=number(),
        metavar="S",
        help=f"begin S seconds after the beginning{whole}",
    )
    command.add_argument(
        end, dest="to_s", type=number(), metavar="S", help=f"end S seconds after the beginning{whole}"
    )


def address(text: str, option: str) -> tuple[str, int]:
    """ADDRESS:PORT as a pair.

    Raises:
        PhalanxError: It is something else.
    """
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit() or int(port) > 65535:
        raise PhalanxError(f"{option} {text!r}: expected ADDRESS:PORT, for example 127.0.0.1:47801")
    return host, int(port)


def bus_end(text: str) -> str:
    """The endpoint of `--bus`: as given, else the bus of this machine."""
    if text != HERE_BUS:
        return text
    from common.bus.endpoints import default_bus

    return default_bus(os.environ)


def site_name(text: str) -> str:
    """A name that can stand in a key of the bus.

    Raises:
        PhalanxError: It is none.
    """
    if not _SITE.fullmatch(text):
        raise PhalanxError(f"--site {text!r}: letters, digits, '_', '.' and '-', at most 63")
    return text


class _UseKeys(argparse.Action):
    """Let this process, and those that it starts, use a keys folder."""

    def __call__(
        self, parser: ArgumentParser, _namespace: Namespace, values: str | Sequence[object] | None, *_: object
    ) -> None:
        """Use it.

        Raises:
            PhalanxError: There is no such folder.
        """
        folder = Path(str(values))
        if not folder.is_dir():
            raise PhalanxError(
                f"--keys {folder}: no such folder; make it: phalanx fleet keys {folder} --make"
            )
        os.environ[_KEYS] = str(folder.resolve())
        os.environ.pop(_RIG_KEY, None)  # the last setting counts


class _UseOpen(argparse.Action):
    """Let the bus of this process leave the machine as plain text."""

    def __call__(self, _parser: ArgumentParser, _namespace: Namespace, *_: object) -> None:
        """Allow it."""
        os.environ[_OPEN] = "1"
