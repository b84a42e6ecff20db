"""What the section fusion counts, on hands worked out by hand: errors, bits, sight."""

import numpy as np
import pytest

from bench.both.fusion import Figures, ratios
from bench.both.scene import Both, Solved, Visibility
from bench.played import START_NS
from common.arrays import Float
from common.geometry.transforms import matrix_to_quaternion
from common.hand.model import TIPS, WRIST
from common.messages import HandPose, Source

BOTH = Both.of("both-poses", 3)
HZ = 60.0
COUNT = 120
T_S = 2.0 + np.arange(COUNT) / HZ
INDEX = 1


def poses(**changes: Float) -> list[HandPose]:
    """Poses without error at T_S, tracked to the last joint; but `off_m` (T, 26, 3) is added, and others replaced."""
    off = changes.get("off_m", np.zeros((COUNT, 26, 3)))
    tracked = changes.get("tracked", np.ones((COUNT, 26)))
    valid = changes.get("valid", np.ones((COUNT, 26)))
    out: list[HandPose] = []
    for k, t in enumerate(T_S.tolist()):
        truth = BOTH.scene.truth(t)
        none = np.full((6, 3), np.nan)
        out.append(
            HandPose(
                hand="anna",
                t_ns=START_NS + round(t * 1e9),
                position_m=truth.joints.position_m + off[k],
                orientation_wxyz=matrix_to_quaternion(truth.joints.rotation),
                radius_m=BOTH.scene.model.radius_m,
                valid=valid[k] > 0.0,
                tracked=tracked[k] * valid[k] > 0.0,
                cov_m2=np.tile(1e-6 * np.eye(3), (26, 1, 1)),
                source=np.full(26, Source.SOLVED, np.uint8),
                angles_rad=truth.angles_rad,
                markers_m=none,
                markers_raw_m=none,
                markers_cov_m2=np.full((6, 3, 3), np.nan),
                inside_volume=np.ones(26, np.bool_),
            )
        )
    return out


def solved(**changes: Float) -> Solved:
    return Solved.of(BOTH, poses(**changes), BOTH.fused)


def shown(visible_area: float = 100.0) -> Visibility:
    """So much paint of every marker in both cameras at all times."""
    times = np.arange(0.0, 6.0, 1.0 / HZ)
    cameras = BOTH.markers.rig.cameras
    areas = {name: np.full((len(times), 6), visible_area) for name in cameras}
    return Visibility(dict.fromkeys(cameras, times), areas)


def test_a_hand_without_error_has_none_and_every_bit_is_true() -> None:
    got = Figures.of(solved(), shown())
    assert got.joint_mm == pytest.approx(0.0, abs=1e-6)
    assert got.four_deg == pytest.approx(0.0, abs=1e-6)
    assert got.fingers_mm == pytest.approx(0.0, abs=1e-6)
    assert (got.valid, got.tracked, got.inside, got.false_tracked) == (1.0, 1.0, 1.0, 0.0)


def test_a_shift_of_the_hand_is_no_error_of_its_fingers() -> None:
    off = np.zeros((COUNT, 26, 3))
    off[60:, :, 0] = 0.006
    got = Figures.of(solved(off_m=off), shown())
    assert got.joint_mm == pytest.approx(3.0)
    assert got.fingers_mm == pytest.approx(0.0, abs=1e-6)
    assert got.inside == pytest.approx(0.5)  # 6 mm where 1 mm is claimed
    assert got.false_tracked == 0.0  # 20 mm are meant


def test_a_joint_that_is_not_valid_has_neither_error_nor_region() -> None:
    off, valid = np.zeros((COUNT, 26, 3)), np.ones((COUNT, 26))
    tip = TIPS[INDEX]
    off[60:62, tip, 1] = 0.5
    valid[60:62, tip] = 0.0
    got = Figures.of(solved(off_m=off, valid=valid), shown())
    assert got.joint_mm == pytest.approx(0.0, abs=1e-6)
    assert got.inside == 1.0
    assert got.valid == pytest.approx(1.0 - 2.0 / (25 * COUNT))


def test_a_tracked_bit_is_false_where_the_joint_is_far_off() -> None:
    off = np.zeros((COUNT, 26, 3))
    off[10:22, TIPS[INDEX], 2] = 0.021
    got = Figures.of(solved(off_m=off), shown())
    assert got.false_tracked == pytest.approx(12 / COUNT)


def test_a_wrist_device_s_hand_is_put_where_it_truly_is() -> None:
    moved = poses()
    R_extra = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    elsewhere = [_moved(pose, R_extra, np.array([0.3, -0.1, 0.2])) for pose in moved]
    alone = Solved.of(BOTH, elsewhere, BOTH.wrist)
    assert np.nanmax(alone.off_mm) == pytest.approx(0.0, abs=1e-6)


def _moved(pose: HandPose, R_extra: Float, shift: Float) -> HandPose:
    t = 1e-9 * (pose.t_ns - START_NS)
    rotation = R_extra @ BOTH.scene.truth(t).joints.rotation
    fields = {name: getattr(pose, name) for name in pose.__struct_fields__}
    fields |= {
        "position_m": pose.position_m @ R_extra.T + shift,
        "orientation_wxyz": matrix_to_quaternion(rotation),
    }
    return HandPose(**fields)


def test_a_finger_is_in_sight_around_the_frame_that_shows_it() -> None:
    both = shown(visible_area=0.0)
    name = BOTH.markers.rig.cameras[0]
    both.visible_px2[name][120, INDEX] = 50.0  # at 2 s
    seen = both.cameras_of(np.array([1.94, 1.97, 2.0, 2.03, 2.06]), 0.04)[:, INDEX]
    assert seen.tolist() == [0, 1, 1, 1, 0]


def test_ratios_compare_what_both_call_valid() -> None:
    off, more = np.zeros((COUNT, 26, 3)), np.zeros((COUNT, 26, 3))
    off[..., 0], more[..., 0] = 0.002, 0.004
    valid = np.ones((COUNT, 26))
    valid[:, TIPS] = 0.0
    more[:, TIPS, 0] = 1.0
    off[:, WRIST, 0] = 0.002
    assert ratios(solved(off_m=off), solved(off_m=more, valid=valid)).joints == pytest.approx(0.5)
