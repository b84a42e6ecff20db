"""All commands of `phalanx-master`, each imported when it is asked for.

To import all of them takes two seconds.
"""

from collections.abc import Callable
from importlib import import_module

import typer

COMMANDS = {
    "run": "master.run_command:run",
    "solve": "master.solve_command:solve",
    "view": "master.view_command:view",
    "console": "master.console_command:console",
    "report": "master.report_command:report",
    "camera": "master.camera_command:camera",
    "check": "master.checklist.command:check",
    "export": "master.export.command:export",
    "fleet": "master.fleet:fleet",
    "hear": "master.wait_for_senders:wait_for_senders",
    "record": "master.recording.record_command:record",
    "play": "master.recording.play_command:play",
    "info": "master.recording.info_command:info",
    "router": "master.router_command:router",
    "relay": "master.router_command:relay",
    "send": "master.send.command:send",
    "install": "master.install_command:install",
}
GROUPS = {
    "calibrate": "master.calibrate.cli:calibrate_app",
    "evaluate": "master.study.command:evaluate_app",
    "gestures": "master.gestures.command:gestures_app",
    "keys": "master.keys_command:keys_app",
}
# Takes the options of `run`, which it passes on.
_CONTEXT = {"install": {"allow_extra_args": True, "ignore_unknown_options": True}}


def command_line(wanted: str | None = None) -> typer.Typer:
    """The commands as one program.

    The wanted one alone, all where there is none of that name.
    """
    app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
    app.callback()(phalanx_master)
    if wanted not in GROUPS:
        for name, command in imported(COMMANDS, wanted).items():
            app.command(name, context_settings=_CONTEXT.get(name))(command)
    if wanted not in COMMANDS:
        for name, group in imported(GROUPS, wanted).items():
            app.add_typer(group(), name=name)
    return app


def imported(table: dict[str, str], wanted: str | None) -> dict[str, Callable[..., typer.Typer]]:
    """Import the functions of a table of `module:name`.

    The wanted one alone, all where the table has none of that name.
    """
    found: dict[str, Callable[..., typer.Typer]] = {}
    for name in [wanted] if wanted in table else table:
        module, attribute = table[name].split(":")
        found[name] = getattr(import_module(module), attribute)
    return found


def phalanx_master() -> None:
    """Turn detections of cameras, or of a wrist device, into a hand of 26 joints.

    `phalanx-master COMMAND --help` shows its examples.
    """
