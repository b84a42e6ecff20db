"""The score of hands and objects is their error against exact truth.

A finger counts as *visible* where its marker is at least half seen by two cameras. Scores come twice: over
visible fingers (the palm's joints with them), and over all. Of objects: millimetres, degrees, how often they
were tracked, and whether the stated covariance was consistent.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.arrays import Bool, Code, Float, Int
from common.errors import RecordingError
from common.geometry.transforms import (
    matrix_to_rotation_vector,
    quaternion_to_matrix,
    rotation_vector_to_matrix,
)
from common.hand.model import FINGER_JOINTS
from common.recording.recorded_files import TRUTH, has_truth, read_truth
from master.outputs.poses import Poses
from master.outputs.result_files import ObjectPoses, nearest_rows

_OF_HAND = ("t_ref", "joints", "angles", "paint_centroid", "frac")  # arrays of a truth
_OF_SWEEP = ("depth", "center", "frac")
_FINGER_OF_JOINT = np.full(26, -1)
for _f, _joints in enumerate(FINGER_JOINTS):
    _FINGER_OF_JOINT[list(_joints)] = _f


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Exact values at N moments."""

    t_ns: Int  # (N,) on the clock of the poses
    joints_m: Float  # (N, 25, 3) WebXR joints [m], rig frame; NaN where the scene has no hand
    pip_rad: Float  # (N, 4) PIP of index ... little
    markers_m: Float  # (N, M, 3) cap centroids
    visible: Float  # (N, C, M) visible share of each marker in each camera


def load_truth(folder: Path, shown: Bool, hand: str | None = None) -> Truth | None:
    """Truth of a rendered recording; None where the folder holds none of this hand.

    `shown`: (M,) markers found most often; a sweep of the depth shows a single flat one. `hand`: None: the first.

    Raises:
        RecordingError: truth.npz is broken, lacks an array, or leads out of the folder.
    """
    if not has_truth(folder):
        return None
    own = {key: key if hand is None else f"{key}_{hand}" for key in _OF_HAND}
    data = read_truth(folder, also=(*_OF_SWEEP, *own.values()))
    if hand is not None:
        if own["joints"] not in data:
            return None
        data = {key: data[name] for key, name in own.items() if name in data}
    try:
        truth = _sweep(data, shown) if "depth" in data else _hand(data)
        _check(truth, len(shown))
        return truth
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise RecordingError(f"{folder / TRUTH}: not the truth of a marker recording: {error}") from error


def score(poses: Poses, truth: Truth, fingers: tuple[int, ...]) -> dict[str, float]:
    """Mean errors over the frames that have a truth; empty scores are left out.

    `fingers`: for each marker the finger it sits on, or -1.

    Returns:
        marker_mm (median over markers seen at least half by two cameras), marker_raw_mm (the same before the
        filter), markers_missed (such markers not found), joint_mm, joint_mm_visible, pip_deg, pip_deg_visible,
        frames_without_pose.
    """
    rows, columns = _match(poses.t_ns, truth.t_ns)
    clear = (truth.visible[columns] >= 0.5).sum(axis=1) >= 2
    out: dict[str, float] = {}
    for name, found in (("marker_mm", poses.markers_m[rows]), ("marker_raw_mm", poses.markers_raw_m[rows])):
        error = np.linalg.norm(found - truth.markers_m[columns], axis=2)[clear]
        put(out, name, 1e3 * error[np.isfinite(error)], np.median)
    wanted = np.isfinite(truth.markers_m[columns]).all(axis=2) & clear
    out["markers_missed"] = float((wanted & ~np.isfinite(poses.markers_raw_m[rows]).all(axis=2)).sum())
    solved = np.isfinite(poses.position_m[rows]).all(axis=(1, 2))
    if not np.isfinite(truth.joints_m[columns]).any():
        return out
    joint = 1e3 * np.linalg.norm(poses.position_m[rows][:, 1:] - truth.joints_m[columns], axis=2)
    pip = np.degrees(np.abs(poses.angles_rad[rows][:, 1:, 2] - truth.pip_rad[columns]))
    finger_clear = _fingers_clear(clear, fingers)
    joint_clear = np.where(_FINGER_OF_JOINT[1:] < 0, True, finger_clear[:, _FINGER_OF_JOINT[1:]])
    put(out, "joint_mm", joint[solved], np.mean)
    put(out, "joint_mm_visible", joint[solved][joint_clear[solved]], np.mean)
    put(out, "pip_deg", pip[solved], np.mean)
    put(out, "pip_deg_visible", pip[solved][finger_clear[:, 1:][solved]], np.mean)
    out["frames_without_pose"] = float((~solved).sum())
    return out


