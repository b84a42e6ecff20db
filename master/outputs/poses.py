"""Poses holds a run as arrays, its truth beside it, and the files of a run.

All files of a run are written at once; each appears under its name complete or not at all, and identical
poses make identical bytes (`TableFile`).
"""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from common.arrays import Bool, Code, Float, Int
from common.hand.model import MIDDLE_METACARPAL, MIDDLE_PROXIMAL
from common.messages import Contact, HandPose, Message, ObjectPose, ResultMessage
from master.outputs.result_files import (
    GESTURES,
    GesturesFile,
    SpooledFile,
    Table,
    TableFile,
    contact_path,
    object_path,
)
from master.rig.setup import RigSetup


@dataclass(frozen=True, slots=True, eq=False)
class Poses(Table[HandPose]):
    """T poses of one hand, row by row; fields as in `HandPose`."""

    kind = HandPose
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

    @property
    def marker_count(self) -> int:
        """M."""
        return self.markers_m.shape[1] if self.markers_m.ndim == 3 else 0

    @classmethod
    def of(cls, poses: Sequence[HandPose]) -> "Poses":
        """Stack poses of one hand; at least one.

        Raises:
            ValueError: No pose, or poses of different hands or marker counts.
        """
        if len({(pose.hand, len(pose.markers_m)) for pose in poses}) != 1:
            raise ValueError("no poses to stack, or of different hands or marker counts")
        return cls.stacked(poses, len(poses[0].markers_m), hand=poses[0].hand)

    @classmethod
    def joined(cls, batches: Sequence["Poses"]) -> "Poses":
        """Concatenate poses of one hand and one marker count; at least one batch."""
        arrays: dict[str, Any] = {
            one.name: np.concatenate([getattr(batch, one.name) for batch in batches])
            for one in fields(cls)
            if one.name != "hand"
        }
        return cls(hand=batches[0].hand, **arrays)


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
        """Map what was measured to its distances (T, K) [m]; NaN: unknown.

        25 joints, without the palm; markers before the filter, or laser points.
        """
        joints = np.where(poses.valid, distance_m(poses.position_m, self.joints_m), np.nan)[:, 1:]
        if self.laser_m is None:
            return {"joints": joints, "markers": distance_m(poses.markers_raw_m, self.markers_m)}
        return {"joints": joints, "laser": distance_m(poses.laser_m, self.laser_m)}


def distance_m(a: Float, b: Float) -> Float:
    """Distances (...) of points (..., 3), same unit; NaN where either is."""
    return np.asarray(np.linalg.norm(a - b, axis=-1), np.float64)


def mean_known(values: Float) -> Float:
    """Return the mean (T,) over the second axis without NaN; NaN: nothing known."""
    known = ~np.isnan(values)
    count = known.sum(axis=1)
    total = np.where(known, values, 0.0).sum(axis=1)
    return np.divide(total, count, out=np.full(len(values), np.nan), where=count > 0)


class PosesFile(TableFile):
    """poses.npz of one hand and its M markers, until `close` a spool."""

    def __init__(self, path: Path, hand: str, markers: int) -> None:
        super().__init__(path, HandPose, {"hand": hand}, markers)
        self._markers = (markers, 3)

    def _encoded(self, message: Message) -> bytes:
        assert isinstance(message, HandPose)
        if message.hand != self._labels["hand"] or message.markers_m.shape != self._markers:
            what = f"{message.hand!r} with {len(message.markers_m)} markers"
            raise ValueError(f"{self._path}: a pose of {what} does not fit")
        return super()._encoded(message)


class RunFiles:
    """A `Sink` that writes poses.npz, and further hands and results beside it."""

    def __init__(self, path: Path, marker_counts: Mapping[str, int], objects: Sequence[str] = ()) -> None:
        """Open the spools; `marker_counts`: hand profile -> M, the first at `path`."""
        first, folder = next(iter(marker_counts)), path.parent
        self._files: dict[tuple[str, ...], SpooledFile] = {}
        for hand, count in marker_counts.items():
            own = path if hand == first else path_of_hand(path, hand)
            self._files["hand", hand] = PosesFile(own, hand, count)
        for name in objects:
            self._files["object", name] = TableFile(object_path(folder, name), ObjectPose, {"object": name})
            for hand, count in marker_counts.items():
                if count:  # a wrist device alone measures no contact
                    labels = {"hand": hand, "object": name}
                    file = TableFile(contact_path(folder, hand, name), Contact, labels)
                    self._files["contact", hand, name] = file
        self._files["gestures",] = GesturesFile(folder / GESTURES)

    @classmethod
    def of(cls, path: Path, setups: Sequence[RigSetup]) -> "RunFiles":
        """The files of all hands and objects of these setups."""
        counts = {setup.hand.profile.name: len(setup.markers) for setup in setups}
        return cls(path, counts, [one.name for setup in setups for one in setup.objects])

    def write(self, message: ResultMessage) -> None:
        """Append a row to the file of its hand or object.

        Raises:
            RecordingError: Disk full; the file is given up.
            ValueError: A hand or object that they were not opened for, or another marker count, or they are closed.
        """
        match message:
            case HandPose():
                key = "hand", message.hand
            case ObjectPose():
                key = "object", message.object
            case Contact():
                key = "contact", message.hand, message.object
            case _:
                key = ("gestures",)
        if key not in self._files:
            opened = (
                ", ".join(" and ".join(other) for kind, *other in self._files if kind == key[0]) or "none"
            )
            what = f"{key[0]} {' and '.join(map(repr, key[1:]))}"
            raise ValueError(f"a pose of {what} does not fit, opened for {opened}")
        self._files[key].write(message)

    def close(self) -> None:
        """Write each file, also where another one cannot be completed; RecordingError."""
        with ExitStack() as all_of_them:
            for file in self._files.values():
                all_of_them.callback(file.close)


def path_of_hand(path: Path, hand: str) -> Path:
    """Name the poses file of a hand other than the first: poses-HAND.npz."""
    return path.with_name(f"{path.stem}-{hand}{path.suffix}")
