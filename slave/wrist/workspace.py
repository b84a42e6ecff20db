"""Regions of the image in which the laser can meet each finger.

The laser's plane stands still, and the palm lies as calibrated or as it was seen (`find_palm_pose`).
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from common.arrays import Bool, Float, Float32, Image, Int
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import intersect_plane
from common.hand.model import CHAINS
from slave.wrist.led_image import (
    NEAREST_M,
    PER_BONE,
    WristView,
    along_bones,
    finger_postures,
    radius_along,
    thumb_postures,
)

_CELL_PX = 8


@dataclass(frozen=True, slots=True, eq=False)
class LaserWorkspace:
    """Which pixels can show the laser on a finger."""

    cells: Bool  # (5, H / 8, W / 8), thumb ... little, where it can be
    plane_m: Float32  # (H, W, 3) what each pixel shows of the laser's plane, camera frame [m]; 0: nothing
    focal_px: float
    palm: "Palm"
    first_row: int  # above it the laser meets no finger

    def holds(self, finger: Int, uv: Float) -> Bool:
        """Whether the laser can be on these fingers (N,) at pixels (N, 2) of the image."""
        column, row = self._cell(uv)
        return self.cells[finger, row // _CELL_PX, column // _CELL_PX]

    def metres_per_px(self, uv: Float) -> Float:
        """How much of the plane one pixel shows [m] at pixels (N, 2); 0: NaN or none."""
        column, row = self._cell(np.nan_to_num(uv))
        return np.where(np.isnan(uv[:, 0]), 0.0, self.plane_m[row, column, 2] / self.focal_px)

    def before_palm(self, uv: Float, T_camera_palm: Float) -> Float:
        """What pixels (N, 2) show of the plane, palm frame (N, 3) [m]."""
        column, row = self._cell(uv)
        T = T_camera_palm
        return (self.plane_m[row, column] - T[:3, 3]) @ T[:3, :3]

    def _cell(self, uv: Float) -> tuple[Int, Int]:
        column, row = (uv + 0.5).astype(np.int64).T
        return column, np.minimum(row, self.plane_m.shape[0] - 1)


@dataclass(frozen=True, slots=True, eq=False)
class Palm:
    """The palm's bones and the thumb's root, in the palm frame."""

    root_m: Float  # (3,) the thumb's
    border_m: float  # how far from it the skin over the thumb's MCP is [m]
    knuckles_m: Float  # (4, 3)
    aside: Float  # (4, 2) way x, z across the axis of each finger, towards the little one's side
    radius_m: Float  # (4,) of the knuckles

    def beyond_m(self, points: Float) -> Float:
        """How far points (N, 3) are beyond the skin over the thumb's MCP (N,) [m].

        However the thumb is turned, that skin lies about as far from its root (CMC); so it is a sphere about the
        root, and for one way the palm lies a fixed line in the image.
        """
        return np.linalg.norm(points - self.root_m, axis=1) - self.border_m

    def place(self, points: Float) -> Float:
        """Beside whose axis points (N, 3) are (N,), 1 index ... 4 little, by distance."""
        flat = self.knuckles_m[:, ::2]
        off = points[:, ::2] @ self.aside.T - (flat * self.aside).sum(axis=1)  # falls finger by finger
        left = np.clip((off > 0.0).sum(axis=1) - 1, 0, 2)[:, None]
        here, there = np.take_along_axis(off, left, 1)[:, 0], np.take_along_axis(off, left + 1, 1)[:, 0]
        least_spacing_m = 5e-3  # of axes, which fan out from the knuckles and meet behind the wrist
        return 1.0 + left[:, 0] + here / np.maximum(here - there, least_spacing_m)

    def surface(self, points: Float, place: Float) -> Bool:
        """Return whether points (N, 3) of these places (N,) are on the palm's skin.

        That is before the knuckles, near their bones. A finger folded to it lies on it, and is thicker than that.
        """
        at = np.arange(1.0, 5.0)
        y, z, thick = (np.interp(place, at, of) for of in (*self.knuckles_m.T[1:], self.radius_m))
        # of the knuckle, above the palm's bones: what a finger folded to the palm is beyond
        folded_radii = 2.0
        return (points[:, 2] < z) & (y - points[:, 1] < folded_radii * thick)


@lru_cache(maxsize=128)  # one for each way the palm may lie
def workspace_of(view: WristView) -> LaserWorkspace:
    """The reach of one wrist rig and hand."""
    thumb, fingers = (
        along_bones(view, thumb_postures(view, 7, 7, 5, 5)),
        along_bones(view, finger_postures(view, 5, 10, 10)),
    )
    radius = radius_along(view)
    beyond = slice(PER_BONE, None)  # the metacarpal of the thumb is the palm's
    cells = [_cells(view, thumb[:, 0, beyond], radius[0, beyond])]
    cells += [_cells(view, fingers[:, finger], radius[finger]) for finger in range(1, 5)]
    held = np.stack(cells).astype(np.bool_)
    rows = np.flatnonzero(held.any(axis=(0, 2)))
    plane = _plane(view.optics, *view.normal.tolist(), view.offset_m)
    first = _CELL_PX * int(rows[0]) if len(rows) else view.optics.height_px - 1
    return LaserWorkspace(held, plane, float(view.optics.matrix[0, 0]), _palm(view), first)


def _cells(view: WristView, bones: Float, radius: Float) -> Image:
    """Cells (H / 8, W / 8) where skin about bones (P, K, 3), palm frame, can meet it."""
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
        out |= np.asarray(cv2.dilate(cells, kernel), np.uint8)
    return out


@lru_cache(maxsize=8)
def _plane(optics: CameraModel, x: float, y: float, z: float, offset_m: float) -> Float32:
    """Point (H, W, 3) [m] of the plane at each pixel, camera frame; 0: nothing."""
    u, v = np.meshgrid(np.arange(optics.width_px), np.arange(optics.height_px))
    rays = optics.ray(np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64))
    points = intersect_plane(np.zeros(3), rays, np.array([x, y, z]), offset_m)
    return np.nan_to_num(points).reshape(*u.shape, 3).astype(np.float32)


def _palm(view: WristView) -> Palm:
    model = view.model
    root, knuckle = model.rest_position_m[CHAINS[0, :2]]
    knuckles, ends = (model.rest_position_m[CHAINS[1:, k]] for k in (0, 1))
    along = (ends - knuckles)[:, ::2]
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    aside = np.stack([along[:, 1], -along[:, 0]], axis=-1)
    if aside[0] @ (knuckles[3] - knuckles[0])[::2] < 0.0:
        aside = -aside
    border = float(np.hypot(np.linalg.norm(knuckle - root), model.radius_m[CHAINS[0, 1]]))
    return Palm(root, border, knuckles, aside, model.radius_m[CHAINS[1:, 0]])
