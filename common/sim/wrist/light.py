"""The light on the scene: the room and its window behind the hand, ambient light, LEDs, the laser, and the sensor.

Brightness is in levels of the sensor above black at the camera file's exposure: 253 saturates. The four rooms differ by
what falls on the hand, by how bright the room behind it is, and by how far the window saturates.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from common.arrays import Float, Image
from common.camera_model import CameraModel

BLACK_LEVEL = 2.0
LED_LEVEL = 78.0  # of skin that faces the LEDs at LED_AT_M on the axis
LED_AT_M = 0.13
LASER_LEVEL = 2400.0  # at the middle of the line on skin that faces the laser at LED_AT_M
SHEET_SIGMA_M = 4.2e-4  # thickness of the sheet of laser light
GLOW = (
    (4.0, 0.035),
    (13.0, 0.012),
)  # light that leaves the skin beside the line: sigma [px], share of the line's
_READ_VARIANCE, _SHOT_VARIANCE = 0.35, 0.032  # of the noise [levels^2], and per level
_TILE_MARGIN = 128

Plane = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Room:
    """Levels of one ambient light: on the hand, of the wall behind it, of the window, and of a patch of sun on skin."""

    hand: float
    wall: float
    window: float
    sun: float = 0.0


ROOMS = {
    "dark": Room(0.6, 0.4, 0.0),
    "indoor": Room(24.0, 16.0, 330.0),
    "bright": Room(68.0, 46.0, 900.0),
    "sun": Room(95.0, 80.0, 2500.0, 150.0),
}


def backdrop(room: Room, optics: CameraModel, seed: int, size: tuple[int, int]) -> Plane:
    """What is seen where no hand is (H, W), `size` = (W, H): a wall, furniture out of focus, and a bright window."""
    rng = np.random.default_rng([seed, 31])
    width, height = size
    scale = width / optics.width_px
    wall = np.full((height, width), room.wall, dtype=np.float32)
    slope = np.linspace(-0.25, 0.25, width) * rng.uniform(-1.0, 1.0)
    wall *= (1.0 + slope).astype(np.float32)
    for _ in range(7):
        x, y = rng.uniform(0.0, width), rng.uniform(0.0, height)
        half = rng.uniform(0.05, 0.25, 2) * size
        level = float(room.wall * rng.uniform(0.4, 1.8))
        cv2.rectangle(wall, _pixel(x - half[0], y - half[1]), _pixel(x + half[0], y + half[1]), level, -1)
    if room.window > 0.0:
        left, top = rng.uniform(0.35, 0.7) * width, rng.uniform(-0.2, 0.05) * height
        right, low = left + rng.uniform(0.25, 0.4) * width, rng.uniform(0.3, 0.55) * height
        cv2.rectangle(wall, _pixel(left, top), _pixel(right, low), room.window, -1)
        bar = left + rng.uniform(0.4, 0.6) * (right - left)
        cv2.rectangle(wall, _pixel(bar, top), _pixel(bar + 0.03 * width, low), 0.2 * room.window, -1)
    blurred = cv2.GaussianBlur(wall, (0, 0), 4.5 * scale)
    if room.window > 0.0:  # the lens scatters a little of the window everywhere
        blurred += 0.006 * cv2.GaussianBlur(wall, (0, 0), 60.0 * scale)
    return np.asarray(blurred, dtype=np.float32)


def _pixel(x: float, y: float) -> tuple[int, int]:
    return round(x), round(y)


def led_light(points: Plane, normals: Plane, led_m: Float) -> Plane:
    """Light (N,) of all LEDs on skin at points (N, 3) [m] with normals (N, 3): inverse square, Lambert's cosine.

    1 is what all of them together give skin that faces them at LED_AT_M.
    """
    led = led_m.astype(np.float32)
    faced = normals @ led.T - np.einsum("ij,ij->i", normals, points)[:, None]
    square = np.einsum("ij,ij->i", points, points)[:, None] - 2.0 * (points @ led.T) + (led * led).sum(axis=1)
    np.maximum(faced, 0.0, out=faced)
    faced /= square * np.sqrt(square)
    return faced.sum(axis=1) * np.float32(LED_AT_M**2 / len(led))


class Sensor:
    """Adds noise and black level, and cuts at what a byte holds. Its state is a tile of noise, drawn once."""

    def __init__(self, height: int, width: int, seed: int) -> None:
        rng = np.random.default_rng([seed, 32])
        self._tile = rng.standard_normal((height + _TILE_MARGIN, width + _TILE_MARGIN), dtype=np.float32)
        level = np.arange(256, dtype=np.float32)
        self._sigma = np.sqrt(_READ_VARIANCE + _SHOT_VARIANCE * level).reshape(1, 256)

    def bytes_of(self, level: Plane, key: int, noise: float = 1.0) -> Image:
        """Image (H, W) of levels above black (H, W); the same key, the same noise."""
        height, width = level.shape
        mixed = (key * 2654435761 + 0x9E3779B9) & 0xFFFFFFFF  # Knuth's multiplicative hash
        mixed = ((mixed ^ (mixed >> 15)) * 0x2C1B3C6D) & 0xFFFFFFFF
        y, x = (mixed >> 4) % _TILE_MARGIN, (mixed >> 14) % _TILE_MARGIN
        sigma = cv2.LUT(cv2.convertScaleAbs(level), noise * self._sigma)
        sigma = cv2.multiply(sigma, self._tile[y : y + height, x : x + width], dst=sigma)
        cv2.add(sigma, level, dst=sigma)
        # Saturated light has no noise that a byte could show: both ends are cut.
        return np.asarray(cv2.add(sigma, BLACK_LEVEL, dtype=cv2.CV_8U), dtype=np.uint8)
