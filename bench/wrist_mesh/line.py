"""The laser line on the mesh: where rays of the fan first meet it, and which of that the camera sees."""

from dataclasses import dataclass

import numpy as np

from bench.wrist_mesh.hand_mesh import HandMesh, Posed
from bench.wrist_mesh.raster import Samples
from common.arrays import Bool, Float, Int
from common.calibration import RigCalibration
from common.geometry.camera_model import CameraModel
from common.kernels import kernel

RAYS = 12288  # 0.15 mrad apart
JOINED_M = 0.0015  # longer chords jump from one part to another
SEEN_WITHIN_M = 0.0006


@dataclass(frozen=True, slots=True, eq=False)
class Fan:
    """The sheet of light.

    Attributes:
        origin: (3,) [m], camera frame.
        normal: Of the plane (3,).
        forward, across: Unit vectors (3,) in the plane: the middle of the fan, and to its side.
        half_rad: Half the fan's angle.
    """

    origin: Float
    normal: Float
    forward: Float
    across: Float
    half_rad: float

    @classmethod
    def of(cls, rig: RigCalibration) -> "Fan":
        """Of a rig whose laser is known in full."""
        plane, laser = rig.laser_plane, rig.laser
        assert plane is not None
        assert laser is not None
        assert laser.origin is not None
        assert laser.forward is not None
        assert laser.fan_rad is not None
        normal = np.array(plane.normal) / np.linalg.norm(plane.normal)
        forward = np.array(laser.forward)
        return cls(np.array(laser.origin), normal, forward, np.cross(normal, forward), 0.5 * laser.fan_rad)

    @property
    def angles_rad(self) -> Float:
        """Angles (RAYS,) of its rays to its middle."""
        return np.linspace(-self.half_rad, self.half_rad, RAYS)


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """The lit line of one instant, ray by ray.

    Attributes:
        reach_m: How far each ray goes (RAYS,), inf: it meets nothing.
        points: (RAYS, 3) [m], camera frame, NaN where it meets nothing.
        label: (RAYS,) finger * 10 + segment; 255: nothing.
        uv: (RAYS, 2) [px].
        seen: (RAYS,) whether the camera sees the point.
        chord_m: (RAYS,) from each point to the next one; 0 where the next is on another part.
    """

    reach_m: Float
    points: Float
    label: Int
    uv: Float
    seen: Bool
    chord_m: Float


def cross(fan: Fan, hand_mesh: HandMesh, posed: Posed, optics: CameraModel, samples: Samples) -> Curve:
    """Where the fan meets the posed hand, of which the camera has `samples`."""
    away: Float = (posed.verts - fan.origin) @ fan.normal
    side: Bool = np.greater(away[hand_mesh.faces], 0.0)
    cut = np.flatnonzero(side.any(axis=1) & ~side.all(axis=1))
    reach = np.full(RAYS, np.inf)
    face = np.full(RAYS, -1, dtype=np.int64)
    corners = posed.verts[hand_mesh.faces[cut]] - fan.origin
    plane = np.stack([corners @ fan.forward, corners @ fan.across], axis=-1)
    _nearest(plane, away[hand_mesh.faces[cut]], cut, fan.half_rad, reach, face)
    angle = fan.angles_rad
    with np.errstate(invalid="ignore"):
        rays = np.cos(angle)[:, None] * fan.forward + np.sin(angle)[:, None] * fan.across
        points = np.where(face[:, None] >= 0, fan.origin + reach[:, None] * rays, np.nan)
    uv = optics.project(points)
    seen = _seen(uv, points[:, 2], samples, (optics.width_px, optics.height_px))
    label = np.where(face >= 0, hand_mesh.label[face], 255)
    chord = np.zeros(RAYS)
    chord[:-1] = np.linalg.norm(np.diff(points, axis=0), axis=1)
    same = np.zeros(RAYS, dtype=np.bool_)
    same[:-1] = (face[1:] >= 0) & (face[:-1] >= 0)
    return Curve(reach, points, label, uv, seen, np.where(same & (chord < JOINED_M), chord, 0.0))


def _seen(uv: Float, depth: Float, samples: Samples, size: tuple[int, int]) -> Bool:
    """Which pixels (N, 2) lie in the picture and are not deeper (N,) [m] than what the samples around them show."""
    width, height = size
    inside = (uv > -0.5) & (uv < np.array([width, height]) - 0.5)
    ok: Bool = np.asarray(inside.all(axis=1), dtype=np.bool_)
    fine = samples.depth.shape[0] // height
    column, row = np.rint((np.where(ok[:, np.newaxis], uv, 0.0) + 0.5) * fine - 0.5).astype(np.int64).T
    far = np.zeros(len(uv))
    for dv in (-1, 0, 1):
        for du in (-1, 0, 1):
            r, c = np.clip(row + dv, 0, height * fine - 1), np.clip(column + du, 0, width * fine - 1)
            near = samples.depth[r, c].astype(np.float64)
            far = np.maximum(far, np.where(np.isfinite(near), near, 0.0))
    return ok & (depth < far + SEEN_WITHIN_M)


@kernel
def _nearest(plane: Float, away: Float, cut: Int, half: float, reach: Float, face: Int) -> None:
    rays = len(reach)
    step = 2.0 * half / (rays - 1)
    end = np.empty((2, 2))
    for k in range(len(cut)):
        n = 0
        for i in range(3):
            j = (i + 1) % 3
            a, b = away[k, i], away[k, j]
            if (a > 0.0) != (b > 0.0) and n < 2:
                share = a / (a - b)
                end[n, 0] = plane[k, i, 0] + share * (plane[k, j, 0] - plane[k, i, 0])
                end[n, 1] = plane[k, i, 1] + share * (plane[k, j, 1] - plane[k, i, 1])
                n += 1
        if n < 2 or end[0, 0] <= 0.0 or end[1, 0] <= 0.0:
            continue
        first, last = np.arctan2(end[0, 1], end[0, 0]), np.arctan2(end[1, 1], end[1, 0])
        low = max(0, int(np.ceil((min(first, last) + half) / step)))
        high = min(rays - 1, int(np.floor((max(first, last) + half) / step)))
        dx, dy = end[1, 0] - end[0, 0], end[1, 1] - end[0, 1]
        for r in range(low, high + 1):
            angle = -half + r * step
            c, s = np.cos(angle), np.sin(angle)
            across = c * dy - s * dx
            if abs(across) < 1e-15:
                continue
            far = (end[0, 0] * dy - end[0, 1] * dx) / across
            if 0.0 < far < reach[r]:
                reach[r] = far
                face[r] = cut[k]
