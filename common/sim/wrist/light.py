"""Light on the scene and the sensor that records it.

The room and its window behind the hand, LEDs and laser.

Brightness is in levels of the sensor above black, at the exposure of the camera's file: 253 saturates. The rooms differ
by what falls on the hand, by how bright they are behind it, by how far the window saturates, and by sunlight on skin.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from common.arrays import Bool, Float, Image
from common.geometry.tapered_capsules import Capsules, Plane, first_hits, terms

BLACK_LEVEL = 2.0
LASER_LEVEL = 2400.0  # of the middle of the line, on skin that faces the laser at SURFACE_AT_M
SURFACE_AT_M = 0.13
SHEET_SIGMA_M = 4.2e-4  # of the sheet of laser light
GLOW = (
    (5.0, 0.13),
    (14.0, 0.10),
)  # what comes out of the skin beside the line: sigma [px], share of the line's light
_TILE_MARGIN = 128
_LEVELS = {  # on the hand, behind it, of the window, of sun on skin
    "dark": (0.6, 0.4, 0.0, 0.0),
    "indoor": (24.0, 16.0, 330.0, 0.0),
    "bright": (68.0, 46.0, 900.0, 0.0),
    "sun": (95.0, 80.0, 2500.0, 190.0),
}


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """One ambient light.

    Attributes:
        hand, wall, window, sun: Levels on skin, behind it, of the window, and of sunlight that falls straight on skin.
        to_sky, to_sun: Unit vectors (3,), camera frame.
        seed: Of what stands in the room.
    """

    hand: float
    wall: float
    window: float
    sun: float
    to_sky: Float
    to_sun: Float
    seed: int

    @classmethod
    def of(cls, name: str, seed: int) -> "Room":
        """The room called dark, indoor, bright or sun."""
        rng = np.random.default_rng([seed, 31])
        sky = np.array([rng.uniform(-0.6, 0.6), -1.0, rng.uniform(-0.6, 0.2)])
        sun = np.array([rng.uniform(-1.0, 1.0), -0.8, rng.uniform(-0.5, 0.1)])
        return cls(*_LEVELS[name], sky / np.linalg.norm(sky), sun / np.linalg.norm(sun), seed)

    def on_surface(self, normals: Plane) -> Plane:
        """Return the levels of plain skin with the given normals.

        Levels (N,), normals (N, 3): light from all sides, more from above, and the sun.
        """
        shade: Plane = self.hand * (0.75 + 0.25 * (normals @ self.to_sky.astype(np.float32)))
        if self.sun > 0.0:
            shade += self.sun * np.maximum(normals @ self.to_sun.astype(np.float32), 0.0)
        return shade

    def backdrop(self, size: tuple[int, int], step: float) -> Plane:
        """Return the background, seen where there is no hand.

        Shape (H, W), `size` = (W, H): a wall, things out of focus, a bright window.

        `step` is how many pixels of the camera one of the backdrop is.
        """
        rng = np.random.default_rng([self.seed, 33])
        width, height = size
        wall = np.full((height, width), self.wall, dtype=np.float32)
        wall *= (1.0 + np.linspace(-0.25, 0.25, width) * rng.uniform(-1.0, 1.0)).astype(np.float32)
        for _ in range(7):
            middle, half = rng.uniform(0.0, 1.0, 2), rng.uniform(0.05, 0.25, 2)
            _box(wall, middle - half, middle + half, self.wall * rng.uniform(0.4, 1.8))
        if self.window > 0.0:
            low = np.array([rng.uniform(0.0, 0.6), rng.uniform(-0.2, 0.05)])
            high = low + np.array([rng.uniform(0.25, 0.4), rng.uniform(0.4, 0.65)])
            bar = low[0] + rng.uniform(0.4, 0.6) * (high[0] - low[0])
            _box(wall, low, high, self.window)
            _box(wall, np.array([bar, low[1]]), np.array([bar + 0.02, high[1]]), 0.2 * self.window)
        out = np.asarray(cv2.GaussianBlur(wall, (0, 0), 7.0 / step), dtype=np.float32)
        # The lens scatters a little of the window everywhere.
        veil = np.asarray(cv2.GaussianBlur(wall, (0, 0), 120.0 / step), dtype=np.float32)
        return np.asarray(cv2.addWeighted(out, 1.0, veil, 0.006, 0.0), dtype=np.float32)


def _box(image: Plane, low: Float, high: Float, level: float) -> None:
    """Fill a box given in shares of the picture."""
    size = np.array(image.shape[::-1])
    (x0, y0), (x1, y1) = (np.rint(corner * size).astype(int).tolist() for corner in (low, high))
    cv2.rectangle(image, (x0, y0), (x1, y1), level, -1)


class Leds:
    """The LEDs beside the lens. Holds where they are."""

    def __init__(self, led_m: Float) -> None:
        """Of places (L, 3) [m], camera frame."""
        self._led = led_m.astype(np.float32)

    def on_surface(self, points: Plane, normals: Plane, before: Capsules | None = None) -> Plane:
        """Return the levels of plain skin at points lit by the LEDs.

        Levels (N,) at points (N, 3) [m]: inverse square and Lambert's cosine, summed over the LEDs.

        Only `before` throws shadows: those of one finger on another are narrow, so near to the lens are the LEDs.
        """
        faced = normals @ self._led.T - np.einsum("ij,ij->i", normals, points)[:, None]
        square = np.einsum("ij,ij->i", points, points)[:, None] - 2.0 * (points @ self._led.T)
        square += (self._led * self._led).sum(axis=1)
        np.maximum(faced, 0.0, out=faced)
        if before is not None:
            for led, place in enumerate(self._led):
                faced[_in_shadow(before, place, points, square[:, led]), led] = 0.0
        faced /= square * np.sqrt(square)
        led_level = 88.0  # of skin that faces the LEDs at SURFACE_AT_M on the axis
        return faced.sum(axis=1) * np.float32(led_level * SURFACE_AT_M**2 / len(self._led))


def _in_shadow(before: Capsules, origin: Plane, points: Plane, square: Plane) -> Bool:
    """Check whether a body blocks the light from an origin to points.

    Origin (3,) [m], points (N, 3) [m], `square` (N,) [m^2]: their squared distances.
    """
    far = np.sqrt(square)
    ways = np.ascontiguousarray(((points - origin) / far[:, None]).T)
    known = terms(before, origin.astype(np.float64), np.float32)
    reach = np.min([first_hits(body, ways) for body in known.T], axis=0)
    shadow_gap_m = 0.001  # nearer to a body nothing is in its shadow: it may be on the body itself
    return reach < far - np.float32(shadow_gap_m)


class Sensor:
    """Adds noise, and cuts at what a byte holds. Holds a tile of noise, drawn once."""

    def __init__(self, height: int, width: int, seed: int) -> None:
        """Of so many pixels."""
        rng = np.random.default_rng([seed, 32])
        self._tile = rng.standard_normal((height + _TILE_MARGIN, width + _TILE_MARGIN), dtype=np.float32)
        level = np.arange(256, dtype=np.float32)
        read_variance, shot_variance = 0.35, 0.032  # of the noise [levels^2], and per level
        self._sigma = np.sqrt(read_variance + shot_variance * np.maximum(level - BLACK_LEVEL, 0.0))

    def bytes_of(self, level: Plane, key: int) -> Image:
        """Convert levels to an image, black at BLACK_LEVEL.

        Levels and image (H, W); the same key gives the same noise.
        """
        height, width = level.shape
        mixed = (key * 2654435761 + 0x9E3779B9) & 0xFFFFFFFF  # Knuth's multiplicative hash
        mixed = ((mixed ^ (mixed >> 15)) * 0x2C1B3C6D) & 0xFFFFFFFF
        y, x = (mixed >> 4) % _TILE_MARGIN, (mixed >> 14) % _TILE_MARGIN
        noise = cv2.LUT(cv2.convertScaleAbs(level), self._sigma)
        cv2.multiply(noise, self._tile[y : y + height, x : x + width], dst=noise)
        return np.asarray(cv2.add(noise, level, dtype=cv2.CV_8U), dtype=np.uint8)  # rounded, and cut
