"""Measure an object: guide its user, fit and save.

The object is moved before the cameras, live on a running master or in a recording. Bead positions go into the
object's file, the rest of an old file is kept.
"""

from argparse import Namespace
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from common.calibration import RigCalibration, load
from common.calibration.object_profile import Bead, ObjectProfile, check_object
from common.command_line import echo
from common.errors import CalibrationError, FitError
from common.geometry.transforms import fit_rigid, transform
from common.messages import HandPose
from master.calibrate.object.beads import (
    ENOUGH_LOOKS,
    MOTION,
    OWN,
    Measurement,
    frame_of,
    measure_object,
    progress_of,
)
from master.calibrate.observations import (
    Observations,
    points_of_detections,
    points_of_poses,
    recorded_motion,
    rows_of,
)
from master.calibrate.picture import FINGER_COLOURS, draw_over_time, figure_of, save_figure
from master.calibrate.report import Column, Table, finish
from master.calibrate.session import Session, listening
from master.calibrate.tree_files import (
    load_marker_rig,
    provenance,
    refusals_named,
    rig_in_tree,
    vector_of,
    write_object,
    write_rig,
)

TOOL = "calibrate object"


def object_command(options: Namespace) -> None:
    """Measure where the beads of a rigid object sit."""
    _check_options(options)
    base, where = base_of(options.calibration, options.name, options.like)
    given = None
    if options.markers is not None:
        given = tuple(part.strip() for part in options.markers.split(",") if part.strip())
    if options.live:
        rig, data = load_marker_rig(options.calibration, options.rig), "live"
        names = names_of(given, base, rig)
        with listening(options.bus, {"hand": None}, with_markers) as receive:
            seen = guide(Session(receive), rig, names, options.seconds)
    else:
        motion = recorded_motion(options.recording, options.detections, options.rig, options.calibration)
        rig, data = motion.rig, motion.data
        names = names_of(given, base, rig)
        seen = points_of_detections(rig, motion.models, motion.rates_hz, motion.messages, names)
    with refusals_named(data):
        found = measure_object(seen)
        radius_m = radii(names, options.radius_mm, base)
        profile, misses = measured_profile(found, options.name, radius_m, data, base, where)

    def write(out: Path) -> dict[Path, str]:
        written = {write_object(out, profile): "markers"}
        rig_name: str = options.rig or rig.name
        if options.add_to_rig:
            there = rig_in_tree(out, rig_name, rig)
            objects = tuple(dict.fromkeys((*there.objects, profile.name)))
            written[write_rig(out, rig_name, replace(there, objects=objects))] = "objects"
        elif profile.name not in rig.objects:
            echo(
                f'to track it: "objects": ["{profile.name}"] in rigs/{rig_name}.json (or again with --add-to-rig)'
            )
        return written

    table = beads_table(found, profile, misses)
    numbers: dict[str, object] = {
        "object": profile.name,
        "epochs": len(found.bundle.T),
        "looks": found.looks,
        "spread": round(found.bundle.spread, 3),
        "beads": dict(zip(found.names, table.json(), strict=True)),
    }
    draw = partial(draw_object, found=found, profile=profile)
    finish(options, report_lines(found, table), numbers, draw, write)


def with_markers(message: object) -> HandPose | None:
    """The pose of a hand with markers: a wrist device alone reports hands without."""
    return message if isinstance(message, HandPose) and len(message.markers_raw_m) else None


def guide(
    session: Session[HandPose], rig: RigCalibration, names: tuple[str, ...], longest_s: float
) -> Observations:
    """Lead a person through the motion until it is enough, or the time is over.

    Raises:
        CalibrationError: The running master has other markers than the rig.
        FitError: No pose came.
    """
    poses = list[HandPose]()
    session.follow(MOTION, poses.append, lambda _: progress_of(points_of_poses(poses, rig, names)), longest_s)
    if not poses:
        raise FitError("no pose came: is `phalanx run` running, on this --bus?")
    return points_of_poses(poses, rig, names)


