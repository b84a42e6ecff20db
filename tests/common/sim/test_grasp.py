"""The grasp: fingers touch the bar and do not enter it, it follows the palm, and both cameras lose all five tips."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from common.arrays import Bool, Float
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.geometry.transforms import invert
from common.hand.model import HandModel
from common.sim.grasp import MCP_PER_PIP, ROUND_S, ROUNDS, TIMING, Grasp, bar_in_palm, closed_round, gaps_m
from common.sim.motion import PERIOD_S, Cylinder, HandState, angles_of
from common.sim.render import Renderer
from common.sim.scene import Scene, view_centre
from common.sim.scenes import scene_by_name

ROOT = Path(__file__).resolve().parents[3]
RIG = load(ROOT / "calib_json/rigs/desk.json", RigCalibration)
CAMERAS = {name: load(ROOT / f"calib_json/cameras/{name}.json", CameraCalibration) for name in RIG.cameras}
HANDS = {
    side: load(ROOT / f"calib_json/hands/default-{side}.json", HandProfile) for side in ("right", "left")
}
CENTRE = view_centre(RIG)
STEP_S = 0.02


@cache
def grasp(side: str = "right", seed: int = 7) -> Grasp:
    return Grasp(HandModel.of(HANDS[side]), CENTRE, seed)


def gaps(side: str, seed: int, times: Float) -> tuple[Float, Bool]:
    """Air (T, 5, 3) [m] between each phalanx and the bar, and whether it is held (T,)."""
    motion, model = grasp(side, seed), HandModel.of(HANDS[side])
    out: list[Float] = []
    held: list[bool] = []
    for t in times.tolist():
        state = motion.at(t)
        (bar,) = state.things
        T_palm_object = invert(state.T_rig_palm) @ bar.T_rig_object
        out.append(gaps_m(model, state.angles_rad, T_palm_object, bar.radius_m))
        held.append(bar.held)
    return np.stack(out), np.array(held, dtype=np.bool_)


@pytest.mark.parametrize(("side", "seed"), [("right", 7), ("left", 8)])
def test_every_finger_touches_the_bar_while_it_is_held_and_none_ever_enters_it(side: str, seed: int) -> None:
    air, held = gaps(side, seed, np.arange(0.0, PERIOD_S, 5 * STEP_S))
    assert air.min() > -0.002
    nearest = air[held].min(axis=2)
    assert (nearest < 0.002).all()
    assert (nearest > -0.0013).all()  # skin gives way
    np.testing.assert_allclose(nearest, np.broadcast_to(nearest[:1], nearest.shape), atol=1e-9)  # no slipping
    assert 0.45 < held.mean() < 0.6


@pytest.mark.parametrize("radius_m", [0.011, 0.013, 0.020, 0.030])
def test_a_hand_closes_round_bars_of_any_thickness(radius_m: float) -> None:
    model, wobble = HandModel.of(HANDS["right"]), np.zeros((5, 4))
    T_palm_object = bar_in_palm(model, radius_m)
    posture = closed_round(model, T_palm_object, radius_m, wobble, np.full(4, MCP_PER_PIP))
    air = gaps_m(model, angles_of(model, posture, wobble), T_palm_object, radius_m).min(axis=1)
    assert (np.abs(air) < 0.002).all()


def test_gaps_are_those_of_the_nearest_points() -> None:
    """A straight middle finger along z, and a bar across it: by hand."""
    model = HandModel.of(HANDS["right"])
    along_x = np.array(
        [[0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, -0.05], [-1.0, 0.0, 0.0, 0.13], [0.0, 0.0, 0.0, 1.0]]
    )
    air = gaps_m(model, np.zeros((5, 4)), along_x, 0.012)
    bone = model.rest_position_m[[12, 13]]
    share = (0.13 - bone[0, 2]) / (bone[1, 2] - bone[0, 2])
    girth = model.radius_m[12] + share * (model.radius_m[13] - model.radius_m[12])
    deep = bone[0, 1] + share * (bone[1, 1] - bone[0, 1])
    assert air[2, 0] == pytest.approx(deep + 0.05 - girth - 0.012, abs=1e-4)


def test_the_bar_lies_still_follows_the_palm_and_comes_back_without_a_jump() -> None:
    motion = grasp()
    found = [motion.at(float(t)) for t in np.arange(0.0, PERIOD_S, STEP_S)]
    bars: list[Cylinder] = [state.things[0] for state in found]
    place, held = np.array([bar.T_rig_object for bar in bars]), np.array([bar.held for bar in bars])
    np.testing.assert_allclose(place[~held], np.broadcast_to(place[0], place[~held].shape), atol=1e-12)
    in_palm = np.array([invert(s.T_rig_palm) @ s.things[0].T_rig_object for s in found])[held]
    np.testing.assert_allclose(in_palm, np.broadcast_to(in_palm[0], in_palm.shape), atol=1e-9)
    moved = np.diff(place[:, :3, 3], n=2, axis=0) / STEP_S**2
    assert np.linalg.norm(moved, axis=1).max() < 3.0  # m/s^2; a jump of 2 mm would be 5
    for k in range(ROUNDS):
        of_round = slice(round(k * ROUND_S / STEP_S), round((k + 1) * ROUND_S / STEP_S))
        lifted = motion.at(k * ROUND_S + TIMING.lifted_s * float(motion.pace[k])).things[0]
        assert 0.07 < place[0, 1, 3] - lifted.T_rig_object[1, 3] < 0.13
        rotations = place[0, :3, :3].T @ place[of_round, :3, :3]
        rotated = np.arccos(np.clip(0.5 * (np.trace(rotations, axis1=1, axis2=2) - 1.0), -1.0, 1.0))
        assert 24.0 < np.degrees(rotated.max()) < 30.0


def held_times(motion: Grasp, step_s: float) -> list[float]:
    """Times [s] at which all fingers are closed: from before the lift until the release."""
    return [
        (k * ROUND_S) + s * float(motion.pace[k])
        for k in range(ROUNDS)
        for s in np.arange(TIMING.closed_s, TIMING.release_s, step_s).tolist()
    ]


@pytest.mark.parametrize(("side", "seed"), [("right", 7), ("left", 8)])
def test_both_cameras_lose_all_tips_while_it_is_held_and_never_the_back(side: str, seed: int) -> None:
    scene = scene_by_name("grasp", RIG, CAMERAS, HANDS[side], seed)
    for name in RIG.cameras:
        renderer = Renderer(scene, name)
        shown = np.array([renderer.markers(t).visible for t in held_times(grasp(side, seed), 0.57)])
        assert shown[:, :5].max() < 0.5
        assert (shown[:, :5] < 0.1).mean() > 0.8
        assert shown[:, 5].min() > 0.9
        back = renderer.markers(TIMING.back_s).visible
        assert back.min() > 0.9  # at rest all are seen again


def test_the_timeline_is_in_order() -> None:
    assert (
        TIMING.closed_s
        < TIMING.lift_s
        < TIMING.lifted_s
        < TIMING.lower_s
        < TIMING.release_s
        < TIMING.back_s
        < ROUND_S
    )


class Before:
    """A hand at rest, and a bar before or behind it."""

    period_s = 1.0

    def __init__(self, nearer_m: float) -> None:
        self._state = grasp().at(0.0)
        at = self._state.T_rig_palm.copy()
        middle = HandModel.of(HANDS["right"]).rest_position_m[15]
        at[:3, 3] = (self._state.T_rig_palm @ [*middle, 1.0])[:3] - np.array([0.0, 0.0, nearer_m])
        at[:3, :3] = self._state.things[0].T_rig_object[:3, :3]
        self._bar = Cylinder(at, 0.015, 0.2, False)
        self.bare = False

    def at(self, t_s: float) -> HandState:
        state = self._state
        return HandState(
            state.T_rig_palm, state.angles_rad, state.wrist_angles_rad, () if self.bare else (self._bar,)
        )


@pytest.mark.parametrize(("nearer_m", "seen"), [(0.05, False), (-0.05, True)])
def test_a_bar_hides_what_is_behind_it_in_the_picture_and_in_the_truth(nearer_m: float, seen: bool) -> None:
    motion = Before(nearer_m)
    renderer = Renderer(Scene.of_motion(RIG, CAMERAS, HANDS["right"], motion), "left")
    image, view = renderer.observe(0.0)
    motion.bare = True
    bare_image, bare = renderer.observe(0.0)
    u, v = np.rint(bare.uv[2]).astype(int)
    assert (view.visible[2] > 0.9) == seen
    assert view.visible[5] == bare.visible[5]  # the back is far from it
    blue, unhidden = image[v, u].astype(int), bare_image[v, u].astype(int)
    assert (np.abs(blue - unhidden).max() < 20) == seen
    assert seen or blue.max() < 90  # matt and dark
    assert (image != bare_image).any()  # behind the hand it shows on both sides
