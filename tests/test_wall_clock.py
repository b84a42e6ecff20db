"""The wall clock is nowhere between light and pose: setting it, by however much, moves nothing.

Every use of it in the three packages is found by the syntax of the code. Dates in files and names, and what other
programs want to be told, stand apart, each with its reason.
"""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("common", "slave", "master")
WALL = {"time": {"time", "time_ns", "localtime", "gmtime", "ctime", "CLOCK_REALTIME", "CLOCK_TAI"}}
WALL |= {"datetime": {"now", "utcnow", "today"}, "date": {"today"}}
# Beside the line: what people set up, look at and keep, and what is sent on in the time of other programs.
NOT_LIVE = ("slave/install/", "slave/doctor/", "master/calibrate/", "master/console/", "master/outputs/network/",
          "master/recording/export/",
          "master/commands/keys.py", "master/commands/keys.py", "master/outputs/web/listening.py",
          "common/bus/keys.py")  # fmt: skip
REASONS = {
    "common/bus/endpoints.py": "what the validity of certificates is judged by, in words about a refused connection",
    "common/calibration/files.py": "the date of a measurement, in its file",
    "common/recording/messages.py": "the date of a recording, in its file",
    "slave/recorder.py": "what the wall clock said when a recording began, in its file",
    "slave/clocks.py": "drivers that stamp frames so: moved to the monotonic clock frame by frame",
}


def uses(text: str) -> set[str]:
    """What of the wall clock a file uses, as `module.name`, also imported by name."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Attribute):
            owner = node.value
            name = (
                owner.id
                if isinstance(owner, ast.Name)
                else owner.attr
                if isinstance(owner, ast.Attribute)
                else ""
            )
            if node.attr in WALL.get(name, ()):
                found.add(f"{name}.{node.attr}")
        elif isinstance(node, ast.ImportFrom) and node.module in WALL:
            found |= {f"{node.module}.{one.name}" for one in node.names if one.name in WALL[node.module]}
    return found


def files() -> list[Path]:
    """Everything on the line from light to pose."""
    everything = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    return [path for path in everything if not path.relative_to(ROOT).as_posix().startswith(NOT_LIVE)]


def test_nothing_on_the_line_asks_the_wall_clock() -> None:
    looked = files()
    assert len(looked) > 200
    found = {path.relative_to(ROOT).as_posix() for path in looked if uses(path.read_text())}
    assert found <= set(REASONS), "a time on the line comes from common.clock"


@pytest.mark.parametrize(
    "text",
    [
        "import time\nt = time.time()",
        "from time import time_ns",
        "import datetime\nd = datetime.datetime.now()",
        "from datetime import datetime, UTC\nd = datetime.now(UTC)",
        "import time\nt = time.clock_gettime_ns(time.CLOCK_REALTIME)",
    ],
)
def test_the_check_sees_a_planted_use(text: str) -> None:
    assert uses(text)


def test_the_monotonic_clock_is_none() -> None:
    assert not uses("import time\nt = time.monotonic_ns() + time.perf_counter_ns()")
