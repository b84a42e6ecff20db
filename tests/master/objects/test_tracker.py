"""The line of a tracker: its poses in the rig by hand, how sure, held, lost, leaps, clocks; and what is refused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from common.calibration import Provenance, RigCalibration
from common.calibration.object_profile import ObjectProfile
from common.errors import CalibrationError
from common.geometry.transforms import matrix_to_rotation_vector, quaternion_to_matrix
from common.messages import ObjectPose, ObjectSource, TrackerPose
from master.calibrate.tracker.registration import documented, register
from master.objects.tracker import TrackerLine, covariance_of, registered
from tests.master.calibrate.tracker.simulated import ZERO_NS, Motion

MS = 1_000_000
RIG = RigCalibration(
    version=1,
    name="desk",
    kind="markers",
    cameras=("left",),
    hand="me",
    T_rig_tracking=((0.0, -1.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
)
CUBE = ObjectProfile(
    version=1,
    name="cube",
    tracker="tracker",
    T_object_tracker=((1.0, 0.0, 0.0, 0.1), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
    stamp_offset_us=-12_000.0,
)
QUARTER = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
HERE = np.array([0.2, 0.3, 0.5])


def pose_at(
    t_ms: float, place: np.ndarray = HERE, quaternion: np.ndarray = QUARTER, session: int = 1
) -> TrackerPose:
    return TrackerPose("tracker", session, int(t_ms), ZERO_NS + round(t_ms * MS), place, quaternion)


def lost(t_ms: float) -> TrackerPose:
    return pose_at(t_ms, np.full(3, np.nan), np.full(4, np.nan))


def one(line: TrackerLine, message: TrackerPose) -> ObjectPose:
    [solved] = line.push(message)
    assert solved.ready_t_ns == message.t_ns
    return solved.pose


def test_a_pose_by_hand() -> None:
    # The device is a quarter turned about the system's z, the system a quarter about the rig's z and 1 m aside: half a
    # turn. Its place 0.2, 0.3, 0.5 becomes 1 - 0.3, 0.2, 0.5; the object's origin is 10 cm along the device's -x, which
    # points along the rig's +x now.
    pose = one(TrackerLine(CUBE, RIG), pose_at(100.0))
    np.testing.assert_allclose(pose.position_m, [0.8, 0.2, 0.5], atol=1e-12)
    np.testing.assert_allclose(
        quaternion_to_matrix(pose.orientation_wxyz), np.diag([-1.0, -1.0, 1.0]), atol=1e-12
    )
    assert pose.t_ns == ZERO_NS + 88 * MS  # 12 ms before its stamp
    assert (pose.object, pose.source, pose.tracked, pose.occluded) == (
        "cube",
        ObjectSource.TRACKER,
        True,
        False,
    )
    assert np.isnan(pose.residual_m)


def test_while_it_is_lost_the_pose_is_held_ever_less_sure_and_then_there_is_none() -> None:
    line = TrackerLine(CUBE, RIG)
    assert one(line, lost(0.0)).source == ObjectSource.NONE
    known = one(line, pose_at(10.0))
    held = [one(line, lost(t_ms)) for t_ms in (20.0, 200.0, 509.0)]
    for pose in held:
        assert (pose.source, pose.tracked, pose.occluded) == (ObjectSource.HELD, False, True)
        np.testing.assert_array_equal(pose.position_m, known.position_m)
    sizes = [float(np.trace(pose.cov)) for pose in (known, *held)]
    assert sizes == sorted(sizes)
    assert held[1].cov[0, 0] > (0.05) ** 2 > held[0].cov[0, 0]
    gone = one(line, lost(520.0))
    assert (gone.source, gone.tracked) == (ObjectSource.NONE, False)
    assert np.isnan([*gone.position_m, *gone.orientation_wxyz, *gone.cov.ravel()]).all()
    assert one(line, pose_at(530.0)).tracked
    assert line.counts == {"lost": 5}


def test_a_leap_is_first_rejected_and_then_accepted() -> None:
    line, far = TrackerLine(CUBE, RIG), HERE + np.array([0.5, 0.0, 0.0])
    one(line, pose_at(0.0))
    leapt = one(line, pose_at(10.0, far))
    assert (leapt.source, leapt.tracked) == (ObjectSource.HELD, False)
    assert one(line, pose_at(20.0)).tracked
    poses = [one(line, pose_at(30.0 + 10.0 * k, far)) for k in range(17)]
    assert [pose.tracked for pose in poses] == [False] * 15 + [True] * 2
    assert line.counts["leap"] == 16
    quick = TrackerLine(CUBE, RIG)  # 4 m/s are none
    assert all(
        one(quick, pose_at(10.0 * k, HERE + np.array([0.04 * k, 0.0, 0.0]))).tracked for k in range(20)
    )


def test_poses_come_once_and_rise_and_a_new_process_may_have_another_clock() -> None:
    line = TrackerLine(CUBE, RIG)
    one(line, pose_at(50.0))
    assert line.push(pose_at(50.0)) == []
    assert line.push(pose_at(40.0)) == []
    assert one(line, pose_at(20.0, session=2)).t_ns == ZERO_NS + 8 * MS
    assert line.counts["late"] == 2


def test_a_turn_that_is_none_is_counted_and_a_foreign_device_is_an_error() -> None:
    line = TrackerLine(CUBE, RIG)
    assert not one(line, pose_at(0.0, quaternion=np.array([0.955, 0.0, 0.0, 0.0]))).tracked
    assert not one(line, pose_at(10.0, quaternion=np.array([1.0, np.nan, 0.0, 0.0]))).tracked
    assert line.counts == {"broken": 1, "lost": 1}
    with pytest.raises(ValueError, match="'other'"):
        line.push(replace(pose_at(20.0), source="other"))


@pytest.mark.parametrize(
    ("profile", "rig", "missing"),
    [
        (replace(CUBE, T_object_tracker=None), RIG, "T_object_tracker"),
        (CUBE, replace(RIG, T_rig_tracking=None), "T_rig_tracking"),
        (replace(CUBE, tracker=None), RIG, "tracker None"),
    ],
)
def test_what_is_not_registered_is_refused(profile: ObjectProfile, rig: RigCalibration, missing: str) -> None:
    assert not registered(profile, rig)
    with pytest.raises(CalibrationError, match=rf"{missing}.*calibrate tracker cube"):
        TrackerLine(profile, rig)
    assert registered(CUBE, RIG)


@given(st.floats(0.1, 20.0), st.floats(0.0, 3.0), st.floats(0.05, 5.0), st.floats(0.0, 1.0))
def test_the_covariance_is_that_of_what_was_left_and_of_the_registration(
    mm: float, sigma_mm: float, deg: float, sigma_deg: float
) -> None:
    residual = {
        "position_mm": mm,
        "position_sigma_mm": sigma_mm,
        "rotation_deg": deg,
        "rotation_sigma_deg": sigma_deg,
    }
    how = Provenance(date="2026-01-01T00:00:00Z", tool="t", data=(), residual=residual)
    cov = covariance_of(replace(CUBE, provenance={"T_object_tracker": how}))
    assert np.trace(cov[:3, :3]) == pytest.approx(1e-6 * (mm**2 + sigma_mm**2))
    assert np.trace(cov[3:, 3:]) == pytest.approx(np.radians(1.0) ** 2 * (deg**2 + sigma_deg**2))
    assert covariance_of(CUBE)[0, 0] > 0.0


def test_from_a_registration_to_poses_that_are_as_right_as_they_say() -> None:
    millimetres, degrees, within = [], [], []
    for seed in range(3):
        motion = Motion(seed + 40)
        profile = replace(CUBE, T_object_tracker=None, stamp_offset_us=0.0)
        found = register(motion.objects(), motion.tracked())
        rig, profile = documented(replace(RIG, T_rig_tracking=None), profile, found, "test")
        line = TrackerLine(profile, rig)
        for message in motion.tracked():
            [solved] = line.push(message)
            if not solved.pose.tracked:
                continue
            R, p = motion.truth(np.array([1e-9 * (solved.pose.t_ns - ZERO_NS)]))
            quaternion = matrix_to_rotation_vector(
                quaternion_to_matrix(solved.pose.orientation_wxyz) @ R[0].T
            )
            off = np.concatenate([solved.pose.position_m - p[0], quaternion])
            millimetres.append(1e3 * float(np.linalg.norm(off[:3])))
            degrees.append(float(np.degrees(np.linalg.norm(off[3:]))))
            within.append(float(off @ np.linalg.solve(solved.pose.cov, off)))
    assert np.quantile(millimetres, 0.95) < 2.0
    assert np.quantile(degrees, 0.95) < 0.3
    assert np.mean(np.array(within) < 12.6) > 0.95  # chi square of six: rather too sure of nothing
