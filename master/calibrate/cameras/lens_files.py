"""Conversion of lenses and poses between fit arrays and calibration file types.

Numbers are rounded as they are written.
"""

import numpy as np

from common.arrays import Float
from common.calibration import Intrinsics, Matrix4
from common.geometry.camera_model import CameraModel

_FIGURES = 9  # decimals: nanometres, and far below any standard deviation


def intrinsics_of(lens: Float) -> Intrinsics:
    """A lens (9,) in the order of `bundle.LENS`."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = (round(float(x), _FIGURES) for x in lens)
    return Intrinsics(fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy, distortion=(k1, k2, p1, p2, k3))


def lens_of(intrinsics: Intrinsics) -> Float:
    """The same back (9,)."""
    return np.array(
        [intrinsics.fx_px, intrinsics.fy_px, intrinsics.cx_px, intrinsics.cy_px, *intrinsics.distortion]
    )


def matrix_of(T: Float) -> Matrix4:
    """A rigid transform (4, 4) as rows."""
    rows = [tuple(round(float(x), _FIGURES) for x in row) for row in T]
    (a, b, c, d) = [(row[0], row[1], row[2], row[3]) for row in rows]
    return a, b, c, d


def camera_model(intrinsics: Intrinsics, size_px: tuple[int, int], T_rig_camera: Matrix4) -> CameraModel:
    """The camera that a file with these values describes."""
    lens = lens_of(intrinsics)
    return CameraModel(
        matrix=np.array([[lens[0], 0.0, lens[2]], [0.0, lens[1], lens[3]], [0.0, 0.0, 1.0]]),
        distortion=lens[4:],
        T_rig_camera=np.array(T_rig_camera, dtype=np.float64),
        width_px=size_px[0],
        height_px=size_px[1],
        row_time_ns=0.0,
    )
