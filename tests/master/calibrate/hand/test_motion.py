"""A hand file from a motion capture: the hand comes back, left and right, and what is lacking is refused or said."""

import json
from pathlib import Path

import numpy as np
import pytest

from common.arrays import Float
from common.calibration import HandProfile, load
from common.errors import CalibrationError, FitError, RecordingError
from common.hand.fitting import joint_angles
from common.hand.model import CHAINS, JOINTS, HandModel, couplings_of
from master.calibrate.hand.motion import Ratio, find_palm, hand_from_motion, motion_couplings, motion_lines
from master.mocap.bvh_file import Side
from tests.cli import calibrate
from tests.master.mocap.moved import LEFT, RIGHT, ROTATION, SHIFT, hand_at, motion_of, ns, write_table

T_S = np.arange(900) / 30.0
BASES = tuple(name for name in JOINTS if name.endswith("finger-metacarpal"))
MODELS: dict[Side, HandModel] = {"right": RIGHT, "left": LEFT}


def run(*options: str) -> str:
    return calibrate("hand", *options)


@pytest.mark.parametrize(
    ("side", "without"), [("right", ()), ("left", ()), ("right", BASES), ("left", ("palm", *BASES))]
)
def test_a_hand_comes_back_and_shows_its_side(side: Side, without: tuple[str, ...]) -> None:
    joints = hand_at(T_S, MODELS[side]).position_m @ ROTATION.T + SHIFT
    hand = hand_from_motion(motion_of(joints, T_S, without), "again")
    assert hand.profile.side == side
    assert not hand.palm.mirrored
    truth, found = MODELS[side], HandModel.of(hand.profile)
    np.testing.assert_allclose(found.bone_m, truth.bone_m, atol=1e-6)
    np.testing.assert_allclose(
        found.rest_position_m[CHAINS[:, 0]], truth.rest_position_m[CHAINS[:, 0]], atol=1e-4
    )
    assert hand.length_m == pytest.approx(0.19, abs=5e-4)
    if not without:
        np.testing.assert_allclose(found.rest_position_m, truth.rest_position_m, atol=6e-3)
    output = "\n".join(motion_lines(hand))
    assert ("index-finger-metacarpal" in output) == bool(without)
    assert "rest_joints" in hand.profile.provenance


@pytest.mark.parametrize("side", ["right", "left"])
def test_left_handed_axes_are_turned_over_where_a_person_says_the_side(side: Side) -> None:
    joints = hand_at(T_S, MODELS[side]).position_m * [-1.0, 1.0, 1.0]
    hand = hand_from_motion(motion_of(joints, T_S, side=side), "again")
    assert hand.palm.mirrored
    np.testing.assert_allclose(HandModel.of(hand.profile).bone_m, MODELS[side].bone_m, atol=1e-6)
    assert "left-handed" in "\n".join(motion_lines(hand))


def test_frames_that_are_wrong_or_not_whole_are_left_out() -> None:
    joints = hand_at(T_S).position_m
    joints[::9, JOINTS.index("index-finger-tip")] += [0.08, 0.0, 0.0]  # swapped with another marker
    joints[1::9, JOINTS.index("ring-finger-phalanx-distal")] = np.nan
    joints[2::9, JOINTS.index("pinky-finger-phalanx-proximal")] += [0.0, 0.09, 0.0]
    hand = hand_from_motion(motion_of(joints, T_S), "again")
    assert hand.frames == 6 * len(T_S) // 9
    np.testing.assert_allclose(HandModel.of(hand.profile).bone_m, RIGHT.bone_m, atol=1e-6)


@pytest.mark.parametrize("spread_deg", [4.0, 8.0])
def test_the_posture_of_a_person_is_measured(spread_deg: float) -> None:
    joints = hand_at(T_S, RIGHT, np.radians(spread_deg)).position_m
    hand = hand_from_motion(motion_of(joints, T_S), "again")
    found = couplings_of(hand.profile)
    assert found.dip_per_pip == pytest.approx(0.7, abs=0.02)
    assert np.degrees(found.dip_spread_rad) == pytest.approx(spread_deg, rel=0.35)  # of a sine, not a normal
    assert found.mcp_per_pip == pytest.approx(0.6, abs=0.05)
    assert "couplings" in hand.profile.provenance


