"""`phalanx-master view`: a running master in the Rerun viewer."""

from pathlib import Path
from typing import Annotated

import typer

from master.master_bus import bus_of_master
from master.options import CALIB_JSON, HERE_BUS, BusEnd, Calibration, Hand, Rigs, Site
from master.rig import load_setups
from master.stopping import stop_on_signals
from master.terminal import print_line


def view(
    rig: Rigs,
    calibration: Calibration = CALIB_JSON,
    hand: Hand = None,
    bus: BusEnd = HERE_BUS,
    site: Site = None,
    web: Annotated[
        bool, typer.Option(help="Serve the viewer to a browser on 127.0.0.1 instead of a window.")
    ] = False,
    web_port: Annotated[int, typer.Option(min=1, max=65535, help="TCP port of that page.")] = 9090,
    save: Annotated[Path | None, typer.Option(help="Write an .rrd instead of showing anything.")] = None,
) -> None:
    """Show a running master in Rerun. A process of its own, which may come and go; it waits for the master.

    Examples:

      phalanx-master view --rig desk

      phalanx-master view --rig desk --rig wrist

      phalanx-master view --rig desk --keys DIR --bus tls/192.168.1.2:47802 --web

      phalanx-master view --rig desk --keys DIR --bus tls/192.168.2.1:47810 --site room-a
    """
    from master.outputs.rerun import run_viewer

    setups = load_setups(calibration, rig, hand)
    stop = stop_on_signals()
    connection = bus_of_master(bus, stop, lambda error: print_line(f"waiting for a master: {error}"), site)
    if connection is None:
        return
    try:
        mode = "save" if save is not None else "web" if web else "spawn"
        run_viewer(
            connection,
            setups,
            mode=mode,
            path=save,
            stop=stop,
            web_port=web_port,
            on_ready=print_line,
        )
    finally:
        connection.close()
