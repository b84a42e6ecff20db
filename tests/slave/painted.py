"""Painted scenes for the tests of marker vision: discs of paint on a desk, with exact centroids and areas.

Rendered 8 x oversampled in linear light, averaged, and encoded as sRGB, so that a rim pixel holds the light
of what covers it: an independent account of how a camera forms an edge.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from common.arrays import Float, Image
from common.calibration import CameraCalibration, HsvRange
from tests.slave.stand_ins import camera_file

NAMES = ("thumb", "index", "middle", "ring", "little", "back")
HUE = (89, 66, 111, 141, 167, 38)
RANGES = {
    n: HsvRange(hsv_low=(h - 9, 80, 40), hsv_high=(h + 9, 255, 255)) for n, h in zip(NAMES, HUE, strict=True)
}
DESK = (20, 27, 95)  # HSV
SKIN = (12, 100, 200)
OVER = 8


@dataclass(frozen=True)
class Disc:
    """A disc of HSV paint around (u, v) [px]; later discs cover earlier ones."""

    hsv: tuple[int, int, int]
    u: float
    v: float
    radius: float


def marker_hsv(marker: int) -> tuple[int, int, int]:
    return (HUE[marker], 180, 150)


def camera(
    width: int = 640, height: int = 480, ranges: dict[str, HsvRange] | None = None
) -> CameraCalibration:
    return camera_file(
        width_px=width,
        height_px=height,
        frame_rate_hz=60.0,
        analogue_gain=1.0,
        colour_gains=(1.0, 1.0),
        row_time_us=0.0,
        markers=RANGES if ranges is None else ranges,
    )


def linear(hsv: tuple[int, int, int]) -> Float:
    bgr = np.asarray(cv2.cvtColor(np.array([[hsv]], np.uint8), cv2.COLOR_HSV2BGR))[0, 0] / 255.0
    return np.where(bgr <= 0.04045, bgr / 12.92, ((bgr + 0.055) / 1.055) ** 2.4)


def _encoded(light: Float) -> Float:
    """sRGB levels, 0 to 255, of linear light."""
    return np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055) * 255.0


def render(
    discs: Sequence[Disc], width: int = 640, height: int = 480, noise: float = 0.0, seed: int = 0
) -> Image:
    """The scene as (height, width, 3) BGR; `noise` is the standard deviation in grey levels."""
    light = np.broadcast_to(linear(DESK), (height, width, 3)).copy()
    left, top, right, bottom = width, height, 0, 0
    for d in discs:
        x0, x1 = max(int(d.u - d.radius) - 2, 0), min(int(d.u + d.radius) + 3, width)
        y0, y1 = max(int(d.v - d.radius) - 2, 0), min(int(d.v + d.radius) + 3, height)
        if x0 >= x1 or y0 >= y1:
            continue
        x = (np.arange((x1 - x0) * OVER) + 0.5) / OVER - 0.5 + x0
        y = (np.arange((y1 - y0) * OVER) + 0.5) / OVER - 0.5 + y0
        inside = (x[None, :] - d.u) ** 2 + (y[:, None] - d.v) ** 2 <= d.radius**2
        share = inside.reshape(y1 - y0, OVER, x1 - x0, OVER).mean(axis=(1, 3))[..., None]
        light[y0:y1, x0:x1] = light[y0:y1, x0:x1] * (1.0 - share) + linear(d.hsv) * share
        left, top, right, bottom = min(left, x0), min(top, y0), max(right, x1), max(bottom, y1)
    code = np.broadcast_to(_encoded(linear(DESK)), (height, width, 3)).copy()
    if left < right:
        code[top:bottom, left:right] = _encoded(light[top:bottom, left:right])
    code += np.random.default_rng(seed).normal(0.0, noise, code.shape) if noise else 0.0
    return np.clip(np.round(code), 0, 255).astype(np.uint8)


def finger(marker: int, u: float, v: float, radius: float = 7.0) -> list[Disc]:
    """A cap with skin below it, as on a finger pointing up."""
    return [Disc(SKIN, u, v + 0.9 * radius, 1.15 * radius), Disc(marker_hsv(marker), u, v, radius)]


def hand(u: float = 300.0, v: float = 200.0) -> list[Disc]:
    """Six markers of a hand whose back is at (u, v)."""
    discs = [Disc(SKIN, u, v, 40.0), Disc(marker_hsv(5), u, v, 16.0)]
    for m, (x, y) in enumerate([(-70, -30), (-35, -90), (-8, -102), (18, -92), (42, -66)]):
        discs += finger(m, u + x, v + y)
    return discs


CENTRES = np.array([(-70, -30), (-35, -90), (-8, -102), (18, -92), (42, -66), (0, 0)], float)
