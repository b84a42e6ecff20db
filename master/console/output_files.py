"""Settings of the live outputs, and the process that follows them.

The page changes the settings. All of it blocks.
"""

import sys
import time
from pathlib import Path

import msgspec

from common.calibration import parse, save
from common.calibration.output_settings import OutputPart, OutputSettings
from master.console.state import ConsoleState
from master.outputs.network.outputs import OUTPUTS, switched_on
from master.outputs.network.sender import NAME, settings_of

PROCESS = "send"


def outputs_path(state: ConsoleState) -> Path:
    """The settings file that the page edits."""
    return state.settings.calibration / "outputs" / "default.json"


def read_outputs(state: ConsoleState) -> OutputSettings:
    """The settings as they are now.

    Raises:
        CalibrationError: The file is broken.
    """
    return settings_of(outputs_path(state))


def change_output(state: ConsoleState, name: str, change: dict[str, object]) -> OutputSettings:
    """Change one output in the settings file, whole or not at all.

    The process runs while any output is on.

    Raises:
        CalibrationError: The file is broken or read-only, or a value is none; the text names the key.
        PhalanxError: The process cannot be started.
    """
    path = outputs_path(state)
    settings = settings_of(path)
    part: OutputPart = OUTPUTS[name].part(settings)
    new_part = msgspec.structs.replace(part, **change)
    new = msgspec.structs.replace(settings, **{name: new_part})
    new = parse(msgspec.json.encode(new), OutputSettings, f"{path}: {name}")
    path.parent.mkdir(parents=True, exist_ok=True)
    save(path, new)
    follow(state, new)
    return new


def follow(state: ConsoleState, settings: OutputSettings) -> None:
    """Run the output process exactly while some output is on.

    A process that somebody else started is left alone.

    Raises:
        PhalanxError: It cannot be started.
    """
    wanted = any(switched_on(settings).values())
    ours = PROCESS in state.local.running()
    if wanted and not ours and not _of_others(state):
        tree = ["--calibration", str(state.settings.calibration), "--bus", state.settings.bus]
        state.local.start(PROCESS, [sys.executable, "-m", "master", "send", *tree], {})
    elif not wanted and ours:
        state.local.stop(PROCESS)


def _of_others(state: ConsoleState) -> bool:
    """Return whether somebody else runs the output process.

    Our own process that has just ended stays visible a moment longer, so this waits until it is gone.
    """
    gone_s = 3.0  # so long one that has ended is still seen on the bus
    until = time.monotonic() + (gone_s if state.local.get(PROCESS) is not None else 0.0)
    while NAME in state.alive and time.monotonic() < until:
        time.sleep(0.1)
    return NAME in state.alive
