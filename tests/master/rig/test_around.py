"""Cameras on both sides of the hand: its back is turned to those that see the marker on it."""

import msgspec
import numpy as np
import pytest

from common.arrays import Float
from common.calibration import Matrix4, RigCalibration
from common.geometry.transforms import matrix_to_rotation_vector, quaternion_to_matrix, rigid
from common.hand.model import WRIST
from common.messages import HandPose, MarkerDetections
from master.rig.pipeline import build_pipeline
from master.rig.setup import RigSetup
from master.run.app import StageTimes
from tests.hand_helpers import (
    MARKERS,
    RIGHT,
    camera_file,
    cap_areas_px2,
    cap_bias_px,
    detections,
    palm,
    rig_file,
)

BACK = MARKERS.index("back")
ANGLES = np.radians(
    np.array([[8, 8, 12, 12], [0, 14, 25, 17], [0, 14, 25, 17], [0, 14, 25, 17], [0, 14, 25, 17]])
)
PERIOD_NS = 16_666_667


def around(rotation_deg: float) -> RigCalibration:
    """Two pairs, both half a metre from (0.04, 0, 0.5); the second turned about the first's y axis."""
    a = np.radians(rotation_deg)
    rotation = np.array([[np.cos(a), 0.0, np.sin(a)], [0.0, 1.0, 0.0], [-np.sin(a), 0.0, np.cos(a)]])
    middle = np.array([0.0375, 0.0, 0.5])
    rig = rig_file(("left", "right", "left2", "right2"))
    poses = {
        name: rigid(rotation, middle + rotation @ (np.array([x, 0.0, 0.0]) - middle))
        for name, x in (("left2", 0.0), ("right2", 0.075))
    }
    places = {name: msgspec.convert(pose.tolist(), Matrix4) for name, pose in poses.items()}
    return msgspec.structs.replace(rig, T_rig_camera=rig.T_rig_camera | places)


def solved(rig: RigCalibration, T_rig_palm: Float) -> list[HandPose]:
    """Poses of a resting hand; only the first pair sees the marker on its back."""
    setup = RigSetup.of(rig, {name: camera_file(name, 60.0, 0.0) for name in rig.cameras}, RIGHT)
    joints = RIGHT.forward(T_rig_palm, ANGLES)
    points = RIGHT.marker_points(joints, MARKERS)
    models = tuple(setup.models.values())
    bias, area = cap_bias_px(joints, points, models), cap_areas_px2(joints, models)
    messages: list[MarkerDetections] = []
    for seq in range(6):
        for c, (name, camera) in enumerate(setup.models.items()):
            uv = camera.project(points) + bias[c]
            uv[BACK] = np.nan if name.endswith("2") else uv[BACK]
            messages.append(detections(name, seq, 1_000_000_000 + seq * PERIOD_NS, uv, area[c]))
    pipeline = build_pipeline(setup, StageTimes())
    return [found.pose for message in messages for found in pipeline.push(message)]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("rotation_deg", [60.0, 90.0])
def test_a_second_pair_aside_does_not_turn_the_hand(rotation_deg: float) -> None:
    """How far the palm rolls is told by habits here, in either rig: of 25 degrees 4 to 9 are left. The second pair must
    not draw it its way: a hand that faced the middle of both pairs would roll 6 degrees farther with 60 between them.
    """
    alone, both = np.zeros((3, 2)), np.zeros((3, 2))
    four = around(rotation_deg)
    for k, roll_deg in enumerate((-25.0, 0.0, 25.0)):
        T = palm(np.array([0.0, roll_deg, 0.0]), np.array([0.04, 0.08, 0.5]))
        alone[k] = off(msgspec.structs.replace(four, cameras=("left", "right")), T)
        both[k] = off(four, T)
    assert abs((both - alone)[:, 1].mean()) < 2.0
    assert both[:, 0].mean() < alone[:, 0].mean()
    assert both[:, 0].max() < 4.5


@pytest.mark.filterwarnings("error")
def test_opposite_pairs_look_in_no_common_direction_and_are_tracked() -> None:
    mm, _ = off(around(180.0), palm(np.zeros(3), np.array([0.04, 0.08, 0.5])))
    assert mm < 4.0


def off(rig: RigCalibration, T_rig_palm: Float) -> tuple[float, float]:
    """Mean error [mm] of all joints of the last pose, and by how much its palm is turned too far about the rig's y
    axis [deg]."""
    poses = solved(rig, T_rig_palm)
    assert len(poses) >= 4
    assert poses[-1].valid.all()
    truth = RIGHT.forward(T_rig_palm, ANGLES)
    mm = 1e3 * float(np.linalg.norm(poses[-1].position_m - truth.position_m, axis=1).mean())
    rotation = quaternion_to_matrix(poses[-1].orientation_wxyz[WRIST]) @ truth.rotation[WRIST].T
    return mm, float(np.degrees(matrix_to_rotation_vector(rotation)[1]))
