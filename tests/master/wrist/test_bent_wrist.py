"""Fingers before the camera of a forearm while the wrist is bent: read for that bend, and how they change with it."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.arrays import Float
from common.messages import Level, WristDetections
from common.wrist_bend import STRAIGHT
from master.wrist.bent import BentWrist
from master.wrist.finger_poses import UNKNOWNS
from master.wrist.fingers import SeenFingers, WristFingers
from master.wrist.laser_plane import PlaneAxes
from tests.master.wrist.test_inverse import TRIPLE_NS, Device, bent

BENDS = [(12.0, 0.0), (-10.0, 5.0), (-20.0, -12.0), (-25.0, 15.0)]


@pytest.fixture(scope="module")
def device(root: Path) -> Device:
    return Device(root)


@pytest.fixture(scope="module")
def wrist(device: Device) -> BentWrist:
    return BentWrist(device.setup, device.poses)


def fingers(device: Device, level: str = "auto") -> WristFingers:
    assert level in ("fk", "ik", "auto")
    setup = replace(device.setup, level=level)
    return WristFingers(setup, Counter(), continuous=False, inverse=device.table, model=device.model)


def shown(device: Device, x: Float, bend: Float, tips: bool = True) -> WristDetections:
    """What the camera sees of unknowns (5, 3) at a bend (2,)."""
    poses = device.poses.bent(device.setup.bent(bend))
    views = poses.views(x[None], np.ones((1, 5), np.bool_))
    optics = device.setup.optics
    laser = optics.project(PlaneAxes.of(device.setup).space(views.seen[0, :, :2]))
    tip = optics.distort(views.seen[0, :, 2:]) if tips else np.full((5, 2), np.nan)
    return WristDetections(
        camera="wrist",
        session=1,
        seq=1,
        t_ns=TRIPLE_NS,
        ready_t_ns=TRIPLE_NS,
        laser_uv=laser,
        laser_sigma_px=np.where(np.isnan(laser[:, 0]), np.nan, 0.2),
        laser_px=np.full(5, np.nan),
        tip_uv=tip,
        tip_sigma_px=np.where(np.isnan(tip[:, 0]), np.nan, 2.0),
        tip_depth=np.full(5, np.nan),
    )


def pushed(device: Device, message: WristDetections, bend: Float, level: str = "auto") -> SeenFingers:
    seen = fingers(device, level).push(message, bend)
    assert seen is not None
    return seen


@pytest.mark.parametrize("bend_deg", BENDS)
def test_derivatives_are_those_of_finite_differences(wrist: BentWrist, bend_deg: tuple[float, float]) -> None:
    rng, bend, finger = np.random.default_rng(3), np.radians(bend_deg), np.arange(5)
    angles = np.radians(np.column_stack([rng.uniform(-4, 4, 5), *rng.uniform(25.0, 50.0, (3, 5))]))
    nudge, view = 1e-5, wrist.at(bend)
    found = view.crossings(angles, finger)
    by_angle = [
        (view.crossings(angles + to, finger).seen - view.crossings(angles - to, finger).seen) / (2.0 * nudge)
        for to in nudge * np.eye(4)
    ]
    by_bend = [
        (
            wrist.at(bend + to).crossings(angles, finger).seen
            - wrist.at(bend - to).crossings(angles, finger).seen
        )
        / (2.0 * nudge)
        for to in nudge * np.eye(2)
    ]
    J, B = np.stack(by_angle, axis=-1), np.stack(by_bend, axis=-1)
    np.testing.assert_allclose(found.by_angles[:, 2:], J[:, 2:], atol=1e-6)
    np.testing.assert_allclose(found.by_bend[:, 2:], B[:, 2:], atol=1e-6)
    # That the ridge turns with the light is left out: a tenth of what moves most.
    np.testing.assert_allclose(found.by_angles[1:, :2], J[1:, :2], atol=0.012)
    np.testing.assert_allclose(found.by_bend[1:, :2], B[1:, :2], atol=0.012)


@pytest.mark.parametrize("bend_deg", BENDS[:2])  # beyond, such fingers end before the plane
def test_tips_tell_flexion_and_abduction_of_every_pip(
    device: Device, wrist: BentWrist, bend_deg: tuple[float, float]
) -> None:
    view = wrist.at(np.radians(bend_deg))
    for node in (3, 10, 16):
        x = bent(30.0, 0.0, 3.0)
        x[:, 2] = wrist.pip[node]
        seen, _, _ = view.views(x, np.arange(5))
        places, energy = view.candidates(seen)
        assert np.isfinite(energy[:, node]).all()
        fits = energy[:, node] < 1e-6
        assert fits.sum() >= 2
        np.testing.assert_allclose(places[fits, node], x[fits], atol=1e-6)


@pytest.mark.parametrize("bend_deg", BENDS[1:])
def test_fingers_are_found_at_the_bend_that_is_told(device: Device, bend_deg: tuple[float, float]) -> None:
    bend, x = np.radians(bend_deg), bent(45.0, 60.0, 3.0)
    message = shown(device, x, bend)
    for level, within in (("ik", (0.1, 1.5)), ("auto", (2.5, 5.0))):
        found = pushed(device, message, bend, level).found
        sure = (found.level == Level.IK) & ~found.ambiguous
        sure[0] = False
        assert sure.sum() >= 3
        off = np.degrees(np.abs(found.angles_rad[:, :UNKNOWNS] - x))[sure]
        assert np.median(off) < within[0]
        assert off.max() < within[1]


def test_a_bend_that_is_not_told_turns_the_knuckles(device: Device) -> None:
    """What the test above would see if the bend were left out: it has to fail then."""
    bend = np.radians([-10.0, 5.0])
    x = bent(35.0, 45.0, 3.0)
    found = pushed(device, shown(device, x, bend), STRAIGHT).found
    assert np.degrees(np.abs(found.angles_rad[1:, 1] - x[1:, 1])).max() > 5.0


@pytest.mark.parametrize("level", ["fk", "auto"])
def test_a_small_bend_tells_what_the_table_of_a_straight_wrist_tells(device: Device, level: str) -> None:
    slope, base = device.poses.habit
    x = bent(0.0, 50.0)
    x[:, 1] = base + slope * x[:, 2]
    message = shown(device, x, STRAIGHT, tips=level == "auto")
    straight = pushed(device, message, STRAIGHT, level).found
    almost = pushed(device, message, np.array([1e-9, 0.0]), level).found
    np.testing.assert_array_equal(almost.told[1:], straight.told[1:])
    np.testing.assert_allclose(almost.angles_rad[1:, 1], straight.angles_rad[1:, 1], atol=np.radians(0.5))
    np.testing.assert_allclose(almost.angles_rad[1:, 2], straight.angles_rad[1:, 2], atol=np.radians(2.0))


@pytest.mark.parametrize("level", ["fk", "auto"])
def test_how_angles_change_with_the_bend_is_told(device: Device, level: str) -> None:
    """The flexion of the knuckles, which a wrong bend turns most."""
    slope, base = device.poses.habit
    x, bend, nudge = bent(0.0, 50.0), np.radians([-6.0, 3.0]), np.radians(1.0)
    x[:, 1] = base + slope * x[:, 2]
    message = shown(device, x, bend, tips=level == "auto")
    told = pushed(device, message, bend, level)
    one, other = (pushed(device, message, bend + np.array([to, 0.0]), level) for to in (nudge, -nudge))
    moved = (one.found.angles_rad - other.found.angles_rad)[1:, 1] / (2.0 * nudge)
    assert np.abs(moved).min() > 0.5
    np.testing.assert_allclose(told.by_bend[1:, 1, 0], moved, atol=0.35, rtol=0.2)


def test_fingers_that_are_not_seen_do_not_change(device: Device) -> None:
    message = shown(device, bent(30.0, 50.0), STRAIGHT)
    nothing, never = np.full((5, 2), np.nan), np.full(5, np.nan)
    none = msgspec.structs.replace(
        message, laser_uv=nothing, laser_sigma_px=never, tip_uv=nothing, tip_sigma_px=never
    )
    seen = pushed(device, none, np.radians([-10.0, 0.0]))
    assert not seen.found.told.any()
    np.testing.assert_array_equal(seen.by_bend, 0.0)


def test_of_neighbours_without_their_tips_the_laser_counts_where_fingers_are_expected(device: Device) -> None:
    """A hand that holds a thing, or one that pinches? One triple cannot tell. One finger alone is bent otherwise."""
    slope, base = device.poses.habit
    x = bent(0.0, 40.0)
    x[:, 1] = base + slope * x[:, 2]
    whole = shown(device, x, STRAIGHT)
    expected = device.poses.angles(x)
    expected[4] = np.nan
    for hidden, told in (([2], []), ([2, 3], [2, 3]), ([2, 3, 4], [2, 3])):
        tip, sigma = whole.tip_uv.copy(), whole.tip_sigma_px.copy()
        tip[hidden], sigma[hidden] = np.nan, np.nan
        message = msgspec.structs.replace(whole, tip_uv=tip, tip_sigma_px=sigma)
        for known, still in ((None, []), (expected, told)):
            seen = fingers(device).push(message, STRAIGHT, known)
            assert seen is not None
            found = seen.found
            assert [f for f in hidden if found.told[f]] == still
            assert [f for f in hidden if found.off[f]] == [f for f in hidden if f not in still]
            assert (found.level[hidden] == Level.FK).all()
