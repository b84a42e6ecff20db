"""`phalanx view`: a running master in the Rerun viewer."""

from argparse import Namespace

from master.commands.options import rigs_of
from master.commands.terminal import print_line
from master.rig.files import load_setups
from master.run.master_bus import bus_of_master
from master.run.stopping import stop_on_signals


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
    try:
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
    finally:
        connection.close()
