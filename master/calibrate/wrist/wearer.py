"""Who wears the device: palm pose, knuckles and thickness of the fingers from one guided motion before it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from common.calibration import CameraCalibration, HandProfile, RigCalibration
from common.geometry import intersect_plane
from common.hand_model import HandModel
from common.messages import WristDetections
from common.wrist_device import laser_plane_of
from master.calibrate.cameras.lens_files import matrix_of
from master.calibrate.wrist.curled import Curled
from master.calibrate.wrist.palm_hand import palm_from_hand
from master.wrist.setup import WristSetup


@dataclass(frozen=True, slots=True, eq=False)
class Wearer:
    """A device and a hand that explain what was seen.

    Attributes:
        rig: The rig with its new `T_camera_palm`.
        hand: The hand file with knuckles and `palmar_scale` as far as they were seen, under its old name.
        report: Lines for a person.
    """

    rig: RigCalibration
    hand: HandProfile
    report: tuple[str, ...]


def calibrate_wearer(
    triples: Sequence[WristDetections],
    rig: RigCalibration,
    camera: CameraCalibration,
    hand: HandProfile,
) -> Wearer:
    """Fit the wearer of a wrist device to one guided motion: open hand, straight fingers bent at the knuckles, curl.

    Args:
        triples: What the slave saw, in order.
        rig: The device: laser plane, and a palm pose that is right to a centimetre and ten degrees.
        camera: Its camera.
        hand: The hand as far as it is known, such as a hand of the user's length.

    Raises:
        FitError: What was seen does not determine it, or nothing explains it; the text says what to do.
        CalibrationError: The rig lacks its laser plane or palm pose.
    """
    setup = WristSetup.of(rig, camera, HandModel.of(hand))
    normal, offset_m = laser_plane_of(rig, f"rig {rig.name!r}")
    laser = np.array([one.laser_uv for one in triples]).reshape(-1, 5, 2)
    tips = np.array([one.tip_uv for one in triples]).reshape(-1, 5, 2)
    points = intersect_plane(np.zeros(3), setup.optics.ray(laser), normal, offset_m)
    fit = palm_from_hand(Curled(points, tips), setup)
    said = (
        f"palm from {fit.note}: ± {np.degrees(fit.turn_sigma_rad):.2f} deg, ± {1e3 * fit.shift_sigma_m:.2f} mm",
    )
    return Wearer(replace(rig, T_camera_palm=matrix_of(fit.T_camera_palm)), hand, said)
