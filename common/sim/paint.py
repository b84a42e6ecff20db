"""Markers: what each covers of the image, its paint in linear light, and the truth that a camera sees of it.

Coverage is measured with everything nearer cut out, and the same coverage blends the paint into the image, so
image and truth come from one drawing.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from common.arrays import Bool, Float, Image
from common.geometry import cross
from common.sim import light, raster
from common.sim.desk import LENS_SIGMA_PX
from common.sim.raster import Coverage, Shape
from common.sim.surface import CAPSULES, PALM_HULL, SLEEVE_SPHERES, SPHERE_COUNT, unit
from common.sim.view import LAYERS, PHALANGES, Snapshot, View

BLUR_STEP_PX = 1.2
MAX_STEPS = 6
SHINE_SHARE = 0.17  # radius of the glossy spot, share of the cap's
MARGIN_PX = 2
REACH_PX = 8.0  # room for motion during the exposure


@dataclass(frozen=True, slots=True, eq=False)
class MarkerView:
    """What one camera truly sees of the markers in one frame.

    Attributes:
        uv: (M, 2) centroid of the visible pixels [px], averaged over the exposure; NaN where none is visible.
        visible: (M,) visible share of the marker's own outline.
        area: (M,) visible area [px^2].
        t_s: (M,) scene time [s] at which the marker's row is at mid-exposure.
    """

    uv: Float
    visible: Float
    area: Float
    t_s: Float


@dataclass(frozen=True, slots=True, eq=False)
class Painted:
    """One marker of one frame: its coverage and its outline."""

    marker: int
    coverage: Coverage
    outline: Shape
    t_s: float


class Painter:
    """Paints the markers of one view. It holds prepared colours; every call is pure."""

    def __init__(self, view: View) -> None:
        """Prepare colours.

        Raises:
            CalibrationError: A marker of the rig has no paint.
        """
        self._view = view
        self._size = (view.optics.width_px, view.optics.height_px)
        self._tables = light.SrgbTables.make()
        self._paint = [light.paint(name) for name in view.scene.rig.markers]
        self._shades = [light.shades(paint, gloss=0.02) for paint in self._paint]
        self._shine = [light.bgr_bytes(np.array(paint) + 0.10) for paint in self._paint]

    def cover(self, snapshot: Snapshot, cards: tuple[Shape, ...]) -> list[Painted]:
        """Every marker with what it covers, everything nearer cut out."""
        surface, view = self._view.surface, self._view
        palm = Shape(view.hulls(snapshot, PALM_HULL, 1)[0], snapshot.speed_uv[list(PALM_HULL)].mean(axis=0))
        caps = [
            Shape(raster.hull(uv), snapshot.speed_uv[k])
            for uv, k in zip(snapshot.cap_uv, view.cap_centre, strict=True)
        ]
        low, high = snapshot.cap_uv.min(axis=1) - REACH_PX, snapshot.cap_uv.max(axis=1) + REACH_PX
        centre = snapshot.points[view.cap_centre]
        hidden = view.behind_palm(snapshot, centre)
        skin = self._skin_before(snapshot, snapshot.uv[view.cap_centre], centre[:, 2], low, high)
        touching = raster.overlaps(low[:, None], high[:, None], low, high)
        touching &= centre[:, None, 2] > centre[None, :, 2]
        painted: list[Painted] = []
        for c, cap in enumerate(surface.caps):
            skin[c, 3 * cap.finger + 2] = False  # that one is the cap's own, see `own_finger`
            nearer = [*_phalanges(snapshot, skin[c]), *(caps[n] for n in np.flatnonzero(touching[c]))]
            nearer += [
                *([palm] if hidden[c] else []),
                *self._sleeve_before(snapshot, caps[c], float(centre[c, 2])),
                *_things_before(snapshot, snapshot.uv[cap.centre], float(centre[c, 2])),
                *cards,
            ]
            cut = view.own_finger(snapshot, c)
            cover = raster.cover(caps[c], cut, nearer, self._moments(caps[c]), self._size)
            painted.append(Painted(cap.marker, cover, caps[c], float(snapshot.t_s[cap.centre])))
        for box in surface.boxes:
            uv = snapshot.uv[box.corners]
            shape = Shape(raster.hull(uv), snapshot.speed_uv[box.corners].mean(axis=0))
            depth = snapshot.points[box.corners, 2].mean(keepdims=True)
            at = uv.min(axis=0)[None] - REACH_PX, uv.max(axis=0)[None] + REACH_PX
            before = self._skin_before(snapshot, uv.mean(axis=0)[None], depth, *at)[0]
            nearer = [*_phalanges(snapshot, before), *([] if view.shows_back(snapshot) else [palm]), *cards]
            nearer += self._sleeve_before(snapshot, shape, float(depth[0]))
            nearer += _things_before(snapshot, uv.mean(axis=0), float(depth[0]))
            cover = raster.cover(shape, None, nearer, self._moments(shape), self._size)
            painted.append(Painted(box.marker, cover, shape, float(snapshot.t_s[box.corners.start])))
        return sorted(painted, key=lambda item: item.marker)

    def _skin_before(self, snapshot: Snapshot, uv: Float, depth: Float, low: Float, high: Float) -> Bool:
        """Which phalanges (N, PHALANGES) reach into the boxes `low`, `high` (N, 2) before the depths (N,) [m]."""
        skin = snapshot.outlines[:PHALANGES, 0]
        touched = raster.overlaps(low[:, None], high[:, None], skin.min(axis=1), skin.max(axis=1))
        return touched & (self._view.phalanx_depth(snapshot, uv) < depth[:, None])

    def _sleeve_before(self, snapshot: Snapshot, marker: Shape, depth_m: float) -> list[Shape]:
        """The sleeve, where it may lie before a marker at that depth."""
        view = self._view
        reach = snapshot.discs_px[list(SLEEVE_SPHERES), 0, None]
        ends = snapshot.uv[list(SLEEVE_SPHERES)]
        low, high = marker.corners.min(axis=0), marker.corners.max(axis=0)
        if not raster.overlaps(low, high, (ends - reach).min(axis=0), (ends + reach).max(axis=0)):
            return []
        before = view.sleeve_depth(snapshot, marker.corners.mean(axis=0)) < depth_m
        if not before or view.looks_into_sleeve(snapshot):
            return []
        return [Shape(view.sleeve(snapshot), snapshot.speed_uv[SLEEVE_SPHERES[0]])]

    def window(self, image: Image, group: list[Painted], snapshot: Snapshot) -> tuple[int, int, Image]:
        """Paint a group of markers and blur its window, all in linear light; where it goes, and its pixels."""
        width, height = self._size
        x0 = max(min(p.coverage.x for p in group) - MARGIN_PX, 0)
        y0 = max(min(p.coverage.y for p in group) - MARGIN_PX, 0)
        x1 = min(max(p.coverage.x + p.coverage.alpha.shape[1] for p in group) + MARGIN_PX, width)
        y1 = min(max(p.coverage.y + p.coverage.alpha.shape[0] for p in group) + MARGIN_PX, height)
        window = self._tables.decode(image[y0:y1, x0:x1])
        for item in group:
            cover = item.coverage
            h, w = cover.alpha.shape
            cx0, cy0, cx1, cy1 = (
                max(cover.x, x0),
                max(cover.y, y0),
                min(cover.x + w, x1),
                min(cover.y + h, y1),
            )
            if cx0 >= cx1 or cy0 >= cy1:
                continue
            alpha = cover.alpha[cy0 - cover.y : cy1 - cover.y, cx0 - cover.x : cx1 - cover.x, None]
            look = self._look(item, snapshot, (cx0, cy0, cx1, cy1))
            part = window[cy0 - y0 : cy1 - y0, cx0 - x0 : cx1 - x0]
            part += (self._tables.decode(look) - part) * alpha
        window = cv2.GaussianBlur(window, (3, 3), LENS_SIGMA_PX)
        left, top = int(x0 > 0), int(y0 > 0)
        inner = window[top : -1 if y1 < height else None, left : -1 if x1 < width else None]
        return x0 + left, y0 + top, self._tables.encode(np.asarray(inner, dtype=np.float32))

    def _look(self, item: Painted, snapshot: Snapshot, box: tuple[int, int, int, int]) -> Image:
        """Colours of one marker's surface over a pixel box, as if it filled it."""
        x0, y0, x1, y1 = box
        look = np.empty((y1 - y0, x1 - x0, 3), dtype=np.uint8)
        view, corner, shades = self._view, np.array([x0, y0]), self._shades[item.marker]
        look[:] = shades[0]
        for c, cap in enumerate(view.surface.caps):
            if cap.marker == item.marker:
                bands = raster.fixed(snapshot.outlines[PHALANGES + c] - corner)
                for layer in range(1, LAYERS):
                    raster.fill(look, bands[layer], shades[layer])
                size = SHINE_SHARE * snapshot.discs_px[SPHERE_COUNT + 2 * c, 0]
                spot = snapshot.shine_uv[c] - corner + size * view.circle
                raster.fill(look, raster.fixed(spot), self._shine[item.marker])
        for side in view.surface.boxes:
            if side.marker == item.marker:
                uv = snapshot.uv[side.corners] - corner
                look[:] = light.face_shade(self._paint[item.marker], 0.25)
                top = snapshot.points[side.corners][:4]
                normal = unit(cross(top[1] - top[0], top[3] - top[0]))
                facing = float(normal @ view.to_light) * (-1.0 if float(normal @ top[0]) > 0.0 else 1.0)
                raster.fill(look, raster.fixed(uv[:4]), light.face_shade(self._paint[item.marker], facing))
        return look

    def _moments(self, shape: Shape) -> Float:
        """Moments of the exposure [s] at which a marker is drawn: about one per pixel of way."""
        exposure = self._view.exposure_s
        n = int(np.clip(np.ceil(np.hypot(*shape.velocity) * exposure / BLUR_STEP_PX), 1, MAX_STEPS))
        return ((np.arange(n) + 0.5) / n - 0.5) * exposure

    def clusters(self, painted: list[Painted]) -> list[list[Painted]]:
        """Markers whose windows touch, together; markers outside the image or hidden left out."""
        groups: list[tuple[Float, Float, list[Painted]]] = []
        for item in painted:
            cover = item.coverage
            low = np.array([cover.x, cover.y], dtype=np.float64) - MARGIN_PX
            high = low + np.array(cover.alpha.shape[::-1]) + 2.0 * MARGIN_PX
            if (high <= 0).any() or (low >= np.array(self._size)).any() or not cover.alpha.any():
                continue
            members = [item]
            touching = [group for group in groups if bool(raster.overlaps(low, high, group[0], group[1]))]
            while touching:
                for group in touching:
                    low, high = np.minimum(low, group[0]), np.maximum(high, group[1])
                    members += group[2]
                groups = [group for group in groups if not any(group is taken for taken in touching)]
                touching = [group for group in groups if bool(raster.overlaps(low, high, group[0], group[1]))]
            groups.append((low, high, members))
        return [members for _, _, members in groups]

    @staticmethod
    def truth(painted: list[Painted]) -> MarkerView:
        """What is visible of all markers, in the order of the rig."""
        covers = [item.coverage for item in painted]
        return MarkerView(
            uv=np.stack([raster.centroid(cover) for cover in covers]),
            visible=np.array([cover.share for cover in covers]),
            area=np.array([float(cover.alpha.sum()) for cover in covers]),
            t_s=np.array([item.t_s for item in painted]),
        )


def _phalanges(snapshot: Snapshot, chosen: Bool) -> list[Shape]:
    """Outlines of the chosen phalanges."""
    return [
        Shape(
            snapshot.outlines[k, 0],
            0.5 * (snapshot.speed_uv[CAPSULES[k, 0]] + snapshot.speed_uv[CAPSULES[k, 1]]),
        )
        for k in np.flatnonzero(chosen)
    ]


def _things_before(snapshot: Snapshot, uv: Float, depth_m: float) -> list[Shape]:
    """Outlines of the things that pass before a marker at that pixel (2,) and depth."""
    return [thing.shape for thing in snapshot.things if float(thing.depth(uv)) < depth_m]
