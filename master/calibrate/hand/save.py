"""Writing of measured lengths into the hand file.

Scaled lengths where nothing was measured, and which are which.
"""

from itertools import pairwise

import numpy as np
from msgspec.structs import replace

from common.arrays import Float
from common.calibration import HandProfile, Provenance, RestJoint, Vector3
from common.hand.model import CHAINS, FINGERS, JOINTS, HandModel, couplings_of
from master.calibrate.hand.measure import CERTAIN, HandMeasurement, hand_length_of
from master.calibrate.tree_files import provenance

TOOL = "calibrate hand"
_QUICK = "rest_joints"  # marks a whole hand that is only scaled


def measured_profile(
    measurement: HandMeasurement, name: str, data: str, dip_per_pip: float | None = None
) -> HandProfile:
    """Return the template with every measured length inserted.

    The parts of a measured sum keep the template's proportions.

    Args:
        measurement: What the routine measured.
        name: Of the new profile.
        data: Name of what it was measured from.
        dip_per_pip: The DIP's ratio that the lengths were measured with, if that was measured; None: the template's.
    """
    model = measurement.template
    factor = bone_factors(measurement)
    profile = replace(model.profile, name=name, rest_joints=stretched(model, factor))
    how: dict[str, Provenance] = {}
    for finger, label in enumerate(FINGERS):
        found = measurement.parted(finger)
        own_bones = {bone for length in found for bone in length.bones}
        residual = {f"{_key(length.name)}_sigma_mm": round(1e3 * length.sigma_m, 3) for length in found}
        residual["rms_mm"] = round(1e3 * measurement.rms_m, 3)
        shared = [length.name for length in found if len(length.bones) > 1]
        scaled = [
            part.name
            for part in measurement.lengths
            if part.finger == finger and len(part.bones) == 1 and part.bones[0] not in own_bones
        ]
        note = [f"measured together, divided as in the template: {', '.join(shared)}"] if shared else []
        note += [f"not measured, scaled from the hand length: {', '.join(scaled)}"] if scaled else []
        note.append("the distal bone ends where the cap's offset puts the tip joint")
        how[label] = provenance(TOOL, (data,), residual, "; ".join(note))
    if dip_per_pip is not None:
        profile = replace(profile, couplings=replace(couplings_of(profile), dip_per_pip=dip_per_pip))
    before = {part: one for part, one in profile.provenance.items() if part != _QUICK}
    return replace(profile, provenance=before | how)


def bone_factors(measurement: HandMeasurement) -> Float:
    """Return the stretch factors (5, 3) of the template's bones.

    1 where nothing was measured.
    """
    factor = np.ones((5, 3))
    for finger in range(5):
        for length in measurement.parted(finger):
            factor[finger, list(length.bones)] = length.length_m / length.scaled_m
    return factor


def stretched(model: HandModel, factor: Float) -> dict[str, RestJoint]:
    """Stretch the bones of the chains of the rest joints by (5, 3).

    Roots and orientations are kept.
    """
    rest = dict(model.profile.rest_joints)
    for chain, own in zip(CHAINS, factor, strict=True):
        at = model.rest_position_m[chain[0]]
        for (a, b), share in zip(pairwise(chain), own, strict=True):
            at = at + share * (model.rest_position_m[b] - model.rest_position_m[a])
            rest[JOINTS[b]] = replace(rest[JOINTS[b]], position_m=_vector(at))
    return rest


def quick_profile(profile: HandProfile, name: str, length_m: float) -> HandProfile:
    """A profile scaled from the length of the hand alone, saying so."""
    note = f"scaled from a hand length of {1e3 * length_m:.0f} mm: no bone is measured, individuals differ by 5 to 8 %"
    return replace(profile, name=name, provenance={_QUICK: provenance(TOOL, ("hand length",), {}, note)})


def report_lines(measurement: HandMeasurement) -> list[str]:
    """The table for a person."""
    template = measurement.template
    rms, times = 1e3 * measurement.rms_m, measurement.fit.spread
    lines = [
        f"{template.profile.side} hand, about {1e3 * hand_length_of(template):.0f} mm long",
        f"residuals {rms:.2f} mm rms per axis, {times:.2f} times what the markers' covariances expect",
        f"{'bone':34} {'fitted':>8} {'+- 99 %':>8} {'scaled':>8}",
    ]
    for finger in range(5):
        parted = measurement.parted(finger)
        own_bones: set[int] = {bone for length in parted for bone in length.bones}
        for length in measurement.lengths:
            if length.finger != finger or (len(length.bones) > 1 and length not in parted):
                continue
            if length in parted:
                verdict = "measured"
            elif set(length.bones) <= own_bones:
                verdict = "undetermined alone: part of a measured sum"
            else:
                verdict = "undetermined: keeps the scaled value"
            lines.append(
                f"{length.name:34} {1e3 * length.length_m:8.1f} {1e3 * CERTAIN * length.sigma_m:8.1f}"
                f" {1e3 * length.scaled_m:8.1f}  {verdict}"
            )
    return lines


def report_json(measurement: HandMeasurement) -> dict[str, object]:
    """The same for programs [mm]."""
    return {
        "side": measurement.template.profile.side,
        "hand_length_mm": round(1e3 * hand_length_of(measurement.template), 2),
        "rms_mm": round(1e3 * measurement.rms_m, 4),
        "spread": round(measurement.fit.spread, 4),
        "align_mm": round(1e3 * measurement.alignment.cost_m, 2),
        "lengths": {
            _key(length.name): {
                "mm": round(1e3 * length.length_m, 3),
                "sigma_mm": round(1e3 * length.sigma_m, 3),
                "scaled_mm": round(1e3 * length.scaled_m, 3),
                "measured": length.measured,
            }
            for length in measurement.lengths
        },
    }


def _key(name: str) -> str:
    return name.replace(" + ", "_").replace(" ", "_")


def _vector(value: Float) -> Vector3:
    x, y, z = (round(float(number), 7) + 0.0 for number in value)
    return x, y, z
