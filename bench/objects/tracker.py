"""Where a tracking system lies in the rig and its device on an object, from twelve seconds that cameras see, too.

Cameras: truth with noise (`bench.objects.views`) through the line of the running master; the tracker is a simulated one
in a frame of its own, with clocks apart, lost for half a second now and then. Errors are those of the object's pose by
the tracker at poses that the motion never had.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from bench.objects.views import Where, detections
from bench.report import CALIBRATION, Row, rig_files
from common.arrays import Float
from common.calibration import RigCalibration, load
from common.calibration.object_profile import ObjectProfile
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import (
    matrix_to_quaternion,
    matrix_to_rotation_vector,
    rigid,
    rotation_vector_to_matrix,
)
from common.messages import ObjectPose, TrackerPose
from common.sim.scene import view_centre
from common.sim.sensors import WANDER_M, WANDER_RAD, WHITE_M, WHITE_RAD
from common.sim.tracked import facing
from master.calibrate.tracker.registration import Registration, register
from master.objects.line import ObjectLine

RIGS = {"cube of tags": "desk-cube", "wand of beads": "desk-wand"}
SEEDS = (31, 32, 33, 34)  # 1 and 2 served to tune it
SECONDS = 12.0
ROTATION_RAD = np.radians(40.0)


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """One registration against its truth: place [mm], turn [deg] and their stated sigmas, the lag [ms], the rest."""

    mm: float
    deg: float
    sigma_mm: float
    sigma_deg: float
    late_ms: float
    left_mm: float
    left_deg: float


def rows() -> Iterable[Row]:
    """Errors over seeds, and how honest they are."""
    for name, rig in RIGS.items():
        results = [measured(rig, seed) for seed in SEEDS]
        for what, values, unit, goal in (
            ("pose by tracker, place", [one.mm for one in results], "mm", "3"),
            ("pose by tracker, turn", [one.deg for one in results], "deg", "2"),
            ("lag of the clocks", [abs(one.late_ms) for one in results], "ms", "5"),
            ("left of the cameras' poses, place", [one.left_mm for one in results], "mm", "-"),
            ("left of the cameras' poses, turn", [one.left_deg for one in results], "deg", "-"),
            ("error by stated sigma, place", [one.mm / one.sigma_mm for one in results], "", "1"),
            ("error by stated sigma, turn", [one.deg / one.sigma_deg for one in results], "", "1"),
        ):
            note = f"worst {max(values):.2f}; goal {goal}"
            yield Row(f"{name}: {what}", float(np.median(values)), unit, note)


def measured(rig_name: str, seed: int) -> Found:
    """Register by one motion; FitError: it was refused."""
    rig, cameras, _ = rig_files(rig_name)
    profile = load(CALIBRATION / "objects" / f"{rig.objects[0]}.json", ObjectProfile)
    models = {name: CameraModel.of(cameras[name], rig.camera_pose(name)) for name in rig.cameras}
    centre, rng = view_centre(rig), np.random.default_rng([seed, 11])
    where = moved(seed, centre)
    X = rigid(rotation_vector_to_matrix(2.0 * rng.normal(size=3)), rng.normal(size=3))
    Y = rigid(rotation_vector_to_matrix(2.0 * rng.normal(size=3)), 0.06 * rng.normal(size=3))
    late_s = float(rng.uniform(-0.04, 0.04))
    line = ObjectLine(profile, rig, models)
    objects = list(seen(line, profile, rig, models, where, seed))
    found = register(objects, list(tracked(where, X, Y, late_s, seed)))
    return against_truth(found, where, X, Y, late_s, centre, seed)


def moved(seed: int, centre_m: Float) -> Where:
    """Somebody turns it about its axes and carries it to all sides, two seconds to and fro, its face to the cameras."""
    rng = np.random.default_rng([seed, 12])
    rate = 2.0 * np.pi * rng.uniform(0.2, 0.6, (2, 3))
    phase = rng.uniform(0.0, 2.0 * np.pi, (2, 3))
    first = facing(0.35)

    def where(t_s: float) -> Float:
        way = np.sin(rate * t_s + phase)
        rotated = first @ rotation_vector_to_matrix(ROTATION_RAD * way[0])
        return rigid(rotated, centre_m + 0.11 * way[1])

    return where


def seen(
    line: ObjectLine,
    profile: ObjectProfile,
    rig: RigCalibration,
    models: dict[str, CameraModel],
    where: Where,
    seed: int,
) -> Iterator[ObjectPose]:
    """What the master makes of the cameras; a part of it is hidden now and then."""

    def hidden(camera: str, feature: int, t_s: float) -> bool:
        return feature % 2 == 0 and t_s % 6.1 < 0.7

    for message in detections(profile, rig.markers, models, where, SECONDS, seed, hides=hidden):
        yield from (one.pose for one in line.push(message))
    yield from (one.pose for one in line.flush())


def tracked(where: Where, X: Float, Y: Float, late_s: float, seed: int) -> Iterator[TrackerPose]:
    """Yield the tracker's poses, in its system's frame."""
    rng = np.random.default_rng([seed, 13])
    back, off = np.linalg.inv(X), np.zeros(6)
    size = np.repeat([WANDER_M, WANDER_RAD], 3)
    white = np.repeat([WHITE_M, WHITE_RAD], 3)
    tracker_hz = 100.0
    for k, t_s in enumerate(np.arange(-0.5, SECONDS + 0.5, 1.0 / tracker_hz).tolist()):
        off = 0.9 * off + np.sqrt(1.0 - 0.9**2) * size * rng.normal(size=6)
        T = back @ where(t_s) @ Y
        error = off + white * rng.normal(size=6)
        place, rotation = T[:3, 3] + error[:3], rotation_vector_to_matrix(error[3:]) @ T[:3, :3]
        lost = t_s % 5.0 < 0.5
        nowhere = np.full(4, np.nan)
        pose = (nowhere[:3], nowhere) if lost else (place, matrix_to_quaternion(rotation))
        yield TrackerPose("tracker", 1, k, round(1e9 * (t_s - late_s)), *pose)


def against_truth(
    found: Registration, where: Where, X: Float, Y: Float, late_s: float, centre_m: Float, seed: int
) -> Found:
    """Errors at 200 poses about the middle: 12 cm to all sides, turned by up to 50 degrees any way."""
    rng = np.random.default_rng([seed, 14])
    axis = rng.normal(size=(200, 3))
    angle = rng.uniform(0.0, np.radians(50.0), (200, 1))
    rotated = facing(0.35) @ rotation_vector_to_matrix(angle * axis / np.linalg.norm(axis, axis=1)[:, None])
    placed = found.fit.placed
    place, rotation = np.zeros((200, 3)), np.zeros((200, 3))
    for k, R in enumerate(rotated):
        truth = rigid(R, centre_m + rng.uniform(-0.12, 0.12, 3))
        device = np.linalg.inv(X) @ truth @ Y
        pose = placed.T_rig_tracking @ device @ np.linalg.inv(placed.T_object_tracker)
        place[k] = pose[:3, 3] - truth[:3, 3]
        rotation[k] = matrix_to_rotation_vector(pose[:3, :3] @ truth[:3, :3].T)
    figures = found.figures
    return Found(
        1e3 * float(np.sqrt((place**2).sum(axis=1).mean())),
        float(np.degrees(np.sqrt((rotation**2).sum(axis=1).mean()))),
        figures["position_sigma_mm"],
        figures["rotation_sigma_deg"],
        1e3 * (placed.late_s - late_s),
        figures["position_mm"],
        figures["rotation_deg"],
    )
