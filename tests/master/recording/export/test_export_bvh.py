from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from common.arrays import Float
from common.geometry.transforms import quaternion_to_matrix
from common.hand.model import CHAINS, JOINTS
from common.messages import HandPose
from master.recording.export.bvh import PER_METRE, Axes, Unit, Up, euler_zxy_deg, write_bvh
from master.recording.export.motion import Skeleton, complete, resample
from tests.hand_helpers import any_rotation
from tests.master.recording.export.made import LEFT, NEAR_M, REST, STEP_NS, poses_of, positions, stacked

RATE_HZ = 1e9 / STEP_NS


def written(
    path: Path, poses: list[HandPose], rest: Skeleton = REST, axes: Axes | None = None
) -> tuple[int, ...]:
    motion = resample(complete(stacked(poses), rest), RATE_HZ)
    return write_bvh(path, motion, rest, RATE_HZ, axes or Axes())


def reader() -> Any:
    """bvhio, which others wrote."""
    return pytest.importorskip("bvhio", reason="bvhio asks for a pyglm that has no wheels for Python 3.14")


def read_m(path: Path, unit: Unit = "cm") -> tuple[Float, float]:
    """Places (T, 26, 3) [m] as another program reads them, and the rate [Hz]."""
    bvhio = reader()
    bvh = bvhio.readAsBvh(str(path))
    root = bvhio.convertBvhToHierarchy(bvh.Root).loadRestPose(recursive=True)
    out = np.empty((bvh.FrameCount, 26, 3))
    for frame in range(bvh.FrameCount):
        root.loadPose(frame)
        places = {joint.Name: list(joint.PositionWorld) for joint, _, _ in root.layout()}
        out[frame] = [places[name] for name in JOINTS]
    return out / PER_METRE[unit], 1.0 / bvh.FrameTime


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=8)
def test_another_parser_reads_every_joint_where_it_was(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    path, poses = tmp_path_factory.mktemp("bvh") / "hand.bvh", poses_of(seed, 3)
    assert written(path, poses, axes=Axes("cm", "rig")) == ()  # rigid bones: turns say all
    places, rate_hz = read_m(path)
    assert np.abs(places - positions(poses)).max() < NEAR_M
    assert rate_hz == pytest.approx(RATE_HZ, rel=1e-6)


def test_bones_that_are_not_rigid_are_read_where_they_were_too(tmp_path: Path) -> None:
    poses = poses_of(4, 5, loose_m=0.004)
    assert len(written(tmp_path / "hand.bvh", poses, axes=Axes("cm", "rig"))) == 25
    assert np.abs(read_m(tmp_path / "hand.bvh")[0] - positions(poses)).max() < NEAR_M


def test_poses_of_another_hand_than_the_profile_keep_their_own_size(tmp_path: Path) -> None:
    poses = poses_of(4, 2, LEFT)
    free = written(tmp_path / "hand.bvh", poses, axes=Axes("cm", "rig"))
    assert free
    assert np.abs(read_m(tmp_path / "hand.bvh")[0] - positions(poses)).max() < NEAR_M


@pytest.mark.parametrize(("unit", "up", "sign"), [("m", "y", -1.0), ("mm", "rig", 1.0)])
def test_units_and_axes(tmp_path: Path, unit: Unit, up: Up, sign: float) -> None:
    poses = poses_of(2, 2)
    written(tmp_path / "hand.bvh", poses, axes=Axes(unit, up))
    expected = positions(poses) * np.array([1.0, sign, sign])
    assert np.abs(read_m(tmp_path / "hand.bvh", unit)[0] - expected).max() < NEAR_M


def test_at_rest_the_bones_are_those_of_the_profile_and_end_beyond_the_tips(tmp_path: Path) -> None:
    written(tmp_path / "hand.bvh", poses_of(1, 1))  # a single frame
    bvh = reader().readAsBvh(str(tmp_path / "hand.bvh"))
    assert bvh.FrameCount == 1
    found: dict[str, Float] = {}

    def process_noise(joint: Any, at: Float) -> None:
        found[joint.Name] = at + np.array(list(joint.Offset))
        if joint.Name.endswith("-tip"):
            ahead = np.array(list(joint.EndSite))
            radius = REST.radius_m[JOINTS.index(joint.Name)]
            assert np.linalg.norm(ahead) == pytest.approx(100.0 * radius, rel=1e-4)
        for child in joint.Children:
            process_noise(child, found[joint.Name])

    process_noise(bvh.Root, np.zeros(3))
    assert set(found) == set(JOINTS)
    places = np.array([found[name] for name in JOINTS])
    np.testing.assert_allclose(places, 100.0 * REST.position_m, atol=1e-4)
    index = CHAINS[1]
    assert (np.diff(places[index, 2]) > 0.5).all()  # fingers along +z


def test_lost_joints_stand_still_in_the_file(tmp_path: Path) -> None:
    valid = np.ones((4, 26), np.bool_)
    valid[2] = False
    poses = poses_of(3, 4, valid=valid)
    written(tmp_path / "hand.bvh", poses, axes=Axes("cm", "rig"))
    places = read_m(tmp_path / "hand.bvh")[0]
    np.testing.assert_allclose(places[2], places[1], atol=NEAR_M)
    assert np.abs(places - positions(poses))[[0, 1, 3]].max() < NEAR_M


def test_the_angles_of_a_joint_are_those_of_another_library() -> None:
    rng = np.random.default_rng(1)
    rotation = np.array([any_rotation(rng) for _ in range(50)])
    again = Rotation.from_euler("ZXY", euler_zxy_deg(rotation), degrees=True).as_matrix()
    np.testing.assert_allclose(again, rotation, atol=1e-9)


def test_a_right_angle_about_x_and_a_full_turn_do_no_harm() -> None:
    steps = np.radians(np.arange(0.0, 720.0, 30.0))
    rotating = quaternion_to_matrix(
        np.stack([np.cos(steps / 2), 0 * steps, np.sin(steps / 2), 0 * steps], axis=1)
    )
    angles = euler_zxy_deg(rotating)
    np.testing.assert_allclose(angles[:, 2], np.degrees(steps), atol=1e-9)  # two turns, no leap
    lock = Rotation.from_euler("ZXY", [[20.0, 90.0, 30.0], [20.0, -90.0, 30.0]], degrees=True).as_matrix()
    again = Rotation.from_euler("ZXY", euler_zxy_deg(lock), degrees=True).as_matrix()
    np.testing.assert_allclose(again, lock, atol=1e-7)
