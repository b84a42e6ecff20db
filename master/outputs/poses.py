"""Poses holds a run as arrays, its truth beside it, and its file poses.npz.

Many poses as arrays.

What poses.npz holds, and what pictures, viewers and scores read.

True motion of the hand, row by row beside the poses.

Where a simulation or a recording knows it.

Writer and reader of poses.npz, the record of a run readable with numpy.

Also writes and reads all files of a run at once.

Each appears under its name complete or not at all, and identical poses make identical bytes (`table_file`).
"""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, cast

import numpy as np

from common.arrays import Bool, Code, Float, Int
from common.errors import RecordingError
from common.hand.model import MIDDLE_METACARPAL, MIDDLE_PROXIMAL
from common.messages import FINGER_COUNT, JOINT_COUNT, Gesture, HandPose, ObjectPose, ResultMessage
from common.recording.recorded_files import read_npz
from master.outputs.result_files import GesturesFile, TableFile, contact_file, object_file


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """T poses of one hand, row by row; fields as in `HandPose`.

    Attributes:
        hand: Name of the hand profile.
        t_ns: (T,) [ns].
        position_m: (T, 26, 3) [m], rig frame.
        orientation_wxyz: (T, 26, 4).
        radius_m: (T, 26) [m].
        valid, tracked: (T, 26).
        cov_m2: (T, 26, 3, 3) [m^2].
        source: (T, 26) `Source` codes.
        angles_rad: (T, 5, 4) [rad].
        markers_m, markers_raw_m: (T, M, 3) [m], after and before the filter.
        markers_cov_m2: (T, M, 3, 3) [m^2], of `markers_raw_m`.
        inside_volume: (T, 26).
        latency_ns: (T,) [ns]; 0 in an offline run.
        laser_m: (T, 5, 3) laser points of a wrist device [m], frame of its camera.
        solver_mode: (T, 5) `SolverMode` codes: what a wrist device solved each finger from.
        ambiguous: (T, 5) another pose of that finger explains what was seen as well.
        palm_world_wxyz, palm_world_sigma_rad: (T, 4), (T, 2) palm in the world of a wrist device's IMU; NaN: none.
        wrist_angles_rad, wrist_angles_sigma_rad: (T, 2) of the wrist, where a device sits on the forearm; NaN: none.
    """

    hand: str
    t_ns: Int
    position_m: Float
    orientation_wxyz: Float
    radius_m: Float
    valid: Bool
    tracked: Bool
    cov_m2: Float
    source: Code
    angles_rad: Float
    markers_m: Float
    markers_raw_m: Float
    markers_cov_m2: Float
    inside_volume: Bool
    latency_ns: Int
    laser_m: Float
    solver_mode: Code
    ambiguous: Bool
    palm_world_wxyz: Float
    palm_world_sigma_rad: Float
    wrist_angles_rad: Float
    wrist_angles_sigma_rad: Float

    def __post_init__(self) -> None:
        """Refuse arrays that do not fit together.

        Raises:
            ValueError: Naming the array, its shape or type, and what is expected.
        """
        dtype = record(self.markers_m.shape[1] if self.markers_m.ndim == 3 else 0)
        for name in dtype.names or ():
            array = getattr(self, name)
            kind, shape = dtype[name].base, (len(self.t_ns), *dtype[name].shape)
            if array.shape != shape or array.dtype != kind:
                raise ValueError(f"{name}: {array.dtype} {array.shape}, expected {kind} {shape}")

    def __len__(self) -> int:
        return len(self.t_ns)

    @property
    def marker_count(self) -> int:
        """M."""
        return self.markers_m.shape[1]

    @classmethod
    def of(cls, poses: Sequence[HandPose]) -> "Poses":
        """Stack poses of one hand; at least one.

        Raises:
            ValueError: No pose, or poses of different hands or marker counts.
        """
        if not poses:
            raise ValueError("no poses to stack")
        if len({(pose.hand, len(pose.markers_m)) for pose in poses}) > 1:
            raise ValueError("poses of different hands or marker counts")
        dtype = record(len(poses[0].markers_m))
        arrays = {
            name: np.array([getattr(pose, name) for pose in poses], dtype=dtype[name].base)
            for name in dtype.names or ()
        }
        return cls(hand=poses[0].hand, **arrays)

    def pose(self, index: int) -> HandPose:
        """Row `index` as the message it came from."""
        times = ("t_ns", "latency_ns")
        arrays = {
            f.name: getattr(self, f.name)[index] for f in fields(self) if f.name not in ("hand", *times)
        }
        return HandPose(
            hand=self.hand, t_ns=int(self.t_ns[index]), latency_ns=int(self.latency_ns[index]), **arrays
        )

    def rows(self, start: int, stop: int) -> "Poses":
        """Rows start..stop-1, without copying."""
        arrays = {f.name: getattr(self, f.name)[start:stop] for f in fields(self) if f.name != "hand"}
        return Poses(hand=self.hand, **arrays)


