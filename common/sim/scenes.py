"""Scenes by name, so that every process of a simulated rig renders the same one."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from common.calibration import CameraCalibration, HandProfile, RigCalibration
from common.errors import PhalanxError
from common.hand_model import HandModel
from common.sim.illuminant import ROOM
from common.sim.leap import load_leap
from common.sim.poses import StudyPoses
from common.sim.scene import Scene, view_centre

NAMES = "standard | lights | poses | leap:FILE.npz"
_LEAP = "leap:"


def scene_by_name(
    name: str, rig: RigCalibration, cameras: Mapping[str, CameraCalibration], hand: HandProfile, seed: int
) -> Scene:
    """The scene called `standard`, the same under light that changes (`lights`), the six poses of the Digits study
    (`poses`), or one that follows a recorded motion.

    Raises:
        PhalanxError: No such scene; a rig, camera or hand that does not fit; a recording that cannot be read.
    """
    if name == "standard":
        return Scene.standard(rig, cameras, hand, seed)
    if name == "lights":
        return replace(Scene.standard(rig, cameras, hand, seed), light=ROOM)
    if name == "poses":
        motion = StudyPoses(HandModel.of(hand), view_centre(rig), seed)
        return Scene.of_motion(rig, cameras, hand, motion, seed)
    if name.startswith(_LEAP):
        motion = load_leap(Path(name.removeprefix(_LEAP)), HandModel.of(hand), view_centre(rig))
        return Scene.of_motion(rig, cameras, hand, motion, seed)
    raise PhalanxError(f"scene {name!r}: there are {NAMES}")
