"""A limit of a preset is a prior with a width: a hand that differs is followed; one of walls is not."""

import numpy as np

from bench.hands.draws import PointHand
from common.arrays import Float
from common.hand.model import HandModel
from common.hand.profiles import generated_profile
from master.estimator.parameters import HandParameters
from master.estimator.settings import KERNEL
from tests.hand_helpers import BACK_NORMAL, MARKERS, RIGHT, palm

SOFT = HandModel.of(generated_profile("soft", "right"))
COV = np.tile(1e-8 * np.eye(3), (6, 1, 1))
ROTATION = palm()[:3, :3], 1e-6 * np.eye(3)


def bent_back(degrees: float) -> Float:
    """Knuckles bent back by so much, all else at rest: the presets have 0."""
    angles = np.zeros((5, 4))
    angles[1:, 1] = -np.radians(degrees)
    return angles


def solved(model: HandModel, angles: Float) -> Float:
    points = model.marker_points(model.forward(palm(), angles), MARKERS)
    hand = PointHand(model, MARKERS).push(0, points, COV, BACK_NORMAL, ROTATION).solution
    assert hand is not None
    return hand.angles_rad


def test_knuckles_that_bend_back_are_followed_and_walls_are_not_passed() -> None:
    truth = bent_back(8.0)
    soft, walled = solved(SOFT, truth), solved(RIGHT, truth)
    assert np.degrees(np.abs(soft[1:, 1] - truth[1:, 1])).max() < 3.0
    assert (walled[1:, 1] > -1e-9).all()


def test_nobody_is_three_standard_deviations_beyond() -> None:
    found = solved(SOFT, bent_back(35.0))
    assert (found[1:, 1] >= -KERNEL.tolerances * SOFT.tolerance_rad[1:, 1] - 1e-9).all()


def test_inside_its_limits_a_hand_is_as_it_was() -> None:
    angles = np.zeros((5, 4))
    angles[1:] = np.radians([0.0, 30.0, 50.0, 50.0 * 2.0 / 3.0])
    angles[0] = np.radians([5.0, 5.0, 10.0, 15.0])
    np.testing.assert_allclose(solved(SOFT, angles), solved(RIGHT, angles), atol=1e-4)


def test_the_box_is_that_of_the_limits_and_their_reach() -> None:
    parameters = HandParameters.of(SOFT)
    sigma = SOFT.tolerance_rad.reshape(20)[parameters.free]
    np.testing.assert_allclose(parameters.legal_low - parameters.low, KERNEL.tolerances * sigma)
    np.testing.assert_allclose(parameters.limit_w2, sigma**-2.0)
    walls = HandParameters.of(RIGHT)
    np.testing.assert_array_equal(walls.low, walls.legal_low)
    assert not walls.limit_w2.any()
