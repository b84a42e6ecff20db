"""The oracle's simulated sets: scenes before the shipped rig, held hands, 16 cameras in a room."""

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.both.shown import markers_shown
from bench.hands.draws import FACING_ROTATION
from bench.hands.motion import held_poses
from bench.oracle.freeze import Piece, calibration_files
from bench.oracle.truth import STEP_NS, Truth
from bench.played import START_NS, times_of
from bench.report import CALIBRATION
from bench.rigs.rooms import DESK, ROOM, middle_m, room
from common.arrays import Float, Int
from common.geometry.transforms import rigid
from common.messages import MarkerDetections
from common.sim.motion import HandState, ScriptedMotion, smooth_step
from common.sim.scene import Scene, view_centre
from common.sim.scenes import scene_by_name
from master.rig.setup import load_setup

SCENES = ("standard", "grasp", "both-travel")
SEEDS = (11, 12, 13)
SECONDS, HELD_SECONDS, ROOM_SECONDS = 10.0, 3.0, 2.0
_ROOM_CAMERAS, _ROOM_HZ = 16, 90.0
_BEHIND_M = np.array(
    [0.03, 0.08, 0.0]
)  # of the palm from the middle of the view, so that the fingers are in it


@dataclass(frozen=True, slots=True, eq=False)
class Held:
    """A hand that opens for half a second, takes a pose in another half and then does not move.

    Attributes:
        place: Pose of the palm (4, 4) [m].
        open_rad, pose_rad: Angles (5, 4).
    """

    place: Float
    open_rad: Float
    pose_rad: Float
    period_s: float = 60.0

    def at(self, t_s: float) -> HandState:
        """The hand at time `t_s` [s]."""
        share = smooth_step(min(max((t_s - 0.5) / 0.5, 0.0), 1.0))
        return HandState(self.place, (1.0 - share) * self.open_rad + share * self.pose_rad)


def scenes(name: str, seconds: float = SECONDS, seeds: tuple[int, ...] = SEEDS) -> Iterator[Piece]:
    """The scene called `name` before the shipped rig, once for each seed."""
    desk = load_setup(CALIBRATION, DESK)
    files = calibration_files(CALIBRATION, DESK)
    for seed in seeds:
        scene = scene_by_name(name, desk.rig, desk.cameras, desk.hand.profile, seed)
        yield shown_piece(f"seed{seed}", files, scene, seconds, seed)


def shown_piece(name: str, files: dict[str, bytes], scene: Scene, seconds: float, seed: int) -> Piece:
    """What the cameras of a scene's rig report, with errors as large as measured."""
    messages: list[MarkerDetections] = []
    for camera in scene.rig.cameras:
        rate = scene.cameras[camera].frame_rate_hz
        times = times_of(scene, camera, seconds, rate)
        messages += markers_shown(scene, camera, times, 1.0 / rate, seed)[0]
    messages.sort(key=lambda one: one.t_ns)
    return Piece(name, (scene.rig.name,), files, messages, truth_of(scene, seconds))


def truth_of(scene: Scene, seconds: float) -> Truth:
    """The hand of a scene, finely in time, a little longer than it is watched."""
    since_ns: Int = np.arange(0, round((seconds + 0.1) * 1e9), STEP_NS)
    states = tuple(scene.motion.at(1e-9 * t) for t in since_ns.tolist())
    angles_rad = np.stack([state.angles_rad for state in states])
    joints = scene.model.forward(np.stack([state.T_rig_palm for state in states]), angles_rad)
    return Truth(START_NS + since_ns, joints.position_m, angles_rad)


def held(seed: int = SEEDS[0]) -> Iterator[Piece]:
    """A hand that takes a pose and keeps it, for each of some poses."""
    desk = load_setup(CALIBRATION, DESK)
    files = calibration_files(CALIBRATION, DESK)
    place = rigid(FACING_ROTATION, view_centre(desk.rig) + _BEHIND_M)
    poses = held_poses(desk.hand)
    for k, (name, angles) in enumerate(poses.items()):
        motion = Held(place, poses["open"], angles)
        scene = Scene.of_motion(desk.rig, desk.cameras, desk.hand.profile, motion, seed + k)
        yield shown_piece(name, files, scene, HELD_SECONDS, seed + k)


def in_room(seconds: float = ROOM_SECONDS, seed: int = SEEDS[0]) -> Iterator[Piece]:
    """A hand among 16 cameras."""
    with tempfile.TemporaryDirectory() as folder:
        tree = room(Path(folder), _ROOM_CAMERAS, _ROOM_HZ)
        setup, files = load_setup(tree, ROOM), calibration_files(tree, ROOM)
    motion = ScriptedMotion(setup.hand, middle_m(), seed)
    scene = Scene.of_motion(setup.rig, setup.cameras, setup.hand.profile, motion, seed)
    yield shown_piece(f"seed{seed}", files, scene, seconds, seed)
