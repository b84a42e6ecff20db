"""Poses holds a run as arrays, its truth beside it, and its file poses.npz.

poses.npz is readable with numpy. All files of a run are written at once; each appears under its name complete
or not at all, and identical poses make identical bytes (`TableFile`).
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
    """T poses of one hand, row by row; fields as in `HandPose`."""

    hand: str
    t_ns: Int  # (T,) [ns]
    position_m: Float  # (T, 26, 3) [m], rig frame
    orientation_wxyz: Float  # (T, 26, 4)
    radius_m: Float  # (T, 26) [m]
    valid: Bool  # (T, 26)
    tracked: Bool  # (T, 26)
    cov_m2: Float  # (T, 26, 3, 3) [m^2]
    source: Code  # (T, 26) `Source` codes
    angles_rad: Float  # (T, 5, 4) [rad]
    markers_m: Float  # (T, M, 3) [m], after the filter
    markers_raw_m: Float  # (T, M, 3) [m], before the filter
    markers_cov_m2: Float  # (T, M, 3, 3) [m^2], of `markers_raw_m`
    inside_volume: Bool  # (T, 26)
    latency_ns: Int  # (T,) [ns]; 0 in an offline run
    laser_m: Float  # (T, 5, 3) laser points of a wrist device [m], frame of its camera
    solver_mode: Code  # (T, 5) `SolverMode` codes: what a wrist device solved each finger from
    ambiguous: Bool  # (T, 5) another pose of that finger explains what was seen as well
    palm_world_wxyz: Float  # (T, 4) palm in the world of a wrist device's IMU; NaN: none
    palm_world_sigma_rad: Float  # (T, 2)
    wrist_angles_rad: Float  # (T, 2) of the wrist, where a device sits on the forearm; NaN: none
    wrist_angles_sigma_rad: Float  # (T, 2)

    def __post_init__(self) -> None:
        """Refuse arrays of shapes or types that do not fit together; ValueError."""
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

    @classmethod
    def joined(cls, batches: Sequence["Poses"]) -> "Poses":
        """Concatenate poses of one hand and one marker count; at least one batch."""
        arrays: dict[str, Any] = {
            one.name: np.concatenate([getattr(batch, one.name) for batch in batches])
            for one in fields(cls)
            if one.name != "hand"
        }
        return cls(hand=batches[0].hand, **arrays)

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
    """Return the type of a row of poses.npz; nothing else fixes names and shapes."""
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
    """True joints and caps at the times of T poses; NaN: unknown there."""

    joints_m: Float  # (T, 26, 3) [m], rig frame
    markers_m: Float  # (T, M, 3) [m], centroids of the painted caps, rig frame
    # (T, 5, 3) [m], where the laser meets each finger, of a wrist device; None: a marker rig
    laser_m: Float | None = None

    @classmethod
    def of_webxr(cls, joints_m: Float, markers_m: Float, laser_m: Float | None = None) -> "PosesTruth":
        """Build the truth from 25 WebXR joints (T, 25, 3); the palm is derived."""
        palm = (joints_m[:, MIDDLE_METACARPAL - 1] + joints_m[:, MIDDLE_PROXIMAL - 1]) / 2
        return cls(np.concatenate([palm[:, None], joints_m], axis=1), markers_m, laser_m)

    def rows(self, start: int, stop: int) -> "PosesTruth":
        """Rows start..stop-1, without copying."""
        laser_m = None if self.laser_m is None else self.laser_m[start:stop]
        return PosesTruth(self.joints_m[start:stop], self.markers_m[start:stop], laser_m)

    def errors_m(self, poses: Poses) -> dict[str, Float]:
        """Map each measured quantity to its distances (T, K) [m]; NaN: unknown."""
        joints = {"joints": self.joint_error_m(poses)}
        if self.laser_m is None:
            return joints | {"markers": self.marker_error_m(poses)}
        return joints | {"laser": distance_m(poses.laser_m, self.laser_m)}

    def joint_error_m(self, poses: Poses) -> Float:
        """Return the distance (T, 25) [m] from the truth, without the palm; NaN: unknown."""
        error = distance_m(poses.position_m, self.joints_m)
        return np.where(poses.valid, error, np.nan)[:, 1:]

    def marker_error_m(self, poses: Poses) -> Float:
        """Distance (T, M) [m] of the unfiltered caps; NaN where not seen."""
        return distance_m(poses.markers_raw_m, self.markers_m)


def distance_m(a: Float, b: Float) -> Float:
    """Distances (...) of points (..., 3), same unit; NaN where either is."""
    return np.asarray(np.linalg.norm(a - b, axis=-1), np.float64)


def mean_known(values: Float) -> Float:
    """Return the mean (T,) over the second axis without NaN; NaN: nothing known."""
    known = ~np.isnan(values)
    count = known.sum(axis=1)
    total = np.where(known, values, 0.0).sum(axis=1)
    return np.divide(total, count, out=np.full(len(values), np.nan), where=count > 0)


class PosesFile:
    """poses.npz of one hand, until `close` a spool."""

    def __init__(self, path: Path, hand: str, marker_count: int) -> None:
        """Open the spool for a hand and its M markers; RecordingError as `TableFile`."""
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
        """Write the .npz; as `TableFile`."""
        self._file.close()


class RunFiles:
    """A `Sink` that writes poses.npz, and further hands and results beside it."""

    def __init__(self, path: Path, marker_counts: Mapping[str, int], objects: Sequence[str] = ()) -> None:
        """Open the spools; `marker_counts`: hand profile -> M, the first at `path`."""
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
        """Write each file, also where another one cannot be completed; RecordingError."""
        with ExitStack() as all_of_them:
            files = (*self._hands.values(), *self._objects.values(), *self._contacts.values(), self._gestures)
            for file in files:
                all_of_them.callback(file.close)


def path_of_hand(path: Path, hand: str) -> Path:
    """Name the poses file of a hand other than the first: poses-HAND.npz."""
    return path.with_name(f"{path.stem}-{hand}{path.suffix}")


def save_poses(path: Path, poses: Poses) -> None:
    """Write poses.npz in one call; RecordingError as `PosesFile`."""
    file = PosesFile(path, poses.hand, poses.marker_count)
    for index in range(len(poses)):
        file.write(poses.pose(index))
    file.close()


def load_poses(path: Path) -> Poses:
    """Read a poses.npz; RecordingError: missing, or not of this type and shape."""
    names = [*(record(0).names or ()), "hand"]
    arrays = read_npz(path, names, "not a poses.npz of ours")
    hand = str(arrays.pop("hand"))
    try:
        return Poses(hand=hand, **cast(dict[str, Any], arrays))
    except (ValueError, AttributeError) as error:
        raise RecordingError(f"{path}: not a poses.npz: {error}") from error
