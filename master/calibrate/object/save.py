"""Writing of the measured beads into the object's file, and the report.

In the frame asked for, the rest of an old file kept.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from common.arrays import Float
from common.calibration import RigCalibration, save
from common.calibration.object_profile import Bead, ObjectProfile, check_object
from common.errors import CalibrationError
from common.geometry.transforms import transform
from master.calibrate.object.frame import OWN, frame_of
from master.calibrate.object.measure import ENOUGH_LOOKS, Measurement
from master.calibrate.tree_files import provenance, rig_in_tree, write_rig

TOOL = "calibrate object"


def measured_profile(
    found: Measurement,
    name: str,
    radius_m: Mapping[str, float],
    data: str,
    like: ObjectProfile | None,
    like_where: str,
) -> tuple[ObjectProfile, dict[str, float]]:
    """Return the object and the displacement of each bead from an old file [m].

    Args:
        found: What was measured.
        name: Of the object.
        radius_m: Of each bead.
        data: Name of what it was measured from.
        like: Whose frame and whose other parts are kept; None: a frame of its own, and nothing else.
        like_where: Name of its file, for errors.

    Raises:
        FitError: The frame of `like` cannot be kept.
        CalibrationError: The object is none that can be tracked.
    """
    if like is None:
        T, misses, frame = found.T_own_body, dict[str, float](), OWN
    else:
        T, misses = frame_of(found.bundle.beads_m, found.names, like, like_where)
        frame = f"frame of {like_where}"
    places = transform(T, found.bundle.beads_m)
    beads = {
        bead: Bead(position_m=_vector(place), radius_m=radius_m[bead])
        for bead, place in zip(found.names, places, strict=True)
    }
    residual = {f"{bead}_rms_mm": _mm(rms) for bead, rms in zip(found.names, found.rms_m, strict=True)}
    residual |= {f"{bead}_sigma_mm": _mm(by) for bead, by in zip(found.names, found.sigma_m, strict=True)}
    how = provenance(TOOL, (data,), residual | {"looks": float(found.looks)}, frame)
    base = ObjectProfile(version=1, name=name) if like is None else replace(like, name=name)
    profile = replace(base, markers=beads, provenance=base.provenance | {"markers": how})
    check_object(profile, name)
    return profile, misses


def write_object(out: Path, profile: ObjectProfile) -> Path:
    """Write objects/<name>.json of the tree `out`; return its path.

    Raises:
        CalibrationError: It cannot be written; an old file is untouched.
    """
    path = out / "objects" / f"{profile.name}.json"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CalibrationError(f"--out: cannot make the folder {path.parent}: {error.strerror}") from error
    save(path, profile)
    return path


def add_to_rig(out: Path, rig_name: str, rig: RigCalibration, name: str) -> Path:
    """Name the object in rigs/<rig_name>.json of the tree `out`; return its path.

    Raises:
        CalibrationError: The file there is broken, of other cameras, or cannot be written.
    """
    there = rig_in_tree(out, rig_name, rig)
    if name not in there.objects:
        there = replace(there, objects=(*there.objects, name))
    return write_rig(out, rig_name, there)


def report_lines(found: Measurement, profile: ObjectProfile, misses: Mapping[str, float]) -> list[str]:
    """The table for a person."""
    bundle = found.bundle
    whole = int(bundle.seen.known.all(axis=1).sum())
    lines = [
        f"{len(bundle.T)} epochs, {whole} with all beads; turned and carried to {found.looks} ways",
        f"{'bead':12} {'x':>8} {'y':>8} {'z':>8} {'+-':>6} {'left':>6} {'outlier_share':>7}   [mm]",
    ]
    for row, name in enumerate(found.names):
        x, y, z = (1e3 * value for value in profile.markers[name].position_m)
        lines.append(
            f"{name:12} {x:8.2f} {y:8.2f} {z:8.2f} {1e3 * found.sigma_m[row]:6.2f} {1e3 * found.rms_m[row]:6.2f}"
            f" {100 * found.outlier_share[row]:5.1f} %"
            + (f"   {1e3 * misses[name]:.2f} from where the file had it" if name in misses else "")
        )
    lines.append(f"what is left is {bundle.spread:.2f} times what the covariances expect")
    if found.looks < ENOUGH_LOOKS:
        lines.append("better: turn it further about all its axes, and carry it to more places")
    return lines


def report_json(found: Measurement, profile: ObjectProfile, misses: Mapping[str, float]) -> dict[str, object]:
    """The same for programs [mm]."""
    return {
        "object": profile.name,
        "instants": len(found.bundle.T),
        "looks": found.looks,
        "spread": round(found.bundle.spread, 3),
        "beads": {
            name: {
                "position_mm": [_mm(value) for value in profile.markers[name].position_m],
                "sigma_mm": _mm(found.sigma_m[row]),
                "rms_mm": _mm(found.rms_m[row]),
                "outlier_share": round(float(found.outlier_share[row]), 4),
                "moved_mm": _mm(misses[name]) if name in misses else None,
            }
            for row, name in enumerate(found.names)
        },
    }


def _mm(value: float | Float) -> float:
    return round(1e3 * float(value), 3)


def _vector(value: Float) -> tuple[float, float, float]:
    x, y, z = (round(float(number), 7) + 0.0 for number in np.asarray(value))
    return x, y, z
