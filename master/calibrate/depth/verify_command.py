"""`phalanx calibrate verify`: measured and predicted depth error of this rig.

Prints the published table.
"""

from argparse import Namespace

import numpy as np

from common.arrays import Float
from common.errors import CalibrationError
from common.terminal import echo
from master.calibrate.depth.commands import (
    measured_from,
)
from master.calibrate.depth.source import Measured, Pair, load_pair, parse_target
from master.calibrate.depth.sweep import check_places
from master.calibrate.depth.tables import parse_distances, parse_numbers
from master.calibrate.depth.verify import Noise, Verified, budget, laws_of, off_axis, verify
from master.calibrate.depth.verify_report import (
    budget_lines,
    expected_json,
    measured_lines,
    off_axis_lines,
    verified_json,
)
from master.commands.summary import write_summary
from master.fabrik.depth import tolerable_skew_s

_TABLE = "0.20:1.00:0.10"  # where the budget is printed


def verify_command(options: Namespace) -> None:
    """Report the error of each depth model at known distances.

    Also prints the error budget, that is, what to expect of the rig.
    """
    noise = _noise(options.sigma_px, options.speed_m_s, options.skew_ms)
    numbers: dict[str, object] = {}
    found: Verified | None = None
    if options.source is None:
        pair = load_pair(options.calibration, options.rig or "desk", options.fov_deg)
        distance = parse_distances(options.distances or _TABLE)
    else:
        outline = parse_target(options.target)
        measured = measured_from(
            options.source,
            options.detections,
            options.marker,
            options.distances,
            options.rig,
            options.calibration,
            options.fov_deg,
            outline,
        )
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
        from master.calibrate.depth.picture import draw_errors

        errors = {name: found.relative(name) for name in found.error_m}
        title = f"Depth of rig {pair.rig.name if pair.rig is not None else ''!r}"
        d = found.sweep.distance_m
        draw_errors(options.picture, title, d, errors, band=found.expected_m / d)


def _measured(measured: Measured, noise: Noise) -> Verified:
    """Hold a sweep against its rig and print the table.

    Raises:
        CalibrationError: The rig has no depth model at all.
        FitError: The sweep is unfit.
    """
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
    for line in measured_lines(found):
        echo(line)
    return found


def _expected(pair: Pair, distance: Float, angle: Float, noise: Noise) -> dict[str, object]:
    """Print the error budget and the off-axis table, and return them as numbers.

    Only where the cameras are known.
    """
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
    for line in [*budget_lines(distance, expected, noise), *off_axis_lines(distance, angle, errors)]:
        echo(line)
    return expected_json(distance, expected, noise, angle, errors)


def _angles(text: str) -> Float:
    """Angles [deg] of --angles.

    Raises:
        CalibrationError: Not numbers, or not in front of the cameras.
    """
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
