"""sRGB curve between image bytes and light: light adds and scales linearly."""

import numpy as np
import numpy.typing as npt

from common.arrays import Float, Image


def to_srgb(linear: Float) -> Float:
    """sRGB transfer curve of linear values 0..1 (IEC 61966-2-1)."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def to_linear(srgb: Float) -> Float:
    """Inverse of `to_srgb`."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def gain_tables(gains: npt.ArrayLike) -> Image:
    """Lookup tables (K, 256) that multiply the light of each channel by gains (K,).

    Light above 1 is clipped, as a sensor clips it. Gains of 1 change nothing.
    """
    light = to_linear(np.arange(256) / 255.0)
    return np.round(255.0 * to_srgb(np.asarray(gains, np.float64)[:, None] * light)).astype(np.uint8)
