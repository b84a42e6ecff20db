"""A body of beads that somebody turns before two cameras: what is seen of it, from exact truth with honest noise."""

from pathlib import Path

import numpy as np

from bench.objects.views import Noise, detections, wander
from common.calibration import CameraCalibration, RigCalibration, load
from common.calibration.object_profile import Bead, ObjectProfile
from common.geometry.camera_model import CameraModel
from common.messages import MarkerDetections
from master.calibrate.observations import Observations, points_of_detections

CALIB = Path(__file__).resolve().parents[4] / "calib_json"
RIG = load(CALIB / "rigs" / "desk-wand.json", RigCalibration)
CAMERAS = {name: load(CALIB / "cameras" / f"{name}.json", CameraCalibration) for name in RIG.cameras}
MODELS = {name: CameraModel.of(file, RIG.camera_pose(name)) for name, file in CAMERAS.items()}
RATES = {name: file.frame_rate_hz for name, file in CAMERAS.items()}
BEADS = ("wand1", "wand2", "wand3")
PLACES_M = np.array([[0.01, 0.02, 0.03], [0.09, 0.0, 0.0], [-0.02, 0.07, -0.01]])
MIDDLE_M = np.array([0.03, 0.0, 0.5])
NOISE = Noise(0.02, 0.12)  # rendered beads mislead a camera for as long as they show it the same side


def body(places_m: np.ndarray = PLACES_M, names: tuple[str, ...] = BEADS) -> ObjectProfile:
    """An object with beads at places (B, 3) and no surface that could hide them."""
    x = [tuple(float(value) for value in place) for place in places_m]
    beads = {
        name: Bead(position_m=(a, b, c), radius_m=0.009) for name, (a, b, c) in zip(names, x, strict=True)
    }
    return ObjectProfile(version=1, name="body", markers=beads)


def messages(seed: int, seconds: float = 5.0, rotation_rad_s: float = 2.0) -> list[MarkerDetections]:
    """What the cameras say of the body on its way, by stamps."""
    where = wander(seed, MIDDLE_M, 0.25, rotation_rad_s)
    sent = detections(body(), RIG.markers, MODELS, where, seconds, seed, noise=NOISE)
    return [message for message in sent if isinstance(message, MarkerDetections)]


def seen(seed: int, seconds: float = 5.0, rotation_rad_s: float = 2.0) -> Observations:
    """The same, placed."""
    return points_of_detections(RIG, MODELS, RATES, messages(seed, seconds, rotation_rad_s), BEADS)
