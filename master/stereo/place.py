"""From pixels to points by the rays of all cameras, and whether the rays of each marker meet."""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.camera_model import CameraModel
from master.fabrik.depth import EXACT, CalibrationResidual
from master.fabrik.intersection import limits_of
from master.stereo.misfit import misfit_of_rays
from master.stereo.triangulate import Triangulator


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """Points and how well they are known.

    Attributes:
        points: (M, 3) [m], rig frame; NaN: not determined.
        cov: (M, 3, 3) [m^2] from the noise of the centroids and what the calibration leaves.
        gain: (M, 3, 2 C) [m/px] by how much each point moves with each u, v, u, v ... of the cameras.
        misfit: (M,) chi square of the rays' distances.
        limit: (M,) misfit above which they are not rays of one point.
    """

    points: Float
    cov: Float
    gain: Float
    misfit: Float
    limit: Float

    def apart(self, uv: Float) -> Bool:
        """(M,) markers that two cameras see, but whose rays do not meet: one camera saw something else."""
        met = np.isfinite(self.points[:, 0]) & (self.misfit <= self.limit)
        return (np.isfinite(uv[..., 0]).sum(axis=0) >= 2) & ~met


class Placement:
    """Triangulates by the cameras of one rig. Holds no state between calls."""

    def __init__(self, cameras: tuple[CameraModel, ...], residual: CalibrationResidual = EXACT) -> None:
        """Prepare what is the same in every frame.

        Args:
            cameras: In the rig's order.
            residual: What the calibration is known to leave.
        """
        self._cameras, self._residual = cameras, residual
        self._triangulator = Triangulator.of(cameras)
        self._limits = limits_of(len(cameras))

    def __call__(self, uv: Float, sigma_px: Float) -> Placed:
        """Place markers seen at (C, M, 2) [px] with standard deviations (C, M) [px]; NaN: not seen."""
        sure_px = np.hypot(sigma_px, self._residual.rays_px)
        found = self._triangulator.triangulate(uv, sure_px)
        misfit = misfit_of_rays(found.error_px2, sigma_px)
        return Placed(found.points, found.covariance, found.gain, misfit, self._limits[found.views])

    def roughly(self, uv: Float, sigma_px: Float) -> Float:
        """Points (M, 3) [m], good enough to tell from which side each camera looks at them; as `__call__`."""
        return self._triangulator.roughly(uv, sigma_px)

    def put(self, points: Float, markers: Int, view: Int, uv: Float, near: Float) -> None:
        """Put markers on the rays of single cameras: `points` (M, 3) is changed.

        Args:
            points: Points of all markers [m].
            markers: (K,) which are put.
            view: (K,) camera of each.
            uv: (K, 2) where it sees them [px].
            near: (M, 3) points as far away as the markers are believed to be [m].
        """
        for k, marker in enumerate(markers):
            camera = self._cameras[int(view[k])]
            points[marker] = camera.centre + np.linalg.norm(near[marker] - camera.centre) * camera.ray(uv[k])


def ray_covariance(sight: Float, across: Float, along: Float) -> Float:
    """Covariances (N, 3, 3) [m^2] of points seen along `sight` (N, 3), from two standard deviations (N,) [m]."""
    direction = sight / np.linalg.norm(sight, axis=1, keepdims=True)
    outer = direction[:, :, None] * direction[:, None, :]
    return across[:, None, None] ** 2 * (np.eye(3) - outer) + along[:, None, None] ** 2 * outer
