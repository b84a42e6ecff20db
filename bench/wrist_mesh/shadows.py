"""Which vertices a light reaches: a depth map as the light sees it."""

import numpy as np

from bench.wrist_mesh.hand_mesh import Posed
from bench.wrist_mesh.raster import rasterise
from common.arrays import Float, Int

WITHIN_M = 0.002  # behind what the light sees first: lit
SKY = 32  # directions from which the room's light comes
_FAR_M = 1.5
_SIZE = 192


def sky() -> Float:
    """Unit directions (SKY, 3), evenly over the sphere (spherical Fibonacci points)."""
    k = np.arange(SKY) + 0.5
    z = 1.0 - 2.0 * k / SKY
    angle = np.pi * (1.0 + np.sqrt(5.0)) * k
    across = np.sqrt(1.0 - z * z)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)


def from_afar(posed: Posed, faces: Int, direction: Float) -> Float:
    """Cosine of incidence (V,) of light from a unit direction (3,); 0 in its shadow."""
    return np.maximum(posed.normals @ direction, 0.0) * lit(
        posed, faces, posed.verts.mean(axis=0) + _FAR_M * direction
    )


def lit(posed: Posed, faces: Int, light: Float) -> Float:
    """1 where a light at `light` (3,) [m] reaches a vertex, 0 in the shadow of others (V,)."""
    ahead = posed.verts.mean(axis=0) - light
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, np.eye(3)[np.abs(ahead).argmin()])
    right /= np.linalg.norm(right)
    local = (posed.verts - light) @ np.stack([right, np.cross(ahead, right), ahead], axis=1)
    depth = local[:, 2]
    seen = depth > 0.01
    uv = local[:, :2] / np.where(seen, depth, np.nan)[:, None]
    low, high = np.nanpercentile(uv, (0.0, 100.0), axis=0)
    size = min(float((high - low).max()), 4.0)
    low = np.maximum(low, 0.5 * (low + high) - 2.0)
    uv = (uv - low) / size * (_SIZE - 3) + 1.0
    near = rasterise(uv, depth, faces, (_SIZE, _SIZE), 1).depth
    near = np.where(np.isfinite(near), near, 0.0)
    at = np.nan_to_num(np.rint(uv), nan=-9.0).astype(np.int64)
    inside = ((at >= 1) & (at < _SIZE - 1)).all(axis=1)
    u, v = np.where(inside[:, None], at, 1).T
    open_to = np.max([near[v + dv, u + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)], axis=0)
    return np.where(inside & seen, depth < open_to + WITHIN_M, True).astype(np.float64)
