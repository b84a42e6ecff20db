"""The command `wrist subject` measures palm pose, knuckles and fingers.

Of the subject who wears the device, from one guided motion (Kim et al. 2012 read the knuckles off the laser
at its smallest extent). The place of a knuckle is measured by the laser where its finger bends most: there
the line lies beside it. One motion shows that, and the flat hand, from which everything is counted, and a
fist, in which fingertips are seen. The fit is in `subject_model` and `subject_fit`; here is what goes in,
comes out and is refused.
"""

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from common.arrays import Bool, Float
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.errors import CalibrationError, FitError
from common.hand.model import CHAINS, FINGERS, HandModel
from common.messages import WristDetections
from master.calibrate.picture import draw_subject
from master.calibrate.report import finish
from master.calibrate.tree_files import matrix_of, provenance, refusals_named, write_hand, write_rig
from master.calibrate.wrist.device import device_of
from master.calibrate.wrist.subject_fit import (
    FLAT,
    MOTION,
    Fit,
    Guided,
    ImageObservations,
    fit_subject,
    guided,
    prior_sigma,
)
from master.calibrate.wrist.subject_model import MCP, SubjectModel, Unknown, fitted_profile
from master.replay.recorded import recorded_cycles
from master.rig.setup import WristSetup

TOOL = "calibrate wrist subject"
_NAMES = FINGERS[1:]
_GUESS = np.radians(5.0), 5e-3  # of a drawing's pose of the palm, standard deviations
_RULER = np.radians(1.0), 1.5e-3  # of a board's: how it lies on the palm, and what was measured with a ruler
_BENT_RAD = np.radians(60.0)  # at its knuckle: from here on the line hardly moves any more


@dataclass(frozen=True, slots=True, eq=False)
class Subject:
    """A device and a hand that explain what was seen."""

    rig: RigCalibration  # the rig with its new `T_camera_palm`
    hand: HandProfile  # the hand file with new knuckles, lengths and `palmar_scale`, under its old name
    report: tuple[str, ...]  # lines for a person
    chosen: Guided  # which strobe cycles were used
    seen: ImageObservations  # observations in them
    fit: Fit
    model: SubjectModel  # the measurement model about the old rig and hand

    @property
    def unknown(self) -> Unknown:
        """What was fitted, as changes of the old rig and hand."""
        return Unknown.of(self.fit.x)


def calibrate_subject(
    cycles: Sequence[WristDetections],
    rig: RigCalibration,
    camera: CameraCalibration,
    hand: HandProfile,
    source: str = "a guided motion",
) -> Subject:
    """Fit the subject of a wrist device to one guided motion.

    Open hand, straight fingers bent at the knuckles, fist.

    Args:
        cycles: What the slave saw, in order.
        rig: The device: laser plane, and a palm pose that is right to a centimetre and ten degrees.
        hand: The hand as far as it is known, such as a hand of the user's length.
        source: Name of the data, for the provenance.

    Raises:
        FitError: The motion was not done or seen, or nothing likely explains it; the text states what to do.
        CalibrationError: The rig lacks its laser plane or palm pose.
    """
    setup = WristSetup.of(rig, camera, HandModel.of(hand))
    model = SubjectModel(setup)
    laser = np.array([one.laser_uv for one in cycles]).reshape(-1, 5, 2)
    points = model.axes.flat(setup.on_plane(laser))[:, 1:]
    chosen = guided(points[..., 1])
    tips = np.array([one.tip_uv for one in cycles])[chosen.row, 1:]
    tip_sigma_px = np.array([one.tip_sigma_px for one in cycles])[chosen.row, 1:]
    tips_seen, fewest = int(np.isfinite(tips[..., 0]).sum()), 8
    if tips_seen < fewest:
        raise FitError(
            f"{tips_seen} fingertips are seen, at least {fewest} are needed: {MOTION}, in sight of the camera"
        )
    seen = ImageObservations(points[chosen.row], tips, tip_sigma_px, chosen.bend)
    sigma = prior_sigma(_pose_sigma(rig), _length_sigma(hand))
    fit = fit_subject(model, seen, sigma)
    _check(fit, seen)
    unknown = Unknown.of(fit.x)
    report = report_lines(setup, fit, len(cycles))
    new_rig, new_hand = _documented(rig, fitted_profile(setup.model, unknown), fit, source)
    new_rig = replace(new_rig, T_camera_palm=matrix_of(model.palm(unknown)))
    return Subject(new_rig, new_hand, report, chosen, seen, fit, model)


