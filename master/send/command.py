"""`phalanx-master send`: the live outputs as one process beside a running master."""

from typing import Annotated

import typer

from common.errors import BusError
from common.zenoh_bus import ZenohBus
from master.master_bus import bus_of_master
from master.options import CALIB_JSON, HERE_BUS, BusEnd, Calibration, Site
from master.send.sender import NAME, refuse_unknown, run_sender, settings_of
from master.stopping import stop_on_signals


def send(
    outputs: Annotated[str, typer.Option(help="A file of CALIBRATION/outputs, without .json.")] = "default",
    only: Annotated[
        str | None,
        typer.Option(metavar="NAMES", help="Send to these, by commas, whatever the file has on."),
    ] = None,
    calibration: Calibration = CALIB_JSON,
    bus: BusEnd = HERE_BUS,
    site: Site = None,
) -> None:
    """Send hands, objects, contact and gestures to other programs: OSC, VMC, ROS 2, LSL, WebSocket.

    A process of its own, which may come and go; it waits for the master. The file is followed while it runs.

    Examples:

      phalanx-master send

      phalanx-master send --only osc,vmc

      phalanx-master send --outputs stage --keys DIR --bus tls/192.168.1.2:47802
    """
    path = calibration / "outputs" / f"{outputs}.json"
    settings = settings_of(path)
    names = [] if only is None else [name.strip() for name in only.split(",") if name.strip()]
    refuse_unknown(names)  # now, not when a master is there
    stop = stop_on_signals()
    connection = bus_of_master(bus, stop, lambda error: _print(f"waiting for a master: {error}"), site)
    if connection is None:
        return
    try:
        _refuse_second(connection)
        run_sender(connection, settings, path, names, stop, _print)
    finally:
        connection.close()


def _refuse_second(connection: ZenohBus) -> None:
    """Two would send everything twice, and answer each other's commands.

    Raises:
        BusError: One is there.
    """
    if NAME in connection.alive():
        raise BusError(
            f"{NAME!r} is on the bus already: another `phalanx-master send` runs beside this master;"
            " switch its outputs in its settings file, or end it"
        )


def _print(line: str) -> None:
    typer.echo(f"outputs: {line}")
