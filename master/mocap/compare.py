"""Comparison measures poses against a motion capture and reports it.

It yields errors, coverage of stated regions and false TRACKED, and how the two were aligned.

Angles are those between bones, from the joints of both alike, so that nobody's definition of zero matters: PIP and
DIP between the two bones at the joint, MCP between the proximal bone and the metacarpal (the line from the wrist,
where the file has no metacarpal joint); of a thumb the MCP and IP. A TRACKED joint is *false* where it is off by 15
mm, or the PIP of its finger by 20 degrees (a thumb's MCP), as in `bench/oracle/score.py`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np

from common.arrays import Bool, Float, Int
from common.geometry.transforms import matrix_to_rotation_vector
from common.hand.model import FINGER_JOINTS, FINGERS, JOINTS, WRIST
from master.mocap.align import Alignment
from master.mocap.bvh_file import JointMotion, Track, known
from master.outputs.poses import Poses
from master.recording.export.motion import back, rotate

CLASSES = ("wrist", "palm", "metacarpal", "phalanx-proximal", "phalanx-intermediate", "phalanx-distal", "tip")
_ANGLES = ("mcp", "pip", "dip")
_OF_FINGER = np.zeros((26, 5), np.bool_)
for _finger, _joints in enumerate(FINGER_JOINTS):
    _OF_FINGER[list(_joints), _finger] = True


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """Poses against truth at the T epochs of the poses in the time of the truth.

    Attributes:
        off_m: (T, 26, 3) [m], rig frame; NaN where the truth is not known or the joint is not valid.
        known: (T, 26) whether there is a truth.
        tracked: (T, 26).
        chi2: (T, 26) of the error under the stated covariance; NaN: no error, or no covariance (outside any
            region).
        angle_deg: (T, 5, 3) error of MCP, PIP, DIP (thumb: NaN, MCP, IP); NaN: not known.
        marker_mm: (T, M) error of markers; NaN: not known.
        own_frame_m: (T, 26, 3) `off_m` in the joint's axes, where a joint centre that is placed elsewhere is
            constant.
    """

    off_m: Float
    known: Bool
    tracked: Bool
    chi2: Float
    angle_deg: Float
    marker_mm: Float
    marker_names: tuple[str, ...]
    own_frame_m: Float

    @property
    def mm(self) -> Float:
        """(T, 26) length of the errors."""
        return 1e3 * np.linalg.norm(self.off_m, axis=2)

    @property
    def false(self) -> Bool:
        """(T, 26) TRACKED joints that are off."""
        false_mm, false_deg = 15.0, 20.0
        bent = np.nan_to_num(self.angle_deg[:, :, 1]) > false_deg
        wrong = (np.nan_to_num(self.mm) > false_mm) | (bent[:, None, :] & _OF_FINGER).any(axis=2)
        return self.tracked & wrong


def joint_track(motion: JointMotion) -> Track:
    """All 26 joints of a motion; NaN where it has none."""
    return Track(motion.t_ns, np.stack([motion.of(name) for name in JOINTS], axis=1))


def compare(
    poses: Poses, motion: JointMotion, alignment: Alignment, marker_names: tuple[str, ...]
) -> Compared:
    """Hold the poses of one hand against the true motion.

    The alignment is from its frame and clock to ours; marker names are those of the poses, none: not known.
    """
    truth = alignment.moved(joint_track(motion))
    inside = (poses.t_ns >= truth.t_ns[0]) & (poses.t_ns <= truth.t_ns[-1])
    t_ns: Int = poses.t_ns[inside]
    exact = truth.at(t_ns)
    valid = poses.valid[inside] & known(poses.position_m[inside])
    found = np.where(valid[..., None], poses.position_m[inside], np.nan)
    off = found - exact
    bases = np.asarray(known(exact).any(axis=0), np.bool_)  # joints that the truth has, metacarpals or not
    names = tuple(name for name in marker_names if name in motion.names)
    own = Track(motion.t_ns, np.stack([motion.of(name) for name in names], axis=1)) if names else None
    rows = [marker_names.index(name) for name in names]
    marker_mm = np.zeros((len(t_ns), 0))
    if own is not None:
        marker_mm = 1e3 * np.linalg.norm(
            poses.markers_m[inside][:, rows] - alignment.moved(own).at(t_ns), axis=2
        )
    return Compared(
        off_m=off,
        known=known(exact),
        tracked=poses.tracked[inside] & valid & known(exact),
        chi2=_chi2(off, poses.cov_m2[inside]),
        angle_deg=np.abs(_angles(found, bases) - _angles(exact, bases)),
        marker_mm=marker_mm,
        marker_names=names,
        own_frame_m=rotate(back(poses.orientation_wxyz[inside]), off),
    )


def _chi2(off_m: Float, cov_m2: Float) -> Float:
    """Squared Mahalanobis length (T, 26) of errors; inf: an error without covariance."""
    stated = np.asarray(known(cov_m2).all(axis=2), np.bool_)
    floor_m2 = 1e-10  # added to covariances: 0.01 mm, so that one without width can be inverted
    cov = np.where(stated[..., None, None], cov_m2, np.eye(3)) + floor_m2 * np.eye(3)
    value = (off_m * np.linalg.solve(cov, off_m[..., None])[..., 0]).sum(axis=2)
    return np.where(stated | np.isnan(value), value, np.inf)


def _angles(joints: Float, bases: Bool) -> Float:
    """Angles (T, 5, 3) [deg] between bones of (T, 26, 3); `bases` (26,): metacarpals."""
    out = np.full((len(joints), 5, 3), np.nan)
    for finger, (first, *chain) in enumerate(FINGER_JOINTS):
        base = first if finger == 0 or bases[first] else WRIST
        for at, (a, b, c) in enumerate(zip((base, *chain), chain, chain[1:], strict=False)):
            column = at + (finger == 0)  # a thumb's chain has one joint less, at its beginning
            out[:, finger, column] = _between(joints[:, b] - joints[:, a], joints[:, c] - joints[:, b])
    return out


def _between(first: Float, second: Float) -> Float:
    """Angles (T,) [deg] between vectors (T, 3)."""
    sine = np.linalg.norm(np.cross(first, second), axis=1)
    return np.degrees(np.arctan2(sine, (first * second).sum(axis=1)))


def figures(compared: Compared) -> dict[str, object]:
    """All metrics by name: hand, classes of joint, fingers, angles; None: no data."""
    every = np.ones(26, np.bool_)
    fingers = {name: _finger_figures(compared, f) for f, name in enumerate(FINGERS)}
    classes = {
        kind: _figures(compared, np.array([f"-{name}".endswith(f"-{kind}") for name in JOINTS]))
        for kind in CLASSES
    }
    angles = {name: _spread(compared.angle_deg[:, 1:, k], "deg") for k, name in enumerate(_ANGLES)}
    markers = {name: _spread(compared.marker_mm[:, k], "mm") for k, name in enumerate(compared.marker_names)}
    return {
        "poses": len(compared.off_m),
        **_figures(compared, every),
        "mcp_deg": angles["mcp"]["mean_deg"],
        "pip_deg": angles["pip"]["mean_deg"],
        "angles": angles,
        "classes": {kind: own for kind, own in classes.items() if own["joint_mm"] is not None},
        "fingers": fingers,
        "markers": markers,
    }


def _finger_figures(compared: Compared, finger: int) -> dict[str, object]:
    angles = ("none", "mcp", "ip") if finger == 0 else _ANGLES
    own = {
        f"{name}_deg": _mean(compared.angle_deg[:, finger, k])
        for k, name in enumerate(angles)
        if name != "none"
    }
    return {**_figures(compared, _OF_FINGER[:, finger]), **own}


def _figures(compared: Compared, joints: Bool) -> dict[str, float | None]:
    """Of some of the joints."""
    mm, chi2 = compared.mm[:, joints], compared.chi2[:, joints]
    exact, tracked = compared.known[:, joints], compared.tracked[:, joints]
    scored = np.isfinite(mm)
    chi2 = np.where(scored, chi2, np.nan)
    of_tracked = np.where(tracked, chi2, np.nan)
    constant = compared.own_frame_m[:, joints]
    chi2_95, chi2_50 = 7.814727903, 2.365973884  # quantiles of a chi-square of 3 degrees of freedom
    return {
        "joint_mm": _mean(mm),
        "joint_mm_p95": _percentile(mm, 95.0),
        "joint_mm_constant": _constant_mm(constant),
        "valid_percent": _percent(scored[exact]),
        "tracked_percent": _percent(tracked[exact]),
        "false_tracked_percent": _percent(compared.false[:, joints][tracked]),
        "coverage_95_percent": _percent((chi2 <= chi2_95)[scored]),
        "coverage_50_percent": _percent((chi2 <= chi2_50)[scored]),
        "tracked_coverage_95_percent": _percent((of_tracked <= chi2_95)[tracked]),
        "tracked_mm": _mean(mm[tracked]),
    }


def _constant_mm(own_frame_m: Float) -> float | None:
    """The mean over joints of the length of the mean error in the joint's axes [mm]."""
    there = known(own_frame_m)
    lengths = [
        float(np.linalg.norm(own_frame_m[there[:, j], j].mean(axis=0)))
        for j in range(own_frame_m.shape[1])
        if there[:, j].any()
    ]
    return 1e3 * float(np.mean(lengths)) if lengths else None


