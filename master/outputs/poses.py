"""Many poses as arrays.

What poses.npz holds, and what pictures, viewers and scores read.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from common.arrays import Bool, Code, Float, Int
from common.messages import FINGER_COUNT, JOINT_COUNT, HandPose


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
