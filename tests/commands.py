"""Runs commands of ours as processes of their own, forked from one that has loaded them: loading takes seconds."""

import importlib
import json
import multiprocessing
import os
import resource
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

_FORKED = multiprocessing.get_context("forkserver")
_FORKED.set_forkserver_preload(
    [
        "master.__main__",
        "master.replay.offline",
        "slave.__main__",
        "slave.commands.offline",
        "master.recording.export.run",
    ]
)
_WAIT_S = 120.0


@dataclass(frozen=True)
class Ended:
    """How a command ended: its code, None where it had to be killed; what it printed, and its processor time [s]."""

    code: int | None
    out: str
    err: str
    spent_s: float

    @property
    def text(self) -> str:
        """All that it printed."""
        return self.out + self.err


def command(module: str, arguments: Sequence[str], folder: Path) -> Ended:
    """Run `python -m MODULE ARGUMENTS`; what it prints is kept in files of a folder."""
    process = _FORKED.Process(target=_run, args=(module, list(arguments), folder), daemon=True)
    process.start()
    process.join(_WAIT_S)
    if process.is_alive():
        process.kill()
        process.join()
        return Ended(None, (folder / "out").read_text(), (folder / "err").read_text(), _WAIT_S)
    spent_s = json.loads((folder / "spent").read_text())
    return Ended(process.exitcode, (folder / "out").read_text(), (folder / "err").read_text(), spent_s)


def _run(module: str, arguments: list[str], folder: Path) -> None:
    for number, name in ((1, "out"), (2, "err")):
        os.dup2(os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), number)
    sys.argv = [f"phalanx-{module}", *arguments]
    before = _spent_s()
    try:
        code = importlib.import_module(f"{module}.__main__").main()
        sys.exit(code or 0)
    finally:
        (folder / "spent").write_text(json.dumps(_spent_s() - before))


def _spent_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime
