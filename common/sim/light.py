"""Colours of the simulated scene.

Reflectances, light, and the step between linear light and sRGB bytes.

Marker reflectances are those of the rendered recordings (truth_meta.json, paint_reflectance_linear_srgb), so that
colours learnt here and there agree.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from common.arrays import Float, Image
from common.errors import CalibrationError
from common.geometry.srgb import to_linear, to_srgb

Float32 = npt.NDArray[np.float32]

MARKER_LINEAR_RGB = {
    "thumb": (0.03, 0.30, 0.33),
    "index": (0.035, 0.33, 0.09),
    "middle": (0.02, 0.075, 0.43),
    "ring": (0.15, 0.035, 0.33),
    "little": (0.52, 0.03, 0.22),
    "back": (0.26, 0.52, 0.06),
}
# Of markers that no rendered recording has; their hues lie in the widest gaps between those of the six.
MORE_MARKER_LINEAR_RGB = {
    "back2": (0.30, 0.03, 0.31),
    "back3": (0.075, 0.42, 0.04),
    # A tracked object has those of the second and third marker of the back, and the only hue that is left: yellow.
    "wand1": (0.55, 0.47, 0.02),
    "wand2": (0.075, 0.42, 0.04),
    "wand3": (0.30, 0.03, 0.31),
}
SKIN_LINEAR_RGB = (0.700, 0.410, 0.255)
SLEEVE_LINEAR_RGB = (0.235, 0.195, 0.165)
THING_LINEAR_RGB = (0.045, 0.043, 0.041)  # matt and dark, so that it is nobody's marker
CARD_LINEAR_RGB = (0.030, 0.030, 0.034)
DESK_LINEAR_RGB = (0.128, 0.117, 0.105)

# A sphere is drawn as nested discs: its outline, then the parts where the cosine to the light exceeds these.
LAYER_COSINES = np.array([0.0, 0.42, 0.72, 0.92])
_LAYER_MEAN_COSINE = np.array([0.16, 0.58, 0.83, 0.97])
AMBIENT = 0.38
TO_LIGHT_RIG = np.array([-0.32, -0.45, -1.0]) / np.linalg.norm([-0.32, -0.45, -1.0])

_ENCODE_STEPS = 4096


@dataclass(frozen=True, slots=True, eq=False)
class SrgbTables:
    """sRGB curve as lookup tables.

    byte -> linear 0..1 (256,), and 4096 linear steps -> byte.
    """

    linear: Float32
    byte: Image

    @classmethod
    def make(cls) -> "SrgbTables":
        """Build both tables."""
        linear = to_linear(np.arange(256) / 255.0).astype(np.float32)
        steps = np.arange(_ENCODE_STEPS) / (_ENCODE_STEPS - 1)
        return cls(linear, np.round(255.0 * to_srgb(steps)).astype(np.uint8))

    def decode(self, image: Image) -> Float32:
        """Linear light (H, W, 3) of sRGB bytes."""
        return np.asarray(cv2.LUT(image, self.linear), dtype=np.float32).reshape(image.shape)

    def encode(self, light: Float32) -> Image:
        """sRGB bytes of linear light (H, W, 3), clipped to 0..1."""
        steps = light * np.float32(_ENCODE_STEPS - 1)
        steps += np.float32(0.5)
        np.clip(steps, 0, _ENCODE_STEPS - 1, out=steps)
        return self.byte.take(steps.astype(np.intp))


def bgr_bytes(linear_rgb: Float) -> tuple[int, int, int]:
    """sRGB bytes, blue first, of linear RGB (3,)."""
    r, g, b = (int(v) for v in np.round(255.0 * to_srgb(linear_rgb)))
    return b, g, r


def shades(linear_rgb: tuple[float, float, float], gloss: float = 0.0) -> tuple[tuple[int, int, int], ...]:
    """Return the colours (BGR bytes) of the layers of a Lambert surface.

    Its brightest layer has `gloss` of white.
    """
    albedo = np.array(linear_rgb)
    light = AMBIENT + (1.0 - AMBIENT) * _LAYER_MEAN_COSINE
    whiteness = np.array([0.0, 0.1, 0.45, 1.0]) * gloss
    return tuple(bgr_bytes(k * albedo + w) for k, w in zip(light, whiteness, strict=True))


def face_shade(linear_rgb: tuple[float, float, float], cosine: float) -> tuple[int, int, int]:
    """Return the colour (BGR bytes) of a flat Lambert face.

    Its normal has this cosine to the light.
    """
    return bgr_bytes((AMBIENT + (1.0 - AMBIENT) * max(cosine, 0.0)) * np.array(linear_rgb))


def marker_colour(marker: str) -> tuple[float, float, float]:
    """Return the linear RGB reflectance of a marker's colour.

    Raises:
        CalibrationError: The simulator has no marker colour of that name.
    """
    known = MARKER_LINEAR_RGB | MORE_MARKER_LINEAR_RGB
    if marker not in known:
        raise CalibrationError(
            f"marker {marker!r}: the simulator has no such paint; it has {', '.join(known)}"
        )
    return known[marker]
