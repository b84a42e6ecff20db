"""`phalanx calibrate wrist flat-field`: the illumination of a wrist device.

How the LEDs and the lens light its image.
"""

from argparse import Namespace
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from common.arrays import Float
from common.calibration import RigCalibration
from common.errors import FitError
from common.geometry.camera_model import CameraModel
from common.recording.frame_recording import Illumination
from common.terminal import echo
from master.calibrate.cameras.boards import Board
from master.calibrate.cameras.options import board_of
from master.calibrate.tree_files import provenance
from master.calibrate.wrist.board_pose import board_pose
from master.calibrate.wrist.device import Device, device_of, print_line, write_device
from master.calibrate.wrist.flat_field import FlatFit, WhiteSamples, fit_flat_field, gathered, white_samples
from master.calibrate.wrist.lit_views import LitView, grouped_by_reason, lit_views
from master.commands.summary import write_summary


@dataclass(frozen=True, slots=True)
class WhiteSeen:
    """Samples of the views that have some, and of every other view the reason."""

    samples: WhiteSamples
    views: int
    refused: Mapping[str, str]


def flat_field(options: Namespace) -> None:
    """Measure the flat field of a wrist device's LEDs.

    From twenty views of a board on matt paper.
    """
    device = device_of(options.source, options.rig, options.calibration, options.out)
    views = lit_views(options.source, device.camera.name, Illumination.LED)
    leds = np.array(device.rig.led) if device.rig.led else np.zeros((1, 3))
    seen = white_of(
        views,
        board_of(options.board, options.square_mm, options.marker_mm, options.dictionary),
        device.optics,
        leds,
    )
    try:
        fit = fit_flat_field(seen.samples, device.optics)
    except FitError as error:
        reasons = "".join(f"\n  {reason}" for reason in grouped_by_reason(seen.refused))
        raise FitError(f"{options.source}: {error}{reasons}") from error
    print_line(report_lines(fit, seen, len(views), known_leds=bool(device.rig.led)))
    if options.picture is not None:
        from master.calibrate.wrist.picture import draw_flat_field  # matplotlib takes a second to import

        draw_flat_field(options.picture, fit, seen.samples, device.optics)
        echo(f"drew {options.picture}")
    written = write_device(options.out, device, rig_with_field(device, fit, seen), "flat_field")
    if options.json_file is not None:
        report: dict[str, object] = {
            "coefficients": list(fit.field.coefficients),
            "rms_percent": round(100 * fit.rms, 4),
            "cross_validated_rms_percent": round(100 * fit.cross_validated_rms, 4),
            "samples": len(seen.samples.light),
            "views": seen.views,
            "refused": dict(seen.refused),
            "written": None if written is None else str(written),
        }
        write_summary(options.json_file, report)


def white_of(views: tuple[LitView, ...], board: Board, optics: CameraModel, led_m: Float) -> WhiteSeen:
    """The white squares of every view.

    Raises:
        RecordingError: An image cannot be read.
    """
    found: list[tuple[Float, Float, Float]] = []
    refused: dict[str, str] = {}
    for view in views:
        led, ambient = view.load(Illumination.LED), view.load(Illumination.AMBIENT)
        assert led is not None  # `lit_views` gives whole ones
        assert ambient is not None
        try:
            placed = board_pose(view, board, optics)
            found.append(white_samples(led, ambient, placed, board, optics, led_m))
        except FitError as error:
            refused[view.name] = str(error)
    if not found:
        found.append((np.empty((0, 2)), np.empty((0, 2)), np.empty(0)))
    return WhiteSeen(gathered(found), len(views) - len(refused), refused)


def report_lines(fit: FlatFit, seen: WhiteSeen, views: int, *, known_leds: bool) -> list[str]:
    """The result for a person."""
    lines = [
        f"flat field from {len(seen.samples.light)} samples in {seen.views} of {views} views",
        f"  residual {100 * fit.rms:.2f} % rms; of views left out of the fit {100 * fit.cross_validated_rms:.2f} %",
    ]
    if not known_leds:
        lines.append("  the rig has no `led`: the LEDs were taken to be at the lens")
    if seen.refused:
        lines += [
            f"left out ({len(seen.refused)}):",
            *(f"  {reason}" for reason in grouped_by_reason(seen.refused)),
        ]
    return lines


def rig_with_field(device: Device, fit: FlatFit, seen: WhiteSeen) -> RigCalibration:
    """The device's rig with the flat field and where it comes from."""
    residual = {
        "rms_percent": round(100 * fit.rms, 4),
        "cross_validated_rms_percent": round(100 * fit.cross_validated_rms, 4),
    }
    note = f"{len(seen.samples.light)} samples of white squares in {seen.views} views"
    how = provenance("calibrate wrist flat-field", (device.source,), residual, note)
    rig = device.rig
    return replace(rig, flat_field=fit.field, provenance=rig.provenance | {"flat_field": how})
