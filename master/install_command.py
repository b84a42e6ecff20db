"""`phalanx-master install`: the master as a service of this user.

It needs no root, and the service starts again by itself.
"""

import getpass
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, cast

import typer

from common.errors import PhalanxError
from common.keys import ENVIRONMENT, FOLDER, OPEN, keys_folder, link_key
from master.key_options import command_of as run_with_keys
from master.rig import load_setups
from master.run_command import checked_ends, run
from master.service_unit import unit_text
from master.user_services import UserServices

_ONE_RUN = ("poses", "summary", "record")  # files of one run: the next start would write over them


def install(
    context: typer.Context,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Write nothing; print the unit.")] = False,
    uninstall: Annotated[bool, typer.Option("--uninstall", help="Stop the service, and remove it.")] = False,
) -> None:
    """Install `phalanx-master run` as a service of this user, without root.

    It is started at login, and again after a fault. All other options are those of `run`, and are checked
    before anything is written. With other options it is installed again, with the same ones nothing changes.
    Keys stay where they are: the unit has the path of their folder alone.

    `systemctl --user status phalanx-master` shows how it is, `journalctl --user -u phalanx-master` what it said.

    Examples:

      phalanx-master install --rig desk

      phalanx-master install --keys DIR --beacon 192.168.1.255:47800 --bind 0.0.0.0:47801 --bus tls/0.0.0.0:47802

      phalanx-master install --rig desk --rig wrist --dry-run

      phalanx-master install --uninstall
    """
    services = UserServices()
    if uninstall:
        if context.args:
            raise PhalanxError(f"--uninstall: takes no other option, found {' '.join(context.args)}")
        typer.echo(services.remove(dry_run))
        return
    command = command_of(context.args)  # which also finds the keys
    text = unit_text(command, Path.cwd(), environment_of())
    if dry_run:
        typer.echo(f"would write {services.file}:\n{text}", nl=False)
        return
    typer.echo(services.install(text))
    if not Path("/var/lib/systemd/linger", user := getpass.getuser()).exists():
        typer.echo(
            f"it starts when {user} logs in; to start it with the machine: loginctl enable-linger {user}"
        )


def command_of(words: Sequence[str]) -> list[str]:
    """The program and its words for these options of `run`; each path is absolute.

    Raises:
        PhalanxError: An option that a service cannot have, a rig or a key that is not there.
    """
    made = run_with_keys(run).make_context("phalanx-master run", list(words))
    values: dict[str, Any] = made.params
    sources = {name: made.get_parameter_source(name) for name in values}
    given = {name for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"}
    if one := next((name for name in _ONE_RUN if name in given), None):
        raise PhalanxError(
            f"--{one}: a service that starts again would write over it; beside the service use phalanx-master record"
        )
    checked_ends(values["beacon"], values["bind"], values["bus"])
    load_setups(values["calibration"], values["rig"], values["hand"])
    if ENVIRONMENT in os.environ and "key_file" not in given:
        raise PhalanxError(
            f"{ENVIRONMENT}: a key is not written into a unit; give --keys DIR (phalanx-master keys make DIR)"
        )
    link_key(os.environ, values["key_file"])
    options: list[str] = []
    for parameter in made.command.params:
        if parameter.name in given | {"calibration"}:
            value = values[parameter.name]
            for one in cast("list[object]", value if isinstance(value, list) else [value]):
                options += [parameter.opts[0], str(one.absolute() if isinstance(one, Path) else one)]
    return [str(_program()), "run", *options]


def environment_of() -> dict[str, str]:
    """The variables that the service needs: where its keys are, never a key."""
    folder = keys_folder(os.environ)
    keys = {} if folder is None else {FOLDER: str(folder.absolute())}
    return keys | ({OPEN: "1"} if os.environ.get(OPEN) == "1" else {})


def _program() -> Path:
    program = Path(sys.executable).with_name("phalanx-master")
    if not program.exists():
        raise PhalanxError(f"{program}: missing; install the package there: pip install '.[master]'")
    return program
