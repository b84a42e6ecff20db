"""Watched children: their lines are heard, a crash is followed by a new start, a stop is clean."""

import os
import sys
from pathlib import Path

import pytest

from deploy.process import Process
from tests.network_helpers import until


def _process(tmp_path: Path, code: str, lines: list[str], **environment: str) -> Process:
    return Process(
        "child",
        [sys.executable, "-u", "-c", code],
        environment,
        tmp_path / "child.log",
        lambda name, line: lines.append(f"{name} {line}"),
    )


FOREVER = """
import os, signal, sys, time
signal.signal(signal.SIGINT, lambda *_: sys.exit(7))
print('up', os.environ.get('COLOUR'), flush=True)
time.sleep(60)
"""


def test_lines_and_environment_reach_the_launcher_and_the_log(tmp_path: Path) -> None:
    lines: list[str] = []
    process = _process(tmp_path, FOREVER, lines, COLOUR="teal")
    assert until(lambda: "child up teal" in lines)
    assert process.stop() == 7  # it ended by its own handler of SIGINT, it was not killed
    assert "up teal" in (tmp_path / "child.log").read_text()


def test_a_killed_child_is_started_again_and_counted(tmp_path: Path) -> None:
    lines: list[str] = []
    process = _process(tmp_path, FOREVER, lines)
    assert until(lambda: len(lines) == 1)
    assert process.check() is None
    first = process.pid
    process._child.kill()
    codes: list[int] = []

    def reported() -> bool:
        code = process.check()
        if code is not None:
            codes.append(code)
        return bool(codes)

    assert until(reported)
    assert codes == [-9]
    assert process.pid != first
    assert process.restarts == 1
    assert until(lambda: len(lines) == 2)
    process.stop()


def test_a_child_that_ignores_the_request_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("deploy.process._STOP_S", 0.5)
    lines: list[str] = []
    deaf = (
        "import signal, time\nsignal.signal(signal.SIGINT, signal.SIG_IGN)\nprint('deaf')\ntime.sleep(60)\n"
    )
    process = _process(tmp_path, deaf, lines)
    assert until(lambda: "child deaf" in lines)
    assert process.stop() == -9


def test_the_end_after_a_stop_is_no_crash(tmp_path: Path) -> None:
    lines: list[str] = []
    process = _process(tmp_path, FOREVER, lines)
    assert until(lambda: len(lines) == 1)
    process.stop()
    assert process.check() is None
    assert process.restarts == 0


def test_the_last_lines_are_kept_for_an_error_message(tmp_path: Path) -> None:
    lines: list[str] = []
    process = _process(tmp_path, "for k in range(30): print(k)\nraise SystemExit(3)", lines)
    assert until(lambda: process.ended() is not None and len(lines) == 30)
    assert list(process.tail)[-2:] == ["28", "29"]
    assert len(process.tail) == 12
    process.stop()


def test_a_child_gives_way_also_after_a_new_start(tmp_path: Path) -> None:
    own = os.getpriority(os.PRIO_PROCESS, 0)
    process = Process(
        "child",
        [sys.executable, "-c", "import time; time.sleep(60)"],
        {},
        tmp_path / "log",
        lambda _name, _line: None,
        nice=4,
    )
    for _ in range(2):
        assert os.getpriority(os.PRIO_PROCESS, process.pid) == min(own + 4, 19)
        process._child.kill()
        assert until(lambda: process.check() is not None)
    process.stop()
