"""`phalanx send`: the live outputs as one process beside a running master."""

from argparse import Namespace

from common.bus.zenoh_bus import ZenohBus
from common.errors import BusError
from common.terminal import echo
from master.outputs.network.sender import NAME, refuse_unknown, run_sender, settings_of
from master.run.master_bus import bus_of_master
from master.run.stopping import stop_on_signals


def send(options: Namespace) -> None:
    """Send hands, objects, contact and gestures to other programs.

    OSC, VMC, ROS 2, LSL, WebSocket.
    """
    path = options.calibration / "outputs" / f"{options.outputs}.json"
    settings = settings_of(path)
    names = [] if options.only is None else [name.strip() for name in options.only.split(",") if name.strip()]
    refuse_unknown(names)  # now, not when a master is there
    stop = stop_on_signals()
    connection = bus_of_master(
        options.bus, stop, lambda error: _print(f"waiting for a master: {error}"), options.site
    )
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
            f"{NAME!r} is on the bus already: another `phalanx send` runs beside this master;"
            " switch its outputs in its settings file, or end it"
        )


def _print(line: str) -> None:
    echo(f"outputs: {line}")
