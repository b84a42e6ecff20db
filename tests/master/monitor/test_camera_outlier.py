"""One camera of three or four is knocked, or takes something else for a marker: the others go on without it."""

from collections import Counter

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from common.arrays import Bool, Float
from common.calibration import RigCalibration
from common.geometry.transforms import rigid
from common.messages import HandPose, MarkerDetections, Source
from master.estimator.epoch import MarkerPositions
from master.fabrik.caps import CapTables
from master.fabrik.rays import RayTriangulator
from master.rig.pipeline import build_pipeline
from master.run.app import StageTimes
from tests.hand_helpers import (
    MARKERS,
    RIGHT,
    camera_models,
    cap_areas_px2,
    cap_bias_px,
    detections,
    palm,
    rig_file,
)
from tests.synthetic_run import setup_of

AT = {
    "left": (0.0, 0.0, 0.0),
    "right": (0.075, 0.01, 0.0),
    "top": (0.05, -0.2, 0.05),
    "side": (0.35, 0.03, 0.1),
}
THREE, FOUR = tuple(AT)[:3], tuple(AT)
ANGLES = np.radians(np.array([[8.0, 8.0, 12.0, 12.0]] + [[0.0, 11.0, 20.0, 14.0]] * 4))
HAND = RIGHT.forward(palm(), ANGLES)
TRUTH = RIGHT.marker_points(HAND, MARKERS)
FRAMES = 4


def preview_leases(at: tuple[float, float, float]) -> Float:
    """Pose of a camera there that looks at the hand."""
    z = np.array([0.04, 0.0, 0.5]) - at
    z /= np.linalg.norm(z)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return rigid(np.stack([x, np.cross(z, x), z], axis=1), np.array(at))


def rig(names: tuple[str, ...], knocked: str = "", by: Float | None = None) -> RigCalibration:
    """Cameras around the hand; the file has one of them turned by a rotation vector [rad]."""
    poses = {name: preview_leases(AT[name]) for name in names}
    if by is not None:
        poses[knocked] = poses[knocked] @ rigid(Rotation.from_rotvec(by).as_matrix(), np.zeros(3))
    rows = {name: tuple(tuple(float(v) for v in row) for row in pose) for name, pose in poses.items()}
    return rig_file(names, T_rig_camera=rows)


def messages(names: tuple[str, ...], swapped: str = "") -> list[MarkerDetections]:
    """Frames of a hand at rest, 0.1 px of noise; one camera may take the index for the ring and the other way round."""
    setup, rng = setup_of(rig(names)), np.random.default_rng(6)
    cameras = tuple(setup.models.values())
    seen = np.stack([c.project(TRUTH) for c in cameras]) + cap_bias_px(HAND, TRUTH, cameras)
    area = cap_areas_px2(HAND, cameras)
    if swapped:
        c = names.index(swapped)
        seen[c, [1, 3]] = seen[c, [3, 1]]
    return [
        detections(name, seq, 10**9 + seq * 16_666_667, seen[c] + rng.normal(0.0, 0.1, (6, 2)), area[c])
        for seq in range(FRAMES)
        for c, name in enumerate(names)
    ]


def solve(file: RigCalibration, sent: list[MarkerDetections]) -> tuple[list[HandPose], Counter[str]]:
    pipeline = build_pipeline(setup_of(file), StageTimes())
    poses = [one.pose for message in sent for one in pipeline.push(message)]
    return poses + [one.pose for one in pipeline.flush()], pipeline.counts


def off_mm(poses: list[HandPose]) -> Float:
    return 1e3 * np.linalg.norm([pose.markers_raw_m - TRUTH for pose in poses], axis=2)


