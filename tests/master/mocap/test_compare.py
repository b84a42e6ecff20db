"""Figures of poses whose errors are known."""

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from common.hand.model import JOINTS
from master.mocap.align import Alignment
from master.mocap.bvh_file import MARKERS, JointMotion
from master.mocap.compare import compare, figures
from master.outputs.poses import Poses
from tests.master.mocap.moved import RIGHT, hand_at, motion_of, ns, poses_of

T_S = np.arange(240) / 60.0
TRUTH_S = np.arange(600) / 120.0
SAME = Alignment(np.eye(4))


def truth(*without: str) -> JointMotion:
    return motion_of(hand_at(TRUTH_S).position_m, TRUTH_S, without)


def of(poses: Poses, motion: JointMotion, markers: tuple[str, ...] = ()) -> dict[str, Any]:
    return cast(dict[str, Any], figures(compare(poses, motion, SAME, markers)))


@pytest.fixture(scope="module")
def noisy() -> Poses:
    return Poses.of(poses_of(T_S, 2e-3))


def test_errors_and_regions_of_independent_noise(noisy: Poses) -> None:
    found = of(noisy, truth())
    assert found["poses"] == 240
    assert found["joint_mm"] == pytest.approx(
        2.0 * np.sqrt(8.0 / np.pi), rel=0.02
    )  # mean of a chi of 3 degrees
    assert found["joint_mm_p95"] == pytest.approx(2.0 * np.sqrt(7.815), rel=0.03)
    assert found["coverage_95_percent"] == pytest.approx(95.0, abs=1.0)
    assert found["coverage_50_percent"] == pytest.approx(50.0, abs=2.0)
    assert found["joint_mm_constant"] < 0.5
    assert found["valid_percent"] == found["tracked_percent"] == 100.0
    assert set(found["classes"]) > {"wrist", "phalanx-intermediate", "tip"}


def test_a_joint_centre_placed_elsewhere_is_constant_in_its_axes() -> None:
    hand = hand_at(T_S)
    exact = Poses.of(poses_of(T_S, 0.0))
    aside = hand.position_m + hand.rotation @ np.array([0.0, 0.005, 0.0])
    found = of(replace(exact, position_m=aside), truth())
    assert found["joint_mm"] == pytest.approx(5.0, abs=0.05)
    assert found["joint_mm_constant"] == pytest.approx(5.0, abs=0.05)


def test_a_false_tracked_joint_is_counted(noisy: Poses) -> None:
    exact = Poses.of(poses_of(T_S, 0.0))
    position, tip = exact.position_m.copy(), JOINTS.index("ring-finger-tip")
    position[:24, tip] += [0.0, 0.0, 0.016]  # a tenth of the time
    found = of(replace(exact, position_m=position), truth())
    assert found["fingers"]["ring"]["false_tracked_percent"] == pytest.approx(100.0 * 0.1 / 5.0)
    assert found["fingers"]["index"]["false_tracked_percent"] == 0.0
    tracked = exact.tracked.copy()
    tracked[:24, tip] = False
    found = of(replace(exact, position_m=position, tracked=tracked), truth())
    assert found["false_tracked_percent"] == 0.0
    assert found["classes"]["tip"]["tracked_percent"] == pytest.approx(100.0 * (1.0 - 0.1 / 5.0))
    # A PIP that is wrong by more than 20 degrees makes the finger's joints false, near as they may be.
    bent = hand_at(T_S)
    rotated = exact.position_m.copy()
    middle, last = (
        JOINTS.index("index-finger-phalanx-intermediate"),
        JOINTS.index("index-finger-phalanx-distal"),
    )
    rotated[:, middle] += bent.rotation[:, middle] @ np.array([0.0, 0.011, 0.0])
    found = of(replace(exact, position_m=rotated), truth())
    assert found["fingers"]["index"]["pip_deg"] > 20.0
    assert found["fingers"]["index"]["false_tracked_percent"] > 50.0
    assert found["fingers"]["middle"]["false_tracked_percent"] == 0.0
    assert last > middle


def test_angles_are_those_between_bones_with_or_without_metacarpals() -> None:
    exact = Poses.of(poses_of(T_S, 0.0))
    bases = tuple(name for name in JOINTS if name.endswith("finger-metacarpal"))
    for without in ((), bases):
        found = of(exact, truth(*without))
        assert found["mcp_deg"] < 0.1
        assert found["pip_deg"] < 0.1
        assert found["fingers"]["thumb"]["ip_deg"] < 0.1


def test_poses_without_covariance_hold_no_truth_and_invalid_ones_count(noisy: Poses) -> None:
    cov = noisy.cov_m2.copy()
    cov[:, 10] = np.nan
    valid = noisy.valid.copy()
    valid[:, 3] = False
    found = of(replace(noisy, cov_m2=cov, valid=valid), truth())
    assert found["coverage_95_percent"] == pytest.approx(95.0 * 24 / 25, abs=1.0)
    assert found["valid_percent"] == pytest.approx(100.0 * 25 / 26)


def test_markers_alone_are_compared(noisy: Poses) -> None:
    hand = hand_at(TRUTH_S)
    points = RIGHT.marker_points(hand, MARKERS[:6])
    motion = JointMotion(ns(TRUTH_S), MARKERS[:6], points + np.array([0.003, 0.0, 0.0]), None, "markers.c3d")
    names = tuple(RIGHT.mounts)
    found = of(noisy, motion, names)
    assert found["joint_mm"] is None
    assert set(found["markers"]) == set(names)
    assert found["markers"]["back"]["mean_mm"] == pytest.approx(3.0, abs=0.05)


def test_only_the_time_of_both_counts(noisy: Poses) -> None:
    motion = motion_of(hand_at(TRUTH_S).position_m[:240], TRUTH_S[:240])  # two seconds of four
    assert of(noisy, motion)["poses"] == 120
