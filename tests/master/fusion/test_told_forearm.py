"""What an instant tells of palm and bend: the marginal of the whole linear problem, with the bend as an unknown."""

from math import radians

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.arrays import Float
from common.geometry import matrix_to_rotation_vector, rigid, rotation_vector_to_matrix
from master.estimator.epoch import FittedHand
from master.estimator.parameters import HandParameters
from master.fusion.orientation import Orientation
from master.fusion.sensed_hand import SensedHand
from master.fusion.told_forearm import ToldForearm, told_forearm
from tests.hand_helpers import RIGHT, any_rotation, natural_angles

PARAMETERS = HandParameters.of(RIGHT)
N = len(PARAMETERS.free)
SIZE, BEND = 6 + N, radians(2.0)
ALIKE, EACH = radians(1.5), radians(5.0)
LITTLE = 1e-4  # so far off everything is linear
seeds = st.integers(0, 2**32 - 1)


class Instant:
    """Markers that tell a palm and free angles, and sensors on the forearm that tell them otherwise; all linear."""

    def __init__(self, seed: int, fingers: int = 5) -> None:
        rng = np.random.default_rng(seed)
        root = rng.normal(size=(SIZE, SIZE)) / np.repeat([0.05, 1e-3, 0.1], [3, 3, N])
        self.markers = root.T @ root + np.diag(PARAMETERS.anywhere)
        self.R = any_rotation(rng)
        angles = natural_angles(rng)
        angles[fingers:] = np.nan
        self.bend = rng.normal(size=2) * 0.1
        # What sights tell of angles and bend; and the palm by an IMU: what the bend turns, and a doubt of its own.
        told = np.arange(5) < fingers
        root = rng.normal(size=(5, 5, 6)) * 30.0 * told[:, None, None]
        self.sights = np.swapaxes(root, 1, 2) @ root
        weight, with_bend, of_bend = self.sights[:, :4, :4], self.sights[:, :4, 4:], self.sights[:, 4:, 4:]
        turned, cov = rng.normal(size=(3, 2)), BEND**2 * np.eye(2)
        palm = Orientation(self.R, turned @ cov @ turned.T + radians(1.0) ** 2 * np.eye(3))
        level = told.astype(np.uint8)
        self.sensed = SensedHand(angles, weight, with_bend, of_bend, told, level, cov, palm, turned @ cov)
        self.free = self.sensed.of(PARAMETERS)
        self.x = PARAMETERS.of_angles(np.nan_to_num(angles))
        self.seen = LITTLE * rng.normal(
            size=SIZE
        )  # where markers alone have turn, shift and angles, from R, 0 and x

    def solved(self, scale: float) -> FittedHand:
        """The least-squares solution of markers and all that the sensors tell."""
        S = np.zeros((23, SIZE))
        S[:3, :3], S[3:, 6:] = np.eye(3), self.free.by_free
        off = np.concatenate([np.zeros(3), self.free.by_free @ self.x - self.free.means])
        told = S.T @ self.sensed.information
        normal = self.markers + told @ S
        at: Float = np.asarray(np.linalg.solve(normal, self.markers @ self.seen - told @ off), np.float64)
        T = rigid(rotation_vector_to_matrix(at[:3]) @ self.R, at[3:6])
        x = self.x + at[6:]
        angles = PARAMETERS.angles(x)
        nothing = np.zeros((26, 3, 3)), np.zeros((5, 3, 3)), np.zeros(5)
        alone: Float = np.asarray(scale * np.linalg.inv(normal), np.float64)
        joints = RIGHT.forward(T, angles)
        return FittedHand(T, angles, joints, *nothing, alone, x, scale, 1.0, np.zeros(6), 1)

    def expected(self, scale: float) -> tuple[Float, Float]:
        """Turn from R and bend from the believed one, by markers and fingers alone: mean (5,) and covariance (5, 5)."""
        size = SIZE + 2 + 12  # palm, angles, bend; what it seems more to all, and to each finger
        normal, pull = np.zeros((size, size)), np.zeros(size)
        off = self.free.by_free @ self.x - self.free.means
        for f in range(5):
            A = np.zeros((6, size))
            A[:4, 6:SIZE] = self.free.by_free[4 * f : 4 * f + 4]
            for one in (SIZE, SIZE + 2, SIZE + 4 + 2 * f):
                A[4:, one : one + 2] = np.eye(2)
            normal += A.T @ self.sights[f] @ A / scale
            pull -= A.T @ self.sights[f, :, :4] @ off[4 * f : 4 * f + 4] / scale
        normal[:SIZE, :SIZE] += self.markers / scale
        normal[SIZE + 2 :, SIZE + 2 :] += np.diag(np.repeat([ALIKE**-2.0, EACH**-2.0 / scale], [2, 10]))
        pull[:SIZE] += self.markers @ self.seen / scale
        cov: Float = np.asarray(np.linalg.inv(normal), np.float64)
        kept = [0, 1, 2, SIZE, SIZE + 1]
        return (cov @ pull)[kept], cov[np.ix_(kept, kept)]


@given(seeds, st.floats(1.0, 5.0))
@settings(max_examples=25, deadline=None)
def test_it_is_the_marginal_of_the_whole_problem_without_the_palm_by_imu(seed: int, scale: float) -> None:
    instant = Instant(seed)
    hand = instant.solved(scale)
    told = told_forearm(hand, instant.sensed, instant.bend, PARAMETERS)
    mean, cov = instant.expected(scale)
    np.testing.assert_allclose(told.information @ cov, np.eye(5), atol=1e-3)
    at = np.linalg.solve(told.information, told.pull)
    turn = matrix_to_rotation_vector(told.R_rig_palm @ instant.R.T)
    off = (np.concatenate([turn, np.zeros(2)]) + at - mean) / np.sqrt(np.diag(cov))
    assert np.abs(off).max() < 0.02 * np.abs(mean / np.sqrt(np.diag(cov))).max()
    np.testing.assert_array_equal(told.bend_rad, instant.bend)


def test_no_finger_tells_no_bend_and_the_palm_is_that_of_the_markers() -> None:
    instant = Instant(3, fingers=0)
    told = told_forearm(instant.solved(1.0), instant.sensed, instant.bend, PARAMETERS)
    np.testing.assert_array_equal(told.information[3:], 0.0)
    np.testing.assert_array_equal(told.pull[3:], 0.0)
    markers = np.linalg.inv(np.linalg.inv(instant.markers)[:3, :3])
    np.testing.assert_allclose(told.information[:3, :3], markers, rtol=1e-3, atol=1e-3 * markers.max())


def test_a_bend_that_is_believed_tells_the_palm_as_far_as_they_go_together() -> None:
    information = np.zeros((5, 5))
    information[[0, 0, 3, 3], [0, 3, 0, 3]] = 1e4 * np.array(
        [1.0, -1.0, -1.0, 1.0]
    )  # flexion less turn about x
    information[[1, 2], [1, 2]] = 1e4
    told = ToldForearm(np.eye(3), np.array([0.1, 0.0]), information, np.zeros(5))
    R, cov = told.palm(np.array([0.3, 0.0]), np.diag([0.02, 0.02]) ** 2)
    np.testing.assert_allclose(matrix_to_rotation_vector(R), [0.2, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(np.sqrt(np.diag(cov)), [np.hypot(0.01, 0.02), 0.01, 0.01])
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.inv(information)