def _pose_sigma(rig: RigCalibration) -> Float:
    """Prior deviations (6,) of the palm pose [rad, m]: rotation about wrist, shift.

    A rig whose maker knows how differently it is worn states so in the residual of the pose's provenance.
    """
    how = rig.provenance.get("T_camera_palm")
    stated = {} if how is None or how.tool == TOOL else how.residual
    rotation = np.radians(stated.get("rotation_sigma_deg", 0.0))
    shift = 1e-3 * stated.get("shift_sigma_mm", 0.0)
    if how is not None and how.tool == "calibrate wrist palm":
        return np.repeat([np.hypot(rotation, _RULER[0]), np.hypot(shift, _RULER[1])], 3)
    return np.repeat([rotation, shift] if rotation > 0.0 and shift > 0.0 else _GUESS, 3)


def _length_sigma(hand: HandProfile) -> Float:
    """Prior deviation (4,) of finger lengths, as shares; less where measured."""
    how = [hand.provenance.get(name) for name in _NAMES]
    known = [one is not None and one.tool == "calibrate hand" and len(one.residual) > 1 for one in how]
    return np.where(known, 0.012, 0.04)  # measured: 1 mm; bones are 6.5 % off their shares, each alone


def _check(fit: Fit, seen: ImageObservations) -> None:
    """Refuse what does not reach the minimum, and what is not likely."""
    knuckles = (seen.bend != FLAT) & ~fit.fist
    if not knuckles.any() or not fit.fist.any():
        missing = "closes to a fist" if knuckles.any() else "bends straight fingers at their knuckles"
        raise FitError(f"the hand never {missing}, or its tips were not seen meanwhile: {MOTION}")
    _check_likely(fit)
    most = np.degrees(most_bent(fit, knuckles))
    short = most < np.degrees(_BENT_RAD)
    if short.sum() > 1:
        reached = ", ".join(f"{name} {angle:.0f}" for name, angle in zip(_NAMES, most, strict=True))
        raise FitError(
            f"straight fingers were bent at their knuckles to {reached} deg, at least {np.degrees(_BENT_RAD):.0f} are"
            " needed, where the laser lies beside the knuckle: bend them towards 90 deg, straight, before the camera"
        )


def _check_likely(fit: Fit) -> None:
    """Refuse fits that neither skin nor prior explains; name what is most unlikely."""
    pull = np.abs(fit.x) / fit.prior_sigma
    worst = int(pull.argmax())
    most_rms = 1.5  # standard deviations: angles are free, so what is left is small
    most_prior_rms = 1.5  # the same: one in a hundred subjects, of 14 numbers that a motion constrains
    unlikely = 3.0  # standard deviations
    far = fit.rms > most_rms or fit.prior_rms > most_prior_rms
    if far or pull[worst] > unlikely or fit.unlike > unlikely:
        raise FitError(
            f"no likely subject explains what was seen: it is {fit.rms:.1f} times farther off than skin explains,"
            f" fingers {fit.unlike:.1f} times from their posture prior, and {_name(worst)} {pull[worst]:.1f} standard"
            " deviations from the file; is the hand file that of this hand and side, the laser plane measured, and"
            f" the palm's pose right to a centimetre and ten degrees? The motion is: {MOTION}"
        )


def most_bent(fit: Fit, knuckles: Bool) -> Float:
    """Largest angle (4,) [rad] of straight fingers at their knuckles."""
    return fit.angles_rad[knuckles][..., MCP].max(axis=0)


def _name(unknown: int) -> str:
    if unknown < 6:
        return f"the palm's {'rotation about' if unknown < 3 else 'shift along'} {'xyz'[unknown % 3]}"
    if unknown < 18:
        return f"the {_NAMES[(unknown - 6) // 3]} knuckle"
    return f"the {'thickness' if unknown < 22 else 'length'} of the {_NAMES[(unknown - 18) % 4]} finger"


