"""All cameras of a rig at once: what `CameraModel` does for one, in one pass of numpy, whose price hardly rises with
their number.

Pixels to rays is the inverse of a polynomial. Newton's method finds it from the pixel itself; the derivative of what
OpenCV's distortion does is symmetric. What does not settle, or settles where the image is folded over (a determinant
below zero), is left to `CameraModel.undistort`. Of a few cameras that is faster anyway.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from common.arrays import Float
from common.camera_model import CameraModel

_FEW = 5  # cameras that are faster asked one after the other
_STEPS = 8
_SETTLED = 1e-7  # normalised: the error after such a step is its square, about


@dataclass(frozen=True, slots=True, eq=False)
class Together:
    """C cameras, laid out along the first axis.

    Attributes:
        cameras: In the order of that axis.
        centre: Optical centres (C, 3) [m], rig frame.
        scale: Pixels of a step of one in the normalised image (C,), the mean of both axes.
        rotation, translation: rig -> camera, (C, 3, 3) transposed and (C, 1, 3) [m].
        focal, principal: fx, fy and cx, cy (C, 1, 2) [px].
        distortion: k1, k2, p1, p2, k3, each (C, 1).
    """

    cameras: tuple[CameraModel, ...]
    centre: Float
    scale: Float
    rotation: Float
    translation: Float
    focal: Float
    principal: Float
    distortion: tuple[Float, Float, Float, Float, Float]

    @classmethod
    def of(cls, cameras: Sequence[CameraModel]) -> "Together":
        """Lay them out."""
        inverse = np.stack([camera.T_camera_rig for camera in cameras])
        matrix = np.stack([camera.matrix for camera in cameras])
        k1, k2, p1, p2, k3 = np.stack([camera.distortion for camera in cameras], axis=1)[..., None]
        return cls(
            cameras=tuple(cameras),
            centre=np.stack([camera.centre for camera in cameras]),
            scale=np.sqrt(matrix[:, 0, 0] * matrix[:, 1, 1]),
            rotation=np.ascontiguousarray(inverse[:, :3, :3].swapaxes(1, 2)),
            translation=inverse[:, None, :3, 3],
            focal=matrix[:, [0, 1], [0, 1]][:, None],
            principal=matrix[:, None, :2, 2],
            distortion=(k1, k2, p1, p2, k3),
        )

    def project(self, points: Float) -> Float:
        """Pixels (C, N, 2) in the distorted images of points (C, N, 3) [m], rig frame, each of its own camera.

        NaN where the point is NaN or not in front of the camera.
        """
        placed = points @ self.rotation + self.translation
        z = placed[..., 2]
        z = np.where(z > 1e-9, z, np.nan)
        k1, k2, p1, p2, k3 = self.distortion
        x, y = placed[..., 0] / z, placed[..., 1] / z
        xx, yy, xy = x * x, y * y, 2.0 * x * y
        r2 = xx + yy
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        out = np.empty((*x.shape, 2))
        out[..., 0] = x * radial + p1 * xy + p2 * (r2 + 2.0 * xx)
        out[..., 1] = y * radial + p1 * (r2 + 2.0 * yy) + p2 * xy
        out *= self.focal
        out += self.principal
        return out

    def undistort(self, uv: Float) -> Float:
        """Normalised image points (C, M, 2) (x/z, y/z) of pixels (C, M, 2); NaN stays NaN."""
        if len(self.cameras) < _FEW:
            return np.stack([one.undistort(seen) for one, seen in zip(self.cameras, uv, strict=True)])
        seen = (uv - self.principal) / self.focal
        unseen = np.isnan(seen)
        found, settled = self._newton(np.where(unseen, 0.0, seen))
        found[unseen] = np.nan
        if not settled.all():
            for c in np.flatnonzero(~settled.all(axis=1)):
                found[c] = self.cameras[c].undistort(uv[c])
        return found

    def _newton(self, seen: Float) -> tuple[Float, np.ndarray]:
        """Points (C, M, 2) that are distorted to the points `seen`, all finite; and which of them are (C, M)."""
        k1, k2, p1, p2, k3 = self.distortion
        u, v = seen[..., 0], seen[..., 1]
        x, y = u.copy(), v.copy()
        settled = np.zeros(x.shape, np.bool_)
        for _ in range(_STEPS):
            xx, yy, xy = x * x, y * y, 2.0 * x * y
            r2 = xx + yy
            radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3)))  # of radial, by r^2, twice
            a = radial + slope * xx + 2.0 * p1 * y + 6.0 * p2 * x
            b = 0.5 * slope * xy + 2.0 * (p1 * x + p2 * y)
            d = radial + slope * yy + 6.0 * p1 * y + 2.0 * p2 * x
            off_x = u - (x * radial + p1 * xy + p2 * (r2 + 2.0 * xx))
            off_y = v - (y * radial + p1 * (r2 + 2.0 * yy) + p2 * xy)
            determinant = a * d - b * b
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                step_x, step_y = (d * off_x - b * off_y) / determinant, (a * off_y - b * off_x) / determinant
                x, y = x + step_x, y + step_y
            small = np.maximum(np.abs(step_x), np.abs(step_y)) < _SETTLED
            settled = small & (determinant > 0.0) & (radial > 0.0)
            if small.all():
                break
        return np.stack([x, y], axis=-1), settled


@lru_cache(maxsize=64)
def together(cameras: tuple[CameraModel, ...]) -> Together:
    """These cameras laid out; once for the same ones."""
    return Together.of(cameras)
