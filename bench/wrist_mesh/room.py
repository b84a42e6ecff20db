"""What is behind the hand, the room's light on it, and the sensor's noise: all measured on the rendered recordings.

The room stands still before the camera, so its picture is the mean of all ambient pictures where no hand is. Only the
light `indoor` has been recorded; the others are that one, scaled; `sun` adds a light from one side.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from bench.wrist_mesh.hand_mesh import Posed
from bench.wrist_mesh.shadows import from_afar, sky
from common.arrays import Float, Image, Int
from common.recording.frame_recording import Illumination, open_recording

BLACK = 2.0
RECORDINGS = ("curl", "mcp", "spread", "left_small")
LEVELS = {"dark": 0.004, "indoor": 0.16, "bright": 0.45, "sun": 0.28}
RECORDED = 0.16
EVERYWHERE = 7.3  # indoor light on all skin [grey]: what the hand and the room throw back
FROM_SKY = (  # and from each direction of the sky, on skin that faces it; residual 2.1 grey
    9.61,
    0.0,
    14.77,
    0.0,
    0.0,
    8.17,
    1.36,
    2.01,
    2.18,
    0.0,
    2.1,
    0.0,
    0.0,
    1.58,
    1.49,
    0.0,
    1.45,
    0.0,
    0.0,
    1.48,
    0.0,
    1.65,
    0.0,
    0.94,
    1.46,
    0.0,
    1.61,
    2.12,
    0.0,
    5.95,
    2.97,
    2.18,
)
SUN = 150.0  # on skin that faces it [grey]; a guess
SUN_FROM = np.array((0.451, -0.551, -0.702))  # unit direction to it, camera frame; a guess
NOISE = (0.06, 0.0195)  # variance [grey^2] in the dark, and per grey value of light
EDGE_PX = 0.15  # standard deviation of the laser's edges, pixel by pixel
GRAIN = 0.055  # and of its brightness, relative
_MARGIN = 7  # pixels around the hand where its blur may be


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """One light.

    Attributes:
        behind: What the camera sees without a hand (H, W) [grey], black left out.
        level: The light, as a share of that recorded.
        sun: On skin that faces the sun [grey].
    """

    behind: Float
    level: float
    sun: float

    @classmethod
    def of(cls, name: str, behind: Float) -> "Room":
        """The light `name` before the picture `behind` of the recorded light."""
        level = LEVELS[name] / RECORDED
        return cls(behind * level, level, SUN if name == "sun" else 0.0)

    def on_surface(self, posed: Posed, faces: Int) -> Float:
        """Light (V,) [grey] on the vertices of a posed hand of triangles (F, 3)."""
        out = np.full(len(posed.verts), EVERYWHERE)
        for direction, grey in zip(sky(), FROM_SKY, strict=True):
            if grey > 0.0:
                out += grey * from_afar(posed, faces, direction)
        out *= self.level
        return out + self.sun * from_afar(posed, faces, SUN_FROM) if self.sun > 0.0 else out


def picture(light: Float, rng: np.random.Generator) -> Image:
    """What the sensor makes of light (H, W) [grey]."""
    spread = np.sqrt(NOISE[0] + NOISE[1] * np.maximum(light, 0.0))
    noisy = BLACK + light + spread * rng.standard_normal(light.shape)
    return np.clip(np.rint(noisy), 0.0, 255.0).astype(np.uint8)


def grained(laser: Float, rng: np.random.Generator) -> Float:
    """The laser's light (H, W) [grey] with the grain that it has in the recordings: ragged edges, uneven brightness."""
    up, down = np.vstack([laser[1:], laser[-1:]]), np.vstack([laser[:1], laser[:-1]])
    shift = np.clip(EDGE_PX * rng.standard_normal(laser.shape), -1.0, 1.0)
    moved = np.where(shift > 0.0, laser + shift * (up - laser), laser - shift * (down - laser))
    return moved * np.maximum(1.0 + GRAIN * rng.standard_normal(laser.shape), 0.0)


def behind(datasets: Path) -> Float:
    """The room alone (H, W) [grey], black left out; where a hand is in every picture, its surroundings."""
    total: Float | None = None
    count: Float | None = None
    for name in RECORDINGS:
        folder = datasets / "wrist" / name
        rows = [row for row in open_recording(folder).rows if row.illumination is Illumination.AMBIENT]
        for k, row in enumerate(rows):
            image = _read(folder / row.file).astype(np.float64)
            hand = _read(folder / f"label_{k:06d}.png") != 255
            free = cv2.dilate(hand.astype(np.uint8), np.ones((_MARGIN, _MARGIN), np.uint8)) == 0
            total = image * free if total is None else total + image * free
            count = free * 1.0 if count is None else count + free
    assert total is not None
    assert count is not None
    known = count > 0
    mean = np.where(known, total / np.maximum(count, 1.0) - BLACK, 0.0)
    weight = cv2.GaussianBlur(known.astype(np.float64), (0, 0), 24.0)
    around = cv2.GaussianBlur(mean, (0, 0), 24.0) / np.maximum(weight, 1e-6)
    floor = float(np.median(mean[known]))
    return np.where(known, mean, np.where(weight > 1e-3, around, floor))


def _read(path: Path) -> Image:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise FileNotFoundError(path)
    return np.asarray(image, dtype=np.uint8)
