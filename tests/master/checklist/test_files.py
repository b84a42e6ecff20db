"""Calibration files that are missing, broken or older than what they rest on, as the checklist judges them."""

import json
import shutil
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from master.checklist.facts import Plan, plan_of
from master.checklist.files import FileMonitor, check
from master.rig.setup import load_setups
from tests.network_helpers import free_endpoint

ROOT = Path(__file__).resolve().parents[3]


def _measured(day: str) -> dict[str, object]:
    return {"date": f"{day}T12:00:00Z", "tool": "test", "data": [], "residual": {}}


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A tree whose places were measured after the lenses."""
    shutil.copytree(ROOT / "calib_json", tmp_path / "calib")
    tree = tmp_path / "calib"
    _edit(
        tree / "rigs/desk.json", lambda rig: rig | {"provenance": {"T_rig_camera": _measured("2026-01-11")}}
    )
    for name in ("left", "right"):
        lens = {"provenance": {"intrinsics": _measured("2026-01-10")}}
        _edit(tree / f"cameras/{name}.json", lambda file, lens=lens: file | lens)
    return tree


def test_without_a_master_the_files_are_checked(tree: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _edit(tree / "cameras/left.json", lambda file: file | {"intrinsics": None})
    options = Namespace(bus=free_endpoint(), site=None, rig=None, calibration=tree, watch=False)
    assert check(options) == 1
    printed = capsys.readouterr().out
    assert printed.startswith("no_master")
    assert "`phalanx run --rig desk` starts one" in printed
    assert "Camera left: its lens is not measured.\n  -> `phalanx calibrate cameras intrinsics`." in printed
    assert "Camera right" not in printed


def _edit(path: Path, change: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    path.write_text(json.dumps(change(json.loads(path.read_text()))))


def _plan(tree: Path) -> Plan:
    return plan_of(load_setups(tree, ("desk",)))


SENSOR = {"sensor": json.loads((ROOT / "calib_json/cameras/ov5647-640x480.json").read_text())["sensor"]}
LATER = {"intrinsics": _measured("2026-02-01")}
# fmt: off
CHANGES: list[tuple[str, str, str, Callable[[Path], None]]] = [
    ("calibration_absent", "left", "cannot be used", lambda tree: (tree / "cameras/left.json").unlink()),
    ("calibration_absent", "left", "cannot be used", lambda tree: _put(tree / "cameras/left.json", "{")),
    ("calibration_absent", "left", "lens is not measured",
     lambda tree: _edit(tree / "cameras/left.json", lambda file: file | {"intrinsics": None})),
    ("calibration_absent", "left", "That of a Camera Module 1 sees some 53 degrees",
     lambda tree: _edit(tree / "cameras/left.json", lambda file: file | SENSOR | {"intrinsics": None})),
    ("calibration_stale", "left", "has 497 pixels of focal length, a Camera Module 1 has 643",
     lambda tree: _edit(tree / "cameras/left.json", lambda file: file | SENSOR)),
    ("calibration_absent", "desk", "places",
     lambda tree: _edit(tree / "rigs/desk.json", lambda rig: rig | {"T_rig_camera": {}})),
    ("calibration_absent", "default-right", "hand",
     lambda tree: (tree / "hands/default-right.json").unlink()),
    ("calibration_stale", "left", "measured after",
     lambda tree: _edit(tree / "cameras/left.json", lambda file: file | {"provenance": LATER})),
    ("calibration_stale", "left", "1280 x 960",
     lambda tree: _edit(tree / "cameras/left.json", lambda file: file | {"width_px": 1280, "height_px": 960})),
]
# fmt: on


def _put(path: Path, text: str) -> None:
    path.write_text(text)


@pytest.mark.parametrize(("code", "subject", "expected", "change"), CHANGES)
def test_a_file_that_is_wrong_is_reported_and_mended_it_is_not(
    code: str, subject: str, expected: str, change: Callable[[Path], None], tree: Path, tmp_path: Path
) -> None:
    plan, watch = _plan(tree), FileMonitor(tree, ("desk",))
    assert watch.look(plan) == ()
    shutil.copytree(tree, tmp_path / "before")
    change(tree)
    (item,) = watch.look(plan)
    assert (item.code, item.subject) == (code, subject)
    assert expected in item.sentence
    assert item.fix
    shutil.copytree(tmp_path / "before", tree, dirs_exist_ok=True)
    assert watch.look(plan) == ()


@pytest.mark.parametrize("rig", ["desk", "desk4", "wrist", "desk-wand"])
def test_the_tree_as_it_comes_has_nothing_wrong(rig: str) -> None:
    plan = plan_of(load_setups(ROOT / "calib_json", (rig,)))
    assert FileMonitor(ROOT / "calib_json", (rig,)).look(plan) == ()
