"""Cameras of a rig as flat arrays, with kernels to project and undistort.

Project also gives derivatives.
"""

from collections.abc import Sequence
from math import sqrt
from typing import NamedTuple

import numpy as np

from common.arrays import Float
from common.geometry.camera_model import CameraModel
from common.kernels import inlined


class CameraArrays(NamedTuple):
    """C cameras of the pinhole model with five distortion coefficients.

    Attributes:
        R: (C, 3, 3) rotations rig -> camera.
        t: (C, 3) [m], so that a point of the camera's frame is R X + t.
        centre: (C, 3) [m] optical centres, rig frame.
        focal: (C, 2) [px] fx, fy.
        principal: (C, 2) [px] cx, cy.
        distortion: (C, 5) k1, k2, p1, p2, k3.
        scale: (C,) [px] of a step of one in the normalised image, the mean of both axes.
    """

    R: Float
    t: Float
    centre: Float
    focal: Float
    principal: Float
    distortion: Float
    scale: Float

    @classmethod
    def of(cls, cameras: Sequence[CameraModel]) -> "CameraArrays":
        """Lay cameras out in their order."""
        matrix = np.stack([camera.matrix for camera in cameras])
        focal = np.stack([matrix[:, 0, 0], matrix[:, 1, 1]], axis=1)
        return cls(
            np.stack([np.ascontiguousarray(camera.T_camera_rig[:3, :3]) for camera in cameras]),
            np.stack([np.ascontiguousarray(camera.T_camera_rig[:3, 3]) for camera in cameras]),
            np.stack([np.ascontiguousarray(camera.centre) for camera in cameras]),
            np.ascontiguousarray(focal),
            np.ascontiguousarray(matrix[:, :2, 2]),
            np.stack([np.ascontiguousarray(camera.distortion, np.float64) for camera in cameras]),
            np.sqrt(focal[:, 0] * focal[:, 1]),
        )


@inlined
def project(cameras: CameraArrays, c: int, point: Float, uv: Float, J: Float) -> bool:
    """Write where camera c sees a point, and how that moves with it.

    Args:
        cameras, c: The camera.
        point: (3,) [m], rig frame.
        uv: Written: (2,) [px], distorted image.
        J: Written: (2, 3) [px/m], by the point.

    Returns:
        Whether the point is in front of the camera; else nothing is written.
    """
    x = cameras.t[c, 0]
    y = cameras.t[c, 1]
    z = cameras.t[c, 2]
    for i in range(3):
        x += cameras.R[c, 0, i] * point[i]
        y += cameras.R[c, 1, i] * point[i]
        z += cameras.R[c, 2, i] * point[i]
    least_depth_m = 1e-9
    if not z > least_depth_m:
        return False
    x, y = x / z, y / z
    k1, k2, p1, p2, k3 = (
        cameras.distortion[c, 0],
        cameras.distortion[c, 1],
        cameras.distortion[c, 2],
        cameras.distortion[c, 3],
        cameras.distortion[c, 4],
    )
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    radial_derivative = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))  # of radial, by r^2, twice
    fx, fy = cameras.focal[c, 0], cameras.focal[c, 1]
    uv[0] = fx * (x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)) + cameras.principal[c, 0]
    uv[1] = fy * (y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y) + cameras.principal[c, 1]
    a = radial + radial_derivative * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    b = radial_derivative * x * y + 2.0 * (p1 * x + p2 * y)
    d = radial + radial_derivative * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    for i in range(3):
        by_x = (cameras.R[c, 0, i] - x * cameras.R[c, 2, i]) / z
        by_y = (cameras.R[c, 1, i] - y * cameras.R[c, 2, i]) / z
        J[0, i] = fx * (a * by_x + b * by_y)
        J[1, i] = fy * (b * by_x + d * by_y)
    return True


@inlined
def undistort(cameras: CameraArrays, c: int, u: float, v: float, out: Float) -> bool:
    """Write the normalised image point (x/z, y/z) of a pixel, by Newton's method.

    Args:
        cameras, c: The camera.
        u, v: [px], distorted image.
        out: Written: (2,).

    Returns:
        Whether it is found; beyond where the lens folds the image over there is none.
    """
    k1, k2, p1, p2, k3 = (
        cameras.distortion[c, 0],
        cameras.distortion[c, 1],
        cameras.distortion[c, 2],
        cameras.distortion[c, 3],
        cameras.distortion[c, 4],
    )
    seen_x = (u - cameras.principal[c, 0]) / cameras.focal[c, 0]
    seen_y = (v - cameras.principal[c, 1]) / cameras.focal[c, 1]
    x, y = seen_x, seen_y
    newton_steps = 12
    for _ in range(newton_steps):
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        radial_derivative = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
        off_x = seen_x - (x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x))
        off_y = seen_y - (y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y)
        a = radial + radial_derivative * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        b = radial_derivative * x * y + 2.0 * (p1 * x + p2 * y)
        d = radial + radial_derivative * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        determinant = a * d - b * b
        step_x = (d * off_x - b * off_y) / determinant
        step_y = (a * off_y - b * off_x) / determinant
        x += step_x
        y += step_y
        settled = 1e-10  # normalised: the error after a step so small is its square, about
        if sqrt(step_x * step_x + step_y * step_y) < settled:
            out[0], out[1] = x, y
            return determinant > 0.0 and radial > 0.0
        if not np.isfinite(x + y):
            break
    return False
