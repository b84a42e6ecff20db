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
# Beyond the skin over the thumb's MCP, from its root. A thumb that is bent before the palm meets the plane at its MCP,
# half a centimetre either way as device and bones are known; a finger folded to the palm does so a centimetre beyond.
_THUMBS_M, _NO_THUMBS_M = 4e-3, 10e-3
_BALL_M = -3e-3  # nearer there is no finger
_LEAST_SPACING_M = 5e-3  # of axes, which fan out from the knuckles and meet behind the wrist
_BESIDE_PALM = 0.5  # place: beyond the outside of the index


@dataclass(frozen=True, slots=True, eq=False)
class Reach:
    """Which pixels can show the laser on a finger.

    Attributes:
        pixels: (5, H, W), thumb ... little.
        beyond_m: (H, W) how far the plane there is beyond the skin of the thumb's MCP, from the thumb's root [m].
        place: (H, W) beside whose axis the plane is: 1 index ... 4 little, and between and beyond them.
        depth_per_focal_m: (H, W) how much of the plane one pixel shows there [m]; 0: none.
        first_row: Above it the laser meets no finger.
    """

    pixels: Bool
    beyond_m: Float32
    place: Float32
    depth_per_focal_m: Float32
    first_row: int

    def holds(self, finger: Int, uv: Float) -> Bool:
        """Whether the laser can be on these fingers (N,) at pixels (N, 2) of the image."""
        column, row = self._cell(uv)
        return self.pixels[finger, row, column]

    def on_plane(self, uv: Float) -> tuple[Float, Float]:
        """`beyond_m` and `place` (N,) at pixels (N, 2) of the image."""
        column, row = self._cell(uv)
        return self.beyond_m[row, column].astype(np.float64), self.place[row, column].astype(np.float64)

    def only_thumb(self, beyond_m: Float, place: Float) -> Bool:
        """Whether there (N,) the laser meets the thumb or nothing."""
        return (beyond_m < _THUMBS_M) & (place < 1.5)

    def no_thumb(self, beyond_m: Float, place: Float) -> Bool:
        """Whether there (N,) the laser never meets the thumb."""
        return (beyond_m > _NO_THUMBS_M) & (place > _BESIDE_PALM)

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
    beyond, place, metres = _on_plane(view)
    pixels[1:] &= beyond > _BALL_M
    rows = np.flatnonzero(pixels.any(axis=(0, 2)))
    return Reach(pixels, beyond, place, metres, int(rows[0]) if len(rows) else size[1] - 1)


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


def _on_plane(view: WristView) -> tuple[Float32, Float32, Float32]:
    """`beyond_m`, `place` and `depth_per_focal_m` of every pixel, each (H, W).

    However the thumb is turned, the skin over its MCP lies about as far from its root (CMC); so it is a sphere about
    the root, and a fixed line in the image.
    """
    model, T = view.model, view.T_camera_palm
    root, knuckle = model.rest_position_m[CHAINS[0, :2]]
    border = np.hypot(np.linalg.norm(knuckle - root), model.radius_m[CHAINS[0, 1]])
    u, v = np.meshgrid(np.arange(view.optics.width_px), np.arange(view.optics.height_px))
    points = np.nan_to_num(view.on_plane(np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)))
    palm = (points - T[:3, 3]) @ T[:3, :3]
    beyond = np.linalg.norm(palm - root, axis=1) - border
    metres = points[:, 2] / view.optics.matrix[0, 0]
    shown = [values.reshape(u.shape).astype(np.float32) for values in (beyond, _place(view, palm), metres)]
    return shown[0], shown[1], shown[2]


def _place(view: WristView, palm: Float) -> Float:
    """Beside whose axis, from index 1 to little 4, points (N, 3) of the palm frame are (N,), seen from before the palm.

    Between two axes, and beyond the outer ones, by their distances.
    """
    knuckles, ends = (view.model.rest_position_m[CHAINS[1:, k]][:, ::2] for k in (0, 1))
    along = (ends - knuckles) / np.linalg.norm(ends - knuckles, axis=1, keepdims=True)
    aside = np.stack([along[:, 1], -along[:, 0]], axis=-1)
    if aside[0] @ (knuckles[3] - knuckles[0]) < 0.0:
        aside = -aside
    off = np.stack(
        [(palm[:, ::2] - knuckles[k]) @ aside[k] for k in range(4)], axis=-1
    )  # falls finger by finger
    left = np.clip((off > 0.0).sum(axis=1) - 1, 0, 2)[:, None]
    here, there = np.take_along_axis(off, left, 1)[:, 0], np.take_along_axis(off, left + 1, 1)[:, 0]
    return 1.0 + left[:, 0] + here / np.maximum(here - there, _LEAST_SPACING_M)
