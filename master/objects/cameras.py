"""All cameras of a rig laid out by observation.

They give where each sees its point, and how that changes with the point.

What a fit asks for in each of its rounds with the same cameras is looked up once (`Views`).
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float, Int
from common.geometry.camera_model import CameraModel


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """The cameras of n observations, and the radii of the balls that they see.

    Attributes:
        R, t: (n, 3, 3), (n, 3) of `T_camera_rig`.
        lens: (5, n) k1, k2, p1, p2, k3.
        focal, centre: (n, 2) [px].
        radius_2: (n,) squares of the radii [m^2], 0: a point.
    """

    R: Float
    t: Float
    lens: Float
    focal: Float
    centre: Float
    radius_2: Float

    def see(self, points: Float) -> tuple[Float, Float, Float]:
        """Project points (n, 3) [m] into the cameras.

        For balls about the points it is the middles of their outlines.

        An ellipse, the outline of a ball of radius r at (x, y, z), has its middle at (x, y) z / (z^2 - r^2).

        Returns:
            Pixels (n, 2); their derivatives (n, 2, 3) [px/m] by the points, rig frame; depth (n,) [m]. NaN: behind.
        """
        own = (self.R @ points[..., None])[..., 0] + self.t
        before_m = 1e-3  # a point nearer to the plane of a camera than this is not before it
        z = np.where(own[:, 2] > before_m, own[:, 2], np.nan)
        z = z - self.radius_2 / z
        xy = own[:, :2] / z[:, None]
        k1, k2, p1, p2, k3 = self.lens
        x, y = xy.T
        xx, yy = x * x, y * y
        r2 = xx + yy
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        radial_derivative = 2.0 * k1 + r2 * (4.0 * k2 + r2 * (6.0 * k3))
        two_xy = 2.0 * x * y
        uv = np.empty_like(xy)
        uv[:, 0] = x * radial + p1 * two_xy + p2 * (r2 + 2.0 * xx)
        uv[:, 1] = y * radial + p1 * (r2 + 2.0 * yy) + p2 * two_xy
        # The tangential part turns the derivative by less than 1 % and is neglected in it.
        by_own = np.empty((len(xy), 2, 3))
        scale = self.focal / z[:, None]
        by_own[:, 0, 0] = radial_derivative * xx + radial
        by_own[:, 1, 1] = radial_derivative * yy + radial
        by_own[:, 0, 1] = by_own[:, 1, 0] = 0.5 * radial_derivative * two_xy
        by_own[..., :2] *= scale[..., None]
        by_own[..., 2] = -by_own[..., 0] * x[:, None] - by_own[..., 1] * y[:, None]
        return uv * self.focal + self.centre, by_own @ self.R, z


class Cameras:
    """The cameras of a rig. Holds no state between calls."""

    def __init__(self, cameras: tuple[CameraModel, ...]) -> None:
        """Lay them out."""
        self._R = np.array([c.T_camera_rig[:3, :3] for c in cameras])
        self._t = np.array([c.T_camera_rig[:3, 3] for c in cameras])
        self._lens = np.array([c.distortion for c in cameras]).T
        self._focal = np.array([c.matrix[[0, 1], [0, 1]] for c in cameras])
        self._centre = np.array([c.matrix[:2, 2] for c in cameras])

    def of(self, camera: Int, radius_m: Float) -> Views:
        """Those of observations (n,), of balls of radii (n,) [m]."""
        return Views(
            self._R[camera],
            self._t[camera],
            self._lens[:, camera],
            self._focal[camera],
            self._centre[camera],
            radius_m * radius_m,
        )
