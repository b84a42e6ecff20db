"""A wrist device beside marker cameras, in the viewer and in the picture: it stands where palm and bend place it."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rerun as rr

from common.arrays import Float
from common.geometry.transforms import quaternion_to_matrix, transform
from common.hand.model import WRIST
from common.messages import HandPose, Source
from common.sim.scenes import scene_by_name
from common.sim.wrist.scene import WristScene, WristTruth
from master.outputs.drawing import DevicePlace
from master.outputs.picture import draw_summary
from master.outputs.picture_overlays import WristPicture
from master.outputs.poses import Poses
from master.outputs.rerun import write_rrd
from master.outputs.rerun_scene import RerunScene
from master.rig.setup import RigSetup, load_setups
from tests.master.outputs.test_outputs_rerun import column, rows_of
from tests.results import pose_of

TIMES_S = np.linspace(0.5, 9.0, 5)
ROOT = ("/world/cameras/wrist", "/world/laser", "/world/rays/wrist")


@pytest.fixture(scope="module")
def setup(root: Path) -> RigSetup:
    (joined,) = load_setups(root / "calib_json", ["desk", "wrist"])
    return joined


@pytest.fixture(scope="module")
def wrist_truths(setup: RigSetup) -> list[WristTruth]:
    """What is true of the device at each instant, in the frame of its camera."""
    assert setup.wrist_rig is not None
    scene = WristScene.by_name("both-moves", setup.wrist_rig, setup.cameras, setup.hand.profile, 7)
    return [scene.truth(float(t)) for t in TIMES_S]


@pytest.fixture(scope="module")
def poses(setup: RigSetup, wrist_truths: list[WristTruth]) -> Poses:
    """What an errorless master would publish; the fingers' bones by the device, the palm by markers."""
    scene = scene_by_name("both-moves", setup.rig, setup.cameras, setup.hand.profile, 7)
    out: list[HandPose] = []
    source = np.full(26, Source.WRIST, np.uint8)
    source[: WRIST + 1] = Source.SOLVED
    for k, (t, device) in enumerate(zip(TIMES_S, wrist_truths, strict=True)):
        now = scene.truth(float(t))
        out.append(
            pose_of(
                setup.hand,
                now.joints,
                t_ns=10**9 + k * 16_666_667,
                source=source,
                angles_rad=now.angles_rad,
                markers_m=now.markers_m,
                laser_m=device.laser_pt[1:6],
                wrist_angles_rad=now.wrist_angles_rad,
                wrist_angles_sigma_rad=np.radians([2.0, 4.0]),
            )
        )
    return Poses.of(out)


def test_what_the_device_sees_stands_in_the_rig_where_the_hand_is(
    setup: RigSetup, poses: Poses, wrist_truths: list[WristTruth]
) -> None:
    assert setup.wrist is not None
    assert np.abs(poses.wrist_angles_rad).max() > np.radians(5.0), "a straight wrist would prove little"
    cameras = DevicePlace.of(poses, setup.hand).cameras(setup.wrist.T_camera_palm)
    for T, now, there in zip(cameras, wrist_truths, poses.position_m, strict=True):
        np.testing.assert_allclose(transform(T, now.joints.position_m), there, atol=1e-6)
    straight = replace(poses, wrist_angles_rad=np.full((len(poses), 2), np.nan))
    moved = DevicePlace.of(straight, setup.hand).cameras(setup.wrist.T_camera_palm)
    assert np.linalg.norm(moved[:, :3, 3] - cameras[:, :3, 3], axis=1).max() > 1e-3  # unknown counts as none


def test_the_forearm_is_as_long_as_asked_and_its_uncertainty_as_wide_as_that_of_the_wrist(
    setup: RigSetup, poses: Poses
) -> None:
    place = DevicePlace.of(poses, setup.hand)
    arm, ring = place.arm_m(0.2), place.uncertainty_m(0.2)
    np.testing.assert_allclose(arm[:, 0], poses.position_m[:, WRIST])
    np.testing.assert_allclose(np.linalg.norm(arm[:, 1] - arm[:, 0], axis=1), 0.2)
    off: Float = np.linalg.norm(ring - arm[:, None, 1], axis=2)
    np.testing.assert_allclose(off.max(axis=1), 0.2 * 2.0 * np.radians(4.0), rtol=0.05)
    np.testing.assert_allclose(off.min(axis=1), 0.2 * 2.0 * np.radians(2.0), rtol=0.05)


