"""Features of a hand: bends by hand calculation, the same wherever the hand is and of either side."""

import msgspec
import numpy as np
import pytest

from common.geometry.transforms import rigid, transform
from common.hand.model import WRIST, HandModel
from common.messages import HandPose
from master.gestures.features import KNOWN_SIGMA_M, FeatureExtractor, HandFeatures
from master.gestures.poses import QUANTITIES, Quantities
from tests.hand_helpers import LEFT, RIGHT, any_rotation, palm
from tests.master.gestures.shown_hands import PINCH, POINT, posture, shown


def of(pose: HandPose, model: HandModel = RIGHT) -> HandFeatures:
    features = FeatureExtractor(model).of(pose)
    assert features is not None
    return features


def test_a_bend_is_the_angle_that_the_model_was_bent_by() -> None:
    # At rest the generated hand's fingers are straight and lie in the palm's plane: what is added is the bend.
    angles = np.zeros((5, 4))
    rest = of(shown(angles)).bend_rad
    angles[1:, 1], angles[1:, 2], angles[1:, 3] = np.radians(50.0), np.radians(70.0), np.radians(40.0)
    bend = of(shown(angles)).bend_rad
    np.testing.assert_allclose(np.degrees(bend - rest)[1:], [[50.0, 70.0, 40.0]] * 4, atol=1.5)


def test_a_finger_bent_back_has_a_negative_bend() -> None:
    angles = np.zeros((5, 4))
    angles[1:, 2] = np.radians(-12.0)
    change = of(shown(angles)).bend_rad - of(shown(np.zeros((5, 4)))).bend_rad
    np.testing.assert_allclose(np.degrees(change[1:, 1]), -12.0, atol=1e-6)


@pytest.mark.parametrize("name", [POINT, PINCH])
def test_no_feature_depends_on_where_the_hand_is(name: str) -> None:
    rng = np.random.default_rng(3)
    here = of(shown(posture(name)))
    for _ in range(5):
        T = rigid(any_rotation(rng), rng.normal(0.0, 0.3, 3))
        there = of(shown(posture(name), T_rig_palm=T))
        np.testing.assert_allclose(Quantities.of(there).value, Quantities.of(here).value, atol=1e-6)
        np.testing.assert_allclose(there.T_rig_palm, T, atol=1e-9)


def test_left_hands_make_the_gestures_of_right_hands() -> None:
    right, left = of(shown(posture(PINCH))), of(shown(posture(PINCH, model=LEFT), model=LEFT), LEFT)
    np.testing.assert_allclose(Quantities.of(left).value, Quantities.of(right).value, atol=1e-6)


def test_a_pad_is_on_the_palmar_side_as_far_from_the_bone_as_the_surface() -> None:
    features = of(shown(np.zeros((5, 4)), T_rig_palm=np.eye(4)))
    assert (features.pads_m[1:, 1] < features.tips_m[1:, 1] - 0.8 * features.radius_m[1:]).all()


def test_uncertainty_and_occlusion_are_reported_per_finger() -> None:
    sigma = np.array([1e-3, 0.5 * KNOWN_SIGMA_M, 2.0 * KNOWN_SIGMA_M, np.nan, 1e-3])
    seen = np.array([True, True, False, False, True])
    features = of(shown(posture(POINT), sigma_m=sigma, tracked=seen))
    np.testing.assert_array_equal(features.known, [True, True, False, False, True])
    np.testing.assert_array_equal(features.seen, seen)
    assert np.isinf(features.sigma_m[3])
    # What is told of the whole hand's place is no doubt of its shape.
    pose = shown(posture(POINT))
    moved = msgspec.structs.replace(pose, cov_m2=pose.cov_m2 + 0.05**2 * np.eye(3))
    assert (of(moved).sigma_m > 0.04).all()
    assert (of(moved).shape_sigma_m < 0.01).all()


def test_a_pose_without_a_hand_has_no_features() -> None:
    pose = shown(posture(POINT))
    valid = pose.valid.copy()
    valid[WRIST] = False
    assert FeatureExtractor(RIGHT).of(msgspec.structs.replace(pose, valid=valid, tracked=valid)) is None


def test_a_finger_that_a_pose_lacks_leaves_the_others() -> None:
    # A wrist device at level ik: no fingertip, no finger.
    pose, whole = shown(posture(POINT)), of(shown(posture(POINT)))
    place, orientation = pose.position_m.copy(), pose.orientation_wxyz.copy()
    place[17:21], orientation[17:21] = np.nan, np.nan
    features = of(msgspec.structs.replace(pose, position_m=place, orientation_wxyz=orientation))
    np.testing.assert_array_equal(features.known, [True, True, True, False, True])
    assert np.isinf(features.shape_sigma_m[3])
    assert np.isfinite(features.joints_m).all()
    others = [0, 1, 2, 4]
    np.testing.assert_array_equal(features.tips_m[others], whole.tips_m[others])
    np.testing.assert_allclose(features.bend_rad[others], whole.bend_rad[others])


def test_a_hidden_finger_is_taken_for_bent_and_a_seen_one_is_not() -> None:
    column = QUANTITIES.index("ring_bend_deg")
    straight, sigma_m = np.zeros((5, 4)), np.array([1e-3, 1e-3, 1e-3, 0.05, 1e-3])
    seen = Quantities.of(of(shown(straight, sigma_m=sigma_m)))
    hidden = Quantities.of(of(shown(straight, sigma_m=sigma_m, tracked=np.arange(5) != 3)))
    assert abs(seen.value[column]) < 15.0
    assert hidden.value[column] > 60.0
    assert hidden.sigma[column] < seen.sigma[column]


def test_the_palm_frame_is_that_of_the_pose() -> None:
    T = palm(np.array([20.0, -10.0, 5.0]))
    features = of(shown(posture(POINT), T_rig_palm=T))
    np.testing.assert_allclose(features.palmar, -T[:3, 1], atol=1e-9)
    np.testing.assert_allclose(transform(T, np.zeros(3)), features.joints_m[WRIST], atol=1e-9)