def report_lines(setup: WristSetup, fit: Fit, count: int) -> tuple[str, ...]:
    """The values before and after the fit for a person.

    Knuckles across (to the thumb), up (to the back) and along the hand.
    """
    new, sigma = Unknown.of(fit.x), Unknown.of(np.sqrt(np.diag(fit.covariance)))
    rotation, shift = np.degrees(np.linalg.norm(new.pose[:3])), 1e3 * np.linalg.norm(new.pose[3:])
    knuckles = ~fit.fist & (fit.angles_rad[..., MCP].max(axis=1) > _BENT_RAD)
    lines = [
        f"subject from {len(fit.fist)} of {count} cycles and {np.isfinite(fit.off[..., 2]).sum()} fingertips in them",
        f"left: laser {1e3 * fit.laser_m:.2f} mm, tips {fit.tip_px:.1f} px; changed by {fit.prior_rms:.1f} of prior",
        f"palm turned by {rotation:.1f} deg, about x, y, z ± {_three(np.degrees(sigma.pose[:3]))}",
        f"palm shifted by {shift:.1f} mm, along x, y, z ± {_three(1e3 * sigma.pose[3:])}",
        f"{'':8} {'bent':>4} {'knuckle before':>20} {'after, mm':>20} {'±':>14} {'thick':>11} {'long':>13}",
    ]
    thumbwards = np.array([setup.model.side_sign, 1.0, 1.0])
    before = setup.model.rest_position_m[CHAINS[1:, 0]] * thumbwards
    moved = new.knuckle_m * thumbwards
    most = np.degrees(most_bent(fit, knuckles)) if knuckles.any() else np.full(4, np.nan)
    for f, name in enumerate(_NAMES):
        lines.append(
            f"{name:8} {most[f]:4.0f} {_three(1e3 * before[f]):>20} {_three(1e3 * (before + moved)[f]):>20}"
            f" {_three(1e3 * sigma.knuckle_m[f]):>14} {np.exp(new.thick[f]):5.2f} ±{sigma.thick[f]:5.2f}"
            f" {np.exp(new.long[f]):6.3f} ±{sigma.long[f]:6.3f}"
        )
    lines.append(
        "± are standard deviations; a value as large as its prior (3 mm, 0.10, 0.04) was not observed and stays at it"
    )
    return tuple(lines)


def _three(values: Float) -> str:
    return " ".join(f"{value:.1f}" for value in values)


def _documented(
    rig: RigCalibration, hand: HandProfile, fit: Fit, source: str
) -> tuple[RigCalibration, HandProfile]:
    sigma = Unknown.of(np.sqrt(np.diag(fit.covariance)))
    left = {"laser_rms_mm": round(1e3 * fit.laser_m, 4), "tip_rms_px": round(fit.tip_px, 4)}
    rotation, shift = np.degrees(sigma.pose[:3].max()), 1e3 * sigma.pose[3:].max()
    pose = left | {"rotation_sigma_deg": round(float(rotation), 4), "shift_sigma_mm": round(float(shift), 4)}
    knuckles = {
        f"{name}_sigma_mm": round(1e3 * float(np.linalg.norm(one)), 4)
        for name, one in zip(_NAMES, sigma.knuckle_m, strict=True)
    }
    thick = {f"{name}_sigma": round(float(one), 4) for name, one in zip(_NAMES, sigma.thick, strict=True)}
    note = "knuckles and palm are known together better than each alone"
    made = {
        key: provenance(TOOL, (source,), residual, note)
        for key, residual in (("knuckles", left | knuckles), ("palmar_scale", left | thick))
    }
    how = provenance(TOOL, (source,), pose, f"hand {hand.name!r}; {note}")
    return (
        replace(rig, provenance=rig.provenance | {"T_camera_palm": how}),
        replace(hand, provenance=hand.provenance | made),
    )


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
    with refusals_named(options.recording):
        found = calibrate_subject(cycles, device.rig, device.camera, profile, device.source)
    hand = replace(found.hand, name=options.name or profile.name)

    def write(out: Path) -> dict[Path, str]:
        rig = write_rig(out, device.file_name, replace(found.rig, hand=hand.name))
        own = "knuckles, lengths and palmar_scale of index ... little"
        return {rig: "T_camera_palm, hand", write_hand(out, hand): own}

    draw = partial(draw_subject, found=found, optics=device.optics)
    finish(options, found.report, summary(found), draw, write)


def _hand_of(name: str, calibration: Path, out: Path | None) -> Path:
    """Path of the rig's hand file, in the tree of the results if that has it."""
    trees = [calibration] if out is None else [out, calibration]
    paths = [tree / "hands" / f"{name}.json" for tree in trees]
    return next((path for path in paths if path.exists()), paths[-1])


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
