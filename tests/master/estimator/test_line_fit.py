"""The fit of the card's line: a hand of the posture prior alone, from points, that begins anew by itself."""

from dataclasses import replace
from math import inf

import numpy as np
import pytest

from common.hand.model import HandModel
from master.estimator.kinematics import BodyPoints
from master.estimator.parameters import HandParameters
from master.estimator.settings import DEFAULT
from tests.hand_helpers import LEFT, MARKERS, RIGHT, natural_angles, palm, small_cov
from tests.master.estimator.fitted import STEP_NS, estimator, fit, forgetful, found, palm_deg, places, push


@pytest.mark.parametrize("model", [RIGHT, LEFT])
def test_a_natural_hand_is_found_from_its_markers_alone(model: HandModel) -> None:
    rng, machine, off, rotation = (
        np.random.default_rng(2),
        forgetful(model, natural=True),
        list[float](),
        list[float](),
    )
    parameters = machine.parameters
    for _ in range(40):
        T = palm(rng.uniform(-25, 25, 3))
        hand = found(fit(places(T, natural_angles(rng), model), small_cov(), by=machine))
        off.append(float(np.linalg.norm(hand.T_rig_palm[:3, 3] - T[:3, 3])))
        rotation.append(palm_deg(hand, T))
        assert (hand.x >= parameters.low - 1e-12).all()
        assert (hand.x <= parameters.high + 1e-12).all()
        assert hand.marker_chi2.max() < DEFAULT.marker_gate
        assert hand.natural_weight == 1.0
    assert np.median(off) < 8e-3
    assert np.median(rotation) < 6.0


def test_too_few_markers_and_none_are_no_palm_and_a_known_one_goes_on_by_one() -> None:
    anyway = replace(DEFAULT, back_normal_rad=inf)
    points = places(palm(), natural_angles(np.random.default_rng(3)))
    for kept, expected in ((0, False), (1, False), (2, False), (3, True)):
        few = points.copy()
        few[kept:] = np.nan
        machine = estimator(natural=True, settings=anyway)
        assert (fit(few, small_cov(), by=forgetful(natural=True, settings=anyway)) is not None) == expected
        push(machine, 0, points)
        hand = push(machine, STEP_NS, few)
        assert hand.solution is not None
        assert (hand.sources > 0).any() == (kept > 0)


def test_the_pose_is_that_of_the_model_and_markers_are_where_it_mounts_them() -> None:
    for model in (RIGHT, LEFT):
        angles = natural_angles(np.random.default_rng(6))
        joints, at = forgetful(model).pose(palm(), angles)
        expected = model.forward(palm(), angles)
        np.testing.assert_allclose(joints.position_m, expected.position_m, atol=1e-12)
        np.testing.assert_allclose(joints.rotation, expected.rotation, atol=1e-12)
        body_points = BodyPoints.markers(model, HandParameters.of(model), MARKERS)
        rotated = body_points.place(model.chains(angles)) @ palm()[:3, :3].T
        np.testing.assert_allclose(at, rotated + palm()[:3, 3], atol=1e-12)


def test_the_covariance_of_a_fit_holds_the_palm() -> None:
    """Of noisy markers of natural hands, of one epoch alone."""
    rng, inside = np.random.default_rng(8), list[bool]()
    for _ in range(150):
        T = palm(rng.uniform(-20, 20, 3))
        points = places(T, natural_angles(rng)) + rng.normal(0.0, 5e-4, (6, 3))
        cov = np.tile(25e-8 * np.eye(3), (6, 1, 1))
        hand = found(fit(points, cov, by=forgetful(natural=True)))
        off = hand.T_rig_palm[:3, 3] - T[:3, 3]
        inside.append(bool(off @ np.linalg.solve(hand.cov_m2[1], off) < 7.81))
    assert np.mean(inside) > 0.9
