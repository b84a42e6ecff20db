"""From pixels to points by the depth model of the rig, and whether the rays of each marker meet.

The one place that knows both models: triangulation by all cameras, or a law of disparity on the first two.
"""

from dataclasses import dataclass
from math import pi, sqrt

import numpy as np

from common.arrays import Bool, Float, Int
from common.calibration import RigCalibration
from common.camera_model import CameraModel
from master.stereo.depth import DepthLaw, position_at_depth
from master.stereo.misfit import limits, misfit_of_rays, misfit_of_rows, row_sigma
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


@dataclass(frozen=True, slots=True)
class CalibrationResidual:
    """What a calibration is known to leave, as its provenance says.

    Attributes:
        rays_px: RMS reprojection error of the cameras together [px]: a bound on what lens and pose are wrong by at one
            place. How much of it was the noise of the corners cannot be told afterwards.
        law: Relative error of the depth law, standard deviation.
    """

    rays_px: float = 0.0
    law: float = 0.0

    @classmethod
    def of(cls, rig: RigCalibration) -> "CalibrationResidual":
        """What the rig's file states; 0 where it states nothing, as for files typed in by hand."""
        rays = rig.provenance.get("T_rig_camera")
        law = None if rig.depth_model == "stereo" else rig.provenance.get(rig.depth_model)
        left = {} if law is None else law.residual
        mean_percent = left.get("leave_one_out_mean_percent", left.get("mean_percent", 0.0))
        return cls(
            rays_px=0.0 if rays is None else rays.residual.get("rms_px", 0.0),
            law=1e-2
            * mean_percent
            * sqrt(pi / 2),  # of a mean of absolute errors that are normally distributed
        )


EXACT = CalibrationResidual()


class Placement:
    """The depth model of one rig. Holds no state between calls."""

    def __init__(
        self,
        cameras: tuple[CameraModel, ...],
        law: DepthLaw | None,
        residual: CalibrationResidual = EXACT,
    ) -> None:
        """Prepare what is the same in every frame.

        Args:
            cameras: In the rig's order.
            law: Depth from disparity of the first two cameras; None: triangulate all cameras.
            residual: What the calibration is known to leave.
        """
        self._cameras, self._law, self._residual = cameras, law, residual
        self._triangulator = Triangulator.of(cameras)
        self._limits = limits(len(cameras))
        self._row_sigma_px = row_sigma(cameras)

    def __call__(self, uv: Float, sigma_px: Float) -> Placed:
        """Place markers seen at (C, M, 2) [px] with standard deviations (C, M) [px]; NaN: not seen."""
        sure_px = np.hypot(sigma_px, self._residual.rays_px)
        if self._law is not None:
            return self._by_law(self._law, uv, sigma_px, sure_px)
        found = self._triangulator.triangulate(uv, sure_px)
        misfit = misfit_of_rays(found.error_px2, sigma_px)
        return Placed(found.points, found.covariance, found.gain, misfit, self._limits[found.views])

    def roughly(self, uv: Float, sigma_px: Float) -> Float:
        """Points (M, 3) [m], good enough to tell from which side each camera looks at them; as `__call__`."""
        if self._law is not None:
            return position_at_depth(self._cameras[0], uv[0], self._law.depth(uv[0, :, 0] - uv[1, :, 0]))
        return self._triangulator.roughly(uv, sigma_px)

    def _by_law(self, law: DepthLaw, uv: Float, sigma_px: Float, sure_px: Float) -> Placed:
        camera = self._cameras[0]
        depth = law.depth(uv[0, :, 0] - uv[1, :, 0])
        points = position_at_depth(camera, uv[0], depth)
        ray = (points - camera.centre) / depth[:, None]
        gain = np.zeros((len(points), 3, 2 * len(uv)))
        across = camera.T_rig_camera[:3, :2] / camera.matrix[[0, 1], [0, 1]]
        gain[:, :, :2] = depth[:, None, None] * across
        per_px = law.metres_per_pixel(depth)[:, None] * ray  # less for more disparity
        gain[:, :, 0] -= per_px
        gain[:, :, 2] += per_px
        noise = gain[:, :, :4] * np.repeat(sure_px[:2].T, 2, axis=1)[:, None]
        misplaced = self._residual.law * (points - camera.centre)
        cov = noise @ noise.swapaxes(1, 2) + misplaced[:, :, None] * misplaced[:, None, :]
        misfit = misfit_of_rows(uv, sigma_px, self._row_sigma_px)
        return Placed(points, cov, gain, misfit, np.full(len(points), self._limits[2]))

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
