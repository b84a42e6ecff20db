"""Rigs of one hand merge in one frame, with their objects and volume.

Several marker rigs of one hand become one of N cameras, and a rig of several hands becomes one for each. Each
pair of cameras is calibrated in a frame of its own; `T_world_rig` is where that lies in the one they share.
What rigs of one hand specify twice must be specified alike: a silent choice between two filters would be
nobody's. The volume is the box in the rig frame in which the rig's accuracy was tested. Outside it a hand is
tracked as well as the cameras see it, but how well is unknown: that a joint lies outside alone makes no pose
invalid.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from common.arrays import Bool, Float
from common.calibration import RigCalibration, Volume, load
from common.calibration.files import Matrix4, Row4
from common.calibration.gesture_settings import GestureSettings, default_gestures
from common.calibration.object_profile import ObjectProfile
from common.calibration.rig import check_places
from common.errors import CalibrationError
from common.geometry.transforms import matrix_to_quaternion, quaternion_to_matrix, transform

_ALIKE = ("markers", "free_markers", "frame_sync", "filter", "solver")


def merged_rig(rigs: Sequence[RigCalibration]) -> RigCalibration:
    """Merge marker rigs into one with all their cameras, in the frame they share.

    It triangulates by all of them, whatever law of two cameras each has (`depth_model` "stereo"). Its
    residual is that of the rig that was measured worst. It states the first volume that a rig states, where
    that is a box along the axes of the shared frame, and the first place of a tracking system and file of
    gestures.

    Raises:
        CalibrationError: They share a camera, two cameras stand in one place, or markers, filter, pairing or
            solver differ.
    """
    placed = [in_world(rig) for rig in rigs]
    if len(placed) == 1:
        return placed[0]
    refuse_shared_senders(rigs)
    first = placed[0]
    for rig in placed:
        for key in _ALIKE:
            if getattr(rig, key) != getattr(first, key):
                raise CalibrationError(
                    f"rigs {first.name!r} and {rig.name!r}: {key}: differ, and both watch hand {first.hand!r}"
                )
    key = "T_rig_camera"
    known = [rig.provenance[key] for rig in placed if key in rig.provenance]
    merged = replace(
        first,
        name="_and_".join(rig.name for rig in placed),
        cameras=tuple(name for rig in placed for name in rig.cameras),
        depth_model="stereo",
        T_rig_camera={name: pose for rig in placed for name, pose in rig.T_rig_camera.items()},
        stamp_offset_us={name: us for rig in placed for name, us in rig.stamp_offset_us.items()},
        volume=next((rig.volume for rig in placed if rig.volume is not None), None),
        provenance={} if not known else {key: max(known, key=lambda one: one.residual.get("rms_px", 0.0))},
        imu=next((rig.imu for rig in placed if rig.imu is not None), None),
        objects=tuple(dict.fromkeys(name for rig in placed for name in rig.objects)),
        T_rig_tracking=next((rig.T_rig_tracking for rig in placed if rig.T_rig_tracking is not None), None),
        gestures=gestures_named(placed),
    )
    check_places(merged, f"rigs {' and '.join(repr(rig.name) for rig in placed)} in one frame (T_world_rig)")
    return merged


def gestures_named(rigs: Sequence[RigCalibration]) -> str | None:
    """Which file of gestures rigs of one hand name; None: none does.

    Raises:
        CalibrationError: They name two.
    """
    named = [rig for rig in rigs if rig.gestures is not None]
    for rig in named[1:]:
        if rig.gestures != named[0].gestures:
            raise CalibrationError(
                f"rigs {named[0].name!r} and {rig.name!r}: gestures: differ, and both watch hand {rig.hand!r}"
            )
    return named[0].gestures if named else None


def refuse_shared_senders(rigs: Sequence[RigCalibration]) -> None:
    """Refuse rigs that share a camera or an IMU: messages have the name alone.

    Raises:
        CalibrationError: With both rigs and the name.
    """
    senders = [
        (rig.name, repr(sender))
        for rig in rigs
        for sender in (*rig.cameras, *(() if rig.imu is None else (rig.imu.name,)))
    ]
    _refuse_shared("rigs", senders, "every camera and every IMU has a name of its own")


def _refuse_shared(owners: str, owned: Iterable[tuple[str, str]], remedy: str = "") -> None:
    """Refuse what two owners have, by a CalibrationError that names both."""
    owner: dict[str, str] = {}
    for name, what in owned:
        if what in owner:
            text = f"{owners} {owner[what]!r} and {name!r} both have {what}"
            raise CalibrationError(f"{text}: {remedy}" if remedy else text)
        owner[what] = name


def in_world(rig: RigCalibration) -> RigCalibration:
    """Return the marker rig in the frame that several rigs share (`T_world_rig`).

    Cameras, world of its IMU, tracking system and volume are moved. A volume that the shared frame's axes
    turn away from is no box there, and is not stated any more.
    """
    if rig.T_world_rig is None:
        return rig
    T_world_rig = np.array(rig.T_world_rig)
    imu, volume, tracking = rig.imu, rig.volume, rig.T_rig_tracking
    if imu is not None and imu.q_rig_world is not None:
        rotation = T_world_rig[:3, :3] @ quaternion_to_matrix(np.array(imu.q_rig_world))
        imu = replace(imu, q_rig_world=_row(matrix_to_quaternion(rotation)))
    unturned = 1e-9  # of a rotation matrix that turns nothing
    if not np.allclose(T_world_rig[:3, :3], np.eye(3), rtol=0.0, atol=unturned):
        volume = None
    if volume is not None:
        low, high = transform(T_world_rig, np.array([volume.low_m, volume.high_m])).tolist()
        volume = Volume(low_m=(low[0], low[1], low[2]), high_m=(high[0], high[1], high[2]))
    if tracking is not None:
        tracking = _matrix(T_world_rig @ np.array(tracking))
    poses = {name: _matrix(T_world_rig @ rig.camera_pose(name)) for name in rig.T_rig_camera}
    return replace(rig, T_world_rig=None, T_rig_camera=poses, imu=imu, volume=volume, T_rig_tracking=tracking)


def _matrix(pose: Float) -> Matrix4:
    a, b, c, d = (_row(row) for row in pose)
    return a, b, c, d


def _row(row: Float) -> Row4:
    a, b, c, d = row.tolist()
    return a, b, c, d


def objects_of(rig: RigCalibration, objects: Mapping[str, ObjectProfile]) -> tuple[ObjectProfile, ...]:
    """The objects that a rig names, in its order.

    Raises:
        CalibrationError: One has no file, its file calls it otherwise, a bead of it is not among the rig's
            `free_markers`, or two share a bead, a tag or a tracker.
    """
    found: list[ObjectProfile] = []
    for name in rig.objects:
        if name not in objects:
            raise CalibrationError(f"rig {rig.name!r}: objects: no object file for {name!r}")
        one = objects[name]
        if one.name != name:
            raise CalibrationError(
                f"rig {rig.name!r}: objects: the file of {name!r} calls it {one.name!r}: name"
            )
        for bead in one.markers:
            if bead not in rig.free_markers:
                raise CalibrationError(
                    f"rig {rig.name!r}: free_markers: {bead!r} is missing, a marker of object {name!r}"
                )
        found.append(one)
    features: list[tuple[str, str]] = []
    for one in found:
        features += [(one.name, f"marker {bead!r}") for bead in one.markers]
        if one.tags is not None:
            features += [(one.name, f"tag {tag.id} of {one.tags.family}") for tag in one.tags.tags]
        if one.tracker is not None:
            features.append((one.name, f"tracker {one.tracker!r}"))
    _refuse_shared(f"rig {rig.name!r}: objects", features)
    return tuple(found)


def refuse_shared_objects(watched: Sequence[tuple[str, Sequence[ObjectProfile]]]) -> None:
    """Refuse objects or trackers in the rigs of two hands: poses would come twice.

    `watched`: of each hand the name of its rig, and its objects.

    Raises:
        CalibrationError: With both rigs and the object.
    """
    owned: list[tuple[str, str]] = []
    for rig, objects in watched:
        for one in objects:
            owned.append((rig, f"object {one.name!r}"))
            if one.tracker is not None:
                owned.append((rig, f"tracker {one.tracker!r}"))
    _refuse_shared("rigs", owned, "objects: let one of them have it")


def load_objects(
    calibration: Path | None, rigs: Sequence[RigCalibration], known: Mapping[str, ObjectProfile]
) -> dict[str, ObjectProfile]:
    """Load the objects of these rigs, from `known`, else <calibration>/objects/.

    Raises:
        CalibrationError: One is in neither, or its file is broken.
    """
    found: dict[str, ObjectProfile] = {}
    for rig in rigs:
        for name in rig.objects:
            if name in known:
                found[name] = known[name]
            elif calibration is None:
                raise CalibrationError(
                    f"rig {rig.name!r}: object {name!r}: give --calibration DIR with objects/{name}.json"
                )
            else:
                found[name] = load(calibration / "objects" / f"{name}.json", ObjectProfile)
    return found


def load_gestures(calibration: Path | None, name: str | None) -> GestureSettings:
    """Load <calibration>/gestures/<name>.json.

    For a rig that names none, default.json, and where that does not exist either, the shipped settings.

    Raises:
        CalibrationError: A file that is named is missing, or one is broken.
    """
    if calibration is None:
        if name is not None:
            raise CalibrationError(f"gestures {name!r}: give --calibration DIR with gestures/{name}.json")
        return default_gestures()
    path = gestures_file(calibration, name)
    return load(path, GestureSettings) if name is not None or path.exists() else default_gestures()


def gestures_file(calibration: Path, name: str | None) -> Path:
    """The file of a rig's gestures; `name` None: default.json."""
    return calibration / "gestures" / f"{name or 'default'}.json"


_EDGES = tuple((a, a | 1 << axis) for a in range(8) for axis in range(3) if not a >> axis & 1)


def inside(volume: Volume | None, points_m: Float) -> Bool:
    """Return (...) which points (..., 3) [m] of the rig frame lie in the volume.

    The faces belong to it. All lie in it where the rig states none; a point that is NaN lies nowhere.
    """
    if volume is None:
        return np.ones(points_m.shape[:-1], np.bool_)
    low, high = np.array(volume.low_m), np.array(volume.high_m)
    return np.asarray(((points_m >= low) & (points_m <= high)).all(axis=-1), np.bool_)


def corners(volume: Volume) -> Float:
    """The eight corners (8, 3) [m]; bit 0, 1, 2 of the row: high along x, y, z."""
    ends = np.array([volume.low_m, volume.high_m])
    return np.array([[ends[row >> axis & 1, axis] for axis in range(3)] for row in range(8)])


def edges(volume: Volume) -> Float:
    """The twelve edges (12, 2, 3) [m], to be drawn."""
    return corners(volume)[np.array(_EDGES)]
