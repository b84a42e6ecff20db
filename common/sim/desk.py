"""Image background and sensor noise.

The desk as one camera sees it behind the hand, and tiles of noise.

Both are made once and only copied afterwards: cameras do not move.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from common.arrays import Float, Image
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import transform
from common.sim.light import DESK_LINEAR_RGB, to_srgb

SIDE = 1536
NOISE_MARGIN = 96
LENS_SIGMA_PX = 0.62


def desk_image(optics: CameraModel, depth_m: float, seed: int) -> Image:
    """Return the image (H, W, 3) BGR of a worn dark grey desk.

    At rig depth `depth_m` [m], fixed in the rig frame.
    """
    height, width = optics.height_px, optics.width_px
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    rays = optics.ray(np.stack([u, v], axis=-1).reshape(-1, 2))
    along = (depth_m - optics.centre[2]) / np.where(rays[:, 2] > 0.05, rays[:, 2], 0.05)
    points = transform(np.eye(4), optics.centre + along[:, None] * rays)
    texel_m = 0.001
    texel = (points[:, :2] / texel_m + SIDE / 2).reshape(height, width, 2).astype(np.float32)
    wear = cv2.remap(
        _wear(seed), texel[..., 0], texel[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
    )
    radius2 = ((u - width / 2) ** 2 + (v - height / 2) ** 2) / (width / 2) ** 2
    lamp = 1.05 - 0.10 * radius2 - 0.06 * (v / height - 0.5)
    linear = np.array(DESK_LINEAR_RGB)[::-1] * (wear * lamp[..., None])
    image = np.round(255.0 * to_srgb(linear)).astype(np.uint8)
    return np.asarray(cv2.GaussianBlur(image, (3, 3), LENS_SIGMA_PX), dtype=np.uint8)


def _wear(seed: int) -> npt.NDArray[np.float32]:
    """Return the relative brightness (SIDE, SIDE, 3) of wear, about 1.

    Blotches, grain and brushed streaks.

    Single precision and one plane for what has no colour: a slave that starts again waits for this.
    """
    rng = np.random.default_rng([seed, 1])
    grey = np.ones((SIDE, SIDE), dtype=np.float32)
    tinted = np.zeros((SIDE // 4, SIDE // 4, 3), dtype=np.float32)
    for cell, depth in ((256, 0.06), (64, 0.045), (16, 0.04), (4, 0.05), (1, 0.07)):
        n = SIDE // cell
        coarse = depth * rng.standard_normal((n, n), dtype=np.float32)
        grey += coarse if cell == 1 else cv2.resize(coarse, (SIDE, SIDE), interpolation=cv2.INTER_CUBIC)
        if cell > 1:
            tint = 0.12 * depth * rng.standard_normal((n, n, 3), dtype=np.float32)
            tinted += cv2.resize(tint, tinted.shape[1::-1], interpolation=cv2.INTER_CUBIC)
    grey += 0.18 * cv2.blur(rng.standard_normal((SIDE, SIDE), dtype=np.float32), (61, 1))
    wear = cv2.resize(tinted, (SIDE, SIDE), interpolation=cv2.INTER_LINEAR)
    wear += grey[..., None]
    return np.asarray(np.clip(wear, 0.5, 1.6, out=wear), dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class NoiseTiles:
    """Sensor noise, drawn once.

    What to add and what to subtract (2 x H + margin, W + margin, 3).
    """

    plus: tuple[Image, ...]
    minus: tuple[Image, ...]

    @classmethod
    def make(cls, height: int, width: int, seed: int, tiles: int = 2) -> "NoiseTiles":
        """Draw the pool."""
        rng = np.random.default_rng([seed, 2])
        plus: list[Image] = []
        minus: list[Image] = []
        for _ in range(tiles):
            white = rng.normal(0.0, 1.0, (height + NOISE_MARGIN, width + NOISE_MARGIN, 3))
            # A colour filter array mixes neighbours.
            mixed: Float = np.asarray(cv2.GaussianBlur(white, (3, 3), 0.45), dtype=np.float64)
            noise_sigma = 1.7  # in sRGB levels: gamma turns shot noise into a nearly constant amplitude
            level = np.rint(mixed * (noise_sigma * np.array([1.25, 0.85, 1.1]) / float(mixed.std())))
            plus.append(np.clip(level, 0, 255).astype(np.uint8))
            minus.append(np.clip(-level, 0, 255).astype(np.uint8))
        return cls(tuple(plus), tuple(minus))

    def add_to(self, image: Image, key: int) -> None:
        """Add noise in place; the same key adds the same noise."""
        height, width = image.shape[:2]
        mixed = (key * 2654435761 + 0x9E3779B9) & 0xFFFFFFFF  # Knuth's multiplicative hash
        mixed = ((mixed ^ (mixed >> 15)) * 0x2C1B3C6D) & 0xFFFFFFFF
        tile = mixed % len(self.plus)
        y, x = (mixed >> 4) % NOISE_MARGIN, (mixed >> 14) % NOISE_MARGIN
        cv2.add(image, self.plus[tile][y : y + height, x : x + width], dst=image)
        cv2.subtract(image, self.minus[tile][y : y + height, x : x + width], dst=image)
