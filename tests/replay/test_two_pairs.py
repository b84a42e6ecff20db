"""A recording of four cameras through the offline line: a fist whose tips the first pair does not see."""

from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.calibration import HandProfile, load
from common.hand.model import HandModel
from common.recording.frame_recording import open_recording
from common.sim.motion import MOVE_S, STATION_S, StudyPoses
from common.sim.record import record_scene
from common.sim.scene import view_centre
from common.sim.scenes import scene_by_name
from master.commands.summary import read_summary
from master.outputs.poses import Poses
from master.replay.offline import solve
from master.rig.setup import RigSetup, load_setup
from tests.replay.replayed import replay

SECONDS, RATE_HZ, SEED = 1.0, 30.0, 7


@dataclass(frozen=True)
class Replayed:
    """A recorded scene, its results, and its setup."""

    folder: Path
    out: Path
    setup: RigSetup


@pytest.fixture(scope="module")
def pointing(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Replayed:
    tree, folder = root / "calib_json", tmp_path_factory.mktemp("pairs")
    setup = load_setup(tree, "desk4")
    cameras = {
        name: msgspec.structs.replace(camera, frame_rate_hz=RATE_HZ) for name, camera in setup.cameras.items()
    }
    profile = load(tree / "hands" / f"{setup.rig.hand}.json", HandProfile)
    scene = scene_by_name("poses", setup.rig, cameras, profile, SEED)
    order = StudyPoses(HandModel.of(profile), view_centre(setup.rig), SEED).order
    start_s = order.index("pointing") * STATION_S + MOVE_S
    record_scene(folder / "recording", scene, SECONDS, start_s)
    replay(folder / "recording", folder / "out", "--calibration", tree)
    return Replayed(folder / "recording", folder / "out", setup)


def test_four_cameras_are_replayed_with_the_hidden_tips_placed(pointing: Replayed) -> None:
    summary = read_summary(pointing.out / "summary.json")
    assert summary["camera_hz"] == dict.fromkeys(pointing.setup.rig.cameras, RATE_HZ)
    assert isinstance(summary["joint_mm"], float)
    assert summary["joint_mm"] < 5.0
    poses = Poses.load(pointing.out / "poses.npz")
    assert poses.valid[5:].all()


def test_one_pair_of_the_same_recording_knows_the_hand_less_well(pointing: Replayed, tmp_path: Path) -> None:
    setup, both = pointing.setup, Poses.load(pointing.out / "poses.npz")
    pair = RigSetup.of(
        msgspec.structs.replace(setup.rig, cameras=("left", "right")), setup.cameras, setup.hand
    )
    alone = solve(open_recording(pointing.folder), [pair], pointing.out, tmp_path)
    four = read_summary(pointing.out / "summary.json")
    assert isinstance(alone["joint_mm"], float)
    assert isinstance(four["joint_mm"], float)
    assert four["joint_mm"] < 0.7 * alone["joint_mm"]
    one = Poses.load(tmp_path / "poses.npz")
    found = [np.isfinite(poses.markers_raw_m[:, :5]).all(axis=2).mean() for poses in (one, both)]
    assert found[0] < 0.4
    assert found[1] > 0.8