def score_hidden(poses: Poses, truth: Truth, fingers: tuple[int, ...]) -> dict[str, float]:
    """Score fingers that the cameras do not see, and changes of a joint's source.

    Returns:
        joint_mm_hidden, pip_deg_hidden: Mean errors of fingers that are valid while their marker is at least half seen
            by less than two cameras; hidden_invalid: share of hidden fingers that are not valid.
        hand_over_step_mm: Largest step of a joint from pose to pose beyond its true step, within 0.2 s of a change of
            any joint's source. A score with nothing to average is left out.
    """
    rows, columns = _match(poses.t_ns, truth.t_ns)
    found, exact = poses.position_m[rows][:, 1:], truth.joints_m[columns]
    valid = poses.valid[rows][:, 1:] & np.isfinite(found).all(axis=2)
    clear = (truth.visible[columns] >= 0.5).sum(axis=1) >= 2
    hidden = ~_fingers_clear(clear, fingers)
    of_finger = (_FINGER_OF_JOINT[1:] >= 0) & hidden[:, _FINGER_OF_JOINT[1:]]
    out: dict[str, float] = {}
    put(out, "joint_mm_hidden", 1e3 * np.linalg.norm(found - exact, axis=2)[of_finger & valid], np.mean)
    all_valid = np.stack(
        [valid[:, [j - 1 for j in chain[1:]]].all(axis=1) for chain in FINGER_JOINTS[1:]], axis=1
    )
    pip = np.degrees(np.abs(poses.angles_rad[rows][:, 1:, 2] - truth.pip_rad[columns]))
    put(out, "pip_deg_hidden", pip[hidden[:, 1:] & all_valid], np.mean)
    put(out, "hidden_invalid", (~all_valid)[hidden[:, 1:]].astype(np.float64), np.mean)
    step = 1e3 * np.linalg.norm(np.diff(found, axis=0) - np.diff(exact, axis=0), axis=2)
    t_ns = poses.t_ns[rows]
    follows_ns = 100_000_000  # longer apart, two poses are no step
    follows = (np.diff(t_ns) <= follows_ns)[:, None] & valid[1:] & valid[:-1]
    near = _near_change(t_ns, poses.source[rows])
    put(out, "hand_over_step_mm", step[follows & near[1:, None]], np.max)
    return out


def _near_change(t_ns: Int, source: Code) -> Bool:
    """Mask (N,) of the times within 0.2 s of a change of any joint's source (N, 26)."""
    changed = t_ns[1:][(source[1:] != source[:-1]).any(axis=1)]
    hand_over_ns = 200_000_000
    after = np.searchsorted(changed, t_ns - hand_over_ns)
    return np.searchsorted(changed, t_ns + hand_over_ns, side="right") > after


def put(out: dict[str, float], name: str, values: Float, reduce: Callable[[Float], object]) -> None:
    """Add the score `name`; with nothing to reduce it is left out."""
    if values.size:
        out[name] = round(float(np.asarray(reduce(values))), 4)


def _fingers_clear(clear: Bool, fingers: tuple[int, ...]) -> Bool:
    """(N, 5) whether a marker of each finger is clearly seen."""
    out = np.zeros((len(clear), 5), dtype=bool)
    for marker, finger in enumerate(fingers):
        if finger >= 0:
            out[:, finger] |= clear[:, marker]
    return out


def _match(t_ns: Int, truth_ns: Int) -> tuple[Int, Int]:
    """Rows of poses and truth: one truth for each pose, one for all, or by time."""
    rows = np.arange(len(t_ns))
    if len(truth_ns) == 1:
        return rows, np.zeros_like(rows)
    if len(truth_ns) == len(t_ns):
        return rows, rows
    nearest = np.clip(np.searchsorted(truth_ns, t_ns), 1, len(truth_ns) - 1)
    nearest = nearest - (np.abs(truth_ns[nearest - 1] - t_ns) <= np.abs(truth_ns[nearest] - t_ns))
    match_ns = 1_000_000
    rows = np.flatnonzero(np.abs(truth_ns[nearest] - t_ns) <= match_ns)
    return rows, nearest[rows]


