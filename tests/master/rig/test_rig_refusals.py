"""Rigs whose depth model or solver does not fit them, as a user meets them: at the start of `phalanx run`."""

import json
from collections.abc import Callable
from pathlib import Path
from shutil import copytree
from typing import Any

import numpy as np
import pytest

from common.bus.keys import new_key
from common.geometry.transforms import axis_rotation
from master.rig.pipeline import build_pipeline
from master.rig.setup import load_setup
from master.run.app import StageTimes
from tests.commands import Ended, command
from tests.network_helpers import free_endpoint

Change = Callable[[dict[str, Any]], None]


@pytest.fixture
def tree(root: Path, tmp_path: Path) -> Path:
    """A copy of the shipped files."""
    return copytree(root / "calib_json", tmp_path / "calib")


def changed(tree: Path, change: Change, name: str = "desk") -> None:
    path = tree / "rigs" / f"{name}.json"
    rig = json.loads(path.read_text())
    change(rig)
    path.write_text(json.dumps(rig))


def started(tree: Path, *rigs: str) -> Ended:
    """`phalanx run`, which ends by itself only where it refuses."""
    key = tree / "rig.key"
    key.write_text(new_key())
    key.chmod(0o600)
    named = [word for rig in rigs for word in ("--rig", rig)]
    addresses = ["--bind", "127.0.0.1:0", "--bus", free_endpoint()]
    words = ["run", *named, "--calibration", str(tree), "--key-file", str(key), *addresses]
    return command("master", words, tree)


def without_numbers(rig: dict[str, Any]) -> None:
    rig |= {"depth_model": "power_law", "power_law": None}


def rotated(rig: dict[str, Any]) -> None:
    """The second camera looks four degrees more to the left."""
    pose = np.array(rig["T_rig_camera"]["right"])
    pose[:3, :3] = pose[:3, :3] @ axis_rotation(1, np.radians(-4.0))
    rig["T_rig_camera"]["right"] = pose.tolist()


def farther(rig: dict[str, Any]) -> None:
    """The law says 5 % more than the places do."""
    rig["power_law"]["k_m"] *= 1.05


def with_imu(rig: dict[str, Any]) -> None:
    rig |= {"solver": "fabrik", "imu": {"q_palm_imu": [1, 0, 0, 0], "q_rig_world": [1, 0, 0, 0]}}


def strange_solver(rig: dict[str, Any]) -> None:
    rig["solver"] = "ik"


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (
            without_numbers,
            (
                "desk.json: depth_model is 'power_law' but the key 'power_law' is missing",
                "set depth_model to 'stereo' until `phalanx calibrate depth --use power_law` has fitted it",
            ),
        ),
        (
            rotated,
            (
                "rig 'desk': depth_model 'power_law' needs parallel cameras side by side, but the second is turned by",
                "at most 3 are allowed: turn them, or use 'stereo'",
            ),
        ),
        (
            farther,
            (
                "rig 'desk': depth_model 'power_law' is 5.",
                "solver 'estimator' needs both to agree within 2 %: calibrate the cameras and the depth again",
                "or set solver to 'fabrik'",
            ),
        ),
        (
            with_imu,
            (
                "rig 'desk': solver 'fabrik' knows markers alone, but an IMU watches this hand too",
                "set solver to 'estimator'",
            ),
        ),
        (strange_solver, ("desk.json: ", "solver")),
    ],
    ids=["no numbers", "turned cameras", "law against places", "IMU", "no such solver"],
)
def test_what_does_not_fit_is_refused_with_its_reason_and_what_to_do(
    change: Change, expected: tuple[str, ...], tree: Path
) -> None:
    changed(tree, change)
    ended = started(tree, "desk")
    assert ended.code == 1, ended.text
    for part in expected:
        assert part in ended.err
    assert "Traceback" not in ended.text


def test_fabrik_with_a_wrist_device_is_refused(tree: Path) -> None:
    ended = started(tree, "desk-fabrik", "wrist")
    assert ended.code == 1, ended.text
    assert "solver 'fabrik' knows markers alone, but a wrist device watches this hand too" in ended.err
    assert "set solver to 'estimator'" in ended.err


def test_fabrik_takes_a_law_that_the_places_contradict(tree: Path) -> None:
    """It uses the law alone, so a rig whose cameras were never placed well is tracked by it."""
    changed(tree, farther, "desk-fabrik")
    build_pipeline(load_setup(tree, "desk-fabrik"), StageTimes())


def test_the_shipped_pair_differs_in_its_solver_alone(root: Path) -> None:
    desk, fabrik = (
        json.loads((root / "calib_json" / "rigs" / f"{name}.json").read_text())
        for name in ("desk", "desk-fabrik")
    )
    assert desk["depth_model"] == "power_law"
    assert set(desk["power_law"]) == {"k_m", "z"}
    assert desk["provenance"]["power_law"]["tool"] == "calibrate depth"
    assert desk.get("solver", "estimator") == "estimator"
    assert fabrik.pop("solver") == "fabrik"
    assert fabrik | {"name": "desk"} == desk
