"""Names select scenes, so that every process renders the same one.

`CardScene`, for `calibrate depth` without hardware: the published target, 75 x 50 mm in a finger's colour
(Kalbfleisch, section VI), stands between the lenses and faces them, before a wall of the grey of the desk. It is
drawn as the checkerboard is; its colour is that of a flat marker in the light of all scenes with a hand.

`ObjectTravel`: a tracked object travels and rotates freely at half a metre, beside a hand that is aside, its fingers
slowly moving. Place, pace, axes and order of the turns are drawn from the seed; smooth (C2), closed over the period.

    0 - 12 s    wanders and turns at once, about all axes
    12 - 15 s   rests
    15 - 23 s   goes to and fro, at 0.6 m/s where it is fastest
    23 - 32 s   turns once about its own axis and once about another, wholly
    32 - 35 s   rests
    35 - 45 s   wanders; a card passes before it (`CARDS`) that hides it from above
    45 - 53 s   comes to rest; the open hand comes before it, hides some of it and goes again
    53 - 60 s   wanders
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import overload

import numpy as np

from common.arrays import Float
from common.calibration import CameraCalibration, HandProfile, RigCalibration
from common.calibration.object_profile import ObjectProfile
from common.calibration.rig import rigs_by_hand
from common.errors import CalibrationError, PhalanxError
from common.geometry.srgb import to_linear
from common.geometry.transforms import axis_rotation, rigid, rotation_vector_to_matrix
from common.hand.model import HandModel
from common.sim.board import BOARD, BoardRenderer, BoardScene, Print
from common.sim.light import DESK_LINEAR_RGB, ROOM, TO_LIGHT_RIG, face_shade, marker_colour
from common.sim.motion import (
    DriftingMotion,
    HandState,
    StudyPoses,
    Waves,
    angles_of,
    base_pose,
    closing,
    smooth_step,
    window,
)
from common.sim.people import HandRoutine, load_leap
from common.sim.render import Renderer
from common.sim.scene import Card, Scene, view_centre
from common.sim.tracked import facing
from common.sim.two_rigs import TWO_RIG_SCENES, TwoHands, two_rig_motion
from common.sim.wrist.render import LIVE_STEP, LIVE_WRIST_RAD, WristRenderer
from common.sim.wrist.scene import WRIST_NAMES, WristScene

MARKER = "index"
WIDTH_M, HEIGHT_M = 0.075, 0.050
# no hand holds it along the rows, where rays in thirds of a pixel would draw it 0.1 px off
ROLL_RAD = np.radians(4.0)
DISTANCES_M = (*(round(0.88 - 0.03 * k, 2) for k in range(15)), 0.40, 0.35)  # closest where the hand is


@dataclass(frozen=True, slots=True, eq=False)
class CardScene(BoardScene):
    """Card held at DISTANCES_M before the middle between the first two lenses.

    Its frame: origin in its middle, z the axis of the first camera, x and y that camera's, turned by
    ROLL_RAD.
    """

    def find_poses(self) -> Float:
        """As `BoardScene`.

        Raises:
            CalibrationError: The rig has one camera.
        """
        if len(self.rig.cameras) < 2:
            raise CalibrationError(f"scene card: rig {self.rig.name!r} has one camera, a depth needs two")
        first, second = (self.rig.camera_pose(name) for name in self.rig.cameras[:2])
        axis = first[:3, 2]
        across = 0.5 * (second[:3, 3] - first[:3, 3])
        foot = first[:3, 3] + across - (across @ axis) * axis
        poses = np.tile(first, (len(DISTANCES_M), 1, 1))
        poses[:, :3, :3] = first[:3, :3] @ axis_rotation(2, ROLL_RAD)
        poses[:, :3, 3] = foot + np.array(DISTANCES_M)[:, None] * axis
        return poses

    def printed(self) -> Print:
        """As `BoardScene`."""
        columns, rows = round(WIDTH_M * BOARD.texels_per_m), round(HEIGHT_M * BOARD.texels_per_m)
        facing = -float(TO_LIGHT_RIG @ self.poses[0, :3, 2])
        colour = np.array(face_shade(marker_colour(MARKER), facing)) / 255.0
        return Print(
            np.ones((rows, columns), np.float32),
            np.array([0.5 * columns - 0.5, 0.5 * rows - 0.5]),
            0.0,
            np.array(DESK_LINEAR_RGB)[::-1],
            to_linear(colour),
        )


AT_M = np.array([-0.05, -0.015, 0.03])  # the object's middle, against that of the view
ASIDE_M = np.array([0.165, 0.06, 0.07])  # the hand, where it hides nothing
BEFORE_M = np.array([0.0, 0.055, -0.11])  # the hand where it hides some of it, against the object
WANDER_M = np.array([0.07, 0.055, 0.06])
WANDER_DEG = np.array([75.0, 75.0, 90.0])
WANDERS_S = ((0.3, 12.0), (35.0, 46.4), (51.6, 59.7))
SHUTTLE_S, SHUTTLE_M_S, SHUTTLE_HZ = (15.0, 23.0), 0.6, (0.8, 1.1)
SPINS_S = ((23.2, 27.4), (27.6, 31.8))
COMES_S = (45.0, 46.6, 51.4, 53.0)
CARDS = (Card(middle_s=40.0, width_m=0.09, top_m=-0.40, bottom_m=0.005, depth_m=0.36, speed_m_s=0.09),)


class ObjectTravel(DriftingMotion):
    """Motion of a travelling object and the hand."""

    def __init__(self, model: HandModel, centre_m: Float, seed: int) -> None:
        rng = np.random.default_rng([seed, 37])
        self._wander = Waves(rng, 6)
        super().__init__(model, centre_m, rng)
        self._fingers = Waves(rng, 5)
        self._place = self._centre + AT_M + rng.uniform(-0.01, 0.01, 3)
        own = rotation_vector_to_matrix(np.radians(rng.uniform(-20.0, 20.0, 3)))
        self._facing = own @ facing(np.radians(25.0))
        way = np.array([1.0, 0.0, 0.0]) + rng.uniform(-1.0, 1.0, 3) * np.array([0.0, 0.6, 0.8])
        self._way = way / np.linalg.norm(way)
        self._rate = 2.0 * np.pi * float(rng.uniform(*SHUTTLE_HZ))
        other = rng.normal(size=3)
        axes = np.stack([self._facing[:, 2], other / np.linalg.norm(other)])
        self._spins = axes[rng.permutation(2)] * rng.choice((-1.0, 1.0), (2, 1))
        self._before = BEFORE_M + rng.uniform(-1.0, 1.0, 3) * np.array([0.035, 0.01, 0.01])

    def _moved(self, t: float, wobble: Float, shift: Float, rotation: Float) -> HandState:
        come, there, leave, gone = COMES_S
        before = smooth_step((t - come) / (there - come)) * smooth_step((gone - t) / (gone - leave))
        shift = shift + (1.0 - before) * ASIDE_M + before * (self._place - self._centre + self._before)
        posture = closing((1.0 - before) * (0.25 + 0.25 * self._fingers.at(t)))
        pose = base_pose(self._model, (self._centre + ASIDE_M) - ASIDE_M, shift, rotation)
        return HandState(pose, angles_of(self._model, posture, wobble), objects=(self.object_at(t),))

    def object_at(self, t_s: float) -> Float:
        """`T_rig_object` (4, 4) [m] at a time within the period [s]."""
        fade_s = 1.0
        inside = sum(window(t_s, start, stop, fade_s) for start, stop in WANDERS_S)
        waves = inside * self._wander.at(t_s)
        place = self._place + WANDER_M * waves[:3]
        start, stop = SHUTTLE_S
        size = window(t_s, start, stop, fade_s) * SHUTTLE_M_S / self._rate
        place = place + size * np.sin(self._rate * (t_s - start)) * self._way
        rotation = rotation_vector_to_matrix(np.radians(WANDER_DEG) * waves[3:])
        for axis, (start, stop) in zip(self._spins, SPINS_S, strict=True):
            spun = 2.0 * np.pi * smooth_step((t_s - start) / (stop - start))
            rotation = rotation @ rotation_vector_to_matrix(spun * axis)
        return rigid(rotation @ self._facing, place)


TWO_HANDS = "hands"
_MORE = " | ".join((*TWO_RIG_SCENES, TWO_HANDS))
NAMES = f"standard | lights | poses | hand-routine | object | leap:FILE.npz | {_MORE}"
VIEWS = f"{NAMES} | board | card"
_LEAP = "leap:"
_MOTIONS = {"poses": StudyPoses, "hand-routine": HandRoutine, "object": ObjectTravel}


def scene_by_name(
    name: str,
    rig: RigCalibration,
    cameras: Mapping[str, CameraCalibration],
    hand: HandProfile,
    seed: int,
    objects: Mapping[str, ObjectProfile] | None = None,
    others: Sequence[HandProfile] = (),
) -> Scene:
    """Return the scene of the given name.

    `standard`, the same under light that changes (`lights`), the six poses of the Digits study (`poses`), a
    hand that follows the guided routine of `calibrate hand` (`hand-routine`), one beside a tracked object
    that travels (`object`), one that moves as in front of a wrist device at the same time (`TWO_RIG_SCENES`), or
    one that follows a recorded motion. `objects`: files of the objects that the rig names. `others`: those of its
    `other_hands`, in that order; such a rig sees two hands that cross (`hands`), which is its `standard`, too.

    Raises:
        PhalanxError: No such scene; a rig, camera, hand or object that does not fit; a recording that cannot
            be read.
    """
    if rig.kind != "markers":
        raise PhalanxError(
            f"scene {name!r}: shows markers, and rig {rig.name!r} is of kind {rig.kind!r}; that has {WRIST_NAMES}"
        )
    if rig.other_hands:
        if name not in (TWO_HANDS, "standard"):
            raise PhalanxError(
                f"scene {name!r}: shows one hand, rig {rig.name!r} watches several: {TWO_HANDS}"
            )
        hands = dict(zip((rig.hand, *rig.other_hands), (hand, *others), strict=True))
        parts = [(own, hands[one]) for one, own, _ in rigs_by_hand(rig, hands)]
        return replace(scene_of_hands(parts, cameras, seed), watched=rig)
    if name in ("standard", "lights"):
        scene = Scene.standard(rig, cameras, hand, seed, objects)
        return scene if name == "standard" else replace(scene, light=ROOM)
    model, centre_m = HandModel.of(hand), view_centre(rig)
    if name.startswith(_LEAP):
        motion = load_leap(Path(name.removeprefix(_LEAP)), model, centre_m)
    elif (make := _MOTIONS.get(name)) is not None:
        motion = make(model, centre_m, seed)
    else:
        motion = two_rig_motion(name, model, centre_m, seed)
    if motion is None:
        raise PhalanxError(f"scene {name!r}: there are {VIEWS} (board and card for cameras only)")
    cards = CARDS if name == "object" else ()
    return Scene.of_motion(rig, cameras, hand, motion, seed, objects, cards)


def scene_of_hands(
    parts: Sequence[tuple[RigCalibration, HandProfile]], cameras: Mapping[str, CameraCalibration], seed: int
) -> Scene:
    """Two hands that cross, each with its part of the rig. As `Scene.of_motion`."""
    first, *others = (
        Scene.of_motion(rig, cameras, hand, TwoHands(HandModel.of(hand), view_centre(rig), seed), seed)
        for rig, hand in parts
    )
    return replace(first, others=tuple(others))


def view_by_name(
    name: str,
    rig: RigCalibration,
    cameras: Mapping[str, CameraCalibration],
    hand: HandProfile,
    seed: int,
    objects: Mapping[str, ObjectProfile] | None = None,
    others: Sequence[HandProfile] = (),
) -> Scene | BoardScene | WristScene:
    """Return the scene of the given name that a simulated camera looks at.

    A scene with a hand, that of a wrist rig where the rig is one, `board`, a checkerboard to calibrate
    cameras with, or `card`, a painted card to calibrate the depth of a pair with.

    Raises:
        PhalanxError: As `scene_by_name`; the scene is none of this kind of rig.
    """
    if name == "board":
        return BoardScene(rig, cameras, seed)
    if name == "card" and rig.kind == "markers":
        return CardScene(rig, cameras, seed)
    if rig.kind == "wrist":
        return WristScene.by_name(name, rig, cameras, hand, seed)
    return scene_by_name(name, rig, cameras, hand, seed, objects, others)


@overload
def renderer_of(scene: WristScene, camera: str, *, live: bool = False) -> WristRenderer: ...
@overload
def renderer_of(
    scene: Scene | BoardScene, camera: str, *, live: bool = False
) -> Renderer | BoardRenderer: ...
def renderer_of(
    scene: Scene | BoardScene | WristScene, camera: str, *, live: bool = False
) -> Renderer | BoardRenderer | WristRenderer:
    """Return the renderer of the scene for one camera.

    `live`: what is not drawn in time is lost: skin before a wrist device is shaded more coarsely, the palm of
    a bent wrist by steps of its bend.

    Raises:
        CalibrationError: The scene has no such camera, or a marker without a colour.
    """
    if isinstance(scene, WristScene):
        if live:
            return WristRenderer(scene, camera, LIVE_STEP, LIVE_WRIST_RAD)
        return WristRenderer(scene, camera)
    return BoardRenderer(scene, camera) if isinstance(scene, BoardScene) else Renderer(scene, camera)