@pytest.mark.parametrize(
    ("names", "knocked"), [(THREE, "right"), (THREE, "top"), (FOUR, "left"), (FOUR, "side")]
)
@pytest.mark.parametrize("across_deg", [(1.4, 1.4), (1.4, -1.4)])
def test_a_camera_that_was_knocked_by_two_degrees_is_left_out(
    names: tuple[str, ...], knocked: str, across_deg: tuple[float, float]
) -> None:
    by = np.radians([*across_deg, 0.0])
    poses, counts = solve(rig(names, knocked, by), messages(names))
    assert off_mm(poses).max() < 5.0  # without it nothing was found, or a centimetre off
    every = len(poses) * len(MARKERS)
    assert {name: n for name, n in counts.items() if "rejected" in name} == {
        f"rejected.{knocked}": every,
        f"mostly_rejected.{knocked}": len(poses),
    }
    assert counts["epipolar_outliers"] == 0
    assert all((pose.source != Source.HELD).all() for pose in poses[1:])


@pytest.mark.parametrize(("names", "swapped"), [(THREE, "left"), (THREE, "top"), (FOUR, "right")])
def test_markers_that_one_camera_swaps_are_taken_from_the_others(
    names: tuple[str, ...], swapped: str
) -> None:
    poses, counts = solve(rig(names), messages(names, swapped))
    assert off_mm(poses).max() < 5.0
    assert counts[f"rejected.{swapped}"] == 2 * len(poses)
    assert counts["epipolar_outliers"] == 0
    assert f"mostly_rejected.{swapped}" not in counts


def test_nothing_is_left_out_where_rays_meet_or_two_cameras_disagree() -> None:
    _, counts = solve(rig(FOUR), messages(FOUR))
    assert not any("rejected" in name for name in counts)
    two = THREE[:2]
    poses, counts = solve(rig(two, "right", np.radians([2.0, 0.0, 0.0])), messages(two))
    assert np.isnan(off_mm(poses)).all()
    assert counts["epipolar_outliers"] == len(poses) * len(MARKERS)
    assert not any("rejected" in name for name in counts)


# -- which one it is ---------------------------------------------------------------------------------------------


def located(file: RigCalibration, uv: Float) -> MarkerPositions:
    """Flat markers, as they are seen."""
    place = RayTriangulator(tuple(camera_models(file).values()), CapTables.flat(uv.shape[1]))
    return place(uv, np.full(uv.shape[:2], 0.1), np.full(uv.shape[:2], np.nan), None, 0.0)


def odd(file: RigCalibration, uv: Float) -> Bool:
    return located(file, uv).rejected


def images(names: tuple[str, ...], seed: int, count: int = 300) -> Float:
    rng = np.random.default_rng(seed)
    points = rng.uniform([-0.05, -0.08, 0.45], [0.12, 0.08, 0.6], (count, 3))
    exact = np.stack([camera.project(points) for camera in camera_models(rig(names)).values()])
    return exact + rng.normal(0.0, 0.1, exact.shape)


@pytest.mark.parametrize("names", [THREE, FOUR])
def test_a_thing_elsewhere_is_the_one_that_is_left_out_or_none(names: tuple[str, ...]) -> None:
    for c in range(len(names)):
        uv = images(names, c)
        uv[c] += np.random.default_rng(c).normal(0.0, 60.0, uv[c].shape)
        outlying = odd(rig(names), uv)
        assert not np.delete(outlying, c, axis=0).any()
        # Of three, whatever lies along one of the two epipolar lines, 3 px of 60 to each side, is not told.
        assert outlying[c].mean() > (0.8 if len(names) == 3 else 0.95)


def test_two_wrong_of_four_and_a_marker_of_two_cameras_are_not_found() -> None:
    uv = images(FOUR, 5, 40)
    uv[1, :, 1] += 60.0
    uv[3, :, 1] -= 60.0
    assert not odd(rig(FOUR), uv).any()
    uv = images(FOUR, 6, 40)
    uv[1, :, 1] += 60.0
    uv[2:] = np.nan
    assert not odd(rig(FOUR), uv).any()


def test_of_three_side_by_side_one_that_is_off_sideways_is_not_found() -> None:
    """Each pair meets, at another distance."""
    row = rig_file(THREE)
    uv = np.stack([camera.project(TRUTH) for camera in camera_models(row).values()])
    uv[1, :, 0] += 15.0
    assert located(row, uv).outliers.all()
    assert not odd(row, uv).any()
    uv[1] += [-15.0, 15.0]  # up or down it is
    assert odd(row, uv)[1].all()
