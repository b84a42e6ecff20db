"""Processes that the console starts: their lines, their end, and that none outlives the console."""

import os
import signal
import subprocess
import sys
from collections.abc import Generator

import pytest

from common.errors import PhalanxError
from master.console.local import LocalProcesses
from master.console.process_supervisor import watch
from tests.network_helpers import until

WAIT_S = 60.0


def there(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    # A child of a process that was killed may stay as a zombie where nobody takes its exit code.
    with open(f"/proc/{pid}/stat") as file:  # noqa: PTH123
        return file.read().rpartition(")")[2].split()[0] != "Z"


@pytest.fixture(name="local")
def _local() -> Generator[LocalProcesses]:
    processes = LocalProcesses()
    yield processes
    processes.close()


def test_lines_input_and_exit_code(local: LocalProcesses) -> None:
    code = "import os, sys; print(os.environ['WORD']); print(input().upper()); sys.exit(3)"
    one = local.start("echo", [sys.executable, "-c", code], {"WORD": "hello"})
    one.send("enter")
    assert until(lambda: one.ended() is not None and len(one.lines) == 2)
    assert (one.ended(), one.tail(), one.stopped) == (3, ["hello", "ENTER"], False)
    one.send("nobody reads this")  # raises nothing
    assert local.running() == {}


def test_a_question_without_an_end_of_line_is_heard_and_a_line_that_is_written_over_is_its_last(
    local: LocalProcesses,
) -> None:
    expected = "import sys\nsys.stdout.write('1 %\\r2 %\\n')\nx = input('how far, in Å? ')"
    code = f"{expected}\nprint(x)\nsys.stdout.write('end')"
    one = local.start("ask", [sys.executable, "-c", code], {"PYTHONIOENCODING": "utf-8"})
    assert until(lambda: one.prompt == "how far, in Å? ")
    assert list(one.lines) == ["2 %"]
    one.send("3")
    assert until(lambda: one.ended() is not None and one.tail()[-1] == "end")
    assert list(one.lines) == ["2 %", "how far, in Å? 3", "end"]


def test_what_does_not_end_is_killed_and_a_name_runs_once(local: LocalProcesses) -> None:
    deaf = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('up'); time.sleep(99)"
    first = local.start("deaf", [sys.executable, "-c", deaf], {})
    assert until(lambda: list(first.lines) == ["up"])
    assert first.stop(0.1) == -signal.SIGKILL
    assert first.stopped
    sleeper = [sys.executable, "-c", "import time; time.sleep(99)"]
    second = local.start("sleeper", sleeper, {})
    third = local.start("sleeper", sleeper, {})
    assert second.ended() is not None
    assert third.ended() is None
    assert local.running() == {"sleeper": third}
    local.close()
    assert third.ended() is not None


def test_a_program_that_is_not_there_is_named(local: LocalProcesses) -> None:
    with pytest.raises(PhalanxError, match=r"cam: cannot start /nowhere/x: No such file"):
        local.start("cam", ["/nowhere/x"], {})


def test_the_list_of_the_warden() -> None:
    assert watch(["+12\n", "+13\n", "junk\n", "-12\n", "+x\n", "-99\n"]) == {13}
    assert watch([]) == set()


def test_a_console_that_is_killed_leaves_nothing_behind() -> None:
    program = (
        "import sys, time\n"
        "from master.console.local import LocalProcesses\n"
        "one = LocalProcesses().start('x', [sys.executable, '-c', 'import time; time.sleep(99)'], {})\n"
        "print(one.pid, flush=True)\n"
        "time.sleep(99)\n"
    )
    console = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert console.stdout is not None
    pid = int(console.stdout.readline())
    assert there(pid)
    console.kill()
    console.wait(WAIT_S)
    console.stdout.close()
    assert until(lambda: not there(pid))
