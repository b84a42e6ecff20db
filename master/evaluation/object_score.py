"""Score of tracked objects against their truth.

It has millimetres, degrees, how often they were tracked, and whether the stated uncertainty was consistent.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.arrays import Float, Int
from common.errors import RecordingError
from common.geometry.transforms import (
    matrix_to_rotation_vector,
    quaternion_to_matrix,
    rotation_vector_to_matrix,
)
from common.recording.recorded_files import TRUTH, has_truth, read_truth
from master.outputs.result_files import ObjectPoses

_NEAR_NS = 100_000_000  # between truths farther apart nothing is interpolated


@dataclass(frozen=True, slots=True, eq=False)
class ObjectTruth:
    """Where an object truly was.

    Attributes:
        t_ns: (N,) rising, on the clock of the poses.
        T_rig_object: (N, 4, 4) [m].
    """

    t_ns: Int
    T_rig_object: Float

    def at(self, t_ns: Int) -> Float:
        """Interpolate poses (T, 4, 4) at other times (T,).

        NaN outside, and where truths are too far apart.
        """
        out = np.full((len(t_ns), 4, 4), np.nan)
        if len(self.t_ns) == 0:
            return out
        last = max(len(self.t_ns) - 2, 0)
        before = np.clip(np.searchsorted(self.t_ns, t_ns, side="right") - 1, 0, last)
        after = np.minimum(before + 1, len(self.t_ns) - 1)
        span = np.maximum(self.t_ns[after] - self.t_ns[before], 1)
        share = (t_ns - self.t_ns[before]) / span
        a, b = self.T_rig_object[before], self.T_rig_object[after]
        rotation = matrix_to_rotation_vector(np.swapaxes(a[:, :3, :3], 1, 2) @ b[:, :3, :3])
        out[:, :3, :3] = a[:, :3, :3] @ rotation_vector_to_matrix(share[:, None] * rotation)
        out[:, :3, 3] = a[:, :3, 3] + share[:, None] * (b[:, :3, 3] - a[:, :3, 3])
        out[:, 3] = (0.0, 0.0, 0.0, 1.0)
        out[(share < 0.0) | (share > 1.0) | (span > _NEAR_NS)] = np.nan
        return out


def load_object_truth(folder: Path, name: str) -> ObjectTruth | None:
    """Truth of an object of a rendered recording; None where the folder holds none.

    Raises:
        RecordingError: truth.npz is broken, leads out of the folder, or its arrays do not fit together.
    """
    if not has_truth(folder):
        return None
    key = f"object_{name}"
    data = read_truth(folder, also=(key, "t_ref"))
    if key not in data or "t_ref" not in data:
        return None
    try:
        poses, t_s = (data[one].astype(np.float64) for one in (key, "t_ref"))
    except (ValueError, TypeError) as error:
        raise RecordingError(f"{folder / TRUTH}: {key}: {error}") from error
    if t_s.ndim != 1 or poses.shape != (t_s.size, 4, 4):
        raise RecordingError(f"{folder / TRUTH}: {key} has shape {poses.shape}, expected ({t_s.size}, 4, 4)")
    first_ns = 1_000_000_000  # scene time 0 of a recording
    return ObjectTruth(first_ns + np.round(1e9 * t_s).astype(np.int64), poses)


def errors(poses: ObjectPoses, truth: ObjectTruth) -> tuple[Float, Float]:
    """Return distance [mm] of the origin and angle [deg] of each pose (T,).

    Both are from the truth; NaN where either is not known.
    """
    true = truth.at(poses.t_ns)
    off_mm = 1e3 * np.linalg.norm(poses.position_m - true[:, :3, 3], axis=1)
    rotation = np.swapaxes(true[:, :3, :3], 1, 2) @ quaternion_to_matrix(poses.orientation_wxyz)
    off_deg = np.degrees(np.linalg.norm(matrix_to_rotation_vector(rotation), axis=1))
    return np.asarray(off_mm, np.float64), np.asarray(off_deg, np.float64)


def score_object(poses: ObjectPoses, truth: ObjectTruth) -> dict[str, float]:
    """Of one object.

    Returns:
        mm, deg (medians over tracked poses), mm_p95, deg_p95, mm_max, tracked (share of the true epochs at which it
        was), occluded (share of the tracked poses that report it), nees (median of the squared error by
        its covariance, six numbers: about 5.3 where that is consistent). What has nothing to average is omitted.
    """
    mm, deg = errors(poses, truth)
    seen = poses.tracked & np.isfinite(mm) & np.isfinite(deg)
    out = {"poses": float(len(poses)), "tracked": tracked_share(poses, truth)}
    if not seen.any():
        return out
    out |= {
        "mm": float(np.median(mm[seen])),
        "deg": float(np.median(deg[seen])),
        "mm_p95": float(np.percentile(mm[seen], 95.0)),
        "deg_p95": float(np.percentile(deg[seen], 95.0)),
        "mm_max": float(mm[seen].max()),
        "occluded": float(poses.occluded[seen].mean()),
        "nees": float(np.median(_nees(poses, truth)[seen])),
    }
    return {name: round(value, 4) for name, value in out.items()}


def tracked_share(poses: ObjectPoses, truth: ObjectTruth) -> float:
    """Return the share of true epochs at which the nearest pose is tracked.

    The nearest pose must not be farther away than the usual spacing of poses.
    """
    if len(truth.t_ns) == 0 or len(poses) == 0:
        return 0.0
    apart = [np.median(np.diff(t_ns)) for t_ns in (truth.t_ns, poses.t_ns) if len(t_ns) > 1]
    after = np.clip(np.searchsorted(poses.t_ns, truth.t_ns), 0, len(poses) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(poses.t_ns[before] - truth.t_ns) <= np.abs(poses.t_ns[after] - truth.t_ns)
    nearest = np.where(nearer, before, after)
    near = np.abs(poses.t_ns[nearest] - truth.t_ns) < max(apart, default=_NEAR_NS)
    return float((near & poses.tracked[nearest]).mean())


def score_objects(scores: dict[str, dict[str, float]]) -> dict[str, object]:
    """Return the object metrics for a summary.

    `objects` (each by its name), and of all together object_mm, object_deg, object_tracked.

    These are of the object that is worst in each.
    """
    if not scores:
        return {}
    out: dict[str, object] = {"objects": scores}
    for name, worst in (("mm", max), ("deg", max), ("tracked", min)):
        known = [one[name] for one in scores.values() if name in one]
        if known:
            out[f"object_{name}"] = worst(known)
    return out


def _nees(poses: ObjectPoses, truth: ObjectTruth) -> Float:
    """Normalised squared errors (T,); NaN where something is not known."""
    true = truth.at(poses.t_ns)
    rotation = quaternion_to_matrix(poses.orientation_wxyz) @ np.swapaxes(true[:, :3, :3], 1, 2)
    off = np.concatenate([poses.position_m - true[:, :3, 3], matrix_to_rotation_vector(rotation)], axis=1)
    out = np.full(len(poses), np.nan)
    known = np.isfinite(off).all(axis=1) & np.isfinite(poses.cov).all(axis=(1, 2))
    off, cov = off[known], poses.cov[known]
    out[known] = np.vecdot(off, np.linalg.solve(cov, off[..., None])[..., 0])
    return out
