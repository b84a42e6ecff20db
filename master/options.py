"""Options that several commands of the master share, and what the texts behind them mean."""

import os
import re
from pathlib import Path
from typing import Annotated

import typer

from common.datagram import Address
from common.endpoints import default_bus
from common.errors import PhalanxError

HERE_BUS = "here"  # of this machine; encrypted where there are keys
Rig = Annotated[str, typer.Option(help="Rig: a file of CALIBRATION/rigs, without .json.")]
Rigs = Annotated[
    list[str],
    typer.Option(
        "--rig",
        default_factory=lambda: ["desk"],
        show_default="desk",
        help="Rig: a file of CALIBRATION/rigs, without .json; once for each that runs.",
    ),
]
Calibration = Annotated[Path, typer.Option(help="Folder with rigs/, cameras/ and hands/.")]
KeyFile = Annotated[
    Path | None,
    typer.Option(help="File of the rig key alone; default: PHALANX_RIG_KEY, then --keys."),
]
MessageFile = Annotated[Path, typer.Argument(metavar="FILE.mcap", help="The recording.")]


def _bus(text: str) -> str:
    """What `--bus` says; said nothing, the bus of this machine."""
    return default_bus(os.environ) if text == HERE_BUS else text


BusEnd = Annotated[
    str,
    typer.Option(
        "--bus",
        help="Endpoint of the bus; tls/ needs keys, docs/keys.md.",
        show_default="tls/127.0.0.1:47802 where there are keys, else tcp/127.0.0.1:47802",
        callback=_bus,
    ),
]
Hand = Annotated[Path | None, typer.Option(help="Hand profile; default: the one the rig names.")]
Beacon = Annotated[str, typer.Option(help="ADDRESS:PORT where slaves listen for the start.")]
RecordingRig = Annotated[
    str | None, typer.Option("--rig", help="Rig of CALIBRATION/rigs; default: the recording's own.")
]
ResultTree = Annotated[
    Path | None, typer.Option("--out", help="Tree to write the files into; may be the one in use.")
]
JointNames = Annotated[
    Path | None,
    typer.Option(
        "--joints",
        metavar="FILE",
        help='JSON of names in a motion capture: {"index-finger-tip": "NAME", ...}, null: not there.',
    ),
]
JsonFile = Annotated[Path | None, typer.Option("--json", help="Write the numbers to this file.")]
Bind = Annotated[str, typer.Option(help="Own ADDRESS:PORT for the data datagrams.")]


def site_name(text: str | None) -> str | None:
    """What `--site` says: a name that can stand in a key of the bus.

    Raises:
        PhalanxError: It is none.
    """
    if text is not None and not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}", text):
        raise PhalanxError(f"--site {text!r}: letters, digits, '_', '.' and '-', at most 63")
    return text


Site = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="Of which site, where --bus is a router of several (docs/scale.md).",
        callback=site_name,
    ),
]
CALIB_JSON = Path("calib_json")
HERE_BEACON, HERE_BIND = "127.255.255.255:47800", "127.0.0.1:47801"


def address(text: str, option: str) -> Address:
    """ADDRESS:PORT as a pair.

    Raises:
        PhalanxError: It is something else.
    """
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit() or int(port) > 65535:
        raise PhalanxError(f"{option} {text!r}: expected ADDRESS:PORT, for example 127.0.0.1:47801")
    return host, int(port)
