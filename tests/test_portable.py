"""Nothing but `elsewhere.LINUX` asks for Linux: neither in its text, nor at import, nor while a rig is tracked."""

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from common.command_line import check_system
from common.errors import PhalanxError
from deploy import demo
from tests.elsewhere import LINUX, ROOT, asks_for_linux
from tests.test_house import PACKAGES, sources

HERE = str(ROOT / "tests/elsewhere.py")


def elsewhere(*words: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONUTF8": "1"}
    command = [sys.executable, HERE, *words]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)


PLANTED = [
    "import fcntl",
    "def late():\n    from termios import tcgetattr\nlate()",
    "import pwd",
    "import resource as limits",
    "from os import fork",
    "import os\nos.killpg(0, 0)",
    "import os\nos.sched_setaffinity(0, {0})",
    "import os\nos.pread(0, 1, 0)",
    "import signal\nx = signal.SIGHUP",
    "import signal as signals, signal\nsignal.pthread_sigmask",
    "import socket\nsocket.SO_REUSEPORT",
    "import socket\nsocket.socket(socket.AF_UNIX)",
    "import time\ntime.clock_gettime_ns(1)",
    "from pathlib import Path\nPath('/proc/self/stat').read_text()",
    "open('/sys/class/net')",
    "import os\nos.listdir('/dev/shm')",
]


@pytest.mark.parametrize("text", PLANTED)
def test_what_is_planted_is_seen_in_the_text_and_when_it_runs(text: str) -> None:
    assert asks_for_linux("common/x.py", text)
    assert not asks_for_linux("deploy/x.py", text)
    done = elsewhere("plant", text)
    assert done.returncode != 0
    kinds = ("ModuleNotFoundError", "ImportError", "AttributeError", "FileNotFoundError")
    assert done.stderr.splitlines()[-1].startswith(kinds), done.stderr


@pytest.mark.parametrize(
    "text", ["import os\nos.getpid()", "import signal\nsignal.SIGTERM", "open(__file__)"]
)
def test_what_every_system_has_is_let_through(text: str) -> None:
    text = text.replace("__file__", repr(HERE))
    assert not asks_for_linux("common/x.py", text)
    done = elsewhere("plant", text)
    assert done.returncode == 0, done.stderr


def test_no_other_file_asks_for_linux_and_each_of_the_list_is_there() -> None:
    files = [(path, text) for package in PACKAGES for path, text in sources(package)]
    assert not {path: bad for path, text in files if (bad := asks_for_linux(path, text))}
    assert all(list(ROOT.glob(one)) for one in LINUX)


def test_all_other_modules_can_be_imported() -> None:
    done = elsewhere("import")
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 300


def test_a_rig_is_tracked_and_what_is_not_there_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = demo._table

    def moved(
        settings: demo.DemoSettings, keys: Path, epoch_ns: int
    ) -> list[tuple[str, list[str], dict[str, str]]]:
        rows = table(settings, keys, epoch_ns)
        assert {tuple(command[1:2]) for _, command, _ in rows} == {("-m",)}
        return [
            (name, [command[0], HERE, *command[2:]], environment | {"PYTHONUTF8": "1"})
            for name, command, environment in rows
        ]

    monkeypatch.setattr(demo, "_table", moved)
    lines: list[str] = []
    settings = demo.DemoSettings(4.0, True, tmp_path, ROOT / "calib_json", ("desk",), 1)
    with demo.demo_keys(settings) as keys:
        epoch_ns = time.monotonic_ns() + round(1e9 * demo.lead_s(3, os.getloadavg()[0]))
        restarts = demo.play(settings, keys, epoch_ns, threading.Event(), lines.append)
    assert not restarts, lines
    summary = json.loads((tmp_path / "live.json").read_text())
    assert summary["poses_per_s"] > 1.0
    for name in ("left", "right", "master"):
        assert (
            "win32: nobody has tried it yet; not here: cameras of a Pi (on USB: --camera opencv:INDEX)"
            in (tmp_path / f"{name}.log").read_text()
        )


@pytest.mark.parametrize(
    ("platform", "words"),
    [
        ("linux", ""),
        ("freebsd15", ""),
        (
            "darwin",
            "darwin: nobody has tried it yet; not here: cameras of a Pi (on USB: --camera opencv:INDEX), I2C",
        ),
        ("win32", "an orderly end of what console starts"),
    ],
)
def test_the_first_line_names_what_a_system_lacks(
    platform: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    check_system(platform, 1)
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == (1 if words else 0)


def test_a_driver_of_linux_is_refused_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PHALANX_RIG_KEY", 64 * "1")
    monkeypatch.setenv("PHALANX_OPEN", "1")
    rig = ["--name", "left", "--rig", "desk", "--calibration", str(ROOT / "calib_json")]
    done = elsewhere("slave", "run", *rig, "--camera", "v4l2")
    assert done.returncode == 1, done.stderr
    assert done.stderr.splitlines()[-1] == "phalanx-slave: fcntl is missing: this needs Linux"


def test_windows_reads_files_as_utf_8_or_does_not_start() -> None:
    with pytest.raises(PhalanxError, match="PYTHONUTF8=1"):
        check_system("win32", 0)
