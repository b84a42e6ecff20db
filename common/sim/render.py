"""Scene -> camera image: hand, paint, desk, card, blur and noise, with the truth of what each marker shows.

Order of drawing: desk; finger parts and palm from far to near, each as nested discs that make it look round;
sleeve; card; then the markers in linear light, each with the share of every pixel that it really covers. That
share is measured with everything nearer cut out, so image and truth come from the same drawing.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from common.arrays import Float, Image
from common.sim import light, raster
from common.sim.desk import LENS_SIGMA_PX, NoiseTiles, desk_image
from common.sim.raster import Coverage, Shape
from common.sim.scene import DESK_DEPTH_M, Scene
from common.sim.surface import CAPSULES, PALM_HULL, SLEEVE_SPHERES, SPHERE_COUNT, WEB_HULL, unit
from common.sim.view import LAYERS, PHALANGES, Snapshot, View

BLUR_STEP_PX = 1.2
MAX_STEPS = 6
SHINE_SHARE = 0.17  # radius of the glossy spot, share of the cap's
ROOTS = (0, 3, 6, 9, 12)  # capsules that begin at the palm
ROUND_LAYER = 2
BEND_COSINE = 0.6  # a finger bent more than this is drawn in two parts, each at its own depth


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
class _Painted:
    """One marker of one frame: its coverage and its outline."""

    marker: int
    coverage: Coverage
    outline: Shape
    t_s: float


class Renderer:
    """Images of one scene by one camera. It holds prepared desk, noise and colours; a frame is a pure function of t."""

    def __init__(self, scene: Scene, camera: str) -> None:
        """Prepare desk, noise and colour tables (about a quarter of a second).

        Raises:
            CalibrationError: No such camera, or a marker without paint.
        """
        self._view = View(scene, camera)
        optics = self._view.optics
        place = scene.rig.cameras.index(camera)
        self._size = (optics.width_px, optics.height_px)
        self._desk = desk_image(optics, DESK_DEPTH_M, scene.seed)
        self._noise = NoiseTiles.make(optics.height_px, optics.width_px, scene.seed * 64 + place)
        self._tables = light.SrgbTables.make()
        self._paint = [light.paint(name) for name in scene.rig.markers]
        self._paint_shades = [light.shades(paint, gloss=0.02) for paint in self._paint]
        self._skin = light.shades(light.SKIN_LINEAR_RGB, gloss=0.01)
        self._sleeve = light.shades(light.SLEEVE_LINEAR_RGB)
        self._card = light.face_shade(light.CARD_LINEAR_RGB, 0.8)
        self._shine = [light.bgr_bytes(np.array(paint) + 0.10) for paint in self._paint]

    def render(self, t_s: float) -> Image:
        """Image (H, W, 3) BGR of the frame whose row 0 is at mid-exposure at scene time `t_s` [s]."""
        return self.observe(t_s)[0]

    def visible_fraction(self, t_s: float) -> Float:
        """Visible share (M,) of every marker in that frame."""
        return self.markers(t_s).visible

    def markers(self, t_s: float) -> MarkerView:
        """Truth of that frame, without the image."""
        snapshot = self._view.snapshot(t_s)
        return self._truth(self._painted(snapshot, self._view.cards(snapshot)))

    def observe(self, t_s: float) -> tuple[Image, MarkerView]:
        """Image and truth of one frame."""
        snapshot = self._view.snapshot(t_s)
        cards = self._view.cards(snapshot)
        painted = self._painted(snapshot, cards)
        image = self._desk.copy()
        self._draw_hand(image, snapshot)
        box = self._hand_box(snapshot, cards)
        self._smear(image, box, snapshot)
        for card in cards:
            raster.fill(image, raster.fixed(card.corners), self._card)
        windows = [self._paint_window(image, group, snapshot) for group in self._clusters(painted)]
        roi = image[box[1] : box[3], box[0] : box[2]]
        cv2.GaussianBlur(roi, (3, 3), LENS_SIGMA_PX, dst=roi)
        for x, y, patch in windows:
            image[y : y + patch.shape[0], x : x + patch.shape[1]] = patch
        self._noise.add_to(image, round(t_s * 1e6))
        return image, self._truth(painted)

    def _hulls(self, snapshot: Snapshot, spheres: tuple[int, ...]) -> list[Float]:
        """Hull of some spheres in every layer [px]."""
        centre, radius = snapshot.discs_uv[list(spheres)], snapshot.discs_px[list(spheres)]
        points = centre[:, :, None] + radius[:, :, None, None] * self._view.circle
        return [raster.hull(points[:, layer].reshape(-1, 2)) for layer in range(LAYERS)]

    def _draw_hand(self, image: Image, snapshot: Snapshot) -> None:
        corners = raster.fixed(snapshot.outlines[:PHALANGES])
        depth = snapshot.points[:, 2]
        palm_depth = float(depth[list(PALM_HULL)].mean())
        parts: list[tuple[float, tuple[int, ...]]] = [(palm_depth, ())]
        for part in _finger_parts(snapshot):
            # A part that grows out of the palm goes under its edge, wherever the rest of it is.
            grown = part[0] in ROOTS
            far = float(depth[CAPSULES[list(part)]].mean())
            parts.append((max(far, palm_depth + 1e-6) if grown else far, part))
        palm = [[raster.fixed(h) for h in self._hulls(snapshot, hull)] for hull in (WEB_HULL, PALM_HULL)]
        raster.fill(image, raster.fixed(snapshot.cuff_uv[0]), self._card)  # the dark inside of the sleeve
        for _, part in sorted(parts, key=lambda item: -item[0]):
            for layer in range(LAYERS):
                shapes = [corners[k, layer] for k in part] if part else [hull[layer] for hull in palm]
                if not part and layer >= ROUND_LAYER:
                    shapes += [corners[k, layer] for k in ROOTS]  # knuckles and thumb flow out of the palm
                for shape in shapes:
                    raster.fill(image, shape, self._skin[layer])
        end = SLEEVE_SPHERES[1]
        for layer in range(LAYERS):
            disc = snapshot.discs_uv[end, layer] + snapshot.discs_px[end, layer] * self._view.circle
            sleeve = raster.hull(np.vstack([snapshot.cuff_uv[layer], disc]))
            raster.fill(image, raster.fixed(sleeve), self._sleeve[layer])

    def _hand_box(self, snapshot: Snapshot, cards: tuple[Shape, ...]) -> tuple[int, int, int, int]:
        """Box x0, y0, x1, y1 [px] of all that is drawn, inside the image."""
        spread = snapshot.discs_px[:, 0, None] + 6.0
        corners = [
            snapshot.discs_uv[:, 0] - spread,
            snapshot.discs_uv[:, 0] + spread,
            *(c.corners for c in cards),
        ]
        points = np.vstack(corners)
        x0, y0 = np.clip(np.floor(points.min(axis=0)), 0, np.array(self._size) - 1).astype(int)
        x1, y1 = np.clip(np.ceil(points.max(axis=0)), 1, self._size).astype(int)
        return int(x0), int(y0), max(int(x1), int(x0) + 1), max(int(y1), int(y0) + 1)

    def _smear(self, image: Image, box: tuple[int, int, int, int], snapshot: Snapshot) -> None:
        """Motion blur of the skin: halves of the palm's way averaged, twice."""
        way = snapshot.speed_uv[list(PALM_HULL)].mean(axis=0) * self._view.exposure_s
        roi = image[box[1] : box[3], box[0] : box[2]]
        for share in (0.5, 0.25):
            dx, dy = np.round(way * share).astype(int)
            if dx == 0 and dy == 0:
                continue
            # Moved half to each side, so that the middle stays at mid-exposure.
            height, width = roi.shape[:2]
            padded = cv2.copyMakeBorder(roi, abs(dy), abs(dy), abs(dx), abs(dx), cv2.BORDER_REPLICATE)
            ay, ax = abs(dy) + dy // 2, abs(dx) + dx // 2
            by, bx = ay - dy, ax - dx
            cv2.addWeighted(
                padded[ay : ay + height, ax : ax + width],
                0.5,
                padded[by : by + height, bx : bx + width],
                0.5,
                0,
                roi,
            )

    def _painted(self, snapshot: Snapshot, cards: tuple[Shape, ...]) -> list[_Painted]:
        """Every marker with what it covers, everything nearer cut out."""
        surface, view = self._view.surface, self._view
        low, high = snapshot.outlines[:, 0].min(axis=1), snapshot.outlines[:, 0].max(axis=1)
        palm = Shape(self._hulls(snapshot, PALM_HULL)[0], snapshot.speed_uv[list(PALM_HULL)].mean(axis=0))
        skin = [
            Shape(snapshot.outlines[k, 0], snapshot.speed_uv[CAPSULES[k]].mean(axis=0))
            for k in range(PHALANGES)
        ]
        caps = [
            Shape(raster.hull(uv), snapshot.speed_uv[k])
            for uv, k in zip(snapshot.cap_uv, view.cap_centre, strict=True)
        ]
        centre = snapshot.points[view.cap_centre]
        phalanx = view.phalanx_depth(snapshot, snapshot.uv[view.cap_centre]) < centre[:, 2:]
        hidden = view.behind_palm(snapshot, centre)
        painted: list[_Painted] = []
        for c, cap in enumerate(surface.caps):
            shape = caps[c]
            touched = raster.overlaps(low[:PHALANGES], high[:PHALANGES], *_reach(shape)) & phalanx[c]
            touched[3 * cap.finger + 2] = False
            nearer = [skin[k] for k in np.flatnonzero(touched)]
            nearer += [caps[n] for n in range(len(caps)) if n != c and centre[n, 2] < centre[c, 2]]
            nearer += [*([palm] if hidden[c] else []), *cards]
            cover = raster.cover(
                shape, view.own_finger(snapshot, c), nearer, self._moments(shape), self._size
            )
            painted.append(_Painted(cap.marker, cover, shape, float(snapshot.t_s[cap.centre])))
        for box in surface.boxes:
            corners = snapshot.points[box.corners]
            shape = Shape(raster.hull(snapshot.uv[box.corners]), snapshot.speed_uv[box.corners].mean(axis=0))
            before = (
                view.phalanx_depth(snapshot, snapshot.uv[box.corners].mean(axis=0)) < corners[:, 2].mean()
            )
            touched = raster.overlaps(low[:PHALANGES], high[:PHALANGES], *_reach(shape)) & before
            nearer = [skin[k] for k in np.flatnonzero(touched)]
            nearer += [*([] if view.shows_back(snapshot) else [palm]), *cards]
            cover = raster.cover(shape, None, nearer, self._moments(shape), self._size)
            painted.append(_Painted(box.marker, cover, shape, float(snapshot.t_s[box.corners.start])))
        return sorted(painted, key=lambda item: item.marker)

    def _moments(self, shape: Shape) -> Float:
        """Moments of the exposure [s] at which a marker is drawn: about one per pixel of way."""
        exposure = self._view.exposure_s
        n = int(np.clip(np.ceil(np.hypot(*shape.velocity) * exposure / BLUR_STEP_PX), 1, MAX_STEPS))
        return ((np.arange(n) + 0.5) / n - 0.5) * exposure

    def _clusters(self, painted: list[_Painted]) -> list[list[_Painted]]:
        """Markers whose windows touch, together; markers outside the image or hidden left out."""
        groups: list[tuple[Float, Float, list[_Painted]]] = []
        for item in painted:
            cover = item.coverage
            low = np.array([cover.x, cover.y], dtype=np.float64) - 2.0
            high = low + np.array(cover.alpha.shape[::-1]) + 4.0
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

    def _paint_window(
        self, image: Image, group: list[_Painted], snapshot: Snapshot
    ) -> tuple[int, int, Image]:
        """Paint a group of markers and blur its window, all in linear light; where it goes, and its pixels."""
        width, height = self._size
        x0 = max(min(p.coverage.x for p in group) - 2, 0)
        y0 = max(min(p.coverage.y for p in group) - 2, 0)
        x1 = min(max(p.coverage.x + p.coverage.alpha.shape[1] for p in group) + 2, width)
        y1 = min(max(p.coverage.y + p.coverage.alpha.shape[0] for p in group) + 2, height)
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

    def _look(self, item: _Painted, snapshot: Snapshot, box: tuple[int, int, int, int]) -> Image:
        """Colours of one marker's surface over a pixel box, as if it filled it."""
        x0, y0, x1, y1 = box
        look = np.empty((y1 - y0, x1 - x0, 3), dtype=np.uint8)
        view, corner, shades = self._view, np.array([x0, y0]), self._paint_shades[item.marker]
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
                normal = unit(np.cross(top[1] - top[0], top[3] - top[0]))
                facing = float(normal @ view.to_light) * (-1.0 if float(normal @ top[0]) > 0.0 else 1.0)
                raster.fill(look, raster.fixed(uv[:4]), light.face_shade(self._paint[item.marker], facing))
        return look

    def _truth(self, painted: list[_Painted]) -> MarkerView:
        covers = [item.coverage for item in painted]
        return MarkerView(
            uv=np.stack([raster.centroid(cover) for cover in covers]),
            visible=np.array([cover.share for cover in covers]),
            area=np.array([float(cover.alpha.sum()) for cover in covers]),
            t_s=np.array([item.t_s for item in painted]),
        )


def _reach(shape: Shape) -> tuple[Float, Float]:
    """Corners of a box around an outline, with room for motion during the exposure [px]."""
    return shape.corners.min(axis=0) - 8.0, shape.corners.max(axis=0) + 8.0


def _finger_parts(snapshot: Snapshot) -> list[tuple[int, ...]]:
    """Capsules of every finger, cut where it is strongly bent."""
    way = snapshot.points[CAPSULES[:, 1]] - snapshot.points[CAPSULES[:, 0]]
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
    parts: list[tuple[int, ...]] = []
    for f in range(5):
        part = [3 * f]
        for k in (1, 2):
            if float(way[3 * f + k] @ way[3 * f + k - 1]) < BEND_COSINE:
                parts.append(tuple(part))
                part = []
            part.append(3 * f + k)
        parts.append(tuple(part))
    return parts
