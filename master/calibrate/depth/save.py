"""Writing of the fitted depth laws into the rig file.

With date, data and residual, and the notes to print about it.
"""

from pathlib import Path

import msgspec
import numpy as np

from common.calibration import (
    AffineDisparityCalibration,
    PowerLawCalibration,
    Provenance,
    RigCalibration,
)
from common.errors import CalibrationError
from master.calibrate.depth.report import DepthReport
from master.calibrate.depth.source import Measured, Pair
from master.calibrate.tree_files import provenance, rig_in_tree, write_rig


def rig_to_write(pair: Pair, out: Path | None) -> RigCalibration | None:
    """Return the rig file that receives the new laws.

    The one in `out` where there is one, else the one in use.

    Raises:
        CalibrationError: No rig is known, it has not two cameras, or other ones than the file in `out`.
    """
    rig = pair.rig
    if out is None:
        return rig
    if rig is None:
        raise CalibrationError("--out: which rig is this? give --rig NAME (a file of --calibration DIR/rigs)")
    if len(rig.cameras) != 2:
        raise CalibrationError(
            f"rig {rig.name!r} has {len(rig.cameras)} cameras: laws of disparity are for two; it needs"
            " depth_model 'stereo'"
        )
    return rig_in_tree(out, pair.file_name, rig)


def write_laws(
    out: Path, rig: RigCalibration | None, report: DepthReport, measured: Measured, use: str | None
) -> Path:
    """Write the rig file with both laws and their provenance.

    Includes the depth model if asked for.

    Raises:
        CalibrationError: The file cannot be written; the old one is untouched.
    """
    assert rig is not None  # `rig_to_write` has refused it
    power, affine = report.power_law, report.affine_disparity
    low, high = float(report.sweep.distance_m.min()), float(report.sweep.distance_m.max())
    dropped = "" if report.used.all() else f"; left out: {report.sweep.names(~report.used)}"

    def how(name: str) -> Provenance:
        mean, largest = report.mean_max(name)
        residual = {
            "mean_percent": round(100 * mean, 4),
            "max_percent": round(100 * largest, 4),
            "leave_one_out_mean_percent": round(100 * float(np.abs(report.rejected[name]).mean()), 4),
        }
        note = f"{int(report.used.sum())} distances, {low:.3g} to {high:.3g} m{dropped}"
        return provenance("calibrate depth", measured.data, residual, note)

    new = msgspec.structs.replace(
        rig,
        power_law=PowerLawCalibration(k_m=power.k_m, z=power.z),
        affine_disparity=AffineDisparityCalibration(a_m_px=affine.a_m_px, x0_px=affine.x0_px),
        depth_model=rig.depth_model if use is None else use,
        provenance=rig.provenance | {name: how(name) for name in report.rejected},
    )
    return write_rig(out, measured.pair.file_name, new)


def conclusion(report: DepthReport, rig: RigCalibration | None, use: str | None, written: Path | None) -> str:
    """Before and after, what was written, and which depth model would be better."""
    before = [name for name in report.errors if name not in report.rejected]
    was = f"before {100 * report.mean_max(before[-1])[0]:.2f} % ({before[-1]}), " if before else ""
    after = ", ".join(f"{100 * report.mean_max(name)[0]:.2f} % ({name})" for name in report.rejected)
    text = f"mean error: {was}after {after}"
    if written is None:
        return f"{text}\nnothing written: give --out DIR"
    model = use if use is not None else "" if rig is None else rig.depth_model
    hint = (
        ""
        if use is not None or model == report.best
        else f"; --use {report.best} would switch it"
        + (
            " (stereo, if calibrated, is better off the axis: see `calibrate verify`)"
            if model == "stereo"
            else ""
        )
    )
    return f"{text}\nwrote {written}; its depth_model is {model}{hint}"
