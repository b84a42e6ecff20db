"""Where each finger is looked at along its length: rows of the image, and for the thumb circles about its root.

Index ... little go up the image, so their stations are its rows. The thumb goes aside, and with its own root (CMC) it
turns about: its stations are circles about the root, the outermost first, so that here too it points up. What the
circles show is read once and put beside the image. *Strip coordinates* (u, v) are pixels of the image for the four; for
the thumb v is how far inside the outermost circle, u the angle, so long that it goes on where the image ends.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from common.arrays import Float
from slave.wrist.corridors import STATION_PX, Corridors, corridors_of
from slave.wrist.led_depth import SHRINK, Float32
from slave.wrist.sweep import NEAREST_M, in_image, thumb_postures
from slave.wrist.view import WristView

THUMB = 0
ROW_PX = 2 * SHRINK  # of a station: profiles change slowly, edges are sought in the full image
_WIDEST_RAD = 0.3  # half of a thumb, as its root sees it
_TALLER_PX = 3 * ROW_PX  # dark beyond the farthest tip
_COLUMN_PX = 1.5  # of the circle at half of the outermost, per strip column: a thumb is broader than a finger
_RARE = 0.1  # share of the thumb's postures left out: those too near to the camera
_NO_MAP: Float32 = np.empty((0, 0), dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Strips:
    """The strips of one wrist rig and hand: R stations.

    Attributes:
        corridors: Whose circles the thumb's are.
        v: (R,) stations, in strip coordinates.
        outermost: Radius [px] where the thumb's v is 0.
        first_u: u where the thumb's strip begins: the image's width.
        first_rad, rad_per_u: Angle there, and of a column.
        map_x, map_y: (R, A) pixels of the shrunken image that the thumb's strip shows.
    """

    corridors: Corridors
    v: Float
    outermost: float
    first_u: float
    first_rad: float
    rad_per_u: float
    map_x: Float32
    map_y: Float32

    def of_image(self, finger: int, uv: Float) -> Float:
        """Strip coordinates (..., 2) of pixels (..., 2)."""
        if finger != THUMB:
            return uv
        radius, angle = self.corridors.polar(uv.reshape(-1, 2))
        out = np.column_stack([self.u_of_angle(angle), self.outermost - radius])
        return out.reshape(uv.shape)

    def to_image(self, finger: int, strip: Float) -> Float:
        """Pixels (..., 2) of strip coordinates (..., 2)."""
        if finger != THUMB:
            return strip
        radius = self.outermost - strip[..., 1]
        angle = self.first_rad + (strip[..., 0] - self.first_u) * self.rad_per_u
        along, across = radius * np.cos(angle), self.corridors.thumb_side * radius * np.sin(angle)
        x, y = self.corridors.up
        return self.corridors.root + np.stack([along * x - across * y, along * y + across * x], axis=-1)

    def up(self, finger: int, strip: Float) -> Float:
        """Which way of the image (..., 2) a finger's strip goes up at strip coordinates (..., 2)."""
        if finger != THUMB:
            return np.broadcast_to([0.0, -1.0], strip.shape)
        out = self.to_image(THUMB, strip) - self.corridors.root
        return out / np.maximum(np.linalg.norm(out, axis=-1, keepdims=True), 1e-9)

    def u_of_angle(self, angle: Float) -> Float:
        """u (...) of the thumb's angles (...) [rad]."""
        return self.first_u + (angle - self.first_rad) / self.rad_per_u

    def beside(self, near: Float32) -> Float32:
        """Nearness (R, columns) of all strips of a shrunken image (h, w): its rows by pairs, and the thumb's."""
        rows = len(self.v)
        fingers = near[: 2 * rows].reshape(rows, 2, -1).mean(axis=1)
        thumb = cv2.remap(near, self.map_x, self.map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        out: Float32 = np.hstack([fingers, thumb]).astype(np.float32, copy=False)
        return out


@lru_cache(maxsize=8)
def strips_of(view: WristView) -> Strips:
    """Those of one wrist rig and hand; made once."""
    corridors = corridors_of(view)
    postures = thumb_postures(view, 7, 7, 3, 3)
    tips, depth = in_image(view, view.model.chains(postures).position_m[:, THUMB, 3])
    seen = depth > NEAREST_M
    thick = view.optics.matrix[0, 0] * view.model.radius_m[5] / depth[seen]
    radius, _ = corridors.polar(tips[seen])
    v = np.arange(view.optics.height_px // ROW_PX, dtype=np.float64) * ROW_PX + 0.5 * (ROW_PX - 1)
    outermost = float(np.quantile(radius + thick, 1.0 - _RARE)) + _TALLER_PX
    middle, half = float(corridors.middle[3, 0]), float(corridors.half[3, 0])
    rad_per_u = _COLUMN_PX / (0.5 * outermost)
    columns = int((2.0 * half + 2.0 * _WIDEST_RAD) / (rad_per_u * SHRINK))
    width = float(view.optics.width_px)
    strips = Strips(corridors, v, outermost, width, middle - half, rad_per_u, _NO_MAP, _NO_MAP)
    u = strips.first_u + SHRINK * np.arange(columns, dtype=np.float64) + 0.5 * (SHRINK - 1)
    at = (strips.to_image(THUMB, np.stack(np.meshgrid(u, v), axis=-1)) - 0.5 * (SHRINK - 1)) / SHRINK
    maps = (np.ascontiguousarray(at[..., k], dtype=np.float32) for k in range(2))
    return Strips(corridors, v, outermost, width, middle - half, rad_per_u, *maps)


def thumb_border(seam_rad: Float, strips: Strips) -> Float:
    """u (R,) of the thumb's seam (S,) [rad] at the stations of its strip."""
    at = strips.corridors.radius + STATION_PX * np.arange(len(seam_rad), dtype=np.float64)
    return strips.u_of_angle(np.interp(strips.outermost - strips.v, at, seam_rad))
