"""The commands `calibrate depth` and `calibrate verify` fit and check depth.

Known distances of a target enter; `depth` leaves two laws of raw disparity in the rig file, with date, data
and residual, `verify` the table of measured and predicted depth error.
"""

from argparse import Namespace
from pathlib import Path

import msgspec
import numpy as np

from common.arrays import Float
from common.calibration import AffineDisparityCalibration, PowerLawCalibration, Provenance, RigCalibration
from common.command_line import echo
from common.errors import CalibrationError
from common.recording.frame_recording import FrameRecording
from master.calibrate.depth.fit import DepthReport, fit_depth, ideal_of, report_json, report_lines
from master.calibrate.depth.session import sweep_live
from master.calibrate.depth.source import (
    Measured,
    Pair,
    from_recording,
    from_table,
    load_pair,
    pair_of,
    parse_target,
)
from master.calibrate.depth.sweep import check_places, checked, parse_distances, parse_numbers
from master.calibrate.depth.verify import (
    Noise,
    Verified,
    budget,
    budget_lines,
    draw_errors,
    expected_json,
    laws_of,
    measured_lines,
    off_axis,
    off_axis_lines,
    verified_json,
    verify,
)
from master.calibrate.tree_files import print_lines, provenance, rig_in_tree, write_report, write_rig
from master.commands.summary import write_summary
from master.fabrik.depth import DepthLaw, tolerable_skew_s


def rig_to_write(pair: Pair, out: Path | None) -> RigCalibration | None:
    """The rig file that receives the new laws: that in `out`, else the one in use.

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
    """Write the rig file with both laws, provenance, and the model `use` if any.

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
    hint = ""
    if use is None and model != report.best:
        hint = f"; --use {report.best} would switch it"
        if model == "stereo":
            hint += " (stereo, if calibrated, is better off the axis: see `calibrate verify`)"
    return f"{text}\nwrote {written}; its depth_model is {model}{hint}"


def depth(options: Namespace) -> None:
    """Fit depth to disparity from a target at known distances, by two laws."""
    outline = parse_target(options.target)
    if options.live:
        _refuse_idle("--live", source=options.source, detections=options.detections)
    else:
        _refuse_idle("a measurement without --live", save=options.save_table)
    measured = sweep_live(options, outline) if options.live else measured_from(options, outline)
    pair = measured.pair
    base = rig_to_write(pair, options.out)
    with measured.named():
        sweep = checked(measured.sweep, pair.cameras, pair.size_px)
        report = fit_depth(sweep, laws_before(pair, base))
    echo(measured.about)
    print_lines(report_lines(report))
    written = None if options.out is None else write_laws(options.out, base, report, measured, options.use)
    echo(conclusion(report, base, options.use, written))
    write_report(options.json_file, report_json(report), written)
    if options.picture is not None:
        draw_errors(options.picture, measured.about, sweep.distance_m, report.errors, used=report.used)


def measured_from(options: Namespace, outline: Float) -> Measured:
    """The sweep of a recording or a table.

    Raises:
        PhalanxError: What the user gave does not make one; the message states what is missing.
    """
    source: Path | None = options.source
    rig: str | None = options.rig
    if source is None:
        raise CalibrationError("what to read is missing: give the folder of a recording, a .csv, or --live")
    if source.is_dir():

        def pair_for(recording: FrameRecording) -> Pair:
            manifest = recording.manifest
            if rig is None:
                return pair_of(manifest.marker_rig(), manifest.cameras)
            return load_pair(options.calibration, rig, options.fov_deg, manifest.cameras)

        return from_recording(
            source, options.detections, options.marker, options.distances, pair_for, outline
        )
    if source.suffix.lower() != ".csv":
        there = source.exists()
        raise CalibrationError(
            f"{source}: {'neither' if there else 'does not exist; give'} the folder of a recording"
            f" {'nor' if there else 'or'} a .csv"
        )
    idle = {name: vars(options)[name] for name in ("detections", "marker", "distances")}
    _refuse_idle(f"{source}, a table", **idle)
    pair = Pair() if rig is None else load_pair(options.calibration, rig, options.fov_deg)
    return from_table(source, pair, outline)


def laws_before(pair: Pair, rig: RigCalibration | None) -> dict[str, DepthLaw]:
    """The laws without this fit: that of ideal cameras, and what the rig file holds."""
    laws: dict[str, DepthLaw] = {}
    if pair.models is not None:
        laws["ideal"] = ideal_of(*pair.models)
    previous = {} if rig is None else laws_of(rig)
    return laws | {f"previous {name.partition('_')[0]}": law for name, law in previous.items()}


