"""Geometric camera model: point -> pixel and pixel -> ray, OpenCV's distortion."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import cast

import cv2
import numpy as np

from common.arrays import Float
from common.calibration import CameraCalibration
from common.errors import CalibrationError
from common.geometry.lens import Lens, contraction, undistorted
from common.geometry.transforms import invert

_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-10)


@dataclass(frozen=True, slots=True, eq=False)
class CameraModel:
    """Intrinsics and place of one camera.

    Attributes:
        matrix: Camera matrix (3, 3) [px].
        distortion: k1, k2, p1, p2, k3 (5,).
        T_rig_camera, T_camera_rig: Camera frame -> rig frame (4, 4) [m], and its inverse.
        row_time_ns: Time from one row to the next [ns] (rolling shutter; 0: global).
        steep: The lens, where OpenCV's iteration does not find the way back from all of the picture (it does not
            converge where the distortion rises steeply, as at the corners of some wide-angle lenses); else None.
    """

    matrix: Float
    distortion: Float
    T_rig_camera: Float
    width_px: int
    height_px: int
    row_time_ns: float
    T_camera_rig: Float = field(init=False)
    steep: Lens | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_camera_rig", invert(self.T_rig_camera))
        (fx, _, cx), (_, fy, cy), _ = self.matrix.tolist()
        k1, k2, p1, p2, k3 = self.distortion.tolist()
        lens = Lens((self.width_px, self.height_px), (fx, fy), (cx, cy), (k1, k2, p1, p2, k3))
        converges = 0.5  # 30 steps of the iteration then leave a billionth of what the lens bends
        if contraction(lens) > converges:
            object.__setattr__(self, "steep", lens)

    @classmethod
    def of(cls, camera: CameraCalibration, T_rig_camera: Float) -> "CameraModel":
        """Build from a camera file, which must have intrinsics, else CalibrationError."""
        k = camera.intrinsics
        if k is None:
            raise CalibrationError(
                f"camera {camera.name!r} has no 'intrinsics': its file needs fx_px, fy_px, cx_px, cy_px and distortion"
            )
        matrix = np.array([[k.fx_px, 0.0, k.cx_px], [0.0, k.fy_px, k.cy_px], [0.0, 0.0, 1.0]])
        return cls(
            matrix=matrix,
            distortion=np.array(k.distortion, dtype=np.float64),
            T_rig_camera=np.asarray(T_rig_camera, dtype=np.float64),
            width_px=camera.width_px,
            height_px=camera.height_px,
            row_time_ns=camera.row_time_us * 1e3,
        )

    @property
    def centre(self) -> Float:
        """Optical centre (3,) [m], rig frame."""
        return self.T_rig_camera[:3, 3]

    def project(self, points: Float) -> Float:
        """Pixels (..., 2) in the distorted image of points (..., 3) [m] in the rig frame.

        NaN where the point is NaN or not in front of the camera.
        """
        camera = np.asarray(points, dtype=np.float64) @ self.T_camera_rig[:3, :3].T + self.T_camera_rig[:3, 3]
        z = np.where(camera[..., 2:] > 1e-9, camera[..., 2:], np.nan)
        return self.distort(camera[..., :2] / z)

    def distort(self, normalized: Float) -> Float:
        """Pixels (..., 2) of normalized image points (..., 2) (x/z, y/z)."""
        k1, k2, p1, p2, k3 = self.distortion.tolist()
        (fx, _, cx), (_, fy, cy), _ = self.matrix.tolist()
        x, y = normalized[..., 0], normalized[..., 1]
        xx, yy, xy = x * x, y * y, 2.0 * x * y
        r2 = xx + yy
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        out = np.empty(normalized.shape)
        out[..., 0] = fx * (x * radial + p1 * xy + p2 * (r2 + 2.0 * xx)) + cx
        out[..., 1] = fy * (y * radial + p1 * (r2 + 2.0 * yy) + p2 * xy) + cy
        return out

    def undistort(self, uv: Float) -> Float:
        """Normalized image points (..., 2) (x/z, y/z) of pixels (..., 2); NaN stays NaN."""
        uv = np.asarray(uv, dtype=np.float64)
        if uv.size == 0:
            return uv.copy()
        if self.steep is not None:
            seen = (uv.reshape(-1, 2) - self.matrix[:2, 2]) / self.matrix[[0, 1], [0, 1]]
            return undistorted(self.steep, seen).reshape(uv.shape)
        points = _undistort(np.ascontiguousarray(uv.reshape(-1, 1, 2)), self.matrix, self.distortion)
        return np.where(np.isnan(uv), np.nan, points.reshape(uv.shape))

    def ray(self, uv: Float) -> Float:
        """Unit ray directions (..., 3) through pixels (..., 2), rig frame; NaN stays NaN."""
        xy = self.undistort(uv)
        direction = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
        direction = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
        return direction @ self.T_rig_camera[:3, :3].T


def _undistort(uv: Float, matrix: Float, distortion: Float) -> Float:
    """Run `cv2.undistortPoints` to convergence (OpenCV 4: `undistortPointsIter`)."""
    of_opencv_4 = cast(Callable[..., Float] | None, getattr(cv2, "undistortPointsIter", None))
    if of_opencv_4 is not None:
        return of_opencv_4(uv, matrix, distortion, None, None, _CRITERIA)
    return np.asarray(cv2.undistortPoints(uv, matrix, distortion, criteria=_CRITERIA), dtype=np.float64)
