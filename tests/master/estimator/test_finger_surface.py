"""A finger before a wrist device: its derivatives, its laser point by ridge and by cut, and the other hand."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from common.arrays import Float
from common.hand.model import CHAINS
from common.hand.wrist import STRAIGHT
from master.calibrate.laser_intersection import LaserIntersection
from master.estimator.sensors import PlaneAxes
from master.rig.setup import WristSetup
from tests.master.estimator.wrist_case import NO_TWIST, PIP, WristCase, bent, natural
from tests.wrist_run import mirrored_setup

WRIST_ANGLES = [(0.0, 0.0), (12.0, 0.0), (-10.0, 5.0), (-20.0, -12.0), (-25.0, 15.0)]


@pytest.fixture(scope="module")
def wrist_case(root: Path) -> WristCase:
    return WristCase.of(root)


def differences(wrist_case: WristCase, angles: Float, bend: Float, twist: Float) -> Float:
    """Derivatives (5, 5, 7) of what is seen by central differences."""

    def seen(angles: Float, bend: Float, twist: Float) -> Float:
        at = wrist_case.looks(angles, bend, twist)
        return np.concatenate([at.predicted_laser, at.tip, np.log(at.depth_m)[:, None]], axis=1)

    nudge, out = 1e-6, np.empty((5, 5, 7))
    for k in range(7):
        to = [np.zeros((5, 4)), np.zeros(5), np.zeros(2)]
        if k < 4:
            to[0][:, k] = nudge
        elif k == 4:
            to[1][:] = nudge
        else:
            to[2][k - 5] = nudge
        ahead = seen(angles + to[0], bend + to[2], twist + to[1])
        back = seen(angles - to[0], bend - to[2], twist - to[1])
        out[:, :, k] = (ahead - back) / (2.0 * nudge)
    return out


@pytest.mark.parametrize("wrist_deg", WRIST_ANGLES)
def test_derivatives_are_those_of_finite_differences(
    wrist_case: WristCase, wrist_deg: tuple[float, float]
) -> None:
    rng, bend = np.random.default_rng(3), np.radians(wrist_deg)
    for _ in range(4):
        angles = np.radians(np.column_stack([rng.uniform(-4, 4, 5), *rng.uniform(25.0, 50.0, (3, 5))]))
        twist = np.radians(rng.uniform(-5.0, 5.0, 5))
        seen, J = wrist_case.looks(angles, bend, twist), differences(wrist_case, angles, bend, twist)
        np.testing.assert_allclose(seen.by[:, 2:], J[:, 2:], atol=1e-6)
        # That the ridge turns with the light is left out [m/rad]: a tenth of what moves most.
        off = (seen.by - J)[1:, :2] * away_m(wrist_case.setup, seen.predicted_laser)[1:, None, None]
        np.testing.assert_allclose(off, 0.0, atol=0.012)


def laser_centroid_of(setup: WristSetup, angles: Float) -> tuple[Float, Float]:
    """Points (5, 2) on the plane [m] and lengths (5,) [px] by another cut, of 64 rays that are densest at the ends."""
    point, length, _ = LaserIntersection(setup)(angles[None, None])
    return point[:, 0, 0], length[:, 0, 0]


def on_plane(setup: WristSetup, laser: Float) -> Float:
    """Points (5, 2) on the plane [m] of rays (5, 2)."""
    ray = np.column_stack([laser, np.ones(5)])
    return PlaneAxes.of(setup).flat(ray * (setup.offset_m / (ray @ setup.normal))[:, None])


def away_m(setup: WristSetup, laser: Float) -> Float:
    """How far along the camera's axis the plane is on rays (5, 2)."""
    return setup.offset_m / (np.column_stack([laser, np.ones(5)]) @ setup.normal)


@pytest.mark.parametrize("wrist_deg", WRIST_ANGLES)
def test_the_cut_is_near_to_that_of_the_calibration(
    wrist_case: WristCase, wrist_deg: tuple[float, float]
) -> None:
    """Within half a millimetre: its rays are evenly spread, and miss what they graze at both ends of the line."""
    rng, bend = np.random.default_rng(8), np.radians(wrist_deg)
    off: list[Float] = []
    longer: list[Float] = []
    for _ in range(40):
        angles = wrist_case.setup.model.clamp(bent(*rng.uniform([0.0, 0.0, -8.0], [60.0, 85.0, 8.0])))
        seen = wrist_case.looks(angles, bend)
        point, length = laser_centroid_of(wrist_case.setup.flexed(bend), angles)
        both = (seen.length_px > 2.0) & (length > 2.0) & np.isfinite(point[:, 0])
        off.append(1e3 * np.linalg.norm(on_plane(wrist_case.setup, seen.laser) - point, axis=1)[both])
        longer.append(seen.length_px[both] / length[both])
    mm, ratio = np.concatenate(off), np.concatenate(longer)
    assert len(mm) > 50
    assert np.median(mm) < 0.55
    assert np.percentile(mm, 90) < 1.5
    assert 0.85 < np.median(ratio) < 1.02


