"""Tests of one camera alone: fingers go on by its rays, depth is held and less sure the longer it is."""

import numpy as np

from common.arrays import Float
from common.hand.model import CHAINS, PALM, TIPS
from common.messages import Source
from master.estimator.settings import DEFAULT
from tests.hand_helpers import palm
from tests.master.estimator.fitted import PAIR, STEP_NS, bent, estimator, found, seen, sure

INDEX, MARKER_INDEX = 1, 1


def test_one_camera_alone_goes_on_with_the_fingers_and_holds_the_depth() -> None:
    machine, off, along = estimator(), list[float](), list[float]()
    for k in range(60):
        truth = seen(palm(), bent(k / 60.0, 40.0))
        hand = machine.push(truth.epoch(k * STEP_NS, cameras=None if k < 15 else (0,)))
        assert hand.solution is not None
        if k >= 18:
            error = hand.solution.joints.position_m - truth.joints.position_m
            off.append(float(np.linalg.norm(error[:, :2], axis=1).mean()))
            along.append(float(np.abs(error[:, 2]).mean()))
            assert not (hand.source == Source.MEASURED).any()
            assert hand.valid.all()
    assert np.mean(off) < 5e-3
    assert np.max(along) < 30e-3


def test_a_hand_that_one_camera_sees_is_less_sure_along_the_sight_the_longer_it_is_so() -> None:
    machine, truth = estimator(), seen(palm(), bent(0.2))
    hands = [machine.push(truth.epoch(k * STEP_NS, cameras=None if k < 10 else (0,))) for k in range(70)]
    value, axis = np.linalg.eigh([found(hand.solution).cov_m2[PALM] for hand in hands])
    sigma = np.sqrt(value[:, -1])
    age_s = (np.arange(70) - 9) * STEP_NS * 1e-9
    late = age_s > 0.5
    assert (sigma[late] >= 0.99 * DEFAULT.unobserved_depth_m_s * age_s[late]).all()
    line_of_sight = truth.joints.position_m[PALM] - PAIR[0].centre
    assert abs(axis[-1][:, -1] @ line_of_sight) / np.linalg.norm(line_of_sight) > 0.99
    assert not hands[-1].tracked.any()


def test_a_marker_that_one_camera_loses_is_kept_on_the_ray_of_the_other() -> None:
    """Sideways, where one camera measures, it is as good as two."""
    machine, off = estimator(), list[Float]()
    for k in range(40):
        truth = seen(palm(), bent(k / 60.0, 40.0))
        epoch = truth.epoch(k * STEP_NS)
        assert epoch.uv is not None
        assert epoch.variance_px2 is not None
        if k >= 15:
            epoch.uv[1, MARKER_INDEX] = epoch.variance_px2[1, MARKER_INDEX] = np.nan
            epoch.points_m[MARKER_INDEX] = np.nan
        hand = machine.push(epoch)
        assert hand.solution is not None
        if k >= 18:
            error = np.abs(hand.solution.joints.position_m - truth.joints.position_m)[TIPS[INDEX]]
            off.append(error)
            np.testing.assert_array_equal(hand.tracked[CHAINS[INDEX]], sure(hand)[CHAINS[INDEX]])
            assert hand.source[TIPS[INDEX]] == Source.SOLVED
    assert np.mean(off, axis=0)[0] < 4e-3
    assert np.linalg.norm(off, axis=1).mean() < 15e-3  # its depth is that of the posture prior
