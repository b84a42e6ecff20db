"""`phalanx run --install`: the master as a service of this user.

It needs no root, and the service starts again by itself.
"""

import getpass
import os
import sys
from argparse import Namespace
from pathlib import Path
from typing import cast

from common.bus.keys import ENVIRONMENT, FOLDER, OPEN, keys_folder, link_key
from common.command_line import defaults_of
from common.errors import PhalanxError
from common.terminal import echo
from master.cli.run import run as declare_run
from master.commands.options import rigs_of
from master.commands.run import checked_ends
from master.commands.service_unit import unit_text
from master.commands.user_services import UserServices
from master.rig.files import load_setups

PROGRAM = "phalanx-master"
# The options of `run` that a service keeps: where they are in what was read, and how they are written.
KEPT = {
    "rig": "--rig",
    "calibration": "--calibration",
    "hand": "--hand",
    "beacon": "--beacon",
    "bind": "--bind",
    "key_file": "--key-file",
    "bus": "--bus",
    "start_timeout_s": "--start-timeout-s",
    "changes": "--set",
}
ONE_RUN = ("poses", "summary", "record")  # files of one run: the next start would write over them


def change_service(options: Namespace) -> None:
    """Install the service with these options of `run`, or remove it.

    Raises:
        PhalanxError: An option that a service cannot have, a rig or a key that is not there.
    """
    services = UserServices()
    if options.uninstall:
        if given := sorted(KEPT[name] for name in _given(options)):
            raise PhalanxError(f"--uninstall: takes no other option, found {' '.join(given)}")
        echo(services.remove(options.dry_run))
        return
    text = unit_text(command_of(options), Path.cwd(), environment_of())
    if options.dry_run:
        echo(f"would write {services.file}:\n{text}", end="")
        return
    echo(services.install(text))
    if not Path("/var/lib/systemd/linger", user := getpass.getuser()).exists():
        echo(f"it starts when {user} logs in; to start it with the machine: loginctl enable-linger {user}")


def command_of(options: Namespace) -> list[str]:
    """The program and its words for these options of `run`; each path is absolute.

    Raises:
        PhalanxError: An option that a service cannot have, a rig or a key that is not there.
    """
    if one := next((name for name in ONE_RUN if getattr(options, name) is not None), None):
        raise PhalanxError(
            f"--{one}: a service that starts again would write over it; beside the service use phalanx record"
        )
    checked_ends(options)
    load_setups(options.calibration, rigs_of(options), options.hand)
    if ENVIRONMENT in os.environ and options.key_file is None:
        raise PhalanxError(
            f"{ENVIRONMENT}: a key is not written into a unit; give --keys DIR (phalanx fleet keys DIR --make)"
        )
    link_key(os.environ, options.key_file)
    words: list[str] = []
    for name in KEPT:
        if name in _given(options) or name == "calibration":
            value = getattr(options, name)
            for one in cast("list[object]", value if isinstance(value, list) else [value]):
                words += [KEPT[name], str(one.absolute() if isinstance(one, Path) else one)]
    return [str(_program()), "run", *words]


def environment_of() -> dict[str, str]:
    """The variables that the service needs: where its keys are, never a key."""
    folder = keys_folder(os.environ)
    keys = {} if folder is None else {FOLDER: str(folder.absolute())}
    return keys | ({OPEN: "1"} if os.environ.get(OPEN) == "1" else {})


def _given(options: Namespace) -> set[str]:
    """Return the options of `KEPT` that differ from their defaults."""
    typical = defaults_of(declare_run)
    return {name for name in KEPT if getattr(options, name) != getattr(typical, name)}


def _program() -> Path:
    program = Path(sys.executable).with_name(PROGRAM)
    if not program.exists():
        raise PhalanxError(f"{program}: missing; install the package there: pip install '.[master]'")
    return program
