"""The middle of a fingertip that faces the camera: half spheres fitted to the normals of the image (squares)."""

import numpy as np

from common.arrays import Float, Int
from slave.wrist.led_depth import DARK, SHRINK, Float32, LedOptics
from slave.wrist.normals import BREADTH, normals_of

CAP_SHARE = 0.8  # of a fingertip's radius: how much of it is compared with a half sphere
LEAST_PIXELS = 6  # of the shrunken image, that show a half sphere
_NOISE = np.float32(np.sqrt(DARK))


def half_spheres(near: Float32, optics: LedOptics, guess: Float, radius: Float) -> Float:
    """Centres (N, 2) [px] of the half spheres whose normals are nearest to those of the image, by squared distance.

    At p the half sphere of centre c leans by (p - c) / radius aside from the way to the camera, the image by t; the
    sum of squares of the difference is least where c is the mean of p - radius t. NaN: too little is lit, or c is
    nowhere near.

    Args:
        near: (h, w) nearness [grey levels^0.5].
        optics: Of the same.
        guess: (N, 2) where they are sought [px].
        radius: (N,) [px].
    """
    height, width = near.shape
    reach = int(radius.max() / SHRINK) + 3
    around: Int = np.arange(-reach, reach + 1, dtype=np.int64)
    beside: Int = np.arange(
        -reach, reach + 1 + BREADTH // 2, dtype=np.int64
    )  # a gap between one window and the next
    cell = np.rint(guess / SHRINK).astype(np.int64)
    row, column = cell[:, 1] + around[:, None], cell[:, :1] + beside
    at = row.clip(0, height - 1)[..., None] * width + column.clip(0, width - 1)
    part = near.ravel()[at]
    outside = (column < 0) | (column >= width)
    outside[:, 2 * reach + 1 :] = True
    part[(part <= _NOISE) | outside | ((row < 0) | (row >= height))[..., None]] = np.nan
    ray, cosine = optics.ray.reshape(-1, 3)[at], optics.cosine.ravel()[at]
    size = len(around), at.shape[1] * at.shape[2]
    full = normals_of((cosine / part).reshape(size), ray.reshape(*size, 3), cosine.reshape(size)).reshape(
        ray.shape
    )
    view = -ray * cosine[..., None]
    lean = full[..., :2] - np.einsum("...k,...k->...", full, view)[..., None] * view[..., :2]
    scale = radius.astype(np.float32)[:, None]
    u, v = (
        (column * SHRINK + 0.5 * (SHRINK - 1)).astype(np.float32),
        (row * SHRINK + 0.5 * (SHRINK - 1)).astype(np.float32),
    )
    finite = np.isfinite(lean[..., 0])
    lean = np.where(finite[..., None], lean, np.float32(0.0))
    toward_u, toward_v = u - scale * lean[..., 0], v[..., None] - scale * lean[..., 1]
    centre: Float = guess.copy()
    for _ in range(2):
        apart = (u - centre[:, :1]) ** 2 + ((v - centre[:, 1]) ** 2)[..., None]
        inside = (apart < (CAP_SHARE * scale) ** 2) & finite
        count = np.count_nonzero(inside, axis=(0, 2))
        some = np.where(count < LEAST_PIXELS, np.nan, count)
        centre = (
            np.stack([(toward_u * inside).sum(axis=(0, 2)), (toward_v * inside).sum(axis=(0, 2))], axis=1)
            / some[:, None]
        )
    centre[np.hypot(*(centre - guess).T) >= radius] = np.nan
    return centre
