"""Tests of the way from JSON to pipeline: every contradiction is named."""

import json
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.calibration import HandProfile, MarkerMount, RigCalibration, load, save
from common.errors import CalibrationError
from common.hand.model import HandModel
from common.hand.profiles import generated_profile
from master.calibrate.tree_files import load_marker_rig
from master.rig.pipeline import build_pipeline, pipeline_of
from master.rig.setup import RigSetup, load_hand, load_setup
from master.run.app import StageTimes
from tests.hand_helpers import RIGHT, camera_file, rig_file


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A calib_json tree of two cameras and a hand."""
    for name in ("rigs", "cameras", "hands"):
        (tmp_path / name).mkdir()
    save(tmp_path / "rigs" / "bench.json", rig_file())
    for name in ("left", "right"):
        save(tmp_path / "cameras" / f"{name}.json", camera_file(name))
    save(tmp_path / "hands" / "made-right.json", generated_profile("made-right", "right"))
    return tmp_path


def test_a_tree_becomes_a_pipeline(tree: Path) -> None:
    setup = load_setup(tree, "bench")
    assert list(setup.cameras) == list(setup.models) == ["left", "right"]
    assert setup.hand.profile.name == "made-right"
    assert build_pipeline(setup, StageTimes()).markers == setup.rig.markers


def test_the_shipped_rig_is_whole(root: Path) -> None:
    setup = load_setup(root / "calib_json", "desk")
    assert len(setup.models) >= 2
    build_pipeline(setup, StageTimes())


def test_cameras_stand_in_the_rigs_order() -> None:
    files = {name: camera_file(name) for name in ("left", "right")}
    setup = RigSetup.of(rig_file(("right", "left")), files, RIGHT)
    assert list(setup.models) == ["right", "left"]


@pytest.mark.parametrize("missing", ["rigs/bench.json", "cameras/right.json", "hands/made-right.json"])
def test_a_missing_file_is_named(tree: Path, missing: str) -> None:
    (tree / missing).unlink()
    with pytest.raises(CalibrationError, match=missing):
        load_setup(tree, "bench")


def test_a_broken_hand_is_named_with_file_and_key(tree: Path) -> None:
    path = tree / "hands" / "made-right.json"
    content = json.loads(path.read_text())
    del content["rest_joints"]["wrist"]
    path.write_text(json.dumps(content))
    with pytest.raises(CalibrationError, match=r"made-right\.json: .*rest_joints: 'wrist' is missing"):
        load_setup(tree, "bench")


def test_a_hand_file_goes_before_the_rigs_hand(tree: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.json"
    save(other, generated_profile("other", "left"))
    assert load_setup(tree, "bench", other).hand.profile.name == "other"


def test_a_hand_from_nowhere_says_what_to_give() -> None:
    with pytest.raises(CalibrationError, match=r"'mine'.*--hand FILE.*--calibration DIR"):
        load_hand(None, "mine", None)


def short_of_markers(profile: HandProfile) -> HandModel:
    markers: dict[str, MarkerMount] = {k: v for k, v in profile.markers.items() if k != "ring"}
    return HandModel.of(msgspec.structs.replace(profile, markers=markers))


def test_contradictions_are_named() -> None:
    files = {name: camera_file(name) for name in ("left", "right")}
    with pytest.raises(CalibrationError, match=r"'bench': no camera file for 'right'"):
        RigSetup.of(rig_file(), {"left": files["left"]}, RIGHT)
    with pytest.raises(CalibrationError, match=r"'bench': cameras: two or more"):
        RigSetup.of(rig_file(("left",)), files, RIGHT)
    with pytest.raises(CalibrationError, match=r"no marker 'ring'.* stands under 'free_markers'"):
        RigSetup.of(rig_file(), files, short_of_markers(RIGHT.profile))
    blind = files | {"right": msgspec.structs.replace(files["right"], intrinsics=None)}
    with pytest.raises(CalibrationError, match=r"'right' has no 'intrinsics'"):
        RigSetup.of(rig_file(), blind, RIGHT)


def test_a_law_of_two_cameras_refuses_three() -> None:
    cameras = ("left", "right", "top")
    rig = rig_file(cameras, depth_model="power_law", power_law={"k_m": 37.5, "z": -1.0})
    setup = RigSetup.of(rig, {name: camera_file(name) for name in cameras}, RIGHT)
    with pytest.raises(CalibrationError, match="needs two cameras"):
        build_pipeline(setup, StageTimes())


def test_a_wrist_rig_has_no_markers_and_the_frame_of_its_camera(root: Path) -> None:
    setup = load_setup(root / "calib_json", "wrist")
    assert setup.wrist is not None
    assert setup.markers == setup.hand_markers == ()
    assert setup.wrist_cameras == tuple(setup.models) == ("wrist",)
    assert (setup.models["wrist"].T_rig_camera == np.eye(4)).all()
    assert load_setup(root / "calib_json", "desk").wrist_cameras == ()


def test_what_needs_markers_refuses_a_wrist_rig(root: Path) -> None:
    setup = load_setup(root / "calib_json", "wrist")
    with pytest.raises(CalibrationError, match="'wrist': kind is 'wrist', this needs a rig of 'markers'"):
        build_pipeline(setup, StageTimes())
    with pytest.raises(
        CalibrationError, match=r"wrist\.json: kind is 'wrist', this needs a rig of 'markers'"
    ):
        load_marker_rig(root / "calib_json", "wrist")
    assert load_marker_rig(root / "calib_json", "desk").kind == "markers"


@pytest.mark.parametrize("key", ["laser_plane", "T_camera_palm"])
def test_a_wrist_rig_without_a_part_names_it(root: Path, key: str) -> None:
    tree = root / "calib_json"
    rig = msgspec.structs.replace(load(tree / "rigs" / "wrist.json", RigCalibration), **{key: None})
    cameras = load_setup(tree, "wrist").cameras
    with pytest.raises(CalibrationError, match=f"'wrist': {key} is missing"):
        RigSetup.of(rig, cameras, RIGHT)
    with pytest.raises(CalibrationError, match="no camera file for 'wrist'"):
        RigSetup.of(rig, {}, RIGHT)


def test_a_wrist_rig_whose_laser_passes_by_the_hand_is_refused_by_name(root: Path) -> None:
    setup = load_setup(root / "calib_json", "wrist")
    assert setup.wrist is not None
    above = setup.wrist.T_camera_palm.copy()
    above[1, 3] -= 0.1
    passed_by = replace(setup, wrist=replace(setup.wrist, T_camera_palm=above))
    with pytest.raises(CalibrationError, match=r"rig 'wrist': .*the laser meets no finger"):
        pipeline_of(passed_by, StageTimes())
