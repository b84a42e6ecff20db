"""Register a tracking system to the rig, and its device to an object.

A motion that cameras and tracking system both see enters, live on a running master or as a file; T_rig_tracking goes
into the rig's file, T_object_tracker and stamp_offset_us into the object's. The system's own frame is whatever it is:
SteamVR's is y up, libsurvive's z up, both with a heading and an origin of their own. The registration takes that up,
so none is turned beforehand; but a registration for one is none for the other, and none after the base stations were
moved or the system was calibrated again.
"""

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from common.arrays import Float
from common.calibration import RigCalibration, load
from common.calibration.object_profile import ObjectProfile
from common.command_line import echo
from common.errors import CalibrationError, FitError, RecordingError
from common.geometry.transforms import rotation_vector_to_matrix
from common.messages import ObjectPose, ObjectSource, TrackerPose
from common.recording.recorded_files import read_npz, write_npz
from master.calibrate.picture import BLUE, GREEN, GREY, ORANGE, draw_over_time, figure_of, save_figure
from master.calibrate.report import finish
from master.calibrate.session import Session, listening
from master.calibrate.tracker.fit import (
    Fit,
    blocks_of,
    first_places,
    fit_registration,
    late_sigma_s,
    sigma_at,
)
from master.calibrate.tracker.tracks import (
    MOTION,
    Coverage,
    coverage_of,
    first_lag,
    guide,
    object_track,
    shared_epochs,
    tracker_track,
)
from master.calibrate.tree_files import (
    load_marker_rig,
    matrix_of,
    provenance,
    refusals_named,
    rig_in_tree,
    write_object,
    write_rig,
)

TOOL = "calibrate tracker"
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
    if late_s is None or len(shared_epochs(seen, device, late_s, fewest)) < fewest:
        raise FitError(f"cameras and tracker hardly saw the object at the same time: {MOTION}")
    if (first := first_places(seen, device, late_s)) is None:
        raise FitError(
            "no registration explains what was seen: cameras and tracker see it turn about other axes. Is it the right"
            " device, are the tracking system's axes right-handed, and pictures not mirrored?"
        )
    coverage = coverage_of(seen, device, first.late_s)
    fit = fit_registration(seen, device, first)
    figures = figures_of(fit)
    refuse(fit, figures, coverage)
    return Registration(fit, coverage, figures)


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
    own = ~fit.outlier
    arm = fit.p_m[own] - fit.p_m[own].mean(axis=0)
    size = 1.0 + float((fit.off[own, :3] * arm).sum() / max((arm**2).sum(), 1e-12))
    if abs(size - 1.0) > 0.015:
        raise FitError(
            f"ways are {size:.3f} times as long for the cameras as for the tracker: were the squares of the cameras'"
            " board as large as was said, and are tags and beads as large as the object's file says?"
        )
    _refuse_moved(fit)
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


def _refuse_moved(fit: Fit) -> None:
    """Refuse places that agree before and after some moment, but not with each other."""
    blocks = [block & ~fit.outlier for block in blocks_of(fit.t_s)]
    blocks = [block for block in blocks if block.any()]
    place = np.array([np.median(fit.off[block, :3], axis=0) for block in blocks])
    for k in range(3, len(place) - 2):
        before, after = place[:k], place[k:]
        step = float(np.linalg.norm(after.mean(axis=0) - before.mean(axis=0)))
        within = np.concatenate([before - before.mean(axis=0), after - after.mean(axis=0)])
        scatter = float(np.sqrt((within**2).sum(axis=1).mean()))
        if step > max(5e-3, 4.0 * scatter):
            raise FitError(
                f"cameras and tracker disagree by {1e3 * step:.0f} mm from {fit.t_s[blocks[k]][0] - fit.t_s[0]:.0f} s"
                " on: a camera, a base station or the tracker on the object moved then; fasten it and do it again"
            )