def _spread(values: Float, unit: str) -> dict[str, float | None]:
    return {f"mean_{unit}": _mean(values), f"p95_{unit}": _percentile(values, 95.0)}


def _mean(values: Float) -> float | None:
    some = values[np.isfinite(values)]
    return float(some.mean()) if some.size else None


def _percentile(values: Float, share: float) -> float | None:
    some = values[np.isfinite(values)]
    return float(np.percentile(some, share)) if some.size else None


def _percent(values: Bool) -> float | None:
    return 100.0 * float(values.mean()) if values.size else None


_COLUMNS = (
    ("joint_mm", "mean mm"),
    ("joint_mm_p95", "95 % mm"),
    ("joint_mm_constant", "const mm"),
    ("mcp_deg", "MCP deg"),
    ("pip_deg", "PIP deg"),
    ("coverage_95_percent", "in 95 %"),
    ("coverage_50_percent", "in 50 %"),
    ("tracked_percent", "TRACKED %"),
    ("false_tracked_percent", "false %"),
)


def alignment_lines(alignment: Alignment) -> list[str]:
    """How frame and clock were brought together."""
    rotation, shift = _rotation_deg(alignment), alignment.T_rig_file[:3, 3]
    fitted = (
        f"clock {1e-9 * alignment.offset_ns:+.4f} s ± {1e3 * alignment.offset_sigma_s:.1f} ms (speeds correlate by"
        f" {alignment.correlation:.2f});"
        f" frame turned by {rotation:.1f}° ± {alignment.rotation_sigma_deg:.2f}°, moved by"
        f" {1e3 * np.linalg.norm(shift):.0f} mm ± {1e3 * alignment.shift_sigma_m:.1f} mm;"
        f" {1e3 * alignment.residual_m:.1f} mm left in the median"
    )
    lines = [
        fitted,
        "this hides what is constant: a delay of the poses, and an error of where the rig's frame lies",
    ]
    if alignment.mirrored:
        lines.append(
            "the file's hand is the mirror image of ours and was turned over: left-handed axes (Unity, Unreal), or the"
            " other hand"
        )
    if np.isfinite(alignment.alternative_s):
        lines.append(
            f"an offset {alignment.alternative_s:+.2f} s from there fits nearly as well: a movement that repeats;"
            " make one that does not"
        )
    return lines


