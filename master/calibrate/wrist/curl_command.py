"""`phalanx calibrate wrist curl`: the line of each finger's laser point.

Along which line the point moves, and how far.
"""

from argparse import Namespace

from msgspec.structs import replace

from common.calibration import RigCalibration
from common.calibration.wrist import FingerLine
from common.errors import FitError
from common.terminal import echo
from master.calibrate.tree_files import provenance
from master.calibrate.wrist.curl import FingerCurl, fit_curls
from master.calibrate.wrist.curled import read_curled
from master.calibrate.wrist.device import Device, device_of, print_line, write_device
from master.commands.summary import write_summary


def curl(options: Namespace) -> None:
    """Measure along which line the laser point of each finger moves.

    From a guided curl of ten seconds.
    """
    device = device_of(options.recording, options.rig, options.calibration, options.out)
    seen = read_curled(options.detections, device)
    try:
        curls = fit_curls(seen.laser_m)
    except FitError as error:
        raise FitError(f"{options.recording}: {error}") from error
    print_line(report_lines(curls))
    if options.picture is not None:
        from master.calibrate.wrist.picture import draw_curls  # matplotlib takes a second to import

        draw_curls(options.picture, curls)
        echo(f"drew {options.picture}")
    summary = ", ".join(found.finger for found in curls if found.line is not None)
    written = write_device(options.out, device, rig_with_lines(device, curls), f"finger_lines of {summary}")
    if options.json_file is not None:
        write_summary(
            options.json_file,
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
    how = provenance("calibrate wrist curl", (device.source,), residual, note)
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