def record(marker_count: int) -> np.dtype[np.void]:
    """Return one row of poses.npz as a structured type.

    The only place that fixes names, types and shapes.
    """
    j, m = JOINT_COUNT, marker_count
    return np.dtype(
        [
            ("t_ns", "<i8"),
            ("position_m", "<f8", (j, 3)),
            ("orientation_wxyz", "<f8", (j, 4)),
            ("radius_m", "<f8", (j,)),
            ("valid", "?", (j,)),
            ("tracked", "?", (j,)),
            ("cov_m2", "<f8", (j, 3, 3)),
            ("source", "u1", (j,)),
            ("angles_rad", "<f8", (FINGER_COUNT, 4)),
            ("markers_m", "<f8", (m, 3)),
            ("markers_raw_m", "<f8", (m, 3)),
            ("markers_cov_m2", "<f8", (m, 3, 3)),
            ("inside_volume", "?", (j,)),
            ("latency_ns", "<i8"),
            ("laser_m", "<f8", (FINGER_COUNT, 3)),
            ("solver_mode", "u1", (FINGER_COUNT,)),
            ("ambiguous", "?", (FINGER_COUNT,)),
            ("palm_world_wxyz", "<f8", (4,)),
            ("palm_world_sigma_rad", "<f8", (2,)),
            ("wrist_angles_rad", "<f8", (2,)),
            ("wrist_angles_sigma_rad", "<f8", (2,)),
        ]
    )


@dataclass(frozen=True, slots=True, eq=False)
class PosesTruth:
    """True joints and caps at the times of T poses.

    NaN: unknown there.

    Attributes:
        joints_m: (T, 26, 3) [m], rig frame.
        markers_m: (T, M, 3) [m], centroids of the painted caps, rig frame.
        laser_m: (T, 5, 3) [m], where the laser meets each finger, of a wrist device; None: a marker rig.
    """

    joints_m: Float
    markers_m: Float
    laser_m: Float | None = None

    @classmethod
    def of_webxr(cls, joints_m: Float, markers_m: Float, laser_m: Float | None = None) -> "PosesTruth":
        """Build the truth from the 25 WebXR joints (T, 25, 3) of a rendered recording.

        The palm is derived.
        """
        palm = (joints_m[:, MIDDLE_METACARPAL - 1] + joints_m[:, MIDDLE_PROXIMAL - 1]) / 2
        return cls(np.concatenate([palm[:, None], joints_m], axis=1), markers_m, laser_m)

    def rows(self, start: int, stop: int) -> "PosesTruth":
        """Rows start..stop-1, without copying."""
        laser_m = None if self.laser_m is None else self.laser_m[start:stop]
        return PosesTruth(self.joints_m[start:stop], self.markers_m[start:stop], laser_m)

    def errors_m(self, poses: Poses) -> dict[str, Float]:
        """Return the distances (T, K) [m] from the truth for each measured quantity.

        A mapping from quantity to distances; NaN where either of the two is not known.
        """
        joints = {"joints": self.joint_error_m(poses)}
        if self.laser_m is None:
            return joints | {"markers": self.marker_error_m(poses)}
        return joints | {"laser": distance_m(poses.laser_m, self.laser_m)}

    def joint_error_m(self, poses: Poses) -> Float:
        """Return the distance (T, 25) [m] of every joint but the palm from the truth.

        NaN where the pose is not valid or there is no truth.
        """
        error = distance_m(poses.position_m, self.joints_m)
        return np.where(poses.valid, error, np.nan)[:, 1:]

    def marker_error_m(self, poses: Poses) -> Float:
        """Distance (T, M) [m] of the unfiltered caps; NaN where not seen."""
        return distance_m(poses.markers_raw_m, self.markers_m)


def distance_m(a: Float, b: Float) -> Float:
    """Distances (...) of points (..., 3), same unit; NaN where either is."""
    return np.asarray(np.linalg.norm(a - b, axis=-1), np.float64)


def mean_known(values: Float) -> Float:
    """Return the mean (T,) over the second axis of (T, K), ignoring NaN values.

    NaN where no value is known.
    """
    known = ~np.isnan(values)
    count = known.sum(axis=1)
    total = np.where(known, values, 0.0).sum(axis=1)
    return np.divide(total, count, out=np.full(len(values), np.nan), where=count > 0)


