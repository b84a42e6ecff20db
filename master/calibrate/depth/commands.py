"""Command `phalanx calibrate depth`: two laws of raw disparity.

The published session, from known distances to the two laws.
"""

import os
from argparse import Namespace
from pathlib import Path

from common.arrays import Float
from common.bus.keys import link_key
from common.calibration import RigCalibration
from common.errors import CalibrationError
from common.recording.frame_recording import FrameRecording
from common.terminal import echo
from master.calibrate.depth.fit import ideal_of
from master.calibrate.depth.live import sweep_live
from master.calibrate.depth.report import fit_depth, report_json, report_lines
from master.calibrate.depth.save import conclusion, rig_to_write, write_laws
from master.calibrate.depth.source import (
    Measured,
    Pair,
    from_recording,
    from_table,
    load_pair,
    pair_of,
    parse_target,
)
from master.calibrate.depth.sweep import checked
from master.calibrate.depth.verify import laws_of
from master.commands.options import (
    address,
)
from master.commands.summary import write_summary
from master.fabrik.depth import DepthLaw

_SWEEP = "1.00:0.20:-0.05"  # the published one


def depth(options: Namespace) -> None:
    """Fit depth to disparity from a target at known distances.

    The power law D = k x^z, and x = a/D + x0.
    """
    outline = parse_target(options.target)
    _refuse_idle(
        "--live", source=options.live and options.source, detections=options.live and options.detections
    )
    _refuse_idle("a measurement without --live", save=not options.live and options.save_table)
    if options.live:
        link = (
            address(options.beacon, "--beacon"),
            address(options.bind, "--bind"),
            link_key(os.environ, options.key_file),
        )
        pair = load_pair(options.calibration, options.rig or "desk", options.fov_deg)
        measured = sweep_live(
            pair,
            options.marker,
            options.distances or _SWEEP,
            options.frames,
            options.seconds,
            link,
            options.save_table,
            outline,
        )
    else:
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
    base = rig_to_write(pair, options.out)
    with measured.named():
        sweep = checked(measured.sweep, pair.cameras, pair.size_px)
        report = fit_depth(sweep, laws_before(pair, base))
    echo(measured.about)
    for line in report_lines(report):
        echo(line)
    written = None if options.out is None else write_laws(options.out, base, report, measured, options.use)
    echo(conclusion(report, base, options.use, written))
    if options.json_file is not None:
        write_summary(
            options.json_file, report_json(report) | {"written": None if written is None else str(written)}
        )
    if options.picture is not None:
        from master.calibrate.depth.picture import draw_errors

        draw_errors(options.picture, measured.about, sweep.distance_m, report.errors, used=report.used)


def measured_from(
    source: Path | None,
    detections: Path | None,
    marker: str | None,
    distances: str | None,
    rig: str | None,
    calibration: Path,
    fov_deg: float | None,
    outline: Float,
) -> Measured:
    """The sweep of a recording or a table.

    Raises:
        PhalanxError: What the user gave does not make one; the message states what is missing.
    """
    if source is None:
        raise CalibrationError("what to read is missing: give the folder of a recording, a .csv, or --live")
    if source.is_dir():

        def pair_for(recording: FrameRecording) -> Pair:
            manifest = recording.manifest
            return (
                pair_of(manifest.marker_rig(), manifest.cameras)
                if rig is None
                else load_pair(calibration, rig, fov_deg, manifest.cameras)
            )

        return from_recording(source, detections, marker, distances, pair_for, outline)
    if source.suffix.lower() != ".csv":
        raise CalibrationError(
            f"{source}: {'neither' if source.exists() else 'does not exist; give'} the folder of a recording"
            f" {'nor' if source.exists() else 'or'} a .csv"
        )
    _refuse_idle(f"{source}, a table", detections=detections, marker=marker, distances=distances)
    return from_table(source, Pair() if rig is None else load_pair(calibration, rig, fov_deg), outline)


def laws_before(pair: Pair, rig: RigCalibration | None) -> dict[str, DepthLaw]:
    """The laws without this fit: that of ideal cameras, and what the rig file holds."""
    laws: dict[str, DepthLaw] = {}
    if pair.models is not None:
        laws["ideal"] = ideal_of(*pair.models)
    previous = {} if rig is None else laws_of(rig)
    return laws | {f"previous {name.partition('_')[0]}": law for name, law in previous.items()}


def _refuse_idle(where: str, **given: object) -> None:
    """Reject options that `where` does not use.

    They are not ignored silently.
    """
    for name, value in given.items():
        if value:
            option = "a recording or a table" if name == "source" else f"--{name}"
            raise CalibrationError(f"{option} has no meaning with {where}: leave it out")
