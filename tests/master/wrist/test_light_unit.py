"""The unit of LED light: learnt from sure fingers, it decides between poses; a tip behind the camera tells nothing."""

import numpy as np

from common.arrays import Float
from master.wrist.light_unit import LightUnit

UNIT = 7.0


def two_poses(near_m: float, far_m: float) -> tuple[Float, Float, Float]:
    """A hand whose index may be near or far, and whose other fingers are sure; the light is that of the near one."""
    depth: Float = np.full((5, 2), (0.10, 0.20)) + 0.01 * np.arange(5.0)[:, None]
    depth[1] = near_m, far_m
    likely: Float = np.full((5, 2), (1.0, 0.0))
    likely[1] = 0.5, 0.5
    return UNIT * depth[:, 0], depth, likely


def test_fingers_that_are_sure_tell_the_unit_and_the_other_is_decided_by_it() -> None:
    unit = LightUnit()
    relative, depth, likely = two_poses(0.10, 0.14)
    log = [unit.push(relative, depth, likely) for _ in range(20)][-1]
    factor, sigma = unit.told
    assert abs(np.log(factor / UNIT)) < 2.0 * sigma < 0.1
    assert log[1, 0] > log[1, 1] + 2.0


def test_a_tip_that_is_not_before_the_camera_is_lit_in_no_pose() -> None:
    for behind in (-0.02, 0.0, np.nan):
        unit = LightUnit()
        relative, depth, likely = two_poses(0.10, behind)
        log = [unit.push(relative, depth, likely) for _ in range(20)][-1]
        assert np.isfinite(log).all()
        assert log[1, 0] > log[1, 1] + 2.0
        assert abs(np.log(unit.told[0] / UNIT)) < 0.1


def test_without_light_nothing_is_told() -> None:
    _, depth, likely = two_poses(0.10, 0.14)
    unit = LightUnit()
    np.testing.assert_array_equal(unit.push(np.full(5, np.nan), depth, likely), np.zeros((5, 2)))
    assert unit.told[1] > 1.0
