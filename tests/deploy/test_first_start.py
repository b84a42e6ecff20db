"""The first start by cloud-init: its script, run as it is written, and whether keys stay on the boot partition."""

import os
import re
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import pytest

from master.commands.keys import files_of_device, make

ROOT = Path(__file__).resolve().parents[2]
TEMPLATE = ROOT / "deploy/cloud_init/user-data"
WIPES = "      trap wipe EXIT\n"


def script_of(template: str) -> str:
    """The script that the template writes."""
    found = re.search(r"content: \|\n(.*?)^runcmd:", template, re.DOTALL | re.MULTILINE)
    assert found is not None
    return textwrap.dedent(found[1]).replace("<192.168.1.2>", "192.168.1.2").replace("<left>", "left")


@dataclass
class Board:
    """A device before its first start, as a folder. Its `python3` is the real installer, on that folder."""

    root: Path
    script: str

    @property
    def partition(self) -> Path:
        return self.root / "boot/firmware/phalanx"

    @property
    def private(self) -> Path:
        return self.root / "var/lib/phalanx-first-start"

    def start(self, *more: str) -> subprocess.CompletedProcess[str]:
        """Run the script; `more` are further options of the installer."""
        programs = self.root / "programs"
        programs.mkdir(exist_ok=True)
        python = programs / "python3"
        words = " ".join(["--root", str(self.root), "--no-apt", *more])
        python.write_text(f'#!/bin/sh\nexec {sys.executable} "$@" {words}\n')
        python.chmod(0o755)
        text = self.script
        for place in ("/boot/firmware", "/var/lib"):
            text = text.replace(f"={place}", f"={self.root}{place}")
        file = programs / "phalanx-first-start"
        file.write_text(text)
        path = {"PATH": f"{programs}:{os.environ['PATH']}"}
        return subprocess.run(
            ["sh", str(file)], cwd=ROOT, env=os.environ | path, capture_output=True, text=True, check=False
        )

    def keys_left(self) -> list[Path]:
        """Files of keys on the boot partition."""
        return [path for path in self.partition.rglob("*") if path.suffix in (".key", ".secret", ".pem")]


def board_of(folder: Path, template: str) -> Board:
    """A boot partition as the template asks for it, but for the rig's file."""
    board = Board(folder / "root", script_of(template))
    (board.root / "var/lib").mkdir(parents=True)
    (board.partition / "wheels").mkdir(parents=True)
    (board.partition / "wheels/phalanx_hand-1.0-py3-none-any.whl").write_bytes(b"")
    shutil.copytree(ROOT / "calib_json", board.partition / "calib_json")
    make(folder / "pc", ["left"], datetime.now(UTC))
    for file in files_of_device("left"):
        (board.partition / "keys" / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(folder / "pc" / file, board.partition / "keys" / file)
        (board.partition / "keys" / file).chmod(0o755)  # as a partition of FAT shows them
    return board


def test_keys_leave_the_boot_partition_also_where_the_installation_fails_and_it_can_be_tried_again(
    tmp_path: Path,
) -> None:
    board = board_of(tmp_path, TEMPLATE.read_text())
    rig = board.partition / "calib_json/rigs/desk.json"
    kept = rig.read_bytes()
    rig.unlink()
    failed = board.start()
    assert failed.returncode != 0
    assert "calib_json/rigs/desk.json: no such rig" in failed.stdout + failed.stderr
    assert board.keys_left() == []
    assert board.private.stat().st_mode & 0o777 == 0o700
    assert all(path.stat().st_mode & 0o077 == 0 for path in board.private.rglob("*"))

    rig.write_bytes(kept)
    again = board.start("--dry-run")  # the real installer takes the keys; it writes nothing
    assert again.returncode == 0, again.stdout + again.stderr
    assert "would write /etc/phalanx/keys/device-left.key" in again.stdout
    assert not board.private.exists()


def _no_room(board: Board) -> None:
    """The keys cannot be copied."""
    (board.root / "var/lib/phalanx-first-start").write_text("a file where the folder is to be")


def _power_goes(board: Board) -> None:
    """The power goes as the installation begins."""
    board.script = board.script.replace("python3 -m", "kill -9 $$; python3 -m")


@pytest.mark.parametrize(("fault", "planted"), [(_no_room, WIPES), (_power_goes, "        wipe\n")])
def test_keys_leave_the_boot_partition_whatever_ends_the_script(
    tmp_path: Path, fault: Callable[[Board], None], planted: str
) -> None:
    """By the trap and by the step before the installation; without that line the keys stay, so the test sees it."""
    template = TEMPLATE.read_text()
    assert template.count(planted) == 1
    left: list[bool] = []
    for folder, text in (("whole", template), ("planted", template.replace(planted, ""))):
        board = board_of(tmp_path / folder, text)
        fault(board)
        assert board.start().returncode != 0
        left.append(bool(board.keys_left()))
    assert left == [False, True]
