"""Report of a comparison for a person and for a program.

It states how the two were aligned, and the metrics.
"""

from collections.abc import Mapping
from typing import cast

import numpy as np

from common.geometry.transforms import matrix_to_rotation_vector
from master.mocap.align import Alignment

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
    """Return the alignment for programs.

    None: frame and clock were stated to be ours.
    """
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
