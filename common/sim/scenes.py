"""Scenes by name, so that every process of a simulated rig renders the same one."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import overload

from common.calibration import CameraCalibration, HandProfile, RigCalibration
from common.calibration.object_profile import ObjectProfile
from common.errors import PhalanxError
from common.hand.model import HandModel
from common.sim.board import BoardRenderer, BoardScene
from common.sim.card import CardScene
from common.sim.illuminant import ROOM
from common.sim.leap import load_leap
from common.sim.poses import StudyPoses
from common.sim.render import Renderer
from common.sim.routine import HandRoutine
from common.sim.scene import Scene, view_centre
from common.sim.together import TOGETHER, together_motion
from common.sim.travel import CARDS, ObjectTravel
from common.sim.wrist.render import LIVE_STEP, LIVE_WRIST_RAD, WristRenderer
from common.sim.wrist.scene import WRIST_NAMES, WristScene

NAMES = f"standard | lights | poses | hand-routine | object | leap:FILE.npz | {' | '.join(TOGETHER)}"
VIEWS = f"{NAMES} | board | card"
_LEAP = "leap:"


def scene_by_name(
    name: str,
    rig: RigCalibration,
    cameras: Mapping[str, CameraCalibration],
    hand: HandProfile,
    seed: int,
    objects: Mapping[str, ObjectProfile] | None = None,
) -> Scene:
    """Return the scene of the given name.

    `standard`, the same under light that changes (`lights`), the six poses of the Digits study (`poses`), a hand that
    follows the guided routine of `calibrate hand` (`hand-routine`), one beside a tracked object that travels
    (`object`), one that moves as in front of a wrist device at the same time (`TOGETHER`), or one that follows a
    recorded motion. `objects` are the files of the objects that the rig names (`common.sim.tracked`).

    Raises:
        PhalanxError: No such scene; a rig, camera, hand or object that does not fit; a recording that cannot be read.
    """
    if rig.kind != "markers":
        raise PhalanxError(
            f"scene {name!r}: shows markers, and rig {rig.name!r} is of kind {rig.kind!r}; that has {WRIST_NAMES}"
        )
    if name == "standard":
        return Scene.standard(rig, cameras, hand, seed, objects)
    if name == "lights":
        return replace(Scene.standard(rig, cameras, hand, seed, objects), light=ROOM)
    if name == "poses":
        motion = StudyPoses(HandModel.of(hand), view_centre(rig), seed)
        return Scene.of_motion(rig, cameras, hand, motion, seed, objects)
    if name == "hand-routine":
        motion = HandRoutine(HandModel.of(hand), view_centre(rig), seed)
        return Scene.of_motion(rig, cameras, hand, motion, seed, objects)
    if name == "object":
        motion = ObjectTravel(HandModel.of(hand), view_centre(rig), seed)
        return replace(Scene.of_motion(rig, cameras, hand, motion, seed, objects), cards=CARDS)
    if name.startswith(_LEAP):
        motion = load_leap(Path(name.removeprefix(_LEAP)), HandModel.of(hand), view_centre(rig))
        return Scene.of_motion(rig, cameras, hand, motion, seed, objects)
    together = together_motion(name, HandModel.of(hand), view_centre(rig), seed)
    if together is not None:
        return Scene.of_motion(rig, cameras, hand, together, seed, objects)
    raise PhalanxError(f"scene {name!r}: there are {VIEWS} (board and card for cameras only)")


def view_by_name(
    name: str,
    rig: RigCalibration,
    cameras: Mapping[str, CameraCalibration],
    hand: HandProfile,
    seed: int,
    objects: Mapping[str, ObjectProfile] | None = None,
) -> Scene | BoardScene | WristScene:
    """Return the scene of the given name that a simulated camera looks at.

    A scene with a hand, that of a wrist rig where the rig is one, `board`, a checkerboard to calibrate cameras with,
    or `card`, a painted card to calibrate the depth of a pair with.

    Raises:
        PhalanxError: As `scene_by_name`; the scene is none of this kind of rig.
    """
    if name == "board":
        return BoardScene(rig, cameras, seed)
    if name == "card" and rig.kind == "markers":
        return CardScene(rig, cameras, seed)
    if rig.kind == "wrist":
        return WristScene.by_name(name, rig, cameras, hand, seed)
    return scene_by_name(name, rig, cameras, hand, seed, objects)


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

    The renderer of a wrist scene also takes the illumination of each frame.

    Args:
        scene: What the camera looks at.
        camera: Its name.
        live: What is not drawn in time is lost: skin before a wrist device is shaded more coarsely, the
            palm of a bent wrist by steps of its bend.

    Raises:
        CalibrationError: The scene has no such camera, or a marker without a colour.
    """
    if isinstance(scene, WristScene):
        return (
            WristRenderer(scene, camera, LIVE_STEP, LIVE_WRIST_RAD) if live else WristRenderer(scene, camera)
        )
    return BoardRenderer(scene, camera) if isinstance(scene, BoardScene) else Renderer(scene, camera)