def measured_profile(
    found: Measurement,
    name: str,
    radius_m: Mapping[str, float],
    data: str,
    like: ObjectProfile | None,
    like_where: str,
) -> tuple[ObjectProfile, dict[str, float]]:
    """The object, and the displacement of each bead from an old file [m].

    `data` names what it was measured from. Frame and other parts are those of `like`, which file `like_where`
    holds; None: a frame of its own, and nothing else.

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
        bead: Bead(position_m=vector_of(place), radius_m=radius_m[bead])
        for bead, place in zip(found.names, places, strict=True)
    }
    residual = {"looks": float(found.looks)}
    for bead, rms, sigma in zip(found.names, found.rms_m, found.sigma_m, strict=True):
        residual |= {
            f"{bead}_rms_mm": round(1e3 * float(rms), 3),
            f"{bead}_sigma_mm": round(1e3 * float(sigma), 3),
        }
    how = provenance(TOOL, (data,), residual, frame)
    base = ObjectProfile(version=1, name=name) if like is None else replace(like, name=name)
    profile = replace(base, markers=beads, provenance=base.provenance | {"markers": how})
    check_object(profile, name)
    return profile, misses


def beads_table(found: Measurement, profile: ObjectProfile, misses: Mapping[str, float]) -> Table:
    """Where each bead lies, how surely, and what is left."""
    places = 1e3 * np.array([profile.markers[name].position_m for name in found.names])
    moved = np.array([1e3 * misses.get(name, np.nan) for name in found.names])
    return Table(
        (
            Column("bead", found.names),
            *(Column(f"{axis} [mm]", places[:, i], "8.2f") for i, axis in enumerate("xyz")),
            Column("", [tuple(place) for place in places.round(3).tolist()], key="position_mm"),
            Column("± [mm]", (1e3 * found.sigma_m).round(3), ".2f", key="sigma_mm"),
            Column("rms [mm]", (1e3 * found.rms_m).round(3), ".2f", key="rms_mm"),
            Column("outliers", 100 * found.outlier_share, ".1f", "%"),
            Column("", found.outlier_share.round(4), key="outlier_share"),
            Column("from the file's [mm]" * bool(misses), moved.round(3), ".2f", key="moved_mm"),
        )
    )


def report_lines(found: Measurement, table: Table) -> list[str]:
    """The report for a person."""
    bundle = found.bundle
    whole = int(bundle.seen.known.all(axis=1).sum())
    lines = [
        f"{len(bundle.T)} epochs, {whole} with all beads; turned and carried to {found.looks} ways",
        *table.lines(),
        f"residuals are {bundle.spread:.2f} times what the covariances expect",
    ]
    if found.looks < ENOUGH_LOOKS:
        lines.append("better: turn it further about all its axes, and carry it to more places")
    return lines


def draw_object(path: Path, found: Measurement, profile: ObjectProfile) -> None:
    """Draw beads and observations in the object's frame, and residuals over time.

    Raises:
        RecordingError: The file cannot be written.
    """
    bundle, own = found.bundle, np.array([profile.markers[name].position_m for name in found.names])
    # Where each observation lies in the object: the bead less its residual, turned into its frame.
    rotation = fit_rigid(own, bundle.beads_m)[:3, :3]
    left = np.einsum("ij,tkj,tbk->tbi", rotation, bundle.T[:, :3, :3], bundle.off_m)
    figure = figure_of((16.0, 8.4))
    figure.suptitle(f"{profile.name}: {len(bundle.T)} epochs in {found.looks} ways of turning and places")
    *sides, time = figure.subplots(2, 2).ravel()
    for axes, (a, b) in zip(sides, ((0, 1), (0, 2), (1, 2)), strict=True):
        for row, name in enumerate(found.names):
            seen = 1e3 * (own[row] - left[:, row])
            colour = FINGER_COLOURS[row % len(FINGER_COLOURS)]
            axes.plot(seen[:, a], seen[:, b], ".", markersize=2, color=colour, alpha=0.5)
            axes.plot(*1e3 * own[row, [a, b]], "+", markersize=12, color="black")
            axes.annotate(name, 1e3 * own[row, [a, b]], textcoords="offset points", xytext=(6, 6))
        axes.set(title=f"object {'xyz'[a]}, {'xyz'[b]} [mm]")
        axes.set_aspect("equal", adjustable="datalim")
    size = 1e3 * np.linalg.norm(bundle.off_m, axis=-1)
    draw_over_time(time, bundle.seen.t_s, size, bundle.outlier, found.names)
    time.set(title="from the rigid body [mm]; crosses: outliers")
    time.set_ylim(0.0, max(1.0, 2.0 * float(np.nanpercentile(1e3 * np.abs(bundle.off_m), 99.0))))
    save_figure(figure, path)


def base_of(calibration: Path, name: str, like: Path | None) -> tuple[ObjectProfile | None, str]:
    """The object file whose frame and other parts are kept, and its name; or None.

    Raises:
        CalibrationError: It is missing or broken.
    """
    path = calibration / "objects" / f"{name}.json" if like is None else like
    if like is None and not path.exists():
        return None, ""
    return load(path, ObjectProfile), path.name


def names_of(
    given: tuple[str, ...] | None, base: ObjectProfile | None, rig: RigCalibration
) -> tuple[str, ...]:
    """Names of the beads: as given, of the file, or all that sit on no hand.

    Raises:
        CalibrationError: Fewer than three, one stands twice, or the rig does not have them.
    """
    names = given or (tuple(base.markers) if base is not None and base.markers else rig.free_markers)
    if len(names) < 3 or len(set(names)) < len(names):
        raise CalibrationError(
            "--markers: three different beads or more determine the orientation of an object, these are"
            f" {', '.join(names) or 'none'}"
        )
    rows_of(rig, names)
    return names


def radii(names: tuple[str, ...], radius_mm: float | None, base: ObjectProfile | None) -> dict[str, float]:
    """Radius of each bead [m]: as given, as the file has it, or the usual."""
    there = {} if base is None else {name: bead.radius_m for name, bead in base.markers.items()}
    return {
        name: there.get(name, 0.008) if radius_mm is None else round(1e-3 * radius_mm, 7) for name in names
    }


def _check_options(options: Namespace) -> None:
    live: bool = options.live
    if live == (options.recording is not None) or live == (options.detections is not None):
        raise CalibrationError("give --live, or --recording FOLDER and --detections DIR of the motion")
    if live and options.rig is None:
        raise CalibrationError("--live needs --rig: that of the running master")
    if options.add_to_rig and options.out is None:
        raise CalibrationError("--add-to-rig writes into the tree --out: give --out DIR")
