"""`--keys` and `--open`, for every command of the master that joins the bus or the link.

Both say the same as their environment variables, and set them: programs that a command starts by itself, such as the
recorder, or what the console's page begins, belong to the same rig.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer
from typer.core import TyperCommand, TyperGroup

from common.errors import PhalanxError
from common.keys import ENVIRONMENT, FOLDER, OPEN

_NEEDED_BY = frozenset({"bus", "key_file", "listen"})  # parameters of the commands that need them


def program(app: typer.Typer) -> TyperGroup:
    """Return `app` as a program whose commands have the options."""
    group = typer.main.get_command(app)
    assert isinstance(group, TyperGroup)
    _extend(group, _both())
    return group


def command_of(function: Callable[..., None]) -> TyperCommand:
    """Return the command of `function` with the options, by itself."""
    app = typer.Typer(add_completion=False)
    app.command()(function)
    command = typer.main.get_command(app)
    assert isinstance(command, TyperCommand)
    _add(command, _both())
    return command


def _both() -> TyperCommand:
    app = typer.Typer(add_completion=False)
    app.command()(_options)
    options = typer.main.get_command(app)
    assert isinstance(options, TyperCommand)
    return options


def _extend(group: TyperGroup, options: TyperCommand) -> None:
    for command in group.commands.values():
        if isinstance(command, TyperGroup):
            _extend(command, options)
        elif isinstance(command, TyperCommand):
            _add(command, options)


def _add(command: TyperCommand, options: TyperCommand) -> None:
    taken = {name for parameter in command.params for name in parameter.opts}
    if _NEEDED_BY & {parameter.name for parameter in command.params}:
        command.params += [
            one for one in options.params if one.name in ("keys", "open_bus") and not taken & set(one.opts)
        ]


def _use_keys(folder: Path | None) -> Path | None:
    if folder is not None:
        if not folder.is_dir():
            raise PhalanxError(f"--keys {folder}: no such folder; make it: phalanx-master keys make {folder}")
        os.environ[FOLDER] = str(folder.resolve())
        os.environ.pop(ENVIRONMENT, None)  # what was said last counts
    return folder


def _use_open(wanted: bool) -> bool:
    if wanted:
        os.environ[OPEN] = "1"
    return wanted


def _options(
    keys: Annotated[
        Path | None,
        typer.Option(
            help=f"Keys folder (docs/keys.md); default: the variable {FOLDER}.",
            is_eager=True,  # the default of --bus rests on it
            expose_value=False,
            callback=_use_keys,
        ),
    ] = None,
    open_bus: Annotated[
        bool,
        typer.Option(
            "--open",
            help="Let the bus leave this machine as plain text, tcp/, for whoever is in the network: only in a closed"
            f" laboratory; also {OPEN}=1.",
            is_eager=True,
            expose_value=False,
            callback=_use_open,
        ),
    ] = False,
) -> None:
    """Bear the options; it is never called."""