def test_a_fused_run_is_all_there_and_its_device_moves(setup: RigSetup, poses: Poses, tmp_path: Path) -> None:
    assert setup.wrist is not None
    path = tmp_path / "run.rrd"
    lost = replace(poses, valid=poses.valid.copy(), position_m=poses.position_m.copy())
    lost.valid[2], lost.position_m[2] = False, np.nan
    write_rrd(path, lost, setup)
    rows, hand = rows_of(path), f"/world/hand/{setup.hand.profile.name}"
    for entity in ("/world/markers/raw", "/world/rays/left", "/world/rays/wrist/laser", "/world/laser/points",
                   "/world/cameras/wrist/laser", f"{hand}/skeleton", f"{hand}/forearm", f"{hand}/forearm_uncertainty",
                   "/plots/wrist_angles_deg/flexion", "/plots/seen/markers", "/plots/seen/laser_points"):  # fmt: skip
        assert rows[entity] == len(poses), entity
    for entity in ROOT:
        assert rows[entity] == len(poses) - 1, entity
    assert "/world" not in rows  # the rig stands still
    _, points = column(path, "/world/laser/points", "positions")
    assert not points[2]  # of a lost hand nobody knows where
    assert all(points[k] for k in (0, 1, 3, 4))
    _, xyzw = column(path, "/world/laser", "Transform3D:quaternion")
    _, at = column(path, "/world/laser", "Transform3D:translation")
    T = DevicePlace.of(poses, setup.hand).cameras(setup.wrist.T_camera_palm)[[0, 1, 3, 4]]
    rotated = quaternion_to_matrix(np.array(xyzw, np.float64)[:, 0][:, [3, 0, 1, 2]])
    np.testing.assert_allclose(rotated, T[:, :3, :3], atol=1e-6)
    np.testing.assert_allclose(np.array(at, np.float64)[:, 0], T[:, :3, 3], atol=1e-6)
    _, arms = column(path, f"{hand}/forearm", "strips")
    assert [len(row) for row in arms] == [1, 1, 0, 1, 1]


def test_two_hands_do_not_write_over_each_other(
    setup: RigSetup, poses: Poses, root: Path, tmp_path: Path
) -> None:
    (other,) = load_setups(root / "calib_json", ["wrist-left"])
    name, recording = other.hand.profile.name, rr.RecordingStream("test")
    recording.save(tmp_path / "two.rrd")
    scene = RerunScene(recording, [setup, other])
    scene.log_poses(poses)
    scene.log_poses(replace(poses.rows(0, 2), hand=name))
    recording.flush()
    recording.disconnect()
    rows = rows_of(tmp_path / "two.rrd")
    for first, second in (
        (f"/world/hand/{setup.hand.profile.name}/skeleton", f"/world/hand/{name}/skeleton"),
        ("/plots/pip_deg/index", f"/plots/pip_deg/{name}/index"),
        ("/plots/seen/joints_tracked", f"/plots/seen/{name}/joints_tracked"),
    ):
        assert (rows[first], rows[second]) == (len(poses), 2)
    assert rows["/world/markers/raw"] == len(poses)


def test_the_picture_of_a_fused_run_shows_laser_forearm_and_sources(
    setup: RigSetup, poses: Poses, tmp_path: Path
) -> None:
    draw_summary(tmp_path / "hand.png", poses, setup.rig, setup.hand, {}, None, 3, WristPicture.of(setup))
    image = cv2.imread(str(tmp_path / "hand.png"))
    assert image is not None
    part = np.asarray(image, np.int64)[100:780, 310:980]

    def near(rgb: tuple[int, int, int]) -> int:
        return int((np.abs(part - np.array(rgb[::-1])).max(axis=-1) <= 12).sum())

    assert near((204, 121, 167)) > 1000  # bones of the device, and the forearm
    assert near((86, 180, 233)) > 100  # the palm, solved from markers
    red = (part[..., 2] > 90) & (part[..., 2] > 1.5 * part[..., 1]) & (part[..., 2] > 1.5 * part[..., 0])
    assert red.sum() > 500  # the laser's fan
