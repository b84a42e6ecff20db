"""Command `phalanx console`: the master in a browser.

The page itself is `master.console`, loaded when it is served.
"""

import os
from argparse import Namespace

from common.bus.keys import ENVIRONMENT, keys_folder, rig_key
from master.commands.options import (
    address,
)
from master.commands.terminal import print_line
from master.run.stopping import stop_on_signals


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
