"""`phalanx-master console`: the master in a browser; the page itself is `master.console`, loaded when it is served."""

import os
from pathlib import Path
from typing import Annotated

import typer

from common.keys import ENVIRONMENT, keys_folder, rig_key
from master.options import (
    CALIB_JSON,
    HERE_BEACON,
    HERE_BIND,
    HERE_BUS,
    Beacon,
    Bind,
    BusEnd,
    Calibration,
    KeyFile,
    address,
)
from master.stopping import stop_on_signals
from master.terminal import print_line


def console(
    calibration: Calibration = CALIB_JSON,
    rig: Annotated[
        list[str] | None,
        typer.Option("--rig", help="Rig that runs, once for each; default: desk, once its file is there."),
    ] = None,
    bus: BusEnd = HERE_BUS,
    beacon: Beacon = HERE_BEACON,
    bind: Bind = HERE_BIND,
    key_file: KeyFile = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port of the page; 0: a free one.")] = 8080,
    host: Annotated[
        str,
        typer.Option(
            help="Address to serve on. Elsewhere than on this machine the page asks for a password."
        ),
    ] = "127.0.0.1",
    password_file: Annotated[
        Path | None,
        typer.Option(
            help="Ask for the password in the first line of this file; default: one is made and said once."
        ),
    ] = None,
) -> None:
    """Serve the console: watch, tune, record and set up in a browser. A process of its own, which may come and go.

    Needs no master and no file: the page sets a rig up from nothing. BEACON, BIND and the key are those of the
    processes that the page starts.

    Examples:

      phalanx-master console

      phalanx-master console --rig desk --rig wrist --port 8081

      phalanx-master console --keys DIR --bus tls/192.168.1.2:47802

      phalanx-master console --host 0.0.0.0
    """
    from master.console.app import run_console
    from master.console.state import ConsoleSettings
    from master.listening import is_open

    address(beacon, "--beacon")
    address(bind, "--bind")
    known = key_file is not None or ENVIRONMENT in os.environ or keys_folder(os.environ) is not None
    key = rig_key(os.environ, key_file) if known else None
    settings = ConsoleSettings(
        calibration,
        tuple(rig or ()),
        bus,
        beacon,
        bind,
        key,
        port,
        host,
        password_file,
        is_open(os.environ),
    )
    run_console(settings, stop_on_signals(), print_line)
