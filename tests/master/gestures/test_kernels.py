"""Kernels under gestures: against numpy, compiled before a hand comes, and of hands that lack a finger."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

import master.gestures
from common.calibration.gesture_settings import default_gestures
from common.geometry.transforms import axis_rotation, rigid
from common.hand.model import CHAINS
from common.hand.skin import finger_segments, gaps_between
from common.messages import HandPose
from common.sim.gesture_postures import knob_grip, pinch_posture
from common.sim.motion import POSES, angles_of
from master.fabrik.linear_algebra import diagonalise, spread
from master.gestures.features import FeatureExtractor, thumb_touch
from master.gestures.grip import Tips, rotation_between
from master.gestures.poses import GestureRecogniser
from tests.hand_helpers import RIGHT, any_rotation
from tests.master.fabrik.compiled import compiled
from tests.master.gestures.shown_hands import FRAME_NS, shown

STILL = np.zeros((5, 4))


def gripping(count: int) -> list[HandPose]:
    """A hand that turns a knob, 3 degrees a frame from the 30th on."""
    knob = knob_grip(RIGHT, 0.023, STILL)
    angles = angles_of(RIGHT, knob.posture_deg, STILL)
    rotated = [axis_rotation(1, np.radians(3.0 * max(k - 30, 0))) for k in range(count)]
    return [shown(angles, k * FRAME_NS, T_rig_palm=rigid(R, np.zeros(3))) for k, R in enumerate(rotated)]


@pytest.mark.parametrize("n", [3, 4])
def test_eigenvalues_and_vectors_are_those_of_numpy(n: int) -> None:
    rng = np.random.default_rng(3)
    for rank in (*range(1, n + 1), n) * 20:
        half = rng.normal(size=(n, rank)) * 10.0 ** rng.uniform(-6.0, 2.0, rank)
        want, own, V = half @ half.T, half @ half.T, np.empty((n, n))
        diagonalise(own, V)
        values, scale = np.diag(own), np.trace(want)
        np.testing.assert_allclose(np.sort(values), np.linalg.eigvalsh(want), atol=1e-14 * scale)
        np.testing.assert_allclose(V @ np.diag(values) @ V.T, want, atol=1e-14 * scale)
        np.testing.assert_allclose(V.T @ V, np.eye(n), atol=1e-14)


def test_a_covariance_spreads_by_the_roots_of_its_eigenvalues() -> None:
    R = any_rotation(np.random.default_rng(5))
    assert spread(R @ np.diag([4.0, 9.0, 1.0]) @ R.T) == pytest.approx((1.0, 3.0), rel=1e-12)
    assert spread(np.diag([-1e-20, 0.0, 4.0])) == (0.0, 2.0)
    assert np.isnan(spread(np.full((3, 3), np.nan))).any()


@pytest.mark.parametrize("name", POSES)
def test_gaps_of_the_thumb_are_those_between_round_cones(name: str) -> None:
    seen = FeatureExtractor(RIGHT).of(shown(angles_of(RIGHT, np.array(POSES[name], np.float64), STILL)))
    assert seen is not None
    capsules = finger_segments(seen.joints_m, RIGHT.radius_m)
    want = gaps_between(capsules.of(slice(0, 1), slice(2, 3)), capsules.of(slice(1, 5), slice(0, 3)))
    found = thumb_touch(seen, RIGHT.radius_m)
    np.testing.assert_allclose(found.key_gap_m, want.gap_m, atol=1e-12)
    np.testing.assert_allclose(found.middle_m, want.middle_m[:, 2], atol=1e-12)


def test_tips_turn_as_they_were_turned() -> None:
    rng = np.random.default_rng(8)
    place, sigma, known = rng.normal(0.0, 0.03, (5, 3)), np.full(5, 1e-3), np.ones(5, np.bool_)
    sigma[2] = np.inf
    then = Tips(place, sigma, known, np.array([0.0, -1.0, 0.0]), np.eye(3))
    for angle in (0.0, 1e-7, 0.3, 3.0):
        now = then._replace(place_m=place @ axis_rotation(2, angle).T + 0.1)
        np.testing.assert_allclose(rotation_between(now, then), [0.0, 0.0, angle], atol=1e-12)


def test_no_kernel_is_compiled_while_a_hand_is_tracked() -> None:
    recogniser = GestureRecogniser(default_gestures(), RIGHT)
    before = compiled(master.gestures)
    assert before["master.gestures.features._measure"] >= 1
    pinch = angles_of(RIGHT, pinch_posture(RIGHT, 2, STILL), STILL)
    poses = [shown(pinch, k * FRAME_NS) for k in range(-30, 0)] + gripping(60)
    kinds = {one.kind for pose in poses for one in recogniser.push(pose)}
    assert {"dial", "pinch"} <= kinds
    fortran = np.asfortranarray(poses[-1].position_m)
    fortran.flags.writeable = False
    recogniser.push(msgspec.structs.replace(poses[-1], t_ns=60 * FRAME_NS, position_m=fortran))
    assert compiled(master.gestures) == before


def test_kernels_are_compiled_once_whether_or_not_a_hand_may_be_written() -> None:
    counts = list[dict[str, int]]()
    for writeable in (False, True):
        radius = RIGHT.radius_m.copy()
        radius.flags.writeable = writeable
        hand = replace(RIGHT, radius_m=radius)
        assert not hand.radius_m.flags.writeable
        GestureRecogniser(default_gestures(), hand)
        counts.append(compiled(master.gestures))
    assert counts[0] == counts[1]


def test_a_finger_that_is_lost_while_a_dial_turns_leaves_the_dial() -> None:
    recogniser, angles = GestureRecogniser(default_gestures(), RIGHT), list[float]()
    for k, pose in enumerate(gripping(60)):
        place, rotated = pose.position_m.copy(), pose.orientation_wxyz.copy()
        if k >= 45:
            place[CHAINS[4]], rotated[CHAINS[4]] = np.nan, np.nan
        lacking = msgspec.structs.replace(pose, position_m=place, orientation_wxyz=rotated)
        angles += [one.angle_rad for one in recogniser.push(lacking) if one.kind == "dial"]
    assert np.isfinite(angles).all()
    assert np.degrees(np.abs(np.diff(angles)).max()) < 4.5
