"""A depth buffer of the mesh as a camera with a distorting lens sees it, several samples to a pixel."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from common.arrays import Float, Int
from common.kernels import kernel

SUPER = 2  # samples per pixel and axis


class Samples(NamedTuple):
    """What each sample of the picture shows (H * SUPER, W * SUPER).

    Attributes:
        face: Its triangle, -1 none.
        depth: (…) [m], inf: nothing.
        share: (…, 2) of the triangle's second and third corner, corrected for perspective.
    """

    face: npt.NDArray[np.int32]
    depth: npt.NDArray[np.float32]
    share: npt.NDArray[np.float32]


def rasterise(
    uv: Float, depth: Float, faces: Int, size: tuple[int, int], supersample: int = SUPER
) -> Samples:
    """Draw triangles.

    Args:
        uv: Corners (V, 2) [px] in the distorted picture.
        depth: (V,) [m] along the camera's axis; triangles with a corner before `NEAR_M` are left out.
        faces: (F, 3).
        size: Width and height of the picture.
        supersample: Samples per pixel and axis.
    """
    width, height = size[0] * supersample, size[1] * supersample
    face = np.full((height, width), -1, dtype=np.int32)
    near = np.full((height, width), np.inf, dtype=np.float32)
    share = np.zeros((height, width, 2), dtype=np.float32)
    fine = (uv + 0.5) * supersample - 0.5
    _fill(fine, depth, faces, face, near, share)
    return Samples(face, near, share)


NEAR_M = 0.004


@kernel
def _fill(
    uv: Float,
    depth: Float,
    faces: Int,
    face: npt.NDArray[np.int32],
    near: npt.NDArray[np.float32],
    share: npt.NDArray[np.float32],
) -> None:
    height, width = face.shape
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        za, zb, zc = depth[a], depth[b], depth[c]
        if not (za > NEAR_M and zb > NEAR_M and zc > NEAR_M):
            continue
        ua, va, ub, vb, uc, vc = uv[a, 0], uv[a, 1], uv[b, 0], uv[b, 1], uv[c, 0], uv[c, 1]
        area = (ub - ua) * (vc - va) - (uc - ua) * (vb - va)
        if not abs(area) > 1e-12:
            continue
        u0 = max(0, int(np.ceil(min(ua, ub, uc))))
        u1 = min(width - 1, int(np.floor(max(ua, ub, uc))))
        v0 = max(0, int(np.ceil(min(va, vb, vc))))
        v1 = min(height - 1, int(np.floor(max(va, vb, vc))))
        for v in range(v0, v1 + 1):
            for u in range(u0, u1 + 1):
                wb = ((u - ua) * (vc - va) - (uc - ua) * (v - va)) / area
                wc = ((ub - ua) * (v - va) - (u - ua) * (vb - va)) / area
                wa = 1.0 - wb - wc
                if wa < 0.0 or wb < 0.0 or wc < 0.0:
                    continue
                z = 1.0 / (wa / za + wb / zb + wc / zc)
                if z < near[v, u]:
                    near[v, u] = z
                    face[v, u] = f
                    share[v, u, 0] = wb * z / zb
                    share[v, u, 1] = wc * z / zc
