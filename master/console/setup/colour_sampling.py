"""Marker colours set by a click.

It finds which pixel of the whole frame was meant, reads which colour the camera took, and keeps it.
"""

import json
from collections.abc import Mapping
from pathlib import Path

from msgspec.structs import replace

from common.calibration import CameraCalibration, HsvRange, load, save
from common.messages import Command, Health
from master.console.setup.files import keep_old


def pixel_of(
    camera: CameraCalibration, preview_px: tuple[int, int], at_px: tuple[float, float]
) -> tuple[float, float]:
    """Return the full-frame pixel under a point of the camera's preview.

    Centres of pixels are whole numbers in both.
    """
    scale_u, scale_v = camera.width_px / preview_px[0], camera.height_px / preview_px[1]
    u, v = (at_px[0] + 0.5) * scale_u - 0.5, (at_px[1] + 0.5) * scale_v - 0.5
    return min(max(u, 0.0), camera.width_px - 1.0), min(max(v, 0.0), camera.height_px - 1.0)


def pick(camera: str, marker: str, uv: tuple[float, float]) -> Command:
    """Return the command that samples a marker's colour around a pixel.

    The pixel is one of the newest frame.
    """
    return Command(camera, "pick", json.dumps({"marker": marker, "uv": [round(uv[0], 1), round(uv[1], 1)]}))


def ranges_of(health: Health) -> dict[str, HsvRange]:
    """Return the colours in use that a camera's answer reports."""
    found: dict[str, HsvRange] = {}
    for key in health.metrics:
        if key.startswith("marker.") and key.endswith(".h_low"):
            name = key.removeprefix("marker.").removesuffix(".h_low")
            low, high = (
                tuple(round(health.metrics[f"marker.{name}.{letter}_{end}"]) for letter in "hsv")
                for end in ("low", "high")
            )
            found[name] = HsvRange(hsv_low=(low[0], low[1], low[2]), hsv_high=(high[0], high[1], high[2]))
    return found


def keep_colours(tree: Path, camera: str, ranges: Mapping[str, HsvRange]) -> Path:
    """Write the colours reported by a camera of another machine into its file here.

    Lens and settings stay.

    Raises:
        CalibrationError: The file is missing, broken, or cannot be written.
    """
    path = tree / "cameras" / f"{camera}.json"
    file = load(path, CameraCalibration)
    markers = {**(file.markers or {}), **ranges}
    if markers != file.markers:
        keep_old(tree, path)
        save(path, replace(file, markers=markers))
    return path