class PosesFile:
    """poses.npz of one hand; holds the spool of rows written so far."""

    def __init__(self, path: Path, hand: str, marker_count: int) -> None:
        """Open the spool in the folder of `path`.

        Args:
            path: The .npz to write.
            hand: Name of the hand profile; every pose must carry it.
            marker_count: M; every pose must have as many markers.

        Raises:
            RecordingError: The folder is missing or read-only.
        """
        self._path, self._hand = path, hand
        self._markers = (marker_count, 3)
        self._file = TableFile(path, record(marker_count), {"hand": hand})

    def write(self, pose: HandPose) -> None:
        """Append one row.

        Raises:
            RecordingError: Disk full; the run's file is given up, see `close`.
            ValueError: Another hand or marker count than the file was opened for, or it is closed.
        """
        if pose.hand != self._hand or pose.markers_m.shape != self._markers:
            what = f"{pose.hand!r} with {len(pose.markers_m)} markers"
            raise ValueError(f"{self._path}: a pose of {what} does not fit, opened for {self._hand!r}")
        self._file.write(pose)

    def close(self) -> None:
        """Write the .npz; an older file of that name is replaced only by a complete one.

        Raises:
            RecordingError: Disk full or folder gone; no part of a file is left.
        """
        self._file.close()


class RunFiles:
    """A `Sink` that writes the files of a run.

    A poses.npz for each hand, and beside it the other results.

    The first hand's poses stand at the path itself, those of others beside it under their names; objects, contact and
    gestures in the same folder (`told_files`).
    """

    def __init__(self, path: Path, marker_counts: Mapping[str, int], objects: Sequence[str] = ()) -> None:
        """Open the spools.

        Args:
            path: Of the first hand's poses.
            marker_counts: Name of the hand profile -> M.
            objects: Names of the objects.

        Raises:
            RecordingError: The folder is missing or read-only.
        """
        first, folder = next(iter(marker_counts)), path.parent
        self._hands = {
            hand: PosesFile(path if hand == first else path_of_hand(path, hand), hand, count)
            for hand, count in marker_counts.items()
        }
        self._objects = {name: object_file(folder, name) for name in objects}
        self._contacts = {
            (hand, name): contact_file(folder, hand, name)
            for hand, count in marker_counts.items()
            if count  # a wrist device alone measures no contact
            for name in objects
        }
        self._gestures = GesturesFile(folder)

    def write(self, message: ResultMessage) -> None:
        """Append a row to the file of its hand or object.

        Raises:
            RecordingError: Disk full; the file is given up.
            ValueError: A hand or object that they were not opened for, or another marker count, or they are closed.
        """
        if isinstance(message, Gesture):
            self._gestures.write(message)
        elif isinstance(message, HandPose):
            if message.hand not in self._hands:
                raise ValueError(
                    f"a pose of {message.hand!r} does not fit, opened for {', '.join(self._hands)}"
                )
            self._hands[message.hand].write(message)
        elif isinstance(message, ObjectPose):
            if message.object not in self._objects:
                opened = ", ".join(self._objects) or "none"
                raise ValueError(f"a pose of object {message.object!r} does not fit, opened for {opened}")
            self._objects[message.object].write(message)
        else:
            if (message.hand, message.object) not in self._contacts:
                raise ValueError(f"contact of {message.hand!r} and {message.object!r} does not fit")
            self._contacts[message.hand, message.object].write(message)

    def close(self) -> None:
        """Write each file.

        A file that cannot be completed does not keep any other from being written.

        Raises:
            RecordingError: Disk full or folder gone; no part of a file is left.
        """
        with ExitStack() as all_of_them:
            files = (*self._hands.values(), *self._objects.values(), *self._contacts.values(), self._gestures)
            for file in files:
                all_of_them.callback(file.close)


def path_of_hand(path: Path, hand: str) -> Path:
    """Return the poses file of a hand other than the first.

    poses.npz -> poses-HAND.npz.
    """
    return path.with_name(f"{path.stem}-{hand}{path.suffix}")


def save_poses(path: Path, poses: Poses) -> None:
    """Write poses.npz in one call.

    Raises:
        RecordingError: As `PosesFile`.
    """
    file = PosesFile(path, poses.hand, poses.marker_count)
    for index in range(len(poses)):
        file.write(poses.pose(index))
    file.close()


def load_poses(path: Path) -> Poses:
    """Read a poses.npz.

    Raises:
        RecordingError: Missing, not an .npz, a key missing or of the wrong type or shape.
    """
    names = [*(record(0).names or ()), "hand"]
    arrays = read_npz(path, names, "not a poses.npz of ours")
    hand = str(arrays.pop("hand"))
    try:
        return Poses(hand=hand, **cast(dict[str, Any], arrays))
    except (ValueError, AttributeError) as error:
        raise RecordingError(f"{path}: not a poses.npz: {error}") from error
