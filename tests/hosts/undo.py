"""Takes back what a run did to this machine, also when the run was killed: a process of its own that waits for its end.

It reads one JSON list a line, the name of an act and its argument, and does nothing else until its input ends: then
it does them all, last first. `kill -9` of the tests ends the input as well as their end does.
"""

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO

PATIENCE_S = 5.0


class Undo:
    """The other end of that process; holds its pipe."""

    def __init__(self) -> None:
        command = [sys.executable, str(Path(__file__).resolve())]
        # A session of its own: Ctrl-C reaches the tests, and this process when they have ended.
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, text=True, start_new_session=True)

    def later(self, act: str, argument: str) -> None:
        """Do `act` with `argument` in the end. Notify it before the deed: what is not there to take back is no error.

        Raises:
            KeyError: There is no such act.
        """
        if act not in _ACTS:
            raise KeyError(f"{act}: one of {', '.join(_ACTS)}")
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps([act, argument]) + "\n")
        self._process.stdin.flush()

    def now(self) -> None:
        """Do all of it and wait. Safe to call twice."""
        if self._process.stdin is not None and not self._process.stdin.closed:
            self._process.stdin.close()
        self._process.wait()


def kill_group(folder: str) -> None:
    """Kill every process of a control group, and remove it with those below it."""
    group = Path(folder)
    if not group.is_dir():
        return
    (group / "cgroup.kill").write_text("1")
    until = time.monotonic() + PATIENCE_S
    while "populated 1" in (group / "cgroup.events").read_text() and time.monotonic() < until:
        time.sleep(0.01)
    below = sorted((path for path in group.rglob("*") if path.is_dir()), key=lambda path: -len(path.parts))
    for one in (*below, group):
        _again_while_busy(one.rmdir)


def _again_while_busy(act: Callable[[], None]) -> None:
    until = time.monotonic() + PATIENCE_S
    while True:
        try:
            return act()
        except OSError:  # a process that was killed is not gone yet
            if time.monotonic() > until:
                raise
            time.sleep(0.02)


def _unmount(place: str) -> None:
    subprocess.run(["umount", "--lazy", place], check=False, stderr=subprocess.DEVNULL)


def _delete_link(name: str) -> None:
    subprocess.run(["ip", "link", "del", name], check=False, stderr=subprocess.DEVNULL)


def _kill_process(pid: str) -> None:
    subprocess.run(["kill", "-KILL", pid], check=False, stderr=subprocess.DEVNULL)


def _remove_folder(folder: str) -> None:
    if any(line.split()[1].startswith(folder) for line in Path("/proc/mounts").read_text().splitlines()):
        raise OSError(f"{folder}: something is still mounted below it, so it stays")
    shutil.rmtree(folder, ignore_errors=True)


_ACTS: dict[str, Callable[[str], None]] = {
    "kill group": kill_group,
    "kill process": _kill_process,
    "unmount": _unmount,
    "delete link": _delete_link,
    "remove folder": _remove_folder,
}


def main(lines: IO[str]) -> int:
    """Read until the end, then act, last first; 1 if something could not be taken back."""
    acts = [(str(act), str(argument)) for act, argument in map(json.loads, lines)]
    failed = 0
    for act, argument in reversed(acts):
        try:
            _ACTS[act](argument)
        except OSError as error:  # the others have to be taken back all the same
            print(f"could not {act} {argument}: {error}", file=sys.stderr)  # noqa: T201  # it has no other voice
            failed = 1
    return failed


if __name__ == "__main__":
    raise SystemExit(main(sys.stdin))
