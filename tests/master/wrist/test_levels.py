"""What is believed of a finger along its valley, and what light adds once its unit is known."""

from pathlib import Path

import numpy as np
import pytest

from common.arrays import Float
from common.messages import Level
from master.wrist.forward import PIP
from master.wrist.light_unit import LightUnit
from master.wrist.pipeline import WristPipeline
from tests.master.wrist.test_inverse import Device, bent, pushed


@pytest.fixture(scope="module")
def device(root: Path) -> Device:
    return Device(root)


def by_light(device: Device, x: Float, unit: float) -> Float:
    return unit * device.poses.tips(device.poses.angles(x))[:, 2]


def tell_unit(device: Device, pipeline: WristPipeline, unit: float) -> None:
    """Poses whose PIP is sure without light."""
    for mcp, pip in ((30.0, 75.0), (38.0, 80.0), (20.0, 85.0)):
        x = bent(mcp, pip)
        pushed(pipeline, *device.seen(x), depth=by_light(device, x, unit))


@pytest.mark.parametrize("level", ["ik", "auto"])
@pytest.mark.parametrize(("mcp", "pip"), [(60.0, 5.0), (55.0, 50.0), (20.0, 60.0), (30.0, 15.0)])
def test_light_resolves_what_laser_and_tip_leave_open(
    device: Device, level: str, mcp: float, pip: float
) -> None:
    x = bent(mcp, pip)
    laser, tip = device.seen(x)
    dark, lit = device.pipeline(level), device.pipeline(level)
    tell_unit(device, lit, 0.4)
    without, pose = pushed(dark, laser, tip), pushed(lit, laser, tip, depth=by_light(device, x, 0.4))
    both = (pose.level == Level.IK) & (without.level == Level.IK)
    both[0] = False
    assert both.sum() >= 3
    off, blind = (np.abs(one.angles_rad[:, PIP] - x[:, PIP])[both] for one in (pose, without))
    assert np.degrees(off).max() < 6.0
    assert off.mean() <= blind.mean() + np.radians(0.5)
    if level == "auto":  # ik calls ambiguous what laser and tip alone leave open
        assert not pose.ambiguous[1:].any()


def test_the_unit_of_light_is_learnt_and_a_finger_is_no_witness_of_itself() -> None:
    unit, depth_m = LightUnit(), np.tile(np.linspace(0.10, 0.15, 21), (5, 1))
    sure = np.zeros((5, 21))
    sure[:, 5] = 1.0
    relative = np.full(5, np.nan)
    relative[1] = 0.3 * depth_m[1, 5]
    alone = unit.push(relative, depth_m, sure)
    np.testing.assert_allclose(alone - alone[:, :1], 0.0, atol=1e-9)
    for _ in range(8):
        unit.push(0.3 * depth_m[:, 5], depth_m, sure)
    factor, sigma = unit.told
    assert abs(np.log(factor / 0.3)) < 0.02
    assert sigma < 0.05
    open_to_all = np.full((5, 21), 1.0 / 21.0)
    told = unit.push(0.3 * depth_m[:, 15], depth_m, open_to_all)
    assert (np.abs(told.argmax(axis=1) - 15) <= 1).all()


@pytest.mark.parametrize("worthless", [np.nan, 0.0, 1e-30])
def test_worthless_light_changes_nothing_much(device: Device, worthless: float) -> None:
    x = bent(27.0, 60.0)
    lit = device.pipeline("ik")
    tell_unit(device, lit, 0.4)
    pose = pushed(lit, *device.seen(x), depth=np.full(5, worthless))
    without = pushed(device.pipeline("ik"), *device.seen(x))
    np.testing.assert_allclose(pose.angles_rad, without.angles_rad, atol=np.radians(3.0))


def test_exact_fingers_are_found_within_what_is_claimed(device: Device) -> None:
    for mcp, pip in ((20.0, 85.0), (45.0, 62.0), (30.0, 75.0), (15.0, 80.0)):
        x = bent(mcp, pip, 4.0)
        pose = pushed(device.pipeline("ik"), *device.seen(x))
        clear = ~pose.ambiguous
        assert clear.sum() >= 3
        off = np.degrees(np.abs(pose.angles_rad[:, :3] - x))[clear]
        assert off.max() < 4.0
        assert off[:, :2].max() < 1.5


def test_one_hand_that_defies_habit_takes_fk_its_belief(device: Device) -> None:
    """Knuckles alone are bent: the finger whose tip is not seen is told by neither curve nor tip."""
    x = bent(80.0, 2.0)
    laser, tip = device.seen(x)
    tip[2] = np.nan
    pose, by_habit = pushed(device.pipeline("auto"), laser, tip), pushed(device.pipeline("fk"), laser, tip)
    assert (pose.level[[1, 3, 4]] == Level.IK).all()
    assert not pose.tracked[12]
    assert np.abs(pose.angles_rad[2, PIP] - x[2, PIP]) < 0.6 * np.abs(by_habit.angles_rad[2, PIP] - x[2, PIP])
