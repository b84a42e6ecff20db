"""From pixels to points by the depth model of the rig, and whether the rays of each marker meet.

The one place that knows both models: triangulation by all cameras, or a law of disparity on the first two.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float, Int
from common.camera_model import CameraModel
from master.stereo.depth import DepthLaw, position_at_depth
from master.stereo.misfit import limits, misfit_of_rays, misfit_of_rows, row_sigma
from master.stereo.triangulate import Triangulator


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """Points and how well they are known.

    Attributes:
        points: (M, 3) [m], rig frame; NaN: not determined.
        cov: (M, 3, 3) [m^2].
        misfit: (M,) chi square of the rays' distances.
        limit: (M,) misfit above which they are not rays of one point.
    """

    points: Float
    cov: Float
    misfit: Float
    limit: Float


class Placement:
    """The depth model of one rig. Holds no state between calls."""

    def __init__(self, cameras: tuple[CameraModel, ...], law: DepthLaw | None) -> None:
        """Prepare what is the same in every frame.

        Args:
            cameras: In the rig's order.
            law: Depth from disparity of the first two cameras; None: triangulate all cameras.
        """
        self._cameras, self._law = cameras, law
        self._triangulator = Triangulator.of(cameras)
        self._limits = limits(len(cameras))
        self._row_sigma_px = row_sigma(cameras)

    def __call__(self, uv: Float, sigma_px: Float) -> Placed:
        """Place markers seen at (C, M, 2) [px] with standard deviations (C, M) [px]; NaN: not seen."""
        if self._law is not None:
            return self._by_law(self._law, uv, sigma_px)
        found = self._triangulator.triangulate(uv, sigma_px)
        misfit = misfit_of_rays(found.error_px2, sigma_px)
        return Placed(found.points, found.covariance, misfit, self._limits[found.views])

    def roughly(self, uv: Float, sigma_px: Float) -> Float:
        """Points (M, 3) [m], good enough to tell from which side each camera looks at them; as `__call__`."""
        if self._law is not None:
            return position_at_depth(self._cameras[0], uv[0], self._law.depth(uv[0, :, 0] - uv[1, :, 0]))
        return self._triangulator.roughly(uv, sigma_px)

    def _by_law(self, law: DepthLaw, uv: Float, sigma_px: Float) -> Placed:
        camera = self._cameras[0]
        depth = law.depth(uv[0, :, 0] - uv[1, :, 0])
        points = position_at_depth(camera, uv[0], depth)
        along = law.metres_per_pixel(depth) * np.hypot(sigma_px[0], sigma_px[1])
        across = depth / camera.matrix[0, 0] * sigma_px[0]
        cov = ray_covariance(points - camera.centre, across, along)
        misfit = misfit_of_rows(uv, sigma_px, self._row_sigma_px)
        return Placed(points, cov, misfit, np.full(len(points), self._limits[2]))

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