def report_lines(found: Registration) -> tuple[str, ...]:
    """The result for a person."""
    fit, figures, coverage = found.fit, found.figures, found.coverage
    placed = fit.placed
    system, device = (1e3 * T[:3, 3] for T in (placed.T_rig_tracking, placed.T_object_tracker))
    shown = {name: f"{value:.2f}" for name, value in figures.items()}
    outliers = f"{100 * figures['outlier_share']:.0f} % outliers"
    left = f"left: {shown['position_mm']} mm, {shown['rotation_deg']} deg; {outliers}"
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
    note = (
        f"object {profile.name}, tracker {profile.tracker}: until base stations, cameras or mount are moved"
    )
    how = provenance(TOOL, (source,), found.figures, note)
    in_rig, in_object = (
        rig.provenance | {"T_rig_tracking": how},
        profile.provenance | {"T_object_tracker": how},
    )
    return replace(rig, T_rig_tracking=matrix_of(placed.T_rig_tracking), provenance=in_rig), replace(
        profile,
        T_object_tracker=matrix_of(placed.T_object_tracker),
        stamp_offset_us=round(1e6 * placed.late_s, 1),
        provenance=in_object,
    )


def tracker(options: Namespace) -> None:
    """Register a tracking system (Lighthouse) to the rig and its device to an object."""
    if options.live == (options.motion is not None):
        raise CalibrationError("give --live, or --motion FILE of a motion that was kept")
    rig = load_marker_rig(options.calibration, options.rig)
    profile = profile_of(options.calibration, options.name, options.device)
    if options.motion is None:
        streams = {"object": profile.name, "device": profile.tracker}
        with listening(options.bus, streams, _pose) as receive:
            seen = guide(Session(receive), options.seconds)
        objects, tracked, source = seen.objects, seen.tracked, "live"
        if options.keep is not None:
            write_motion(options.keep, objects, tracked)
            echo(f"kept {options.keep}")
    else:
        objects, tracked = read_motion(options.motion, profile)
        source = options.motion.name
    with refusals_named(source):
        found = register(objects, tracked)

    def write(out: Path) -> dict[Path, str]:
        path = out / "objects" / f"{profile.name}.json"
        there = replace(load(path, ObjectProfile) if path.exists() else profile, tracker=profile.tracker)
        new_rig, new = documented(rig_in_tree(out, options.rig, rig), there, found, source)
        in_rig = {write_rig(out, options.rig, new_rig): "T_rig_tracking"}
        return in_rig | {write_object(out, new): "T_object_tracker, stamp_offset_us"}

    finish(options, report_lines(found), summary(found), partial(draw_registration, found=found), write)


def _pose(message: object) -> ObjectPose | TrackerPose | None:
    return message if isinstance(message, ObjectPose | TrackerPose) else None


_KEYS = {"t_ns": (), "position_m": (3,), "orientation_wxyz": (4,)}
_FIX = "it needs t_ns, position_m and orientation_wxyz, each with object_ and tracker_ before it (docs/tracker.md)"


def write_motion(path: Path, objects: Sequence[ObjectPose], tracked: Sequence[TrackerPose]) -> None:
    """Save the poses of a motion as an .npz file that `read_motion` reads.

    Raises:
        RecordingError: The file cannot be written.
    """
    own = [one for one in objects if one.tracked]
    arrays = {
        f"{who}_{key}": np.array([getattr(one, key) for one in poses]).reshape(-1, *shape)
        for who, poses in (("object", own), ("tracker", tracked))
        for key, shape in _KEYS.items()
    }
    arrays["object_cov"] = np.array([one.cov for one in own]).reshape(-1, 6, 6)
    arrays["object_source"] = np.array([one.source for one in own], np.uint8)
    try:
        write_npz(path, arrays)
    except OSError as error:
        raise RecordingError(f"{path}: cannot write: {error.strerror}") from error


def read_motion(path: Path, profile: ObjectProfile) -> tuple[list[ObjectPose], list[TrackerPose]]:
    """Read poses of one object from cameras and tracker, on one clock; NaN: lost.

    Raises:
        RecordingError: The file is missing or broken, or lacks a key; the text states which.
    """
    names = [f"{who}_{key}" for who in ("object", "tracker") for key in _KEYS]
    arrays = read_npz(path, names, _FIX, also=("object_cov", "object_source"))
    sizes = {who: _checked(path, arrays, who) for who in ("object", "tracker")}
    cov = arrays.get("object_cov", np.full((sizes["object"], 6, 6), np.nan))
    source = arrays.get("object_source", np.full(sizes["object"], ObjectSource.TAGS))
    if cov.shape != (sizes["object"], 6, 6) or source.shape != (sizes["object"],):
        raise RecordingError(f"{path}: object_cov, object_source: not one for each of object_t_ns")
    try:
        objects = [
            ObjectPose(
                profile.name, int(t), p, q, c, float("nan"), int(s), bool(np.isfinite(p).all()), 1, 1, False
            )
            for t, p, q, c, s in zip(*(arrays[f"object_{key}"] for key in _KEYS), cov, source, strict=True)
        ]
        name = profile.tracker or profile.name
        tracked = [
            TrackerPose(name, 0, k, int(t), p, q)
            for k, (t, p, q) in enumerate(zip(*(arrays[f"tracker_{key}"] for key in _KEYS), strict=True))
        ]
    except (ValueError, TypeError) as error:
        raise RecordingError(f"{path}: {error}") from error
    return objects, tracked


