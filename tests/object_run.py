"""A short run of exact detections of a hand and tracked objects: markers, tags, poses of a tracker; none rendered."""

from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import replace as with_fields
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from common.arrays import Float
from common.calibration.object_profile import ObjectProfile, tag_corners
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import invert, matrix_to_quaternion, rigid, transform
from common.messages import MarkerDetections, TagDetections, TrackerPose
from common.sim.scene import Scene
from master.evaluation.report import Played
from master.rig.setup import RigSetup, load_setups

PERIOD_NS = 16_666_667
START_NS = 1_000_000_000
LATE_NS = (0, 5_000_000)
Sent = MarkerDetections | TagDetections | TrackerPose
T_RIG_TRACKING = rigid(
    np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.array([0.3, -1.0, 2.0])
)
T_OBJECT_TRACKER = rigid(np.eye(3), np.array([0.0, 0.0, -0.1]))


@dataclass(frozen=True)
class ObjectRun:
    """Messages in the order in which they come, and the truth at any moment."""

    setup: RigSetup
    scene: Scene
    messages: list[Sent]

    def pose(self, name: str, t_ns: int) -> Float:
        """Where the object is (4, 4), rig frame."""
        return self.scene.truth((t_ns - START_NS) * 1e-9).objects[name]


def matrix(T: Float) -> tuple[tuple[float, ...], ...]:
    """As a file has it."""
    return tuple(tuple(float(v) for v in row) for row in T)


def object_run(
    root: Path, rig: str, frames: int, scene: str = "object", first: int = 0, setup: RigSetup | None = None
) -> ObjectRun:
    """Two cameras at 60 Hz, the right one 5 ms late; every third frame is searched for tags."""
    if setup is None:
        (setup,) = load_setups(root / "calib_json", (rig,))
    shown = Played.of(setup, scene, 5).shown
    assert shown is not None
    sent: list[Sent] = []
    for c, (name, camera) in enumerate(setup.models.items()):
        for k in range(first, first + frames):
            t_ns = START_NS + k * PERIOD_NS + LATE_NS[c]
            sent.append(_markers(name, camera, shown, k, t_ns))
            if k % 3 == 0 and any(one.tags is not None for one in setup.objects):
                sent.append(tags_seen(setup.objects, name, camera, shown, k, t_ns))
    return ObjectRun(setup, shown, sorted(sent, key=lambda one: one.t_ns))


def _markers(name: str, camera: CameraModel, scene: Scene, k: int, t_ns: int) -> MarkerDetections:
    count = len(scene.rig.markers)
    uv = np.full((count, 2), 240.0)
    for _ in range(2):  # each marker at the time of its own row
        for m in range(count):
            at_s = (t_ns - START_NS) * 1e-9 + 1e-9 * camera.row_time_ns * float(uv[m, 1])
            uv[m] = camera.project(scene.truth(at_s).markers_m[m][None])[0]
    ones = np.ones(count)
    return MarkerDetections(
        name, 1, k, t_ns, t_ns + 2_000_000, uv, 300.0 * ones, ones, 0.1 * ones, np.full((count, 2), np.nan)
    )


def tags_seen(
    objects: Sequence[ObjectProfile], name: str, camera: CameraModel, scene: Scene, k: int, t_ns: int
) -> TagDetections:
    """The tags that face the camera, each corner at the time of its row."""
    found: dict[int, Float] = {}
    for one in objects:
        for tag in () if one.tags is None else one.tags.tags:
            own = transform(np.array(tag.T_object_tag), tag_corners(tag.edge_m))
            uv = np.full((4, 2), 240.0)
            for _ in range(2):
                for i in range(4):
                    at_s = (t_ns - START_NS) * 1e-9 + 1e-9 * camera.row_time_ns * float(uv[i, 1])
                    T = scene.truth(at_s).objects[one.name]
                    uv[i] = camera.project(transform(T, own[i : i + 1]))[0]
            T = scene.truth((t_ns - START_NS) * 1e-9).objects[one.name] @ np.array(tag.T_object_tag)
            to_camera = camera.centre - T[:3, 3]
            if T[:3, 2] @ to_camera > 0.4 * np.linalg.norm(to_camera):
                found[tag.id] = uv
    ids = np.array(sorted(found), np.uint16)
    uv = np.array([found[int(number)] for number in ids]).reshape(-1, 4, 2)
    return TagDetections(name, 1, k, t_ns, t_ns + 2_000_000, ids, uv, np.full(len(ids), 0.1))


def tracker_pose(source: str, T_rig_object: Float, seq: int, t_ns: int) -> TrackerPose:
    """What a tracker on the object says."""
    T = invert(T_RIG_TRACKING) @ T_rig_object @ T_OBJECT_TRACKER
    return TrackerPose(source, 1, seq, t_ns, T[:3, 3], matrix_to_quaternion(T[:3, :3]))


def with_tracker(setup: RigSetup, *, registered: bool = True, only: bool = False) -> RigSetup:
    """The setup whose first object has a tracker on it; `only`: and nothing else to be seen by."""
    changes: dict[str, object] = {"tracker": "puck"}
    if registered:
        changes["T_object_tracker"] = matrix(T_OBJECT_TRACKER)
    if only:
        changes |= {"markers": {}, "tags": None}
    objects = (replace(setup.objects[0], **changes), *setup.objects[1:])
    rig = replace(setup.rig, T_rig_tracking=matrix(T_RIG_TRACKING)) if registered else setup.rig
    return with_fields(setup, objects=objects, rig=rig)
