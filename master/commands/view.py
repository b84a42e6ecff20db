"""`phalanx view` and `phalanx console` show a running master on a screen."""

import os
from argparse import Namespace
from contextlib import closing

from common.bus.keys import ENVIRONMENT, keys_folder, rig_key
from master.commands.options import address, rigs_of
from master.commands.summary import print_line
from master.rig.setup import load_setups
from master.run.process import bus_of_master, stop_on_signals


def view(options: Namespace) -> None:
    """Show a running master in Rerun."""
    from master.outputs.rerun import run_viewer

    setups = load_setups(options.calibration, rigs_of(options), options.hand)
    stop = stop_on_signals()
    connection = bus_of_master(
        options.bus, stop, lambda error: print_line(f"waiting for a master: {error}"), options.site
    )
    if connection is None:
        return
    with closing(connection):
        mode = "save" if options.save is not None else "web" if options.web else "spawn"
        run_viewer(
            connection,
            setups,
            mode=mode,
            path=options.save,
            stop=stop,
            web_port=options.web_port,
            on_ready=print_line,
        )


def console(options: Namespace) -> None:
    """Serve the console: watch, tune, record and set up in a browser."""
    from master.console.app import run_console
    from master.console.state import ConsoleSettings
    from master.outputs.web.listening import is_open

    address(options.beacon, "--beacon")
    address(options.bind, "--bind")
    known = options.key_file is not None or ENVIRONMENT in os.environ or keys_folder(os.environ) is not None
    key = rig_key(os.environ, options.key_file) if known else None
    settings = ConsoleSettings(
        options.calibration,
        tuple(options.rig or ()),
        options.bus,
        options.beacon,
        options.bind,
        key,
        options.port,
        options.host,
        options.password_file,
        is_open(os.environ),
    )
    run_console(settings, stop_on_signals(), print_line)
