"""The scene of the six study poses: all of them, under many turns; and what hides a finger tip in it really does."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.arrays import Float
from common.calibration import CameraCalibration, HandProfile, Matrix4, RigCalibration, load
from common.hand.model import CHAINS, HandModel
from common.recording.frame_recording import open_recording
from common.sim.motion import (
    MOVE_S,
    PERIOD_S,
    POSES,
    REACH_M,
    ROTATION_DEG,
    ROUNDS,
    STATION_S,
    HandState,
    StudyPoses,
)
from common.sim.render import Renderer
from common.sim.scene import Scene, view_centre
from common.sim.scenes import scene_by_name
from common.sim.surface import SLEEVE_SPHERES
from common.sim.view import View

ROOT = Path(__file__).resolve().parents[3]
RIG = load(ROOT / "calib_json/rigs/desk4.json", RigCalibration)
CAMERAS = {name: load(ROOT / f"calib_json/cameras/{name}.json", CameraCalibration) for name in RIG.cameras}
HANDS = {
    side: load(ROOT / f"calib_json/hands/default-{side}.json", HandProfile) for side in ("right", "left")
}
MODEL = HandModel.of(HANDS["right"])
TIMES = np.arange(0.0, PERIOD_S, 0.02)


def motion(seed: int = 7) -> StudyPoses:
    return StudyPoses(MODEL, view_centre(RIG), seed)


def test_every_pose_is_held_in_every_round_in_a_place_of_its_own() -> None:
    poses = motion()
    assert all(sorted(poses.order[6 * r : 6 * r + 6]) == sorted(POSES) for r in range(ROUNDS))
    held = [poses.held(float(t)) for t in TIMES]
    assert {held.count(name) for name in POSES} == {round(ROUNDS * (STATION_S - MOVE_S) / 0.02)}
    rotations = np.array(
        [poses.at((k + 0.9) * STATION_S).T_rig_palm[:3, :3] for k in range(len(poses.order))]
    )
    cosines = 0.5 * (np.einsum("aij,bij->ab", rotations, rotations) - 1.0)
    apart_deg = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    assert apart_deg[np.triu_indices(len(rotations), 1)].min() > 1.0
    assert apart_deg.max() > ROTATION_DEG


def test_it_is_seeded_smooth_closed_and_within_limits_and_reach() -> None:
    seed = 1234
    poses, again = motion(seed), motion(seed)
    states = [poses.at(float(t)) for t in TIMES]
    place = np.array([s.T_rig_palm[:3, 3] for s in states])
    angles = np.array([s.angles_rad for s in states])
    assert MODEL.within_limits(angles).all()
    np.testing.assert_array_equal(poses.at(13.7).angles_rad, again.at(13.7).angles_rad)
    assert (motion(seed + 1).at(13.7).angles_rad != poses.at(13.7).angles_rad).any()
    speed = np.linalg.norm(np.diff(np.vstack([place, place[:1]]), axis=0), axis=1) / 0.02
    assert speed.max() < 1.0  # m/s; a jump in 20 ms would be far more
    assert np.abs(np.diff(np.concatenate([angles, angles[:1]]), axis=0)).max() / 0.02 < np.radians(400.0)
    middle = MODEL.rest_position_m[:, 2].max() / 2.0
    centre = np.array([(s.T_rig_palm @ [0.0, 0.0, middle, 1.0])[:3] for s in states]) - view_centre(RIG)
    assert (np.abs(centre) < REACH_M + 0.01).all()


def test_cameras_around_the_hand_see_the_same_scene_as_the_first_pair_alone() -> None:
    pair = load(ROOT / "calib_json/rigs/desk.json", RigCalibration)
    scenes = [scene_by_name("poses", rig, CAMERAS, HANDS["right"], 7) for rig in (pair, RIG)]
    np.testing.assert_array_equal(scenes[0].truth(9.1).markers_m, scenes[1].truth(9.1).markers_m)
    for name in RIG.cameras:
        for t in TIMES[::50]:
            uv = scenes[1].optics[name].project(scenes[1].truth(float(t)).markers_m)
            assert ((uv > 0.0) & (uv < np.array([639.0, 479.0]))).all(), (name, t)


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_pointing_hand_hides_its_bent_fingers_from_the_first_pair_and_not_from_all(side: str) -> None:
    scene = scene_by_name("poses", RIG, CAMERAS, HANDS[side], 7)
    poses = StudyPoses(HandModel.of(HANDS[side]), view_centre(RIG), 7)
    times = [(k + 0.8) * STATION_S for k, name in enumerate(poses.order) if name == "pointing"]
    renderers = {name: Renderer(scene, name) for name in ("left", "left2")}
    shown = {
        name: np.array([np.nan_to_num(renderer.markers(t).visible) for t in times])
        for name, renderer in renderers.items()
    }
    assert (shown["left"][:, 1] > 0.9).all()  # the finger that points
    assert (shown["left"][:, 2:4] < 0.5).all()
    assert (shown["left2"][:, 2:4] > 0.5).any()


class _Still:
    """A hand that does not move."""

    period_s = 1.0

    def __init__(self, state: HandState) -> None:
        self._state = state

    def at(self, t_s: float) -> HandState:
        return self._state


def test_what_is_hidden_agrees_with_path_traced_hands(datasets: Path) -> None:
    """Six poses of the left hand, two cameras, six markers: the same are at least half visible."""
    folder = datasets / "stereo" / "poses_left"
    if not folder.is_dir():
        pytest.skip(f"no rendered recording at {folder}")
    manifest = open_recording(folder).manifest
    rig = manifest.marker_rig()
    profile = load(datasets / "hands" / "webxr-left.json", HandProfile)
    model = HandModel.of(profile)
    ahead = -model.rest_rotation[CHAINS[1:, 0], :, 2]
    fan = model.side_sign * np.arctan2(ahead[:, 0], ahead[:, 2])
    with np.load(folder / "truth.npz") as truth:
        named, palms, share = truth["angles"], truth["T_palm"], np.nan_to_num(truth["frac"])
    seen: list[Float] = []
    for row, palm in zip(named, palms, strict=True):
        angles = np.empty((5, 4))
        angles[0] = row[[1, 0, 3, 4]]  # its twist of up to 13 degrees has no place in our thumb
        fingers = row[5:].reshape(4, 4)
        angles[1:] = np.stack([fingers[:, 1] - fan, fingers[:, 0], fingers[:, 2], fingers[:, 3]], axis=1)
        scene = Scene.of_motion(rig, manifest.cameras, profile, _Still(HandState(palm, angles)))
        seen.append(np.array([Renderer(scene, name).markers(0.0).visible for name in rig.cameras]))
    visible = np.nan_to_num(np.array(seen))
    assert (share < 0.5).sum() > 20  # of 72: the poses do hide tips
    assert ((visible >= 0.5) == (share >= 0.5)).mean() > 0.93
    assert np.abs(visible - share).mean() < 0.06


def nearest_to_ray(point: Float, ends: Float) -> tuple[float, float]:
    """Distance [m] of the ray from the camera to `point` (3,) from the line between `ends` (2, 3), and how far out."""
    share = np.linspace(0.0, 1.0, 200)
    ray, line = share[:, None] * point, ends[0] + share[:, None] * (ends[1] - ends[0])
    apart = np.linalg.norm(ray[:, None] - line[None], axis=2)
    row, _ = np.unravel_index(int(np.argmin(apart)), apart.shape)
    return float(apart.min()), float(share[row])


def test_from_behind_the_forearm_the_sleeve_hides_the_tips() -> None:
    low = np.array(
        [[1.0, 0.0, 0.0, 0.04], [0.0, 0.0, -1.0, 0.55], [0.0, 1.0, 0.0, 0.50], [0.0, 0.0, 0.0, 1.0]]
    )
    rig = msgspec.structs.replace(
        RIG, T_rig_camera=RIG.T_rig_camera | {"left2": msgspec.convert(low.tolist(), Matrix4)}
    )
    scene = scene_by_name("poses", rig, CAMERAS, HANDS["right"], 7)
    view, renderer = View(scene, "left2"), Renderer(scene, "left2")
    radius = 0.9 * float(view.surface.radius_m[SLEEVE_SPHERES[0]])
    behind: list[float] = []
    for t in TIMES[::60]:
        snapshot = view.snapshot(float(t))
        assert not snapshot.into_sleeve
        sleeve, shown = snapshot.points[list(SLEEVE_SPHERES)], renderer.markers(float(t)).visible
        for tip in range(5):
            apart, along = nearest_to_ray(snapshot.points[view.cap_centre[tip]], sleeve)
            if apart < radius - view.cap_radius[tip] and along < 0.9:
                behind.append(float(shown[tip]))
    assert len(behind) > 10
    assert max(behind) < 0.05
