"""Profiles from joints that were recorded: a known hand comes back, and Leap's and WebXR's hands are followed."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from bench.hands.motion import floor_m, recordings
from common.arrays import Float
from common.calibration import HandProfile
from common.errors import CalibrationError
from common.hand.fitting import profile_from_joints, profile_from_rest
from common.hand.model import CHAINS, HandModel
from common.hand.profiles import generated_profile


def motion(model: HandModel, count: int = 200) -> Float:
    """Angles (T, 5, 4) [rad] of a hand that opens, closes and spreads, extended at the beginning."""
    t = np.linspace(0.0, 1.0, count)[:, None]
    bend = 0.5 - 0.5 * np.cos(2.0 * np.pi * t)
    phases = np.arange(5) / 5.0
    angles = np.zeros((count, 5, 4))
    angles[..., 0] = 0.2 * bend * np.sin(2.0 * np.pi * (3.0 * t + phases))
    angles[..., 1] = 0.8 * bend
    angles[..., 2] = 1.2 * bend
    angles[..., 3] = 0.8 * bend
    return model.clamp(angles)


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_generated_hand_comes_back_from_its_joints(side: str) -> None:
    truth = HandModel.of(generated_profile("made", side))
    chains = truth.chains(motion(truth)).position_m
    found = HandModel.of(profile_from_joints("again", side, chains))
    np.testing.assert_allclose(found.bone_m, truth.bone_m, atol=1e-6)
    for chain in CHAINS:
        np.testing.assert_allclose(
            found.rest_position_m[chain[0]], truth.rest_position_m[chain[0]], atol=1e-6
        )
        rotation = found.rest_rotation[chain[0]].T @ truth.rest_rotation[chain[0]]
        off_deg = np.degrees(np.arccos(np.clip(0.5 * (np.trace(rotation) - 1.0), -1.0, 1.0)))
        assert off_deg < 2.0  # where abduction is zero is what the recording shows of it


def test_noise_of_a_millimetre_leaves_the_bones() -> None:
    truth = HandModel.of(generated_profile("made", "right"))
    chains = truth.chains(motion(truth)).position_m
    chains = chains + np.random.default_rng(1).normal(0.0, 1e-3, chains.shape)
    found = HandModel.of(profile_from_joints("again", "right", chains))
    lengths = [np.linalg.norm(model.bone_m, axis=2) for model in (found, truth)]
    # Noise across a bone of 11 mm lengthens it by its variance over the length, 0.2 mm.
    np.testing.assert_allclose(lengths[0], lengths[1], atol=3e-4)


def test_a_finger_that_never_bends_is_refused() -> None:
    model = HandModel.of(generated_profile("made", "right"))
    angles = motion(model)
    angles[:, 3] = 0.0
    with pytest.raises(CalibrationError, match="the ring never bends by 5 degrees"):
        profile_from_joints("stiff", "right", model.chains(angles).position_m)


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_rest_heading_is_the_median_of_the_motion_where_joints_are_noisy(side: str) -> None:
    """Straight fingers bend in no plane: of a middle finger that is mostly so, planes were up to 170 degrees off."""
    truth = HandModel.of(generated_profile("made", side))
    angles = motion(truth, 600)
    angles[..., 2:] *= 0.1
    chains = truth.chains(angles).position_m
    chains = chains + np.random.default_rng(2).normal(0.0, 1e-3, chains.shape)
    found = HandModel.of(profile_from_joints("again", side, chains))
    for chain in CHAINS[1:]:
        ahead, exact = (-model.rest_rotation[chain[0]][:, 2] for model in (found, truth))
        off_deg = np.degrees(np.arctan2(ahead[0], ahead[2]) - np.arctan2(exact[0], exact[2]))
        assert abs(off_deg) < 2.0


def test_a_hand_that_the_profile_does_not_follow_is_said(caplog: pytest.LogCaptureFixture) -> None:
    model = HandModel.of(generated_profile("made", "right"))
    chains = model.chains(motion(model)).position_m
    profile_from_joints("good", "right", chains)
    assert not caplog.records
    chains[::2, 3, 1:] += [0.0, 0.0, 0.015]  # a ring finger whose first bone changes its length
    profile_from_joints("odd", "right", chains)
    assert "'odd': the ring of the profile is" in caplog.text


def test_a_side_is_left_or_right() -> None:
    with pytest.raises(CalibrationError, match="left or right"):
        profile_from_rest("odd", "both", np.zeros((25, 3)), np.tile(np.eye(3), (25, 1, 1)))


def test_a_recorded_hand_is_followed_to_a_tenth_of_a_millimetre(datasets: Path) -> None:
    for recorded in recordings(datasets / "leapjs"):
        some = replace(recorded, fingers_m=recorded.fingers_m[:: max(1, len(recorded.fingers_m) // 10)])
        assert floor_m(some, recorded.model()).mean() < 2e-4, recorded.name


def test_a_flat_webxr_hand_is_its_own_rest_pose(datasets: Path) -> None:
    with np.load(datasets / "handy_poses" / "poses.npz") as data:
        flats = dict(zip(data["hands"].tolist(), np.asarray(data["flat"], np.float64), strict=True))
    assert set(flats) == {"left", "right"}
    for side, flat in flats.items():
        profile: HandProfile = profile_from_rest(side, side, flat[:, :3, 3], flat[:, :3, :3])
        model = HandModel.of(profile)
        at_rest = model.forward(np.eye(4), np.zeros((5, 4))).position_m
        np.testing.assert_allclose(at_rest[1:], flat[:, :3, 3] * [-1.0, 1.0, -1.0], atol=1e-6)
        # Fingers ahead, the back of the hand up, the thumb to its own side.
        assert (at_rest[CHAINS[1:, 3], 2] > 0.1).all()
        assert np.sign(at_rest[5, 0]) == model.side_sign
        for a, b in pairwise(CHAINS[2]):
            assert np.linalg.norm(at_rest[b] - at_rest[a]) > 0.01
