"""`phalanx run`: track live until Ctrl-C.

Or install that as a service of this user.
"""

import os
from argparse import Namespace

from common.bus.certificates import MASTER
from common.bus.endpoints import check, encrypted, port_of
from common.bus.keys import access_of, link_key
from common.command_line import UsageError
from common.errors import BusError
from common.link.datagram import Address
from master.commands.options import address, rigs_of
from master.commands.terminal import print_line
from master.estimator.settings import Settings
from master.rig.files import RigFiles
from master.run.live import LiveSettings, run_live
from master.run.stopping import stop_on_signals


def run(options: Namespace) -> None:
    """Track live until Ctrl-C, or install or remove the service that does."""
    if options.install or options.uninstall:
        from master.commands.install import change_service

        change_service(options)
        return
    if options.dry_run:
        raise UsageError("--dry-run is for --install and --uninstall")
    files = RigFiles(options.calibration, tuple(rigs_of(options)), options.hand, Settings.of(options.changes))
    setups = files.load()
    settings = LiveSettings(
        *checked_ends(options),
        options.bus,
        options.start_timeout_s,
        options.poses,
        options.summary,
        files,
        options.record,
    )
    run_live(setups, link_key(os.environ, options.key_file), settings, stop_on_signals(), print_line)


def checked_ends(options: Namespace) -> tuple[Address, Address]:
    """Where the beacon goes and where datagrams come; the bus is checked as well.

    Raises:
        PhalanxError: One of them is malformed; the bus would leave the machine as plain text, or its keys are missing.
    """
    addresses = address(options.beacon, "--beacon"), address(options.bind, "--bind")
    access = access_of(os.environ, MASTER)
    check(options.bus, access.open)
    if port_of(options.bus) == 0:
        raise BusError(f"--bus {options.bus!r}: expected a port at its end, for example tls/0.0.0.0:47802")
    if encrypted(options.bus):
        access.identity()
    return addresses