def _checked(path: Path, arrays: dict[str, Float], who: str) -> int:
    """The number of poses; refuse keys that have another, or no numbers."""
    count = len(arrays[f"{who}_t_ns"]) if arrays[f"{who}_t_ns"].ndim == 1 else -1
    for key, shape in _KEYS.items():
        array = arrays[f"{who}_{key}"]
        if array.shape != (count, *shape) or array.dtype.kind not in "fiu":
            raise RecordingError(f"{path}: {who}_{key}: shape {array.shape}, {_FIX}")
    return count


def profile_of(calibration: Path, name: str, device: str | None) -> ObjectProfile:
    """The object, with the name of the device on it.

    Raises:
        CalibrationError: The file is missing or broken, no device is named, or cameras cannot see the object.
    """
    path = calibration / "objects" / f"{name}.json"
    profile = load(path, ObjectProfile)
    if device is not None:
        profile = replace(profile, tracker=device)
    if profile.tracker is None:
        raise CalibrationError(
            f"{path}: tracker: no device is named: write its name there, or give --device NAME"
        )
    if not profile.markers and profile.tags is None:
        raise CalibrationError(
            f"{path}: neither markers nor tags: cameras cannot see where the object is, and nothing else shows where "
            "the tracker sits on it"
        )
    return profile


def summary(found: Registration) -> dict[str, object]:
    """What was measured, as numbers."""
    placed = found.fit.placed
    return {
        "T_rig_tracking": placed.T_rig_tracking.tolist(),
        "T_object_tracker": placed.T_object_tracker.tolist(),
        "late_ms": 1e3 * placed.late_s,
        "epochs": len(found.fit.t_s),
        "shared_s": found.coverage.shared_s,
        **found.figures,
    }


def draw_registration(path: Path, found: Registration) -> None:
    """Draw the object's path (dots: cameras; lines: tracker), and offsets over time.

    Raises:
        RecordingError: The file cannot be written.
    """
    fit = found.fit
    figure = figure_of((17.0, 8.4))
    figure.suptitle("\n".join(report_lines(found)[:2]))
    above, side, place, rotation = figure.subplots(2, 2).ravel()
    seen = 1e3 * (fit.p_m + fit.off[:, :3])
    track_mm = 1e3 * fit.p_m.copy()
    track_mm[np.diff(fit.t_s, prepend=fit.t_s[0]) > 0.2] = np.nan  # a gap is no way
    for axes, (a, b), title in ((above, (0, 2), "from above [mm]"), (side, (2, 1), "from the side [mm]")):
        axes.plot(track_mm[:, a], track_mm[:, b], "-", color=GREY, linewidth=0.8, label="tracker")
        for own, look, colour, name in (
            (~fit.outlier, ".", BLUE, "cameras"),
            (fit.outlier, "x", ORANGE, "outlier"),
        ):
            axes.plot(seen[own, a], seen[own, b], look, color=colour, markersize=3, label=name)
        axes.set(title=f"{title}: rig {'xyz'[a]}, {'xyz'[b]}")
        axes.set_aspect("equal", adjustable="datalim")
        axes.legend(fontsize=8)
    side.invert_yaxis()  # y of the rig points down
    fine = ~fit.outlier
    for axes, columns, unit, title in (
        (place, slice(0, 3), 1e3, "cameras against tracker: place [mm]"),
        (rotation, slice(3, 6), np.degrees(1.0), "cameras against tracker: turn [deg]"),
    ):
        off = unit * fit.off[fine, columns]
        draw_over_time(axes, fit.t_s[fine], off, np.zeros(len(off), np.bool_), "xyz", (BLUE, ORANGE, GREEN))
        axes.axhline(0.0, color=GREY, linewidth=0.8)
        axes.set(title=title)
    save_figure(figure, path)
