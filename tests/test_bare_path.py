"""The gate sees no program but those that `.ci/programs` lists: one that is only on this machine is not found."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.programs import missing, needs

ROOT = Path(__file__).resolve().parents[1]
# In the place of `make`: what was asked of it, its PATH, whether that has the planted program.
MAKE = """#!/bin/sh
echo "$*"
echo "$PATH"
command -v foreign || echo "no foreign program"
"""


def written(path: Path, text: str) -> None:
    path.write_text(text)
    path.chmod(0o755)


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """What continuous integration starts, below a folder of its own: the gate's PATH of this very run stays."""
    shutil.copytree(ROOT / ".ci", tmp_path / "clone/.ci")
    return tmp_path / "clone"


@pytest.fixture
def typical(tmp_path: Path) -> str:
    """The PATH of a machine that has a program of no list."""
    (tmp_path / "bin").mkdir()
    written(tmp_path / "bin/foreign", "#!/bin/sh\n")
    written(tmp_path / "bin/make", MAKE)
    return f"{tmp_path / 'bin'}:{os.environ['PATH']}"


def lines(command: list[str], folder: Path, path: str) -> list[str]:
    environment = os.environ | {"PATH": path}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


@pytest.fixture
def bare(clone: Path, typical: str) -> str:
    """The PATH of the gate on that machine."""
    (clone / "bare").mkdir()
    assert lines([".ci/bare_path", "bare"], clone, typical) == []
    return str(clone / "bare")


def test_the_gate_runs_the_command_of_the_readme_and_it_finds_only_what_is_listed(
    clone: Path, typical: str
) -> None:
    assert lines(["make", "test"], clone, typical)[-1].endswith("bin/foreign"), (
        "planted: everybody else finds it"
    )
    asked, path, found = lines(["bash", ".ci/run"], clone, typical)
    assert asked == "test"
    assert found == "no foreign program"
    assert not Path(path).exists(), "it leaves nothing behind"


def test_on_the_path_is_what_is_listed_and_python(bare: str) -> None:
    listed = {
        program
        for line in (ROOT / ".ci/programs").read_text().splitlines()
        if not line.startswith("#")
        for program in line.partition(":")[2].split()
    }
    assert {"sh", "git", "make", "awk", "chromium"} < listed
    assert not {"rsync", "ssh", "ip", "node", "uv", "perl", "cc"} & listed
    there = {path.name for path in Path(bare).iterdir()}
    assert there >= listed
    assert {"python3"} <= there - listed <= {"python3", *(f"python3.{minor}" for minor in range(11, 15))}
    for program in ("foreign", "rsync", "ssh", "node"):
        assert shutil.which(program, path=bare) is None


def test_its_python_is_the_interpreter_itself(clone: Path, bare: str) -> None:
    (real,) = lines(["python3", "-c", "import sys; print(sys.executable)"], clone, bare)
    (base,) = lines([real, "-c", "import sys; print(sys._base_executable)"], clone, bare)
    assert not Path(real).is_relative_to(clone)
    assert Path(real).samefile(base)


def test_what_make_installs_after_the_path_was_made_is_found(clone: Path, typical: str) -> None:
    (clone / ".ci/programs").write_text("later: installed-later\n")
    (clone / "bare").mkdir()
    lines([".ci/bare_path", "bare"], clone, typical)
    link = clone / "bare/installed-later"
    assert shutil.which(link.name, path=str(link.parent)) is None
    assert link.readlink() == Path("/usr/bin/installed-later")


def test_a_test_that_lacks_a_program_says_which_and_is_skipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(pytest.skip.Exception) as skipped:
        needs("rsync", "ip")
    assert skipped.value.msg == "missing here: rsync, ip (Debian: apt install iproute2 rsync)"
    written(tmp_path / "rsync", "#!/bin/sh\n")
    assert missing("rsync") is None
    assert missing("rsync", "ip") == "missing here: ip (Debian: apt install iproute2)"
