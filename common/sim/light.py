"""Light gives a simulated scene its illuminant, colours, desk and noise.

Marker reflectances are those of the rendered recordings (truth_meta.json, paint_reflectance_linear_srgb), so that
colours learnt here and there agree. The desk of a camera and the tiles of noise are made once: cameras do not move.

The camera's white balance is fixed, set under the light that the colours were calibrated in. Another light multiplies
every channel in linear light (von Kries' law of coefficients, with the channels of linear sRGB as receptors):

    gain = exposure * white(kelvin) / white(calibrated kelvin)

where `white` is the linear sRGB colour of a Planckian radiator of luminance 1, its chromaticity from the cubic
splines of Kang et al. 2002 (J. Korean Phys. Soc. 41, 865), 1667-25000 K. Equal luminance: exposure is the only change
of brightness.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from common.arrays import Float, Image
from common.errors import CalibrationError, PhalanxError
from common.geometry.camera_model import CameraModel
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


_LINEAR = to_linear(np.arange(256) / 255.0).astype(np.float32)  # byte -> light
_BYTE = np.round(255.0 * to_srgb(np.arange(_ENCODE_STEPS) / (_ENCODE_STEPS - 1))).astype(np.uint8)  # and back


def decode(image: Image) -> Float32:
    """Linear light (H, W, 3), 0..1, of sRGB bytes."""
    return np.asarray(cv2.LUT(image, _LINEAR), dtype=np.float32).reshape(image.shape)


def encode(light: Float32) -> Image:
    """sRGB bytes of linear light (H, W, 3), clipped to 0..1."""
    steps = light * np.float32(_ENCODE_STEPS - 1)
    steps += np.float32(0.5)
    np.clip(steps, 0, _ENCODE_STEPS - 1, out=steps)
    return _BYTE.take(steps.astype(np.intp))


def bgr_bytes(linear_rgb: Float) -> tuple[int, int, int]:
    """sRGB bytes, blue first, of linear RGB (3,)."""
    r, g, b = (int(v) for v in np.round(255.0 * to_srgb(linear_rgb)))
    return b, g, r


def shades(linear_rgb: tuple[float, float, float], gloss: float = 0.0) -> tuple[tuple[int, int, int], ...]:
    """Colours (BGR bytes) of a Lambert surface's layers; `gloss` whitens the last."""
    albedo = np.array(linear_rgb)
    light = AMBIENT + (1.0 - AMBIENT) * _LAYER_MEAN_COSINE
    whiteness = np.array([0.0, 0.1, 0.45, 1.0]) * gloss
    return tuple(bgr_bytes(k * albedo + w) for k, w in zip(light, whiteness, strict=True))


def face_shade(linear_rgb: tuple[float, float, float], cosine: float) -> tuple[int, int, int]:
    """Colour (BGR bytes) of a flat Lambert face at this cosine to the light."""
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


CALIBRATED_KELVIN = 4300.0  # the middle of 3000-6500 K in reciprocal temperature, in which steps look equal
KELVINS = (1667.0, 25000.0)  # domain of Kang's splines
# XYZ -> linear sRGB (IEC 61966-2-1).
RGB_OF_XYZ = np.array(
    [
        [3.2404542, -1.5371385, -0.4985314],
        [-0.9692660, 1.8760108, 0.0415560],
        [0.0556434, -0.2040259, 1.0572252],
    ]
)


def planckian_xy(kelvin: float) -> tuple[float, float]:
    """CIE 1931 chromaticity x, y of a Planckian radiator, by Kang's splines.

    Raises:
        PhalanxError: Outside 1667-25000 K, where they do not hold.
    """
    if not KELVINS[0] <= kelvin <= KELVINS[1]:
        raise PhalanxError(f"light of {kelvin:g} K: from {KELVINS[0]:g} to {KELVINS[1]:g} K are possible")
    k = 1e3 / kelvin
    if kelvin <= 4000.0:
        x = ((-0.2661239 * k - 0.2343589) * k + 0.8776956) * k + 0.179910
    else:
        x = ((-3.0258469 * k + 2.1070379) * k + 0.2226347) * k + 0.240390
    if kelvin <= 2222.0:
        y = ((-1.1063814 * x - 1.34811020) * x + 2.18555832) * x - 0.20219683
    elif kelvin <= 4000.0:
        y = ((-0.9549476 * x - 1.37418593) * x + 2.09137015) * x - 0.16748867
    else:
        y = ((3.0817580 * x - 5.87338670) * x + 3.75112997) * x - 0.37001483
    return x, y


def white(kelvin: float) -> Float:
    """Return the linear sRGB (3,) of a Planckian radiator of luminance 1.

    Below about 1900 K its blue would be negative: 0.

    Raises:
        PhalanxError: As `planckian_xy`.
    """
    x, y = planckian_xy(kelvin)
    return np.maximum(RGB_OF_XYZ @ np.array([x / y, 1.0, (1.0 - x - y) / y]), 0.0)


