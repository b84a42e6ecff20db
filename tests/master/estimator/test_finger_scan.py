"""The search along a finger's minima: for every PIP the best of the other angles, and which hand is likely."""

from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from common.arrays import Float
from common.messages import SolverMode
from master.estimator.finger_scan import NODES, Scan
from master.estimator.wrist_pipeline import WristPipeline
from tests.master.estimator.wrist_case import (
    CYCLE_NS,
    DIP,
    PIP,
    WristCase,
    bent,
    message,
    natural,
    pipeline,
    pushed,
)

NATURAL, STRAIGHT, FREE = 0, 1, 2


@pytest.fixture(scope="module")
def wrist_case(root: Path) -> WristCase:
    return WristCase.of(root)


def scan_of(line: WristPipeline) -> Scan:
    """What the last triple left."""
    return line._estimator._at.scan


def scanned(
    wrist_case: WristCase, angles: Float, solver_mode: Literal["fk", "auto"] = "auto", tip_px: float = 2.0
) -> Scan:
    """The minima of a hand of angles (5, 4)."""
    line, seen = pipeline(wrist_case, solver_mode), wrist_case.message(angles)
    pushed(line, message(seen.laser_uv, seen.tip_uv, tip_px=tip_px))
    return scan_of(line)


def nodes(wrist_case: WristCase, f: int) -> Float:
    """PIPs (NODES,) of the grid."""
    low, high = wrist_case.model.limits_rad[f, PIP]
    return np.linspace(low, high, NODES)


def on_profile(wrist_case: WristCase, scan: Scan, f: int, pip: float) -> Float:
    """Angles and twist (5,) where the minimum has that PIP."""
    return np.array([np.interp(pip, nodes(wrist_case, f), scan.x[f, :, k]) for k in range(5)])


@pytest.mark.parametrize(
    ("mcp", "pip"), [(10.0, 5.0), (20.0, 40.0), (45.0, 30.0), (30.0, 75.0), (45.0, 62.0)]
)
def test_the_profile_passes_through_the_true_pose(wrist_case: WristCase, mcp: float, pip: float) -> None:
    angles = bent(mcp, pip)
    scan = scanned(wrist_case, angles)
    for f in range(1, 5):
        assert scan.chi2[f] < 1.5
        off = np.degrees(on_profile(wrist_case, scan, f, angles[f, PIP])[:4] - angles[f])
        np.testing.assert_allclose(off[1], 0.0, atol=1.5)
        np.testing.assert_allclose(off[[0, DIP]], 0.0, atol=3.0)


def test_of_random_poses_every_one_is_on_its_profile(wrist_case: WristCase) -> None:
    rng, asked, lost = np.random.default_rng(23), 0, 0
    for _ in range(15):
        angles = wrist_case.setup.model.clamp(bent(*rng.uniform([0.0, 0.0], [60.0, 80.0])))
        scan = scanned(wrist_case, angles)
        shown = wrist_case.looks(angles).length_px > 10.0
        for f in np.flatnonzero(shown[1:]) + 1:
            asked += 1
            off = np.degrees(on_profile(wrist_case, scan, int(f), angles[f, PIP])[:PIP] - angles[f, :PIP])
            lost += int(np.abs(off).max() > 3.0)
    assert asked > 40
    assert lost <= 0.05 * asked


def test_a_sharper_tip_makes_a_narrower_density(wrist_case: WristCase) -> None:
    angles = bent(45.0, 62.0)
    wide, narrow = scanned(wrist_case, angles, tip_px=8.0), scanned(wrist_case, angles, tip_px=1.0)
    assert (narrow.pip2[1:] < wide.pip2[1:]).all()


def test_all_fingers_decide_which_hand_it_is(wrist_case: WristCase) -> None:
    assert scanned(wrist_case, natural(60.0)).share[NATURAL] > 0.85
    assert scanned(wrist_case, bent(60.0, 3.0)).share[STRAIGHT] > 0.5
    assert scanned(wrist_case, bent(70.0, 45.0)).share[FREE] > 0.5
    for angles in (natural(60.0), bent(60.0, 3.0)):
        assert scanned(wrist_case, angles).share.sum() == pytest.approx(1.0)
        np.testing.assert_array_equal(scanned(wrist_case, angles, "fk").share, [1.0, 0.0, 0.0])


def test_a_finger_measured_only_by_the_laser_has_no_weight(wrist_case: WristCase) -> None:
    line = pipeline(wrist_case, "auto")
    pushed(line, wrist_case.message(natural(60.0), tips=False))
    np.testing.assert_allclose(scan_of(line).share, [0.8, 0.1, 0.1], atol=1e-9)


def test_the_estimate_lies_on_the_profile_and_its_spread_is_that_of_the_density(
    wrist_case: WristCase,
) -> None:
    for angles in (natural(50.0), bent(30.0, 60.0), bent(60.0, 5.0)):
        scan = scanned(wrist_case, angles)
        for f in range(1, 5):
            for chosen in (scan.out[f], scan.mode[f]):
                expected = on_profile(wrist_case, scan, f, float(chosen[PIP]))
                np.testing.assert_allclose(chosen, expected, atol=1e-9)
            assert 0.0 < scan.pip2[f] < 1.5
            assert scan.way[f, PIP] == pytest.approx(1.0)
            assert scan.parts[f] >= 1.0


def test_where_a_finger_was_decides_between_two_poses_that_look_alike(wrist_case: WristCase) -> None:
    """A finger that comes from either side of a pose that looks like another stays on that side."""
    alone = pipeline(wrist_case)
    duplicates: list[tuple[float, float, int]] = []
    t_ns = 0
    for mcp in (15.0, 20.0, 24.0, 27.0, 30.0):
        for pip in (50.0, 60.0, 70.0, 80.0):
            t_ns += CYCLE_NS
            pose = pushed(alone, wrist_case.message(bent(mcp, pip), t_ns))
            duplicates += [(mcp, pip, int(f)) for f in np.flatnonzero(pose.ambiguous)]
    assert duplicates
    kept = 0
    for mcp, pip, f in duplicates:
        line = pipeline(wrist_case, continuous=True)
        for k in range(1, 11):
            pose = pushed(line, wrist_case.message(bent(mcp, pip + 10.0 - k), k * CYCLE_NS, unit=0.5))
        kept += int(abs(np.degrees(pose.angles_rad[f, PIP]) - pip) < 12.0)
    assert kept >= 0.7 * len(duplicates)


def test_a_finger_that_is_not_seen_is_not_searched(wrist_case: WristCase) -> None:
    line, seen = pipeline(wrist_case), wrist_case.message(natural(40.0))
    laser = seen.laser_uv.copy()
    laser[3] = np.nan
    pose = pushed(line, message(laser, np.full((5, 2), np.nan)))
    np.testing.assert_array_equal(scan_of(line).known, [1.0, 1.0, 1.0, 0.0, 1.0])
    assert pose.solver_mode[3] == SolverMode.NONE
