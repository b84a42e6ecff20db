"""Where in the image the laser can meet each finger: a known set, since the laser's plane and the palm stand still."""

from dataclasses import dataclass
from functools import lru_cache
from typing import cast

import cv2
import numpy as np
import numpy.typing as npt

from common.arrays import Bool, Float, Image, Int
from common.hand_model import CHAINS
from slave.wrist.sweep import NEAREST_M, PER_BONE, along_bones, finger_postures, radius_along, thumb_postures
from slave.wrist.view import WristView

Float32 = npt.NDArray[np.float32]

_CELL_PX = 8
# The border between thumb and thenar is where the head of the thumb's metacarpal ends, a little beyond the middle of
# the joint. It is known no better than the bone's length (5 %) and than bending the joint by 40 degrees moves the
# plane that halves its angle, at a finger's radius: 3 mm each.
_WEB = 1.05  # of the metacarpal
_BORDER_M = 3e-3
_LEAST_SHARE = 0.005  # a line that lies on the ball of the thumb alone is the best that is known of the thumb


@dataclass(frozen=True, slots=True, eq=False)
class Reach:
    """Which pixels can show the laser on a finger.

    Attributes:
        pixels: (5, H, W), thumb ... little.
        thumb_share: (H, W) how sure the laser on the thumb's line is beyond the ball of the thumb, 0 ... 1.
        depth_per_focal_m: (H, W) how much of the plane one pixel shows there [m]; 0: none.
        first_row: Above it the laser meets no finger.
    """

    pixels: Bool
    thumb_share: Float32
    depth_per_focal_m: Float32
    first_row: int

    def holds(self, finger: Int, uv: Float) -> Bool:
        """Whether the laser can be on these fingers (N,) at pixels (N, 2) of the image."""
        column, row = self._cell(uv)
        return self.pixels[finger, row, column]

    def of_thumb(self, uv: Float) -> Float:
        """`thumb_share` (N,) at pixels (N, 2) of the image."""
        column, row = self._cell(uv)
        return self.thumb_share[row, column].astype(np.float64)

    def metres_per_px(self, uv: Float) -> Float:
        """`depth_per_focal_m` (N,) at pixels (N, 2) of the image; 0 where they are NaN."""
        column, row = self._cell(np.nan_to_num(uv))
        return np.where(np.isnan(uv[:, 0]), 0.0, self.depth_per_focal_m[row, column])

    def _cell(self, uv: Float) -> tuple[Int, Int]:
        column, row = (uv + 0.5).astype(np.int64).T
        return column, np.minimum(row, self.pixels.shape[1] - 1)


@lru_cache(maxsize=8)
def reach_of(view: WristView) -> Reach:
    """The reach of one wrist rig and hand."""
    size = (view.optics.width_px, view.optics.height_px)
    thumb, fingers = (
        along_bones(view, thumb_postures(view, 7, 7, 5, 5)),
        along_bones(view, finger_postures(view, 5, 10, 10)),
    )
    radius = radius_along(view)
    beyond = slice(PER_BONE, None)  # the metacarpal of the thumb is the palm's
    cells = [_cells(view, thumb[:, 0, beyond], radius[0, beyond])]
    cells += [_cells(view, fingers[:, finger], radius[finger]) for finger in range(1, 5)]
    pixels = np.stack([cv2.resize(part, size, interpolation=cv2.INTER_NEAREST) for part in cells]).astype(
        np.bool_
    )
    share, metres = _on_plane(view)
    pixels[1:] &= share > _LEAST_SHARE  # no finger is where the ball of the thumb is
    rows = np.flatnonzero(pixels.any(axis=(0, 2)))
    return Reach(pixels, share, metres, int(rows[0]) if len(rows) else size[1] - 1)


def _cells(view: WristView, bones: Float, radius: Float) -> Image:
    """1 in the cells (H / 8, W / 8) where the skin about points (P, K, 3) of bones, palm frame, can meet the plane.

    Args:
        view: The rig.
        bones: Points of all postures.
        radius: (K,) of the finger there [m].
    """
    T = view.T_camera_palm
    camera = bones @ T[:3, :3].T + T[:3, 3]
    off = camera @ view.normal - view.offset_m
    near = (np.abs(off) < radius) & (camera[..., 2] > NEAREST_M)
    foot = camera[near] - off[near, None] * view.normal
    half = np.sqrt(np.broadcast_to(radius, off.shape)[near] ** 2 - off[near] ** 2)
    grow = np.ceil(view.optics.matrix[0, 0] * half / foot[:, 2] / _CELL_PX).astype(np.int64)
    column, row = np.floor(view.optics.project(foot) / _CELL_PX).astype(np.int64).T
    shape = (-(-view.optics.height_px // _CELL_PX), -(-view.optics.width_px // _CELL_PX))
    inside = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
    out = np.zeros(shape, dtype=np.uint8)
    for size in np.unique(grow[inside]):
        some = inside & (grow == size)
        cells = np.zeros(shape, dtype=np.uint8)
        cells[row[some], column[some]] = 1
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * int(size) + 1, 2 * int(size) + 1))
        out |= cast(Image, cv2.dilate(cells, kernel))
    return out


def _on_plane(view: WristView) -> tuple[Float32, Float32]:
    """How sure it is (H, W) that a laser point of the thumb's line lies on the thumb and not on its ball (thenar); and
    how much of the laser plane a pixel shows (H, W) [m].

    However the thumb is turned, the skin over its MCP lies about as far from its root (CMC); so the border is a sphere
    about the root, and a fixed line in the image.
    """
    model, T = view.model, view.T_camera_palm
    root, knuckle = model.rest_position_m[CHAINS[0, :2]]
    border = np.hypot(_WEB * np.linalg.norm(knuckle - root), model.radius_m[CHAINS[0, 1]])
    u, v = np.meshgrid(np.arange(view.optics.width_px), np.arange(view.optics.height_px))
    points = view.on_plane(np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64))
    away = np.linalg.norm(points - (T[:3, :3] @ root + T[:3, 3]), axis=1)
    share = np.clip(0.5 + (np.nan_to_num(away) - border) / (2.0 * _BORDER_M), _LEAST_SHARE, 1.0)
    metres = np.nan_to_num(points[:, 2]) / view.optics.matrix[0, 0]
    return share.reshape(u.shape).astype(np.float32), metres.reshape(u.shape).astype(np.float32)