@dataclass(frozen=True, slots=True)
class Light:
    """Colour temperature [K], and brightness of the picture against calibration."""

    kelvin: float = CALIBRATED_KELVIN
    exposure: float = 1.0

    def gains_bgr(self, calibrated_kelvin: float = CALIBRATED_KELVIN) -> Float:
        """Factors (3,) of the channels in linear light against calibration, blue first.

        Raises:
            PhalanxError: A temperature outside 1667-25000 K.
        """
        return (self.exposure * white(self.kelvin) / white(calibrated_kelvin))[::-1]


@dataclass(frozen=True, slots=True)
class LightSchedule:
    """Light of a scene over time: knots (time [s], kelvin, exposure), rising.

    Straight lines between knots; two at one time are a jump. Before the first and after the last nothing
    changes.
    """

    knots: tuple[tuple[float, float, float], ...]

    def at(self, t_s: float) -> Light:
        """The light at scene time `t_s` [s]; of a jump at that very time, the new light."""
        after = int(np.searchsorted([t for t, _, _ in self.knots], t_s, side="right"))
        last = len(self.knots) - 1
        (t0, *before), (t1, *then) = self.knots[max(after - 1, 0)], self.knots[min(after, last)]
        share = (t_s - t0) / (t1 - t0) if 0 < after <= last else 0.0
        return Light(*(a + share * (b - a) for a, b in zip(before, then, strict=True)))


# One minute of a room: dusk under a lamp, then the lamp is dimmed, a cloud, noon; back at the end, so that it repeats.
ROOM = LightSchedule(
    (
        (2.0, CALIBRATED_KELVIN, 1.0),
        (12.0, 3000.0, 1.0),
        (18.0, 3000.0, 0.7),
        (24.0, 3000.0, 1.3),
        (36.0, 6500.0, 1.3),
        (42.0, 6500.0, 0.7),
        (48.0, 6500.0, 1.0),
        (58.0, CALIBRATED_KELVIN, 1.0),
    )
)


SIDE = 1536
NOISE_MARGIN = 96
LENS_SIGMA_PX = 0.62


def desk_image(optics: CameraModel, depth_m: float, seed: int) -> Image:
    """Image (H, W, 3) BGR of a worn dark grey desk at `depth_m` [m], rig frame."""
    height, width = optics.height_px, optics.width_px
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    rays = optics.ray(np.stack([u, v], axis=-1).reshape(-1, 2))
    along = (depth_m - optics.centre[2]) / np.where(rays[:, 2] > 0.05, rays[:, 2], 0.05)
    points = optics.centre + along[:, None] * rays
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
    """Relative brightness (SIDE, SIDE, 3) of wear: blotches, grain, brushed streaks.

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


def tile_place(key: int) -> tuple[int, int, int]:
    """Number and place (y, x) in the margin of a noise tile; one key, one place."""
    mixed = (key * 2654435761 + 0x9E3779B9) & 0xFFFFFFFF  # Knuth's multiplicative hash
    mixed = ((mixed ^ (mixed >> 15)) * 0x2C1B3C6D) & 0xFFFFFFFF
    return mixed, mixed >> 4, mixed >> 14


class NoiseTiles:
    """Sensor noise, drawn once: tiles (H + margin, W + margin, 3), plus and minus."""

    def __init__(self, height: int, width: int, seed: int) -> None:
        rng = np.random.default_rng([seed, 2])
        self._tiles: list[tuple[Image, Image]] = []
        for _ in range(2):
            white = rng.normal(0.0, 1.0, (height + NOISE_MARGIN, width + NOISE_MARGIN, 3))
            # A colour filter array mixes neighbours.
            mixed: Float = np.asarray(cv2.GaussianBlur(white, (3, 3), 0.45), dtype=np.float64)
            noise_sigma = 1.7  # in sRGB levels: gamma turns shot noise into a nearly constant amplitude
            level = np.rint(mixed * (noise_sigma * np.array([1.25, 0.85, 1.1]) / float(mixed.std())))
            plus, minus = (np.clip(one, 0, 255).astype(np.uint8) for one in (level, -level))
            self._tiles.append((plus, minus))

    def add_to(self, image: Image, key: int) -> None:
        """Add noise in place; the same key adds the same noise."""
        height, width = image.shape[:2]
        number, y, x = tile_place(key)
        y, x = y % NOISE_MARGIN, x % NOISE_MARGIN
        plus, minus = (tile[y : y + height, x : x + width] for tile in self._tiles[number % 2])
        cv2.add(image, plus, dst=image)
        cv2.subtract(image, minus, dst=image)
