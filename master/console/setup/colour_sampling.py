"""Colours by a click: which pixel of the whole frame was meant, what the camera says it took, and keeping it."""

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
    """The pixel of the whole frame under a point of its preview: centres of pixels are whole numbers in both."""
    scale_u, scale_v = camera.width_px / preview_px[0], camera.height_px / preview_px[1]
    u, v = (at_px[0] + 0.5) * scale_u - 0.5, (at_px[1] + 0.5) * scale_v - 0.5
    return min(max(u, 0.0), camera.width_px - 1.0), min(max(v, 0.0), camera.height_px - 1.0)


def pick(camera: str, marker: str, uv: tuple[float, float]) -> Command:
    """The command that takes a marker's colour from about a pixel of the newest frame."""
    return Command(camera, "pick", json.dumps({"marker": marker, "uv": [round(uv[0], 1), round(uv[1], 1)]}))


def ranges_of(health: Health) -> dict[str, HsvRange]:
    """The colours in use that an answer of a camera tells."""
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
    """Write colours that a camera of another machine told into its file here; lens and settings stay.

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
