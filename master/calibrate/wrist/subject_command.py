"""`phalanx calibrate wrist subject`: palm pose, knuckles and fingers.

Of the subject who wears the device, from a guided motion.
"""

from argparse import Namespace
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from common.arrays import Float
from common.calibration import HandProfile, load
from common.errors import CalibrationError, FitError
from common.hand.model import FINGERS
from common.terminal import echo
from master.calibrate.tree_files import write_hand
from master.calibrate.wrist.device import Device, device_of, print_line, write_device
from master.calibrate.wrist.subject import Subject, calibrate_subject
from master.calibrate.wrist.subject_model import Unknown
from master.commands.summary import write_summary
from master.replay.recorded import recorded_cycles


def subject(options: Namespace) -> None:
    """Measure who wears the device."""
    device = device_of(options.recording, options.rig, options.calibration, options.out)
    if device.rig.T_camera_palm is None:
        raise CalibrationError(
            f"rig {device.file_name!r}: T_camera_palm: a first guess is needed, such as from the drawing of the device;"
            " or lay a board on the palm (calibrate wrist palm)"
        )
    profile = load(options.hand or _hand_of(device.rig.hand, options.calibration, options.out), HandProfile)
    cycles = list(recorded_cycles(options.detections, device.camera.name))
    try:
        found = calibrate_subject(cycles, device.rig, device.camera, profile, device.source)
    except FitError as error:
        raise FitError(f"{options.recording}: {error}") from error
    print_line(found.report)
    if options.picture is not None:
        from master.calibrate.wrist.subject_picture import draw_subject  # matplotlib takes a second to import

        draw_subject(options.picture, found, device.optics)
        echo(f"drew {options.picture}")
    new = replace(found.hand, name=options.name or profile.name)
    written = _write(options.out, device, found, new)
    if options.json_file is not None:
        write_summary(options.json_file, summary(found) | {"written": written})


def _hand_of(name: str, calibration: Path, out: Path | None) -> Path:
    """Return the path of the rig's hand file.

    Beside the rig in the tree of the results if that has it, as the rig itself.
    """
    trees = [calibration] if out is None else [out, calibration]
    paths = [tree / "hands" / f"{name}.json" for tree in trees]
    return next((path for path in paths if path.exists()), paths[-1])


def _write(out: Path | None, device: Device, found: Subject, hand: HandProfile) -> list[str]:
    """Write hand and rig, which names the hand; their paths, none without a tree."""
    rig = write_device(out, device, replace(found.rig, hand=hand.name), "T_camera_palm, hand")
    if out is None or rig is None:
        return []
    path = write_hand(out, hand)
    echo(f"wrote {path}: knuckles, lengths and palmar_scale of index ... little")
    return [str(rig), str(path)]


def summary(found: Subject) -> dict[str, object]:
    """What was measured, as numbers."""
    sigma = Unknown.of(np.sqrt(np.diag(found.fit.covariance)))
    new = found.unknown
    pose = {
        "T_camera_palm": [list(row) for row in found.rig.T_camera_palm or ()],
        "rotation_sigma_deg": _numbers(np.degrees(sigma.pose[:3])),
        "shift_sigma_mm": _numbers(1e3 * sigma.pose[3:]),
    }
    fingers = {
        name: {
            "knuckle_moved_mm": _numbers(1e3 * new.knuckle_m[f]),
            "knuckle_sigma_mm": _numbers(1e3 * sigma.knuckle_m[f]),
            "thickness": round(float(np.exp(new.thick[f])), 4),
            "thickness_sigma": round(float(sigma.thick[f]), 4),
            "length": round(float(np.exp(new.long[f])), 4),
            "length_sigma": round(float(sigma.long[f]), 4),
        }
        for f, name in enumerate(FINGERS[1:])
    }
    left = {"laser_mm": round(1e3 * found.fit.laser_m, 4), "tip_px": round(found.fit.tip_px, 4)}
    return {**pose, "fingers": fingers, "residual": left, "cycles": len(found.chosen.row)}


def _numbers(values: Float) -> list[float]:
    return [round(float(value), 4) for value in values]
