"""`phalanx-master calibrate curl`: along which line the laser point of each finger moves, and how far."""

from pathlib import Path
from typing import Annotated

import typer
from msgspec.structs import replace

from common.calibration import RigCalibration
from common.errors import FitError
from common.wrist_calibration import FingerLine
from master.calibrate.tree_files import provenance
from master.calibrate.wrist.curl import FingerCurl, fit_curls
from master.calibrate.wrist.curled import read_curled
from master.calibrate.wrist.device import Device, device_of, print_line, write_device
from master.options import CALIB_JSON, Calibration, JsonFile, RecordingRig, ResultTree
from master.summary import write_summary

Recording = Annotated[
    Path, typer.Argument(help="Folder of a recording: a hand that curls slowly.", show_default=False)
]
Detections = Annotated[
    Path, typer.Option(help="Folder with detections_<camera>.npz of it, from `phalanx-slave detect`.")
]
Picture = Annotated[Path | None, typer.Option(help="Write a picture of points and lines to this .png.")]


def curl(
    recording: Recording,
    detections: Detections,
    rig: RecordingRig = None,
    calibration: Calibration = CALIB_JSON,
    out: ResultTree = None,
    json_file: JsonFile = None,
    picture: Picture = None,
) -> None:
    """Measure along which line the laser point of each finger moves, from a guided curl of ten seconds.

    With the device on: open the hand flat, close it slowly to a fist, all fingers together, and open it again, twice.
    Fingers that did not move enough are named and keep what the rig had. Nothing is written without --out.

    Examples:

      phalanx-slave detect RECORDING --camera wrist --calibration calib_json -o found/detections_wrist.npz

      phalanx-master calibrate curl RECORDING --detections found --rig wrist --out calib_json --picture curl.png
    """
    device = device_of(recording, rig, calibration, out)
    seen = read_curled(detections, device)
    try:
        curls = fit_curls(seen.laser_m)
    except FitError as error:
        raise FitError(f"{recording}: {error}") from error
    print_line(report_lines(curls))
    if picture is not None:
        from master.calibrate.wrist.picture import draw_curls  # matplotlib takes a second to import

        draw_curls(picture, curls)
        typer.echo(f"drew {picture}")
    summary = ", ".join(found.finger for found in curls if found.line is not None)
    written = write_device(out, device, rig_with_lines(device, curls), f"finger_lines of {summary}")
    if json_file is not None:
        write_summary(
            json_file,
            {
                "fingers": {found.finger: _json_of(found) for found in curls},
                "written": None if written is None else str(written),
            },
        )


def report_lines(curls: tuple[FingerCurl, ...]) -> list[str]:
    """The table for a person."""
    lines = [f"{'finger':8} {'points':>6} {'left out':>8} {'range mm':>8} {'residual mm':>11}"]
    for found in curls:
        left = found.seen - len(found.points_m)
        text = f"{found.finger:8} {len(found.points_m):6} {left:8}"
        if found.line is None:
            lines.append(f"{text}  left out: {found.reason}")
        else:
            lines.append(f"{text} {1e3 * found.line.range_m[1]:8.1f} {1e3 * found.line.residual_m:11.2f}")
    return lines


def rig_with_lines(device: Device, curls: tuple[FingerCurl, ...]) -> RigCalibration:
    """The device's rig with the new lines and where they come from."""
    lines: dict[str, FingerLine] = {}
    residual: dict[str, float] = {}
    for found in curls:
        if found.line is not None:
            lines[found.finger] = found.line
            residual[f"{found.finger}_mm"] = round(1e3 * found.line.residual_m, 4)
    missing = [found.finger for found in curls if found.line is None]
    note = f"not measured: {', '.join(missing)}" if missing else ""
    how = provenance("calibrate curl", (device.source,), residual, note)
    rig = device.rig
    return replace(
        rig, finger_lines=rig.finger_lines | lines, provenance=rig.provenance | {"finger_lines": how}
    )


def _json_of(found: FingerCurl) -> dict[str, object]:
    summary: dict[str, object] = {"points": len(found.points_m), "seen": found.seen}
    if found.line is None:
        return summary | {"refused": found.reason}
    return summary | {
        "range_mm": round(1e3 * found.line.range_m[1], 4),
        "residual_mm": round(1e3 * found.line.residual_m, 4),
        "origin_m": list(found.line.origin_m),
        "direction": list(found.line.direction),
    }
