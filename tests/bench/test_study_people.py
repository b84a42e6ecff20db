"""Who takes part is spread as the study has it, and what is measured of a hand is off as calibrations are."""

from pathlib import Path

import numpy as np
import pytest

from bench.study.trials import Participant, orders, participant, rotated, with_bones
from common.arrays import Float
from common.calibration import HandProfile, RigCalibration, load
from common.hand.model import FINGER_JOINTS, JOINTS, HandModel
from common.sim.motion import POSES

CALIB = Path(__file__).resolve().parents[2] / "calib_json"
RIG = load(CALIB / "rigs/wrist.json", RigCalibration)
HAND = load(CALIB / "hands/default-right.json", HandProfile)
PEOPLE: list[Participant] = [participant(5, number, RIG, HAND) for number in range(1, 121)]


def lengths(hand: HandProfile) -> Float:
    """(5, 3) [m]."""
    place = np.array(
        [[hand.rest_joints[JOINTS[j]].position_m for j in chain[-4:]] for chain in FINGER_JOINTS]
    )
    return np.linalg.norm(np.diff(place, axis=1), axis=2)


def test_bones_mounting_and_reflectance_stay_in_their_ranges_and_fill_them() -> None:
    share = np.array([lengths(one.hand) for one in PEOPLE]) / lengths(HAND) - 1.0
    assert np.abs(share).max() <= 0.08 + 1e-6
    assert np.ptp(share, axis=0).min() > 0.14  # every bone of its own
    assert np.abs(np.corrcoef(share[:, 1, 0], share[:, 1, 1])[0, 1]) < 0.3
    skin = np.array([one.reflectance for one in PEOPLE])
    assert 0.8 <= skin.min() < 0.83
    assert 1.17 < skin.max() <= 1.2
    nominal = np.array(RIG.T_camera_palm)
    poses = np.array([one.rig.T_camera_palm for one in PEOPLE])
    shift = 1e3 * (poses[:, :3, 3] - nominal[:3, 3])
    assert 1.9 < np.abs(shift).max() <= 2.0
    rotations = poses[:, :3, :3] @ nominal[:3, :3].T
    angle = np.degrees(np.arccos(np.clip(0.5 * (np.trace(rotations, axis1=1, axis2=2) - 1.0), -1.0, 1.0)))
    assert angle.max() <= 3.0 * np.sqrt(3.0) + 1e-6
    assert angle.max() > 3.5
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-9)


def test_measured_bones_are_off_as_a_hand_calibration_is() -> None:
    off = 1e3 * np.array([lengths(one.measured) - lengths(one.hand) for one in PEOPLE])
    assert float(np.sqrt((off**2).mean())) == pytest.approx(0.9, abs=0.05)  # a bone alone
    assert float(np.sqrt((off.sum(axis=2) ** 2).mean())) == pytest.approx(0.43, abs=0.05)  # a whole finger


def test_the_same_seed_is_the_same_person_and_each_number_another() -> None:
    assert participant(5, 3, RIG, HAND) != participant(5, 4, RIG, HAND)
    again = participant(5, 3, RIG, HAND)
    assert (again.hand, again.rig, again.reflectance, again.seed) == (
        PEOPLE[2].hand,
        PEOPLE[2].rig,
        PEOPLE[2].reflectance,
        PEOPLE[2].seed,
    )
    assert len({one.seed for one in PEOPLE} | {participant(6, 1, RIG, HAND).seed}) == len(PEOPLE) + 1


def test_a_hand_with_its_own_bones_is_the_same_hand_and_every_hand_is_legal() -> None:
    same = with_bones(HAND, 1.0, np.ones((5, 3)))
    for name, joint in HAND.rest_joints.items():
        np.testing.assert_allclose(same.rest_joints[name].position_m, joint.position_m, atol=1e-12)
    still = np.array(rotated(RIG, np.zeros(3), np.zeros(3)).T_camera_palm)
    np.testing.assert_allclose(still, np.array(RIG.T_camera_palm), atol=1e-12)
    for one in PEOPLE[:5]:
        assert HandModel.of(one.hand).dip_per_pip == pytest.approx(0.84)  # as the paper's hands bend


def test_every_block_has_the_six_poses_in_an_order_of_its_own() -> None:
    order = orders(40, seed=9)
    assert all(sorted(block) == sorted(POSES) for block in order)
    assert len(set(order)) > 30
    assert {block[0] for block in order} == set(POSES)
    assert order == orders(40, seed=9)