def table_lines(figures: Mapping[str, object]) -> list[str]:
    """The table: all joints, classes of joints, fingers; then markers."""
    lines = [
        f"{figures['poses']} poses compared",
        f"{'':22}" + "".join(f"{title:>10}" for _, title in _COLUMNS),
    ]
    rows = [("all joints", figures)]
    rows += list(cast(Mapping[str, Mapping[str, object]], figures["classes"]).items())
    rows += list(cast(Mapping[str, Mapping[str, object]], figures["fingers"]).items())
    lines += [
        f"{name:22}" + "".join(f"{_number(row.get(key)):>10}" for key, _ in _COLUMNS)
        for name, row in rows
        if row.get("joint_mm") is not None
    ]
    markers = cast(Mapping[str, Mapping[str, object]], figures["markers"])
    for name, row in markers.items():
        lines.append(f"{'marker ' + name:22}{_number(row['mean_mm']):>10}{_number(row['p95_mm']):>10}")
    return lines


def alignment_json(alignment: Alignment | None) -> dict[str, object]:
    """The alignment for programs; None: frame and clock were stated to be ours."""
    if alignment is None:
        return {"aligned": True}
    alternative = alignment.alternative_s
    return {
        "aligned": False,
        "T_rig_file": [[round(float(value), 9) for value in row] for row in alignment.T_rig_file],
        "offset_ns": alignment.offset_ns,
        "offset_sigma_ms": 1e3 * alignment.offset_sigma_s,
        "rotation_deg": _rotation_deg(alignment),
        "rotation_sigma_deg": alignment.rotation_sigma_deg,
        "shift_sigma_mm": 1e3 * alignment.shift_sigma_m,
        "residual_mm": 1e3 * alignment.residual_m,
        "speed_correlation": alignment.correlation,
        "rival_offset_s": alternative if np.isfinite(alternative) else None,
        "mirrored": alignment.mirrored,
    }


def _rotation_deg(alignment: Alignment) -> float:
    linear = alignment.T_rig_file[:3, :3]
    linear = linear @ np.diag([1.0, 1.0, -1.0]) if alignment.mirrored else linear
    return float(np.degrees(np.linalg.norm(matrix_to_rotation_vector(linear))))


def _number(value: object) -> str:
    return f"{value:.1f}" if isinstance(value, float) else "-"