def test_noise_of_joints_is_no_spread_of_a_person() -> None:
    joints = hand_at(T_S, RIGHT, np.radians(8.0)).position_m
    noise = np.random.default_rng(1).normal(0.0, 8e-4, joints.shape)

    def output(joints: Float) -> Ratio | None:
        chains = find_palm(joints, "right", "file").chains_m
        return motion_couplings(joint_angles(RIGHT, chains), chains, ns(T_S)).dip

    clean, noisy = output(joints), output(joints + noise)
    assert clean is not None
    assert noisy is not None
    assert noisy.noise_rad > np.radians(4.0)
    assert noisy.spread_rad == pytest.approx(clean.spread_rad, rel=0.25)


def test_a_dip_that_a_tracker_made_is_not_a_person_s() -> None:
    hand = hand_from_motion(motion_of(hand_at(T_S).position_m, T_S), "again")
    assert couplings_of(hand.profile).dip_per_pip == pytest.approx(2.0 / 3.0)
    assert "its tracker made it" in "\n".join(motion_lines(hand))


def test_a_short_motion_measures_no_posture() -> None:
    t_s = T_S[:300]
    hand = hand_from_motion(motion_of(hand_at(t_s, RIGHT, 0.1).position_m, t_s), "again")
    assert hand.profile.couplings is None
    assert "20 s and 20° are needed" in "\n".join(motion_lines(hand))


@pytest.mark.parametrize(
    ("change", "kind", "output"),
    [
        ("no tips", RecordingError, "a hand needs thumb-tip, index-finger-tip"),
        ("stiff ring", CalibrationError, "the ring never bends by 5 degrees"),
        ("flat", FitError, "record fists"),
        ("few", FitError, "60 are needed"),
        ("no knuckles", RecordingError, "a hand needs"),
        ("giant", FitError, "expected 0.1 to 0.25 m"),
    ],
)
def test_what_makes_no_hand_is_refused(change: str, kind: type[Exception], output: str) -> None:
    joints, without = hand_at(T_S).position_m, tuple[str, ...]()
    if change == "no tips":
        without = tuple(name for name in JOINTS if name.endswith("tip"))
    elif change == "no knuckles":
        without = tuple(name for name in JOINTS if name.endswith("finger-phalanx-proximal"))
    elif change == "few":
        joints[59:, 20] = np.nan
    elif change == "giant":
        joints = 3.0 * joints
    else:
        angles = np.zeros((len(T_S), 5, 4))
        if change == "stiff ring":
            angles[:, [0, 1, 2, 4], 1:] = (0.5 - 0.5 * np.cos(T_S))[:, None, None]
        joints = RIGHT.forward(np.tile(np.eye(4), (len(T_S), 1, 1)), angles).position_m
    with pytest.raises(kind) as caught:
        hand_from_motion(motion_of(joints, T_S, without), "again")
    assert output in str(caught.value)


def test_a_user_makes_a_hand_file(tmp_path: Path) -> None:
    joints = hand_at(T_S, LEFT).position_m
    names = tuple(f"L_{name}" for name in JOINTS)
    table = write_table(tmp_path / "mine.csv", T_S, names, joints)
    output = run(
        "--from", str(table), "--name", "mine", "--out", str(tmp_path), "--json", str(tmp_path / "mine.json")
    )
    assert "left hand (from its names or --side), 190 mm long" in output
    made = load(tmp_path / "hands" / "mine.json", HandProfile)
    assert made.side == "left"
    assert made.provenance["rest_joints"].data == ("mine.csv",)
    figures = json.loads((tmp_path / "mine.json").read_text())
    assert figures["bones"]["index_proximal"]["mm"] == pytest.approx(0.245 * 190.0, abs=0.05)
    with pytest.raises(CalibrationError, match="--length-mm has no meaning with --from"):
        run("--from", str(table), "--length-mm", "190")
    with pytest.raises(CalibrationError, match="are for --from FILE"):
        run("--length-mm", "190", "--unit", "mm")
