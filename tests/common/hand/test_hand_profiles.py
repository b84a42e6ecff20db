"""Tests of generated hands: published bone lengths, mirror images, and the files shipped with the project."""

from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.calibration import HandProfile, load, save
from common.geometry.transforms import quaternion_to_matrix
from common.hand.model import CHAINS, FINGER_JOINTS, HandModel
from common.hand.profiles import generated_profile, mirrored_profile, scaled_profile

# Buchholz, Armstrong & Goldstein, 1992: proximal and middle bone as shares of hand length.
BONES = {1: (0.245, 0.143), 2: (0.266, 0.170), 3: (0.244, 0.165), 4: (0.204, 0.117)}


@given(st.floats(0.1, 0.25), st.sampled_from(["left", "right"]))
def test_bones_are_the_published_shares_of_the_hand(length_m: float, side: str) -> None:
    model = HandModel.of(generated_profile("any", side, length_m))
    for finger, shares in BONES.items():
        bones = np.linalg.norm(np.diff(model.rest_position_m[CHAINS[finger]], axis=0), axis=1)
        np.testing.assert_allclose(bones[:2], np.array(shares) * length_m, atol=1e-6)


@given(st.floats(0.1, 0.25))
def test_left_is_the_mirror_image_of_right(length_m: float) -> None:
    right, left = (generated_profile("any", side, length_m) for side in ("right", "left"))
    mirror = np.array([-1.0, 1.0, 1.0])
    for name, joint in right.rest_joints.items():
        other = left.rest_joints[name]
        np.testing.assert_array_equal(np.array(other.position_m), np.array(joint.position_m) * mirror)
        R, L = (quaternion_to_matrix(np.array(j.orientation_wxyz)) for j in (joint, other))
        np.testing.assert_allclose(L, np.outer(mirror, mirror) * R, atol=1e-7)
    assert right.radius_m == left.radius_m
    assert right.markers["index"] == left.markers["index"]


@pytest.mark.parametrize("side", ["left", "right"])
def test_joint_axes_are_those_of_openxr(side: str) -> None:
    model = HandModel.of(generated_profile("any", side))
    for joints in FINGER_JOINTS:
        for a, b in pairwise(joints):
            along = model.rest_position_m[b] - model.rest_position_m[a]
            R = model.rest_rotation[a]
            np.testing.assert_allclose(-R[:, 2], along / np.linalg.norm(along), atol=1e-4)  # -z to the tip
            assert np.linalg.det(R) == pytest.approx(1.0)
    assert (model.rest_rotation[CHAINS[1:].ravel(), 1, 1] > 0.99).all()  # +y dorsal


def test_the_caps_lie_ahead_of_the_tips_and_the_back_marker_on_the_back() -> None:
    profile = generated_profile("any", "right", 0.2)
    assert profile.markers["index"].offset_m == pytest.approx((0.0, 0.0, -0.15 * 0.038 * 0.2))
    assert profile.markers["back"].offset_m == pytest.approx((0.0, 0.068 * 0.2, 0.29 * 0.2))


@pytest.mark.parametrize(("side", "length_m"), [("both", 0.19), ("", 0.19), ("left", 0.09), ("right", 0.26)])
def test_no_hand_is_made_of_nonsense(side: str, length_m: float) -> None:
    with pytest.raises(ValueError, match=r"left or right|expected 0\.1 to 0\.25"):
        generated_profile("any", side, length_m)


def test_length_that_is_no_number_is_refused() -> None:
    with pytest.raises(ValueError, match="hand length"):
        generated_profile("any", "left", float("nan"))


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_shipped_default_hands_are_the_generated_ones(root: Path, side: str) -> None:
    shipped = load(root / "calib_json" / "hands" / f"default-{side}.json", HandProfile)
    made = generated_profile(f"default-{side}", side)
    assert msgspec.structs.replace(shipped, limits_rad=None, couplings=None) == made
    HandModel.of(shipped)


def test_a_generated_hand_survives_its_file(tmp_path: Path) -> None:
    made = generated_profile("mine", "left", 0.173)
    save(tmp_path / "mine.json", made)
    assert load(tmp_path / "mine.json", HandProfile) == made


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_mirrored_profile_is_the_generated_one_of_the_other_side(side: str) -> None:
    other = "right" if side == "left" else "left"
    mirrored, made = mirrored_profile(generated_profile("any", side)), generated_profile("any", other)
    assert mirrored.side == other
    assert mirrored.markers == made.markers
    for name, joint in made.rest_joints.items():
        assert mirrored.rest_joints[name].position_m == joint.position_m
        R, L = (
            quaternion_to_matrix(np.array(of.rest_joints[name].orientation_wxyz)) for of in (mirrored, made)
        )
        np.testing.assert_allclose(R, L, atol=1e-7)
    assert mirrored_profile(mirrored) == generated_profile("any", side)


@given(st.floats(0.12, 0.24), st.floats(0.12, 0.24))
def test_a_scaled_profile_is_the_generated_one_of_that_length(length_m: float, other_m: float) -> None:
    scaled = scaled_profile(generated_profile("any", "right", length_m), other_m / length_m)
    made = generated_profile("any", "right", other_m)
    for name, joint in made.rest_joints.items():
        np.testing.assert_allclose(scaled.rest_joints[name].position_m, joint.position_m, atol=1e-6)
    for name, mount in made.markers.items():
        np.testing.assert_allclose(scaled.markers[name].offset_m, mount.offset_m, atol=2e-6)
