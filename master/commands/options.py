"""Options that several commands of the master share, and what their texts mean.

`--keys` and `--open` set their environment variables: programs that a command starts by itself, such as the
recorder, or what the console's page begins, belong to the same rig.
"""

import argparse
import os
import re
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from common.command_line import Number, number
from common.errors import PhalanxError

CALIB_JSON = Path("calib_json")
HERE_BEACON, HERE_BIND = "127.255.255.255:47800", "127.0.0.1:47801"
HERE_BUS = "here"  # of this machine; encrypted where there are keys
_KEYS, _OPEN, _RIG_KEY = "PHALANX_KEYS", "PHALANX_OPEN", "PHALANX_RIG_KEY"
_SITE = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}")


def add_text(command: ArgumentParser, name: str, metavar: str, text: str, **how: Any) -> None:
    """An option or argument; its help is `text`, and its default if it has one."""
    usual = "" if how.get("default") in (None, []) else " (default: %(default)s)"
    command.add_argument(name, metavar=metavar, help=text + usual, **how)


def add_names(command: ArgumentParser, name: str, metavar: str, text: str, **how: Any) -> None:
    """An option that is given once for each name, as `add_text`."""
    add_text(command, name, metavar, text, action="append", default=[], **how)


def add_path(command: ArgumentParser, name: str, metavar: str, text: str, **how: Any) -> None:
    """A file or folder, as `add_text`."""
    add_text(command, name, metavar, text, type=Path, **how)


def add_number(
    command: ArgumentParser, name: str, metavar: str, text: str, bounds: Number | None = None, **how: Any
) -> None:
    """A number within `bounds`, as `add_text`."""
    add_text(command, name, metavar, text, type=bounds or number(), **how)


def add_choice(
    command: ArgumentParser, name: str, choices: tuple[str, ...], text: str, default: str | None = None
) -> None:
    """One of some words, as `add_text`."""
    usual = "" if default is None else " (default: %(default)s)"
    command.add_argument(name, choices=choices, help=text + usual, default=default)


def add_flag(command: ArgumentParser, name: str, text: str, **how: Any) -> None:
    """A switch, off without it."""
    command.add_argument(name, action="store_true", help=text, **how)


def add_rigs(command: ArgumentParser) -> None:
    """Rigs that run together; `rigs_of` gives them."""
    text = "a file of CALIBRATION/rigs, without .json; once for each that runs (default: desk)"
    add_text(command, "--rig", "NAME", text, action="append")


def rigs_of(options: Namespace) -> list[str]:
    """The rigs of `add_rigs`."""
    return options.rig or ["desk"]


def add_rig(command: ArgumentParser) -> None:
    """One rig."""
    add_text(command, "--rig", "NAME", "a file of CALIBRATION/rigs, without .json", default="desk")


def add_recording_rig(command: ArgumentParser) -> None:
    """The rig of a recording."""
    add_text(command, "--rig", "NAME", "a file of CALIBRATION/rigs (default: the recording's own rig)")


def add_calibration(command: ArgumentParser, folders: str = "rigs/, cameras/ and hands/") -> None:
    """The calib_json tree."""
    add_path(command, "--calibration", "DIR", f"folder with {folders}", default=CALIB_JSON)


def add_hand(command: ArgumentParser) -> None:
    """The hand profile."""
    add_path(command, "--hand", "FILE", "hand profile (default: the one that the rig names)")


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
    text = "which site is read, where --bus is a router of several (docs/scale.md)"
    add_text(command, "--site", "NAME", text, type=site_name)


def add_link(command: ArgumentParser) -> None:
    """Where slaves receive the start, where their datagrams arrive, and by which key."""
    add_text(command, "--beacon", "ADDRESS:PORT", "where slaves listen for the start", default=HERE_BEACON)
    add_text(command, "--bind", "ADDRESS:PORT", "own address for the data datagrams", default=HERE_BIND)
    text = f"file of the rig key alone (default: {_RIG_KEY}, then --keys)"
    add_path(command, "--key-file", "FILE", text)


def add_out(command: ArgumentParser) -> None:
    """The tree of the results."""
    add_path(command, "--out", "DIR", "tree to write the files into; may be the one in use")


def add_json(command: ArgumentParser) -> None:
    """A file for the numbers."""
    add_path(command, "--json", "FILE", "write the numbers to this file", dest="json_file")


def add_picture(command: ArgumentParser, what: str) -> None:
    """A file for a picture of `what`."""
    add_path(command, "--picture", "FILE", f"draw {what} in this .png")


def add_results(command: ArgumentParser, drawn: str) -> None:
    """Options of a calibration: files, numbers, and a picture of what is `drawn`."""
    add_out(command)
    add_json(command)
    add_picture(command, drawn)


def add_joints(command: ArgumentParser) -> None:
    """Names of joints in a motion capture."""
    text = 'JSON of names in a motion capture: {"index-finger-tip": "NAME", ...}, null: not there'
    add_path(command, "--joints", "FILE", text)


def add_span(command: ArgumentParser, whole: str, end: str) -> None:
    """Options that select a part of `whole`; the option `end` gives where it ends."""
    add_number(command, "--from", "S", f"begin S seconds after the beginning{whole}", dest="from_s")
    add_number(command, end, "S", f"end S seconds after the beginning{whole}", dest="to_s")


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
        folder = Path(str(values))
        if not folder.is_dir():
            raise PhalanxError(
                f"--keys {folder}: no such folder; make it: phalanx fleet keys {folder} --make"
            )
        os.environ[_KEYS] = str(folder.resolve())
        os.environ.pop(_RIG_KEY, None)  # the last setting counts


class _UseOpen(argparse.Action):
    def __call__(self, _parser: ArgumentParser, _namespace: Namespace, *_: object) -> None:
        os.environ[_OPEN] = "1"
