"""A wrist device in the viewer and in the picture of a run."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rerun as rr

from common.arrays import Float
from common.geometry.transforms import axis_rotation, matrix_to_quaternion, quaternion_to_matrix
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import WristTruth
from master.evaluation.report import lit_view
from master.outputs.drawing import fan, fan_rays
from master.outputs.picture import draw_summary
from master.outputs.picture_overlays import WristPicture
from master.outputs.poses import Poses, PosesTruth
from master.outputs.rerun import write_rrd
from master.rig.setup import RigSetup
from tests.master.outputs.test_outputs_picture import read
from tests.master.outputs.test_outputs_rerun import column, rows_of
from tests.wrist_run import exact_cycle, true_poses, wrist_scene, wrist_setup


@pytest.fixture(scope="module", params=["wrist", "wrist-left"])
def setup(root: Path, request: pytest.FixtureRequest) -> RigSetup:
    return wrist_setup(root, request.param)


# A picture takes over a second, and of the other hand it is the same code.
ONE_HAND = pytest.mark.parametrize("setup", ["wrist"], indirect=True)


@pytest.fixture(scope="module")
def truths(setup: RigSetup) -> list[WristTruth]:
    scene = wrist_scene(setup)
    return [scene.truth(float(t)) for t in np.linspace(0.0, 5.0, 8)]


def ghost_of(poses: Poses, off_m: float) -> PosesTruth:
    return PosesTruth(
        poses.position_m + np.array([off_m, 0.0, 0.0]),
        poses.markers_m,
        poses.laser_m + np.array([0.0, off_m, 0.0]),
    )


def statics(path: Path) -> Mapping[str, list[str]]:
    """Entities that never change, with the names of their components."""
    out: dict[str, list[str]] = {}
    for chunk in rr.chunk.RrdReader(path).stream():
        if chunk.is_static:
            out.setdefault(chunk.entity_path, []).extend(chunk.to_record_batch().schema.names)
    return out


def test_the_fan_lies_in_the_laser_plane_about_the_camera_view(setup: RigSetup) -> None:
    assert setup.wrist is not None
    rays = fan_rays(setup.rig, setup.wrist)
    np.testing.assert_allclose(rays @ setup.wrist.normal, 0.0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0)
    assert setup.rig.laser is not None
    assert np.arccos(rays[0] @ rays[-1]) == pytest.approx(setup.rig.laser.fan_rad, abs=1e-6)
    assert (rays.mean(axis=0) @ [0.0, 0.0, 1.0]) > 0.7  # towards the fingers
    for line in fan(setup.wrist.laser_m, rays):
        np.testing.assert_allclose(line @ setup.wrist.normal, setup.wrist.offset_m, atol=1e-6)


def test_a_wrist_run_is_all_there(setup: RigSetup, truths: list[WristTruth], tmp_path: Path) -> None:
    path, camera = tmp_path / "run.rrd", setup.rig.cameras[0]
    poses = true_poses(setup, truths)
    seen = [exact_cycle(setup, now, k) for k, now in enumerate(truths)]
    frames = [(camera, int(t), np.full((48, 64), 90, np.uint8)) for t in poses.t_ns]
    write_rrd(path, poses, setup, {camera: seen}, ghost_of(poses, 0.002), frames)
    rows, n = rows_of(path), len(truths)
    for entity in (
        f"hand/{setup.hand.profile.name}/skeleton",
        "laser/points",
        f"rays/{camera}/laser",
        f"rays/{camera}/tips",
        "truth/skeleton",
        "truth/laser",
        f"cameras/{camera}/laser",
        f"cameras/{camera}/detections/laser",
        f"cameras/{camera}/detections/tips",
    ):
        assert rows[f"/world/{entity}"] == n, entity
    assert not [entity for entity in rows if "marker" in entity]
    fixed = statics(path)
    assert "/world/laser/fan" in fixed
    assert f"/world/cameras/{camera}" in fixed
    assert not [entity for entity in fixed if "marker" in entity or "jitter" in entity]
    _, error = column(path, "/plots/error_mm/laser", "scalars")
    np.testing.assert_allclose(np.array(error, float).ravel(), 2.0, rtol=1e-6)
    assert len(rr.chunk.RrdReader(path).blueprints()) == 1


def test_laser_points_stand_where_they_are_and_where_the_camera_saw_them(
    setup: RigSetup, truths: list[WristTruth], tmp_path: Path
) -> None:
    path, camera = tmp_path / "run.rrd", setup.rig.cameras[0]
    poses = true_poses(setup, truths)
    seen = [exact_cycle(setup, now, k) for k, now in enumerate(truths)]
    write_rrd(path, poses, setup, {camera: seen})
    _, points = column(path, "/world/laser/points", "positions")
    _, detected = column(path, f"/world/cameras/{camera}/detections/laser", "positions")
    for k, now in enumerate(truths):
        there = np.isfinite(now.laser_pt[1:6, 0])
        assert there.any()
        np.testing.assert_allclose(np.array(points[k]), now.laser_pt[1:6][there], atol=1e-6)
        np.testing.assert_allclose(np.array(detected[k]), now.laser_uv[1:6][there] + 0.5, atol=1e-3)


@ONE_HAND
def test_the_picture_shows_the_device_and_what_its_camera_saw(
    setup: RigSetup, truths: list[WristTruth], tmp_path: Path
) -> None:
    poses = true_poses(setup, truths)
    renderer = WristRenderer(wrist_scene(setup), setup.rig.cameras[0])
    frame = lit_view(renderer, truths[-1].t_s)
    pictures: list[Float] = []
    for name, view in (("with", WristPicture.of(setup, frame)), ("without", WristPicture.of(setup))):
        path = tmp_path / f"{name}.png"
        row = len(poses) - 1
        draw_summary(path, poses, setup.rig, setup.hand, {"laser_mm": 0.3}, ghost_of(poses, 0.003), row, view)
        pictures.append(read(path).astype(np.float64))
    shown, bare = pictures
    assert shown.shape == (900, 1600, 3)
    differs = np.abs(shown - bare).max(axis=2) > 8.0
    rows, columns = np.nonzero(differs)
    # The frame, and only the frame, in the lower left corner.
    assert rows.min() > 560
    assert columns.max() < 400
    assert differs[600:880, 20:380].mean() > 0.05
    red = (bare[..., 2] > 100) & (bare[..., 2] > 1.8 * bare[..., 1]) & (bare[..., 2] > 1.8 * bare[..., 0])
    assert red[100:800, 300:1000].sum() > 500  # the fan


@ONE_HAND
def test_a_pose_of_which_nothing_is_known_can_be_drawn(
    setup: RigSetup, truths: list[WristTruth], tmp_path: Path
) -> None:
    poses = true_poses(setup, truths[:2])
    poses.laser_m[0] = np.nan
    poses.valid[0], poses.tracked[0], poses.position_m[0] = False, False, np.nan
    path = tmp_path / "hand.png"
    draw_summary(path, poses, setup.rig, setup.hand, {}, None, None, WristPicture.of(setup))
    assert read(path).max() > 200
    write_rrd(tmp_path / "run.rrd", poses, setup)
    _, points = column(tmp_path / "run.rrd", "/world/laser/points", "positions")
    assert not points[0]
    assert points[1]


def test_the_scene_is_turned_as_the_forearm_is_held(
    setup: RigSetup, truths: list[WristTruth], tmp_path: Path
) -> None:
    poses = true_poses(setup, truths)
    write_rrd(tmp_path / "still.rrd", poses, setup)
    assert "/world" not in rows_of(tmp_path / "still.rrd")  # nobody tells how
    assert setup.wrist is not None
    camera_palm = setup.wrist.T_camera_palm[:3, :3]
    world_camera = [axis_rotation(2, 0.7) @ axis_rotation(0, -1.2 + 0.2 * k) for k in range(len(poses))]
    held = replace(poses, palm_world_wxyz=matrix_to_quaternion(np.array(world_camera) @ camera_palm))
    held.palm_world_wxyz[3] = np.nan
    write_rrd(tmp_path / "held.rrd", held, setup)
    times, output = column(tmp_path / "held.rrd", "/world", "Transform3D:quaternion")
    known = [k for k in range(len(poses)) if k != 3]
    assert times == poses.t_ns[known].tolist()
    xyzw = np.array(output, np.float64)[:, 0]
    rotated = quaternion_to_matrix(xyzw[:, [3, 0, 1, 2]])
    up = np.array([R[2] for R in world_camera])[known]  # in the camera's frame
    np.testing.assert_allclose(
        (rotated @ up[..., None])[..., 0], np.tile([0.0, -1.0, 0.0], (7, 1)), atol=1e-6
    )
    assert rotated[0, 0, 2] == pytest.approx(
        0.0, abs=1e-6
    )  # what the camera looks along begins straight ahead
