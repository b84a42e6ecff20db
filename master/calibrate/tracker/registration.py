"""Registration of a tracking system to the rig and of its device to an object.

From one motion that both saw. The system's own frame is whatever it is: SteamVR's is y up, libsurvive's z up,
both with a heading and an origin of their own. The registration takes that up, so none is turned beforehand;
but a registration for one is none for the other, and none after the base stations were moved or the system
was calibrated again.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from common.arrays import Float
from common.calibration import Provenance, RigCalibration
from common.calibration.object_profile import ObjectProfile
from common.errors import FitError
from common.geometry.transforms import rotation_vector_to_matrix
from common.messages import ObjectPose, TrackerPose
from master.calibrate.tracker.fit import (
    Fit,
    first_lag,
    first_places,
    fit_registration,
    late_sigma_s,
    sigma_at,
)
from master.calibrate.tracker.tracks import Coverage, coverage_of, object_track, shared_epochs, tracker_track
from master.calibrate.tree_files import matrix_of, provenance

TOOL = "calibrate tracker"
MOTION = (
    "hold the object with the tracker on it before the cameras for twenty seconds: turn it about all its axes, a"
    " quarter turn and back, and carry it to all sides"
)
_SIGMA_M, _SIGMA_RAD, _LATE_S = 3e-3, np.radians(1.0), 5e-3  # standard deviations, at most
_LEFT_RAD = np.radians(5.0)
# What is off in the same way all the time, a tag that sits a little aside, no leaving out of a part shows: of what is
# left it counts as if it averaged out over so many looks only.
_LOOKS = 24
_REACH_M, _ROTATION_RAD = 0.12, np.radians(50.0)  # of the poses at which the result must be known


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """A registration that explains what was seen."""

    fit: Fit
    coverage: Coverage  # what the motion was
    figures: dict[str, float]  # quantity with its unit -> value: residuals, and standard deviations
    report: tuple[str, ...]  # lines for a person


def register(objects: Sequence[ObjectPose], tracked: Sequence[TrackerPose]) -> Registration:
    """Find the registration.

    Object poses are the cameras', in any order (those held or reported by a tracker are rejected), the
    device's on the same clock.

    Raises:
        FitError: The motion was not done or seen, does not constrain the registration, or none explains it.
    """
    if not (objects and tracked):
        raise FitError(f"{'the cameras' if not objects else 'the tracker'} reported nothing: {MOTION}")
    zero_ns = min(objects[0].t_ns, tracked[0].t_ns)
    seen, device = object_track(objects, zero_ns), tracker_track(tracked, zero_ns)
    fewest = 60
    if len(seen) < fewest or len(device) < fewest:
        raise FitError(
            f"the cameras gave {len(seen)} poses, the tracker {len(device)}; at least {fewest} of each are needed:"
            f" {MOTION}"
        )
    late_s = first_lag(seen, device)
    first = None if late_s is None else first_places(seen, device, late_s)
    if first is None or len(shared_epochs(seen, device, first.late_s, fewest)) < fewest:
        raise FitError(f"cameras and tracker hardly saw the object at the same time: {MOTION}")
    coverage = coverage_of(seen, device, first.late_s)
    fit = fit_registration(seen, device, first)
    figures = figures_of(fit)
    refuse(fit, figures, coverage)
    return Registration(fit, coverage, figures, report_lines(fit, figures, coverage))


def figures_of(fit: Fit) -> dict[str, float]:
    """Residuals of the inliers and uncertainty of the result, with their units.

    `position_mm` and `rotation_deg` are roots of the mean square of the whole offset; sigmas are of an
    object's pose by the tracker, wherever it may be within the motion's reach, turned by up to 50 degrees,
    from the registration alone.
    """
    left = fit.off[~fit.outlier]
    place, rotation = (np.sqrt((part**2).sum(axis=1).mean()) for part in (left[:, :3], left[:, 3:]))
    R, p = _reach(fit)
    place_sigma, rotation_sigma = sigma_at(fit, R, p)
    place_sigma = np.hypot(place_sigma, place / _LOOKS**0.5)
    rotation_sigma = np.hypot(rotation_sigma, rotation / _LOOKS**0.5)
    return {
        "position_mm": 1e3 * float(place),
        "rotation_deg": float(np.degrees(rotation)),
        "outlier_share": float(fit.outlier.mean()),
        "position_sigma_mm": 1e3 * float(place_sigma),
        "rotation_sigma_deg": float(np.degrees(rotation_sigma)),
        "late_sigma_ms": 1e3 * late_sigma_s(fit),
    }


def _reach(fit: Fit) -> tuple[Float, Float]:
    """Poses (T, 3, 3), (T, 3) about the middle at which the result must be known."""
    ways = np.concatenate([np.eye(3), -np.eye(3)])
    mean = fit.R[len(fit.R) // 2]
    rotated = np.concatenate([mean[None], rotation_vector_to_matrix(_ROTATION_RAD * ways) @ mean])
    places = fit.middle_m + _REACH_M * np.concatenate([np.zeros((1, 3)), ways])
    return np.repeat(rotated, len(places), axis=0), np.tile(places, (len(rotated), 1))


def refuse(fit: Fit, figures: dict[str, float], coverage: Coverage) -> None:
    """Refuse what no registration explains, and what the motion does not constrain.

    Raises:
        FitError: With what to do.
    """
    left_m, left_rad = 1e-3 * figures["position_mm"], np.radians(figures["rotation_deg"])
    if figures["outlier_share"] > 0.4 or left_m > 0.012 or left_rad > _LEFT_RAD:
        raise FitError(
            f"no registration explains what was seen: {figures['position_mm']:.0f} mm"
            f" and {figures['rotation_deg']:.1f} deg"
            f" left, {100 * figures['outlier_share']:.0f} % outliers. Is the tracker firm on this object, is it the"
            " right device, are object file and cameras calibrated, and did the base stations stay where they are?"
        )
    wanting: list[str] = []
    turned = np.radians(figures["rotation_sigma_deg"]) > _SIGMA_RAD
    if 1e-3 * figures["position_sigma_mm"] > _SIGMA_M or turned:
        wanting.append(
            f"poses would be known to {figures['position_sigma_mm']:.1f} mm,"
            f" {figures['rotation_sigma_deg']:.1f} deg only"
        )
    if 1e-3 * figures["late_sigma_ms"] > _LATE_S:
        wanting.append(f"the clocks are known to {figures['late_sigma_ms']:.1f} ms only: move it faster")
    if wanting:
        raise FitError("; ".join([*wanting, *coverage.missing]) + f". {MOTION[0].upper()}{MOTION[1:]}")


def report_lines(fit: Fit, figures: dict[str, float], coverage: Coverage) -> tuple[str, ...]:
    """The result for a person."""
    placed = fit.placed
    system, device = (1e3 * T[:3, 3] for T in (placed.T_rig_tracking, placed.T_object_tracker))
    shown = {name: f"{value:.2f}" for name, value in figures.items()}
    left = f"left: {shown['position_mm']} mm, {shown['rotation_deg']} deg; {100 * figures['outlier_share']:.0f} % stray"
    lag = f"its poses hold {1e3 * placed.late_s:+.1f} ms after their stamps"
    sure = f"{shown['position_sigma_mm']} mm, {shown['rotation_sigma_deg']} deg"
    return (
        f"{len(fit.t_s)} epochs; {coverage.line()}",
        f"{left}; off by {fit.scale:.2f} times what was predicted",
        f"the tracking system's origin lies at {system[0]:.0f} {system[1]:.0f} {system[2]:.0f} mm of the rig",
        f"the device sits at {device[0]:.1f} {device[1]:.1f} {device[2]:.1f} mm of the object",
        f"{lag} (standard deviation {shown['late_sigma_ms']} ms)",
        f"an object's pose by the tracker is then known to {sure}, and the device's own jitter",
        *(f"better: {line}" for line in coverage.missing),
    )


def documented(
    rig: RigCalibration, profile: ObjectProfile, found: Registration, source: str
) -> tuple[RigCalibration, ObjectProfile]:
    """Rig and object with what was measured, and where that comes from."""
    placed = found.fit.placed
    how: Provenance = provenance(
        TOOL,
        (source,),
        {name: round(value, 4) for name, value in found.figures.items()},
        f"object {profile.name}, tracker {profile.tracker}: until base stations, cameras or mount are moved",
    )
    new_rig = replace(
        rig,
        T_rig_tracking=matrix_of(placed.T_rig_tracking),
        provenance=rig.provenance | {"T_rig_tracking": how},
    )
    new_object = replace(
        profile,
        T_object_tracker=matrix_of(placed.T_object_tracker),
        stamp_offset_us=round(1e6 * placed.late_s, 1),
        provenance=profile.provenance | {"T_object_tracker": how},
    )
    return new_rig, new_object