def test_the_closed_form_meets_the_plane_where_the_surface_does(wrist_case: WristCase) -> None:
    """Where one phalanx alone is in the light."""
    off: list[Float] = []
    for pip in range(5, 90, 5):
        angles = natural(float(pip))
        seen = wrist_case.looks(angles)
        off.append(
            1e3
            * np.linalg.norm(
                on_plane(wrist_case.setup, seen.predicted_laser)
                - laser_centroid_of(wrist_case.setup, angles)[0],
                axis=1,
            )
        )
    mm = np.array(off)
    assert np.median(mm[8:, 1:]) < 0.2  # from a PIP of 45 degrees on
    assert np.median(mm[:, 1:]) < 0.4
    assert mm[:, 1:].max() < 1.2


def test_fingertips_are_where_the_hand_model_has_them(wrist_case: WristCase) -> None:
    rng = np.random.default_rng(5)
    angles = np.radians(rng.uniform([-5, 10, 10, 5], [5, 60, 60, 40], (5, 4)))
    exact = wrist_case.setup.model.forward(wrist_case.setup.T_camera_palm, angles).position_m
    last, joint = exact[CHAINS[:, 2]], exact[CHAINS[:, 3]]
    way = joint - last
    beyond = wrist_case.setup.model.radius_m[CHAINS[:, 3]]
    tip = joint + way * (beyond / np.linalg.norm(way, axis=1))[:, None]
    seen = wrist_case.looks(angles)
    np.testing.assert_allclose(seen.tip, tip[:, :2] / tip[:, 2:], atol=1e-9)
    np.testing.assert_allclose(seen.depth_m, tip[:, 2], atol=1e-12)


def test_hinges_that_are_rolled_turn_the_finger_about_its_first_bone(wrist_case: WristCase) -> None:
    """What lies on that bone stays, and a fingertip moves across by how far it is from it."""
    angles, twist = bent(0.0, 60.0), np.radians(np.full(5, 5.0))
    straight, rolled = wrist_case.looks(angles), wrist_case.looks(angles, STRAIGHT, twist)
    moved = np.linalg.norm(rolled.tip - straight.tip, axis=1) * straight.depth_m
    assert (moved[1:] > 1e-3).all()
    flat = bent(0.0, 0.0)
    same, still = wrist_case.looks(flat), wrist_case.looks(flat, STRAIGHT, twist)
    np.testing.assert_allclose(still.tip[1:], same.tip[1:], atol=0.02)
    np.testing.assert_array_equal(wrist_case.looks(angles, STRAIGHT, NO_TWIST).tip, straight.tip)


def test_the_left_hand_is_the_right_one_mirrored(wrist_case: WristCase) -> None:
    optics = replace(wrist_case.setup.optics, distortion=np.zeros(5))
    right = WristCase(replace(wrist_case.setup, optics=optics))
    left = WristCase(mirrored_setup(right.setup))
    for pip in (10.0, 40.0, 70.0):
        angles = bent(0.5 * pip, pip, 4.0)
        here, there = right.looks(angles), left.looks(angles)
        for one, other in ((here.predicted_laser, there.predicted_laser), (here.tip, there.tip)):
            np.testing.assert_allclose(other, one * [-1.0, 1.0], atol=1e-12)
        np.testing.assert_allclose(there.laser, here.laser * [-1.0, 1.0], atol=2e-3)
        np.testing.assert_allclose(there.length_px, here.length_px, rtol=0.03)


def test_the_point_comes_nearer_until_the_last_phalanx_folds_into_the_light(wrist_case: WristCase) -> None:
    """But for the last degrees, in which the line grows shorter."""
    pip = np.arange(0.0, 121.0, 2.0)
    seen = [wrist_case.looks(natural(degrees)) for degrees in pip]
    along = np.array([on_plane(wrist_case.setup, one.laser)[1:, 1] for one in seen])
    for f in range(4):
        end = int(np.argmin(np.diff(along[:, f])))
        assert 70.0 < pip[end] < 115.0
        assert (np.diff(along[: end + 1, f]) < 1.5e-3).all()
        assert along[end, f] - along[end + 1, f] > 8e-3 or np.isnan(along[end + 1, f])


def test_a_finger_that_ends_before_the_plane_is_prolonged(wrist_case: WristCase) -> None:
    """So that a search finds its way back: the laser misses it, the ridge has a point and derivatives."""
    bend = np.radians([-45.0, 0.0])
    seen = wrist_case.looks(bent(-10.0, 0.0), bend)
    assert (seen.length_px[1:] == 0.0).all()
    assert np.isfinite(seen.predicted_laser).all()
    assert np.isfinite(seen.by).all()
    assert seen.by.shape[2] == 7
    assert PIP == 2