def _check(truth: Truth, markers: int) -> None:
    """Refuse arrays that do not fit together; the ValueError names the array."""
    n = len(truth.t_ns)
    cameras = truth.visible.shape[1] if truth.visible.ndim == 3 else 1
    for name, array, shape in (
        ("t_ref", truth.t_ns, (max(n, 1),)),
        ("joints", truth.joints_m, (n, 25, 3)),
        ("angles", truth.pip_rad, (n, 4)),
        ("paint_centroid", truth.markers_m, (n, markers, 3)),
        ("frac", truth.visible, (n, cameras, markers)),
    ):
        if array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}, expected {shape}")


def _hand(data: dict[str, Float]) -> Truth:
    exact = {name: data[name].astype(np.float64) for name in _OF_HAND}
    return Truth(
        t_ns=np.round(1e9 * (1.0 + exact["t_ref"])).astype(np.int64),
        joints_m=exact["joints"],
        pip_rad=exact["angles"][:, [7, 11, 15, 19]],
        markers_m=exact["paint_centroid"],
        visible=exact["frac"],
    )


def _sweep(data: dict[str, Float], shown: Bool) -> Truth:
    """One flat marker moved along the axis in steps of a second; there is no hand."""
    depth, centre, seen = (data[name].astype(np.float64) for name in _OF_SWEEP)
    n = depth.size if depth.ndim == 1 else 0
    return Truth(
        t_ns=1_000_000_000 * (1 + np.arange(n)),
        joints_m=np.broadcast_to(np.nan, (n, 25, 3)),
        pip_rad=np.broadcast_to(np.nan, (n, 4)),
        markers_m=np.where(shown[None, :, None], centre[:, None], np.nan),
        visible=np.where(shown, seen[:, :, None], 0.0),
    )


_NEAR_NS = 100_000_000  # between truths farther apart nothing is interpolated


@dataclass(frozen=True, slots=True, eq=False)
class ObjectTruth:
    """Where an object truly was."""

    t_ns: Int  # (N,) rising, on the clock of the poses
    T_rig_object: Float  # (N, 4, 4) [m]

    def at(self, t_ns: Int) -> Float:
        """Interpolate poses (T, 4, 4) at times (T,); NaN outside and in long gaps."""
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
    """Truth of an object of a rendered recording; None where there is none.

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
    """Distance [mm] of the origin and angle [deg] (T,) from the truth; NaN: unknown."""
    true = truth.at(poses.t_ns)
    off_mm = 1e3 * np.linalg.norm(poses.position_m - true[:, :3, 3], axis=1)
    rotation = np.swapaxes(true[:, :3, :3], 1, 2) @ quaternion_to_matrix(poses.orientation_wxyz)
    off_deg = np.degrees(np.linalg.norm(matrix_to_rotation_vector(rotation), axis=1))
    return np.asarray(off_mm, np.float64), np.asarray(off_deg, np.float64)


def score_object(poses: ObjectPoses, truth: ObjectTruth) -> dict[str, float]:
    """Score one object; what has nothing to average is omitted.

    Returns:
        mm, deg (medians over tracked poses), mm_p95, deg_p95, mm_max, tracked (share of the true epochs at which it
        was), occluded (share of the tracked poses that report it), nees (median of the squared error by
        its covariance, six numbers: about 5.3 where that is consistent).
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
    """Share of true epochs whose nearest pose, not farther than usual, is tracked."""
    if len(truth.t_ns) == 0 or len(poses) == 0:
        return 0.0
    periods_ns = [np.median(np.diff(t_ns)) for t_ns in (truth.t_ns, poses.t_ns) if len(t_ns) > 1]
    nearest = nearest_rows(poses.t_ns, truth.t_ns)
    near = np.abs(poses.t_ns[nearest] - truth.t_ns) < max(periods_ns, default=_NEAR_NS)
    return float((near & poses.tracked[nearest]).mean())


def score_objects(scores: dict[str, dict[str, float]]) -> dict[str, object]:
    """Object metrics of a summary: `objects` by name, and the worst as object_*."""
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
