"""What the oracle's simulated sets are made of: scenes before the shipped rig, a held hand, and 16 cameras in a room."""

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.fusion_shown import markers_shown
from bench.oracle_freeze import Piece, calibration_files
from bench.oracle_truth import STEP_NS, Truth
from bench.played import START_NS, times_of
from bench.real_motion import FACING, held_poses
from bench.scale_rig import CALIBRATION, DESK, ROOM, in_order, room, scene_of, told
from common.arrays import Float, Int
from common.geometry import rigid
from common.messages import MarkerDetections
from common.sim.motion import HandState
from common.sim.scene import Scene, view_centre
from common.sim.scenes import scene_by_name
from master.rig import load_setup

SCENES = ("standard", "grasp", "both-travel")
SEEDS = (11, 12, 13)
SECONDS, HELD_SECONDS, ROOM_SECONDS = 10.0, 2.0, 3.0
_ROOM_CAMERAS, _ROOM_HZ = 16, 90.0
_BEHIND_M = np.array(
    [0.03, 0.08, 0.0]
)  # of the palm from the middle of the view, so that the fingers are in it


@dataclass(frozen=True, slots=True, eq=False)
class Held:
    """A hand that does not move."""

    state: HandState
    period_s: float = 60.0

    def at(self, t_s: float) -> HandState:
        """The hand at time `t_s` [s]."""
        del t_s
        return self.state


def simulated(seconds: float = SECONDS, seeds: tuple[int, ...] = SEEDS) -> Iterator[Piece]:
    """All simulated sets."""
    desk = load_setup(CALIBRATION, DESK)
    files = calibration_files(CALIBRATION, DESK)
    for name in SCENES:
        for seed in seeds:
            scene = scene_by_name(name, desk.rig, desk.cameras, desk.hand.profile, seed)
            yield shown_piece(name, f"seed{seed}", files, scene, seconds, seed)
    yield from _held(files, seeds[0])
    yield from _room(min(seconds, ROOM_SECONDS))


def shown_piece(
    set_name: str, name: str, files: dict[str, bytes], scene: Scene, seconds: float, seed: int
) -> Piece:
    """What the cameras of a scene's rig report, with errors as large as measured."""
    messages: list[MarkerDetections] = []
    for camera in scene.rig.cameras:
        rate = scene.cameras[camera].frame_rate_hz
        times = times_of(scene, camera, seconds, rate)
        messages += markers_shown(scene, camera, times, 1.0 / rate, seed)[0]
    messages.sort(key=lambda one: one.t_ns)
    return Piece(set_name, name, scene.rig.name, files, messages, truth_of(scene, seconds))


def truth_of(scene: Scene, seconds: float, start_ns: int = START_NS, move_m: Float | None = None) -> Truth:
    """The hand of a scene, finely in time, a little longer than it is watched.

    Args:
        scene: The scene.
        seconds: How long it is watched.
        start_ns: Scene time 0 on the clock of the messages.
        move_m: (3,) from the frame of the scene to that of the rig; None: they are the same.
    """
    since_ns: Int = np.arange(0, round((seconds + 0.1) * 1e9), STEP_NS)
    states = tuple(scene.motion.at(1e-9 * t) for t in since_ns.tolist())
    joints_m = scene.joints_of(states).position_m
    angles_rad = np.stack([state.angles_rad for state in states])
    return Truth(start_ns + since_ns, joints_m + (0.0 if move_m is None else move_m), angles_rad)


def _held(files: dict[str, bytes], seed: int) -> Iterator[Piece]:
    desk = load_setup(CALIBRATION, DESK)
    place = rigid(FACING, view_centre(desk.rig) + _BEHIND_M)
    for k, (name, angles) in enumerate(held_poses(desk.hand).items()):
        motion = Held(HandState(place, angles))
        scene = Scene.of_motion(desk.rig, desk.cameras, desk.hand.profile, motion, seed + k)
        yield shown_piece("held", name, files, scene, HELD_SECONDS, seed + k)


def _room(seconds: float) -> Iterator[Piece]:
    with tempfile.TemporaryDirectory() as folder:
        tree = room(Path(folder), _ROOM_CAMERAS, _ROOM_HZ)
        setup, files = load_setup(tree, ROOM), calibration_files(tree, ROOM)
    scene, move_m = scene_of(setup)
    messages = [one for one in in_order(told(setup, _ROOM_HZ)) if one.t_ns < seconds * 1e9]
    yield Piece("room", "cameras16", ROOM, files, messages, truth_of(scene, seconds, 0, move_m))
