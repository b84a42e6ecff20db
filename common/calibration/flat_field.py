"""Flat field of a wrist device's LEDs as a function of image position.

It is the polynomial that `FlatField` describes.
"""

import numpy as np

from common.arrays import Float
from common.calibration.wrist import FLAT_FIELD_TERMS, FlatField


def terms_of(xy: Float, degree: int) -> Float:
    """Return the polynomial terms (..., T) at normalised image points (..., 2).

    Ordered as `FlatField.coefficients`.
    """
    x, y = xy[..., 0], xy[..., 1]
    return np.stack([x ** (d - k) * y**k for d in range(degree + 1) for k in range(d + 1)], axis=-1)


def field_at(field: FlatField, xy: Float) -> Float:
    """The polynomial (...) at normalised image points (..., 2)."""
    return terms_of(xy, FLAT_FIELD_TERMS.index(len(field.coefficients))) @ np.array(field.coefficients)


def flat_of(field: FlatField, xy: Float) -> Float:
    """Return the flat field (...) at normalised image points (..., 2).

    Never less than a fiftieth of the value on the axis.
    """
    least = 0.02  # a polynomial beyond where it was measured must not turn the image inside out
    return np.maximum(field_at(field, xy), least)
