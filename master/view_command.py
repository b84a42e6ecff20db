"""`phalanx view`: a running master in the Rerun viewer."""

from argparse import Namespace

from master.master_bus import bus_of_master
from master.options import rigs_of
from master.rig import load_setups
from master.stopping import stop_on_signals
from master.terminal import print_line


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
