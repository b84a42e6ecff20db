"""Intersections of rays with the laser plane, with their uncertainty.

It also gives coordinates in that plane.

A pixel is the ray r = (x, y, 1) through its undistorted point; it meets the plane n . X = c at X = c r / (n . r)
(Digits, UIST 2012: triangulation by one camera and a plane of light). The plane is seen at a flat angle, so one pixel
is many times longer along it than across; the covariance carries that.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float
from common.geometry.transforms import intersect_plane
from master.rig.wrist import WristSetup

_STEP_PX = 0.5  # of the differences that carry a pixel's noise onto the plane
_AROUND_PX = np.array([[0.0, 0.0], [_STEP_PX, 0.0], [-_STEP_PX, 0.0], [0.0, _STEP_PX], [0.0, -_STEP_PX]])


@dataclass(frozen=True, slots=True, eq=False)
class LaserPoints:
    """Points on the plane.

    Attributes:
        point_m: (N, 3) [m], camera frame; NaN: not seen, or the ray does not meet the plane in front of the camera.
        cov_m2: (N, 3, 3) [m^2], of rank two.
    """

    point_m: Float
    cov_m2: Float


def in_image(setup: WristSetup, uv: Float, sigma_px: Float) -> Bool:
    """Return which pixels (N, 2) can have been seen (N,).

    They must be in the image, and their standard deviations (N,) not beyond it.
    """
    size = np.array([setup.optics.width_px, setup.optics.height_px])
    return ((uv >= -0.5) & (uv <= size - 0.5)).all(axis=1) & (sigma_px <= size.max())


def laser_points(setup: WristSetup, uv: Float, sigma_px: Float) -> LaserPoints:
    """Return the points on the laser plane behind pixels (N, 2).

    The pixels are of the distorted image, of standard deviations (N,) [px].
    """
    rays = setup.optics.ray(uv[:, None] + _AROUND_PX)
    found = intersect_plane(np.zeros(3), rays, setup.normal, setup.offset_m)
    by_pixel = (found[:, 1::2] - found[:, 2::2]) * (sigma_px / (2.0 * _STEP_PX))[:, None, None]
    cov = np.swapaxes(by_pixel, -1, -2) @ by_pixel
    point = np.where(np.isfinite(cov[:, 0, :1]), found[:, 0], np.nan)
    return LaserPoints(point, cov)


@dataclass(frozen=True, slots=True, eq=False)
class PlaneAxes:
    """Two axes in the laser plane, from where its light comes.

    They are across (image right) and along (away from the camera).

    Attributes:
        origin_m: (3,) [m], camera frame.
        axes: (2, 3) unit vectors.
    """

    origin_m: Float
    axes: Float

    @classmethod
    def of(cls, setup: WristSetup) -> "PlaneAxes":
        """Axes of a device."""
        across = np.array([1.0, 0.0, 0.0]) - setup.normal[0] * setup.normal
        across /= np.linalg.norm(across)
        along = np.cross(across, setup.normal)
        return cls(setup.laser_m, np.stack([across, along * np.sign(along[2])]))

    def flat(self, points_m: Float) -> Float:
        """Coordinates (..., 2) [m] of points (..., 3)."""
        return (points_m - self.origin_m) @ self.axes.T

    def space(self, flat_m: Float) -> Float:
        """Points (..., 3) [m], camera frame, of coordinates (..., 2)."""
        return self.origin_m + flat_m @ self.axes

    def flat_cov(self, cov_m2: Float) -> Float:
        """Covariances (..., 2, 2) of covariances (..., 3, 3)."""
        return self.axes @ cov_m2 @ self.axes.T
