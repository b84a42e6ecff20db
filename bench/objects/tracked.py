"""Where tracked objects are: rendered frames, detectors of the slaves, line of the master, exact truth.

The scene `object` (`common/sim/scenes.py`): the object wanders and turns, goes to and fro, turns wholly, and is partly
hidden by a card and by a hand. Seeds are others than served to tune it. A feature *faces* a camera where it lies in its
image, turned to it and large enough to be found nearly always.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from bench.played import START_NS, observed, times_of
from bench.report import CALIBRATION, Row, rig_files
from common.arrays import Float
from common.calibration import load
from common.calibration.object_profile import ObjectProfile
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import matrix_to_rotation_vector, quaternion_to_matrix
from common.messages import MarkerDetections, ObjectPose, TagDetections
from common.sim.scene import Scene
from common.sim.scenes import scene_by_name
from master.objects.line import ObjectLine
from master.objects.surface import Features
from slave.tags.finder import TagFinder

OBJECTS = {"wand": "beads", "cube": "tags"}
SEEDS = (11, 12)
PARTS = {"seen": ((2.0, 4.0), (16.0, 4.0), (24.0, 4.0)), "partly hidden": ((38.5, 3.0), (47.0, 3.0))}
_HIDDEN = 0.5  # share that a hidden feature shows at most
Seen = dict[str, list[tuple[int, Float]]]
"""Camera -> when its rows were exposed [ns] and which shares of the features (F,) it sees."""


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """One stretch: errors [mm], [deg] of what was tracked; right flags and all."""

    frames: int
    mm: Float
    deg: Float
    flagged: tuple[int, int]
    clear: tuple[int, int]


def rows() -> Iterable[Row]:
    """Errors and flags, for each object and part of the scene."""
    for name, kind in OBJECTS.items():
        for part, stretches in PARTS.items():
            found = [stretch(name, seed, start, length) for seed in SEEDS for start, length in stretches]
            yield from _rows_of(f"{name} of {kind}, {part}", found)


def _rows_of(title: str, found: list[Outcome]) -> Iterable[Row]:
    mm, deg = (np.concatenate([getattr(one, key) for one in found]) for key in ("mm", "deg"))
    frames = sum(one.frames for one in found)
    for what, values, unit, goal in (("place", mm, "mm", 3), ("turn", deg, "deg", 2)):
        if len(values):  # a stretch in which it is never tracked has no error
            most, middle = np.percentile(values, [95, 50])
            note = f"median {middle:.2f}; goal {goal}"
            yield Row(f"{title}: {what}, 95 % of frames", float(most), unit, note)
    within = 100.0 * float(((mm <= 3.0) & (deg <= 2.0)).sum()) / frames
    yield Row(f"{title}: tracked and within both", within, "%", f"of {frames} frames")
    for what, pairs in (
        ("hidden and flagged", [one.flagged for one in found]),
        ("not hidden and flagged", [one.clear for one in found]),
    ):
        yes, all_of = (sum(pair[k] for pair in pairs) for k in (0, 1))
        yield Row(f"{title}: {what}", float(yes), "frames", f"of {all_of}")


def stretch(name: str, seed: int, start_s: float, seconds: float) -> Outcome:
    """Render, detect and solve a stretch of the scene."""
    rig, cameras, hand = rig_files(f"desk-{name}")
    profile = load(CALIBRATION / f"objects/{name}.json", ObjectProfile)
    models = {c: CameraModel.of(file, rig.camera_pose(c)) for c, file in cameras.items()}
    scene = scene_by_name("object", rig, cameras, hand, seed, {name: profile})
    messages, seen = _detected(scene, profile, start_s, seconds)
    line = ObjectLine(profile, rig, models)
    poses = [solved.pose for message in messages for solved in line.push(message)]
    poses += [solved.pose for solved in line.flush()]
    return _judged(poses, scene, Features.of(profile, rig.markers), models, seen, name)


def _detected(
    scene: Scene, profile: ObjectProfile, start_s: float, seconds: float
) -> tuple[list[MarkerDetections | TagDetections], Seen]:
    """What the slaves of all cameras would send, in order, and what there was to be seen."""
    rig, messages, seen = scene.rig, list[MarkerDetections | TagDetections](), Seen()
    for camera in rig.cameras:
        own = scene.cameras[camera]
        seen[camera] = []
        finder = None if profile.tags is None else TagFinder(own, [profile])
        half_ns = round(0.5 * own.height_px * own.row_time_us * 1e3)
        times = times_of(scene, camera, seconds, own.frame_rate_hz, start_s)
        for message, view, image in observed(scene, camera, times):
            seen[camera].append((message.t_ns + half_ns, view.objects[profile.name].visible))
            messages.append(message)
            if finder is not None:
                tags, of = finder.push(image, message.t_ns), (message.seq, message.t_ns, message.t_ns)
                messages.append(TagDetections(camera, 1, *of, tags.ids, tags.uv, tags.sigma_px))
    return sorted(messages, key=lambda m: (m.t_ns, isinstance(m, TagDetections))), seen


def _judged(
    poses: list[ObjectPose],
    scene: Scene,
    features: Features,
    models: dict[str, CameraModel],
    seen: Seen,
    name: str,
) -> Outcome:
    mm, deg = list[float](), list[float]()
    flags = {True: [0, 0], False: [0, 0]}
    for pose in poses:
        T = scene.truth((pose.t_ns - START_NS) * 1e-9).objects[name]
        shares = [
            np.where(features.expected(T, model), _near(seen[camera], pose.t_ns), 1.0)
            for camera, model in models.items()
        ]
        least = float(np.min(shares))
        if least < _HIDDEN or least > 0.93:  # shown in part: neither
            flags[least < _HIDDEN][0] += pose.occluded
            flags[least < _HIDDEN][1] += 1
        if not pose.tracked:
            continue
        rotation = matrix_to_rotation_vector(T[:3, :3] @ quaternion_to_matrix(pose.orientation_wxyz).T)
        mm.append(1e3 * float(np.linalg.norm(T[:3, 3] - pose.position_m)))
        deg.append(float(np.degrees(np.linalg.norm(rotation))))
    (hidden, of_hidden), (clear, of_clear) = flags[True], flags[False]
    return Outcome(len(poses), np.array(mm), np.array(deg), (hidden, of_hidden), (clear, of_clear))


def _near(seen: list[tuple[int, Float]], t_ns: int) -> Float:
    """Shares (F,) in the frame nearest to a moment."""
    return min(seen, key=lambda frame: abs(frame[0] - t_ns))[1]
