"""Visible skin surface: rays of a grid against the hand, and its appearance.

While the wrist is straight the palm stands still in the picture: it is looked at once, and its gaps between bones are
filled up. Of a bent wrist that is done for every picture. Each part of a finger is looked for only inside the box of
its own image; so are the things that the hand holds, whose surface is as dark everywhere.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from common.arrays import Float, Int
from common.calibration.rig import flat_of
from common.geometry.tapered_capsules import Capsules, Plane, first_hits, terms
from common.sim.wrist.capsules import ALBEDO
from common.sim.wrist.scene import WristScene

_AROUND = (0, 0, 0, 1, 1, 2, 2, 2), (0, 1, 2, 0, 2, 0, 1, 2)  # corners and middles of a box
_ORIGIN = np.zeros(3)


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceView:
    """Seen skin (N,).

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


@dataclass(frozen=True, slots=True, eq=False)
class Palm:
    """Palm with no finger in front of it: its surface, and its depth (H * W,) [m]."""

    seen: SurfaceView
    depth: Plane


class HandSurface:
    """Grid and palm of one scene; holds the last palm by its flexion.

    Attributes:
        size: Of the grid, (W, H).
        flat: (H * W,) how the lens and the LEDs' lobes darken the corners.
        straight: The palm of a straight wrist.
    """

    def __init__(self, scene: WristScene, step: int, wrist_step_rad: float = 0.0) -> None:
        optics = scene.optics
        self._scene, self._step, self._wrist_step_rad = scene, step, wrist_step_rad
        self._flexed: tuple[tuple[int, ...], Palm] | None = None
        self.size = (-(-optics.width_px // step), -(-optics.height_px // step))
        columns, lines = (np.arange(n, dtype=np.float64) * step + 0.5 * (step - 1) for n in self.size)
        rays = optics.ray(np.stack(np.meshgrid(columns, lines), axis=-1)).reshape(-1, 3)
        self.flat = _flat_field(scene, rays).astype(np.float32)
        self._rays = np.ascontiguousarray(rays.T, dtype=np.float32)
        self._texture = _texture(np.random.default_rng([scene.seed, 41]))
        self._straight_bodies = scene.straight_bodies()
        self.straight = self._palm(self._straight_bodies, range(scene.capsules.still))
        # The forearm lies as it does whatever the wrist does; outside the picture nobody need look for it.
        forearm = scene.capsules.forearm.tolist()
        met = self._cast(self._straight_bodies, forearm, np.full(len(rays), np.inf, dtype=np.float32))
        outside = set(forearm) - set(np.unique(met).tolist())
        self._rotated = [body for body in range(scene.capsules.still) if body not in outside]

    def palm(self, bodies: Capsules, wrist_angles_rad: Float) -> Palm:
        """Palm of a hand at `bodies`, wrist flexed by (2,) [rad]; `straight` itself at 0."""
        if self._scene.capsules.same_palm(bodies, self._straight_bodies):
            return self.straight
        if self._wrist_step_rad <= 0.0:
            return self._palm(bodies, self._rotated)
        steps = tuple(np.rint(wrist_angles_rad / self._wrist_step_rad).astype(int).tolist())
        if self._flexed is None or self._flexed[0] != steps:
            rounded = self._scene.straight_bodies(self._wrist_step_rad * np.array(steps))
            self._flexed = steps, self._palm(rounded, self._rotated)
        return self._flexed[1]

    def appearance(self, bodies: Capsules, palm: Palm) -> SurfaceView:
        """Visible surface of fingers, thumb and things in front of the palm."""
        depth = palm.depth.copy()
        hit = self._cast(bodies, range(self._scene.capsules.still, len(bodies.start_m)), depth)
        return self._view(bodies, np.flatnonzero(hit >= 0), hit, depth)

    def _palm(self, bodies: Capsules, which: Iterable[int]) -> Palm:
        depth = np.full(self._rays.shape[1], np.inf, dtype=np.float32)
        hit = self._cast(bodies, which, depth)
        return Palm(self._smooth(self._view(bodies, np.flatnonzero(hit >= 0), hit, depth)), depth)

    def _view(self, bodies: Capsules, pixel: Int, hit: Int, depth: Plane) -> SurfaceView:
        points = np.ascontiguousarray((self._rays[:, pixel] * depth[pixel]).T)
        body = hit[pixel]
        normals = bodies.normals(body, points)
        return SurfaceView(pixel, points, normals, self._albedo(bodies, body, points, normals))

    def _cast(self, bodies: Capsules, which: Iterable[int], depth: Plane) -> Int:
        """Lower `depth` (H * W,) [m] where a body is nearer; return that body, -1: none."""
        low, high = self._boxes(bodies)
        known = terms(bodies, _ORIGIN, np.float32)
        shape = self.size[::-1]
        hit = np.full(shape, -1, dtype=np.int64)
        near, rays = depth.reshape(shape), self._rays.reshape(3, *shape)
        for b in which:
            (x0, y0), (x1, y1) = low[b], high[b]
            if x0 >= x1 or y0 >= y1:  # outside the picture
                continue
            box = slice(y0, y1), slice(x0, x1)
            found = first_hits(known[:, b], rays[:, *box])
            nearer = found < near[box]
            np.copyto(near[box], found, where=nearer)
            np.copyto(hit[box], b, where=nearer)
        return hit.ravel()

    def _boxes(self, bodies: Capsules) -> tuple[Int, Int]:
        """Corners (B, 2) of the boxes on the grid that hold the images of the bodies."""
        centre = np.stack([bodies.start_m, bodies.stop_m], axis=1)
        square = np.stack([bodies.start_radius_m, bodies.stop_radius_m], axis=1) ** 2
        x, z = centre[..., :2], np.maximum(centre[..., 2:], 0.0)
        gap = z[..., 0] ** 2 - square
        nearest_m = 0.01  # a body that comes nearer may be anywhere in the picture
        whole = np.min(gap, axis=1) < nearest_m**2
        # Where planes through the lens touch a sphere, by column and by row.
        gap = np.maximum(gap, nearest_m**2)[..., None]
        half = np.sqrt(square[..., None] * np.maximum(x * x + gap, 0.0))
        low, high = ((x * z + sign * half) / gap for sign in (-1.0, 1.0))
        # Beyond the picture the polynomial of the lens means nothing.
        sides = np.clip(
            np.stack([low.min(axis=1), 0.5 * (low + high).mean(axis=1), high.max(axis=1)]), -1.2, 1.2
        )
        around = np.stack([sides[list(at), :, axis] for axis, at in enumerate(_AROUND)], axis=-1)
        uv = self._scene.optics.distort(around) / self._step
        margin = 1.5  # of the boxes, on the grid
        first, last = uv.min(axis=0) - margin, uv.max(axis=0) + margin + 1.0
        first[whole], last[whole] = 0.0, np.inf
        size = np.array(self.size)
        return np.clip(first, 0, size).astype(np.int64), np.clip(last, 0, size).astype(np.int64)

    def _albedo(self, bodies: Capsules, body: Int, points: Plane, normals: Plane) -> Plane:
        """Albedo of skin and things; things are even.

        Skin never is: blotches stay on their body, dark lines go across it where a joint is.
        """
        axis = bodies.stop_m - bodies.start_m
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        aside = np.eye(3)[0] - axis[:, :1] * axis  # across the body, whichever way it is bent
        table = np.concatenate([bodies.start_m, axis, aside * bodies.start_radius_m[:, None]], axis=1)
        own = table.astype(np.float32)[body]
        along = np.einsum("ij,ij->i", points - own[:, :3], own[:, 3:6])
        across = np.einsum("ij,ij->i", normals, own[:, 6:])
        texels_per_m = 2000.0
        row, column = ((x * np.float32(texels_per_m)).astype(np.int32) for x in (along, across))
        last = self._texture.shape[0] - 1
        texture = self._texture[row & last, (column + 37 * body) & last]
        crease_m, crease_depth = 0.0008, 0.08
        albedo = texture * (1.0 - crease_depth * np.exp(-((along / np.float32(crease_m)) ** 2)))
        # Things give back what they do, however bright the skin of this hand is.
        albedo[body >= len(self._scene.capsules.group)] = ALBEDO / self._scene.reflectance
        return albedo

    def _smooth(self, palm: SurfaceView) -> SurfaceView:
        """Fill the gaps between the bones as flesh does: normals of the smoothed surface."""
        if not len(palm.pixel):  # bent out of the picture
            return palm
        width, height = self.size
        palm_smooth_px = 9.0  # about 2 mm at the palm's distance
        sigma = palm_smooth_px / self._step
        cloud = np.zeros((height, width, 4), dtype=np.float32)
        cloud.reshape(-1, 4)[palm.pixel] = np.column_stack(
            [palm.normals, np.ones(len(palm.pixel), np.float32)]
        )
        # Beyond the palm nothing is asked for: the blur need not go further than it reaches from there.
        reach = int(4.0 * sigma) + 2
        lines, columns = np.divmod(palm.pixel, width)
        x0, y0, w, h = cv2.boundingRect(np.stack([columns, lines], axis=1).astype(np.int32))
        box = np.s_[max(y0 - reach, 0) : y0 + h + reach, max(x0 - reach, 0) : x0 + w + reach]
        cloud[box] = cv2.GaussianBlur(cloud[box], (0, 0), sigma)
        smooth = cloud.reshape(-1, 4)[palm.pixel]
        normals = smooth[:, :3] / np.maximum(smooth[:, 3:], 1e-3)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return SurfaceView(palm.pixel, palm.points, normals, palm.albedo)


def _flat_field(scene: WristScene, rays: Float) -> Float:
    """The rig file's brightness along rays (N, 3); 1 where the file states nothing."""
    if scene.rig.flat_field is None:
        return np.ones(len(rays))
    return flat_of(scene.rig.flat_field, rays[:, :2] / rays[:, 2:])


def _texture(rng: np.random.Generator) -> Plane:
    """Skin's brightness (256, 256), about 1; half a millimetre a texel, closed."""
    out = np.ones((256, 256), dtype=np.float32)
    for sigma, depth in ((1.0, 0.03), (5.0, 0.03), (20.0, 0.04)):
        noise = np.tile(rng.standard_normal((256, 256), dtype=np.float32), (2, 2))
        part = np.asarray(cv2.GaussianBlur(noise, (0, 0), sigma), dtype=np.float32)[128:384, 128:384]
        out += depth * part / float(part.std())
    return np.clip(out, 0.7, 1.3)