def _refuse_idle(where: str, **given: object) -> None:
    """Reject options that `where` does not use, rather than ignore them."""
    for name, value in given.items():
        if value:
            option = "a recording or a table" if name == "source" else f"--{name}"
            raise CalibrationError(f"{option} has no meaning with {where}: leave it out")


_TABLE = "0.20:1.00:0.10"  # where the budget is printed


def verify_command(options: Namespace) -> None:
    """Report each depth model's error at known distances, and the error budget."""
    noise = _noise(options.sigma_px, options.speed_m_s, options.skew_ms)
    numbers: dict[str, object] = {}
    found: Verified | None = None
    if options.source is None:
        pair = load_pair(options.calibration, options.rig or "desk", options.fov_deg)
        distance = parse_distances(options.distances or _TABLE)
    else:
        measured = measured_from(options, parse_target(options.target))
        pair = measured.pair
        found = _measured(measured, noise)
        numbers |= verified_json(found)
        distance = parse_distances(_TABLE)
    numbers |= _expected(pair, distance, _angles(options.angles), noise)
    if options.json_file is not None:
        write_summary(options.json_file, numbers)
    if options.picture is not None:
        if found is None:
            raise CalibrationError(
                "--picture: there are no measured errors to draw; give a recording or a .csv"
            )
        errors = {name: found.relative(name) for name in found.error_m}
        title = f"Depth of rig {pair.rig.name if pair.rig is not None else ''!r}"
        d = found.sweep.distance_m
        draw_errors(options.picture, title, d, errors, band=found.expected_m / d)


def _measured(measured: Measured, noise: Noise) -> Verified:
    """Compare a sweep with its rig and print the table."""
    pair = measured.pair
    laws = {} if pair.rig is None else laws_of(pair.rig)
    if not laws and pair.models is None:
        raise CalibrationError(
            "there is nothing to verify: give --rig NAME, a rig with power_law, affine_disparity or calibrated cameras"
        )
    with measured.named():
        sweep = check_places(measured.sweep, pair.cameras, pair.size_px)
    found = verify(sweep, laws, pair.models, noise)
    if not found.error_m:
        raise CalibrationError(
            "the stereo model needs the columns v_left_px and v_right_px, and the rig has no law of disparity"
        )
    echo(measured.about)
    rates = ", ".join(f"{file.name} {file.frame_rate_hz:g} Hz" for file in pair.files) or "unknown"
    echo(f"camera rate: {rates}; processed: {int(found.sweep.frames.sum())} frame pairs")
    for name in laws:
        known = pair.rig.provenance.get(name) if pair.rig is not None else None
        if known is not None and set(known.data) & set(measured.data):
            echo(f"{name} was fitted to this very sweep ({known.date}): its error for other places is larger")
    print_lines(measured_lines(found))
    return found


def _expected(pair: Pair, distance: Float, angle: Float, noise: Noise) -> dict[str, object]:
    """Print budget and off-axis table where the cameras are known; return numbers."""
    if pair.models is None or pair.rig is None:
        echo("no budget: focal length and baseline are not known (--rig NAME; --fov-deg without intrinsics)")
        return {}
    expected = budget(pair.models, distance, noise)
    errors = {name: off_axis(law, pair.models, distance, angle) for name, law in laws_of(pair.rig).items()}
    baseline_m = float(np.linalg.norm(pair.models[1].centre - pair.models[0].centre))
    wanted = 0.02  # of the depth, as the published rig
    apart_ms = 1e3 * tolerable_skew_s(wanted, baseline_m, 1.0)
    echo(
        f"f = {pair.models[0].matrix[0, 0]:.1f} px, B = {1e3 * baseline_m:.1f} mm (lenses of {pair.origin});"
        f" {100 * wanted:g} % at 1 m/s sideways needs exposures within {apart_ms:.2f} ms of each other"
    )
    print_lines([*budget_lines(distance, expected, noise), *off_axis_lines(distance, angle, errors)])
    return expected_json(distance, expected, noise, angle, errors)


def _angles(text: str) -> Float:
    """Angles [deg] of --angles, in front of the cameras."""
    angles = parse_numbers(
        text, "--angles", "FIRST:LAST:STEP in degrees, such as -20:20:10, or a list -20,0,20"
    )
    if not (np.abs(angles) < 90.0).all():
        raise CalibrationError(f"--angles {text!r}: expected angles between -90 and 90 degrees")
    return angles


def _noise(sigma_px: float, speed_m_s: float, skew_ms: float) -> Noise:
    for option, value in (("--sigma-px", sigma_px), ("--speed-m-s", speed_m_s), ("--skew-ms", skew_ms)):
        if not (np.isfinite(value) and value >= 0.0):
            raise CalibrationError(f"{option} {value:g}: expected a number that is not negative")
    return Noise(sigma_px, speed_m_s, skew_ms * 1e-3)
