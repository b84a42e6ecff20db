"""What skin the camera sees where: rays of a grid against the flesh, and what the skin there looks like.

The palm stands still in the picture: its depth, normals and lines are found once. Each part of a finger is looked for
only inside the box of its own image.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from common.arrays import Float, Int
from common.sim.wrist.cones import Cones, distances
from common.sim.wrist.light import Plane
from common.sim.wrist.scene import WristScene

CREASE_M = 0.0007
MARGIN_PX = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class SkinView:
    """The seen skin of one instant (N,).

    Attributes:
        pixel: Flat index in the grid.
        points: (N, 3) [m], camera frame.
        normals: (N, 3) out of the skin.
        albedo: (N,) brightness against plain skin.
    """

    pixel: Int
    points: Plane
    normals: Plane
    albedo: Plane


class Skin:
    """The grid and the palm of one scene. What it holds was prepared by the constructor."""

    def __init__(self, scene: WristScene, step: int) -> None:
        optics = scene.optics
        self._scene, self._step = scene, step
        self.size = (-(-optics.width_px // step), -(-optics.height_px // step))
        u, v = np.meshgrid(*(np.arange(n) * step + 0.5 * (step - 1) for n in self.size))
        rays = optics.ray(np.stack([u, v], axis=-1))
        self._rays = rays.astype(np.float32)
        self._flat = _flat_field(scene, rays).astype(np.float32).ravel()
        joints = scene.joints_at(0.0)
        flesh = scene.flesh
        self._still_depth = np.full(self.size[::-1], np.inf, dtype=np.float32)
        self._still_body = np.zeros(self.size[::-1], dtype=np.int64)
        self._cast(flesh.bodies(joints), range(flesh.still), self._still_depth, self._still_body)
        rng = np.random.default_rng([scene.seed, 41])
        self._texture = _texture(rng)

    def flat(self, pixel: Int) -> Plane:
        """How the lens darkens its corners, at flat indices (N,) of the grid."""
        return self._flat[pixel]

    def look(self, bodies: Cones) -> SkinView:
        """The seen skin of a hand whose flesh is at `bodies`."""
        depth, body = self._still_depth.copy(), self._still_body.copy()
        self._cast(bodies, range(self._scene.flesh.still, len(bodies.start_m)), depth, body)
        pixel = np.flatnonzero(np.isfinite(depth))
        points = self._rays.reshape(-1, 3)[pixel] * depth.reshape(-1)[pixel, None]
        index = body.reshape(-1)[pixel]
        normals = bodies.normals(index, points).astype(np.float32)
        return SkinView(pixel, points, normals, self._albedo(bodies, index, points))

    def _cast(self, bodies: Cones, which: range, depth: Plane, body: Int) -> None:
        """Bring nearer (H, W) `depth` [m] along the rays, and whose it is, by bodies in their boxes."""
        low, high = self._boxes(bodies)
        for b in which:
            (x0, y0), (x1, y1) = low[b], high[b]
            if x1 <= x0 or y1 <= y0:
                continue
            rays = self._rays[y0:y1, x0:x1].reshape(-1, 3)
            found = distances(bodies.of(slice(b, b + 1)), np.zeros(3), rays).reshape(y1 - y0, x1 - x0)
            here = depth[y0:y1, x0:x1]
            nearer = found < here
            np.copyto(here, found, where=nearer)
            body[y0:y1, x0:x1][nearer] = b

    def _boxes(self, bodies: Cones) -> tuple[Int, Int]:
        """Corners (B, 2) of the boxes on the grid that hold the images of the bodies."""
        optics = self._scene.optics
        centre = np.stack([bodies.start_m, bodies.stop_m], axis=1)
        radius = np.stack([bodies.start_radius_m, bodies.stop_radius_m], axis=1)
        gap = np.maximum(centre[..., 2] - radius, 0.005)
        spread = optics.matrix[0, 0] * radius / gap * 1.15 + MARGIN_PX
        near = np.maximum(centre[..., 2:], 0.01)
        uv = np.clip(optics.distort(np.clip(centre[..., :2] / near, -1.5, 1.5)), -2000.0, 3000.0)
        behind = (centre[..., 2] - radius < 0.01).any(axis=1)
        low = np.where(behind[:, None], 0.0, (uv - spread[..., None]).min(axis=1)) / self._step
        high = np.where(behind[:, None], 1e4, (uv + spread[..., None]).max(axis=1)) / self._step + 1.0
        size = np.array(self.size)
        return np.clip(low, 0, size).astype(np.int64), np.clip(high, 0, size).astype(np.int64)

    def _albedo(self, bodies: Cones, body: Int, points: Plane) -> Plane:
        """Skin is never even: blotches that stay on their body, and dark lines across it at the joints."""
        axis = (bodies.stop_m - bodies.start_m).astype(np.float32)
        length = np.sqrt((axis * axis).sum(axis=1))
        along = np.einsum(
            "ij,ij->i", points - bodies.start_m.astype(np.float32)[body], (axis / length[:, None])[body]
        )
        side = points[:, 0] * np.float32(2000.0)
        n = self._texture.shape[0] - 1
        texture = self._texture[
            (along * 2000.0).astype(np.int64) & n, (side.astype(np.int64) + 37 * body) & n
        ]
        texture *= 1.0 - 0.22 * np.exp(-((along / CREASE_M) ** 2))
        return texture


def _flat_field(scene: WristScene, rays: Float) -> Float:
    """What the rig's file says of the brightness across the image, at rays (..., 3); 1 where it says nothing."""
    if scene.rig.flat_field is None:
        return np.ones(rays.shape[:-1])
    x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    total, degree, used = np.zeros(x.shape), 0, 0
    while used < len(scene.rig.flat_field.coefficients):
        for k in range(degree + 1):
            total += scene.rig.flat_field.coefficients[used + k] * x ** (degree - k) * y**k
        degree, used = degree + 1, used + degree + 1
    return np.maximum(total, 0.02)


def _texture(rng: np.random.Generator) -> Plane:
    """Brightness of skin (256, 256) about 1, half a millimetre a texel, closed at its edges."""
    out = np.ones((256, 256), dtype=np.float32)
    for sigma, depth in ((1.0, 0.03), (5.0, 0.03), (20.0, 0.04)):
        noise = cv2.GaussianBlur(
            np.tile(rng.standard_normal((256, 256), dtype=np.float32), (2, 2)), (0, 0), sigma
        )
        part = noise[128:384, 128:384]
        out += depth * part / float(part.std())
    return np.clip(out, 0.7, 1.3)
