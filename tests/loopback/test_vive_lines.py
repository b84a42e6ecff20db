"""The whole way of a Vive tracker: lines of libsurvive in bunches, broken ones among them, to an object in the rig."""

import numpy as np

from common.calibration import RigCalibration
from common.calibration.object_profile import ObjectProfile
from common.geometry.transforms import matrix_to_rotation_vector, quaternion_to_matrix
from common.messages import TrackerPose
from master.calibrate.tracker.registration import documented, register
from master.objects.tracker import TrackerLine
from slave.objects.survive import SurviveDevice
from tests.master.calibrate.tracker.simulated import ZERO_NS, Motion
from tests.slave.objects.recorded import HEAD

DELAY_NS = 6_000_000  # from the pose to its line, at the least
RATE = 1.0 + 60e-6  # of the program's clock
RIG = RigCalibration(version=1, name="desk", kind="markers", cameras=("left",), hand="me")
OBJECT = ObjectProfile(version=1, name="cube", tracker="tracker")


def lines_of(motion: Motion) -> list[tuple[int, bytes]]:
    """When each line of a program that began 30 s before was there, slave's clock [ns], and the line.

    Six decimals; some poses of another device, of a solver that failed, cut in the middle; none where it was lost.
    """
    rng = np.random.default_rng([motion.seed, 21])
    lines: list[tuple[int, bytes]] = [(ZERO_NS - 30_000_000_000, HEAD)]
    for one in motion.tracked():
        if not np.isfinite(one.position_m).all():
            continue
        t_ns = one.t_ns + round(1e9 * motion.late_s) + DELAY_NS
        stamp = RATE * 1e-9 * (t_ns - ZERO_NS + 30_000_000_000)
        numbers = " ".join(f"{value:.6f}" for value in (*one.position_m, *one.orientation_wxyz))
        line = f"{stamp:.6f} WM0 POSE {numbers} \r\n".encode()
        if rng.random() < 0.03:
            line = line[: rng.integers(10, 60)] + line
        if rng.random() < 0.02:
            line += f"{stamp:.6f} WM0 POSE nan nan nan nan nan nan nan\r\n".encode()
        line += f"{stamp:.6f} T20 POSE 5 5 5 1 0 0 0\r\n{stamp:.6f} WM0 VELOCITY 0 0 0 0 0 0\r\n".encode()
        lines.append((t_ns, line))
    return lines


def read(motion: Motion) -> tuple[list[TrackerPose], SurviveDevice]:
    """What the slave makes of the lines, read in bunches by a machine that is busy now and then."""
    rng = np.random.default_rng([motion.seed, 22])
    device, poses = SurviveDevice("tracker", "LHR-1A2B3C4D"), list[TrackerPose]()
    waiting = b""
    for t_ns, line in lines_of(motion):
        waiting += line
        if rng.random() < 0.4:
            poses += device.push(waiting, t_ns + round(1e6 * rng.exponential(3.0)))
            waiting = b""
    return poses, device


def test_lines_of_a_recording_become_an_object_in_the_rig_that_is_where_it_is() -> None:
    off_mm, off_deg = list[float](), list[float]()
    for seed in (51, 52):
        motion = Motion(seed, late_s=0.0)
        poses, device = read(motion)
        assert device.counts["broken.length"] + device.counts["broken.number"] > 10
        assert device.counts["others"] > 1000
        found = register(motion.objects(), poses)
        assert abs(1e3 * found.fit.placed.late_s + 6.0) < 2.0  # stamps are 6 ms late, so poses hold before
        rig, profile = documented(RIG, OBJECT, found, "lines")
        line = TrackerLine(profile, rig)
        for pose in [solved.pose for one in poses for solved in line.push(one)]:
            if pose.tracked:
                R, p = motion.truth(np.array([1e-9 * (pose.t_ns - ZERO_NS)]))
                off_mm.append(1e3 * float(np.linalg.norm(pose.position_m - p[0])))
                rotation = matrix_to_rotation_vector(quaternion_to_matrix(pose.orientation_wxyz) @ R[0].T)
                off_deg.append(float(np.degrees(np.linalg.norm(rotation))))
    assert len(off_mm) > 3000
    assert np.quantile(off_mm, 0.95) < 2.5
    assert np.quantile(off_deg, 0.95) < 1.0
