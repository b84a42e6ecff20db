"""Painters draw markers, beads and tags and record their ground truth.

Pixel coverage is measured with everything nearer cut out, and the same coverage blends the marker's colour into the
image in linear light, so image and truth come from one drawing.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import cv2
import numpy as np

from common.arrays import Float, Image
from common.geometry.transforms import cross
from common.sim import light, raster
from common.sim.light import LENS_SIGMA_PX, Float32
from common.sim.objects_seen import SeenBead, SeenPart, SeenSheet, sheet_appearance
from common.sim.raster import Coverage, Shape
from common.sim.surface import unit
from common.sim.view import NO_PHALANX, REACH_PX, Places, Snapshot, View, hand_before, things_before

Box = tuple[int, int, int, int]  # x0, y0, x1, y1 [px]


@dataclass(frozen=True, slots=True, eq=False)
class ObjectView:
    """Ground truth of what one camera sees of one tracked object in one frame.

    Features as `TrackedObjects.features`.

    Attributes:
        visible: (F,) visible share of the outline of each bead and of the paper of each tag, which is 0 from
            behind.
        corners_uv: (tags, 4, 2) [px] corners of the black squares, hidden or not, each where it is when its
            own row is exposed, as `tag_corners` has them; NaN from behind.
        t_s: (F,) scene time [s] at which the row of each is at mid-exposure.
    """

    visible: Float
    corners_uv: Float
    t_s: Float


@dataclass(frozen=True, slots=True, eq=False)
class PaintedFeature:
    """A bead or a tag of one frame, and what it covers."""

    feature: SeenBead | SeenSheet
    coverage: Coverage


class ObjectPainter:
    """Renderer of the beads and tags of one view; every call is pure."""

    def __init__(self, view: View, tables: light.SrgbTables) -> None:
        """Prepare colours; CalibrationError: a bead's marker has none."""
        self._view, self._tables = view, tables
        self._size = (view.optics.width_px, view.optics.height_px)
        names = view.scene.rig.markers
        colours = {
            b.marker: light.marker_colour(names[b.marker]) for b in view.objects.beads if b.marker is not None
        }
        self._shades = {
            marker: light.shades(marker_colour, gloss=0.02) for marker, marker_colour in colours.items()
        }
        self._shine = {
            marker: light.bgr_bytes(np.array(marker_colour) + 0.10)
            for marker, marker_colour in colours.items()
        }

    def cover(
        self, snapshot: Snapshot, cards: tuple[Shape, ...], hand: Sequence[tuple[Shape, float]]
    ) -> list[PaintedFeature]:
        """Every bead and every tag that shows its front, everything nearer cut out.

        Args:
            cards: Occluders before all else.
            hand: Outlines of the hand's markers and their depths [m].
        """
        tracked = snapshot.tracked
        features: list[tuple[SeenBead | SeenSheet, SeenPart | None]] = [(b, b.part) for b in tracked.beads]
        features += [
            (sheet, None if sheet.sheet.on is None else tracked.parts[sheet.sheet.on])
            for sheet in tracked.sheets
            if sheet.shows
        ]
        if not features:
            return []
        at = np.array([feature.at for feature, _ in features])
        shapes = [feature.shape for feature, _ in features]
        places = Places(
            uv=np.array([feature.uv for feature, _ in features]),
            depth=at[:, 2],
            low=np.array([shape.corners.min(axis=0) for shape in shapes]) - REACH_PX,
            high=np.array([shape.corners.max(axis=0) for shape in shapes]) + REACH_PX,
            behind_palm=self._view.behind_palm(snapshot, at),
            phalanx=np.full(len(features), NO_PHALANX),
        )
        boxes = np.array([(one.corners.min(axis=0), one.corners.max(axis=0)) for one, _ in hand])
        boxes = boxes.reshape(-1, 2, 2)
        away = np.array([depth for _, depth in hand])
        markers: list[raster.Marker] = []
        for k, surface in enumerate(hand_before(snapshot, places)):
            depth = float(places.depth[k])
            over = (away < depth) & raster.overlaps(boxes[:, 0], boxes[:, 1], places.low[k], places.high[k])
            touching_m = 0.001  # a tag lies on what it is stuck on
            things = things_before(snapshot, places, k, depth - touching_m, features[k][1])
            nearer = (*things, *surface, *(hand[int(n)][0] for n in np.flatnonzero(over)), *cards)
            markers.append(raster.Marker(shapes[k], nearer))
        covers = raster.cover(markers, self._view.exposure_s, self._size)
        return [PaintedFeature(feature, cover) for (feature, _), cover in zip(features, covers, strict=True)]

    def appearance(self, item: PaintedFeature, box: Box) -> Float32:
        """Linear light (h, w, 3) as if the item's surface filled pixels x0, y0, x1, y1."""
        if isinstance(item.feature, SeenSheet):
            return sheet_appearance(
                item.feature, raster.moments(item.feature.shape, self._view.exposure_s), box
            )
        x0, y0, x1, y1 = box
        bead, corner = item.feature, np.array([x0, y0])
        assert bead.bead.marker is not None
        shades = self._shades[bead.bead.marker]
        appearance = np.empty((y1 - y0, x1 - x0, 3), dtype=np.uint8)
        appearance[:] = shades[0]
        for band, shade in zip(bead.bands[1:], shades[1:], strict=True):
            raster.fill(appearance, raster.fixed(band - corner), shade)
        shine_share = 0.15  # radius of the glossy spot, share of the bead's
        spot = bead.shine_uv - corner + shine_share * bead.shine_px * self._view.circle
        raster.fill(appearance, raster.fixed(spot), self._shine[bead.bead.marker])
        return self._tables.decode(appearance)

    def truth(self, snapshot: Snapshot, painted: Sequence[PaintedFeature]) -> Mapping[str, ObjectView]:
        """What is visible of every tracked object of the scene."""
        view = self._view
        shares = {id(item.feature): item.coverage.share for item in painted}
        views: dict[str, ObjectView] = {}
        for k, name in enumerate(view.scene.rig.objects):
            beads = snapshot.tracked.beads[view.objects.beads_of[k]]
            sheets = snapshot.tracked.sheets[view.objects.sheets_of[k]]
            corners = [s.square_uv if s.shows else np.full((4, 2), np.nan) for s in sheets]
            views[name] = ObjectView(
                np.array([shares.get(id(feature), 0.0) for feature in (*beads, *sheets)]),
                np.array(corners).reshape(-1, 4, 2),
                np.array([feature.t_s for feature in (*beads, *sheets)]),
            )
        return views


MARGIN_PX = 2


@dataclass(frozen=True, slots=True, eq=False)
class MarkerView:
    """What one camera truly sees of the markers in one frame.

    Attributes:
        uv: (M, 2) centroid of the visible pixels [px], averaged over the exposure; NaN where none is visible.
        visible: (M,) visible share of the marker's own outline.
        area: (M,) visible area [px^2].
        t_s: (M,) scene time [s] at which the marker's row is at mid-exposure.
        objects: Tracked object -> what is seen of it.
    """

    uv: Float
    visible: Float
    area: Float
    t_s: Float
    objects: Mapping[str, ObjectView] = field(default_factory=dict[str, ObjectView])


@dataclass(frozen=True, slots=True, eq=False)
class Painted:
    """One marker of the hand in one frame: coverage and scene time of its row [s]."""

    marker: int
    coverage: Coverage
    t_s: float


AnyPainted: TypeAlias = Painted | PaintedFeature


@dataclass(frozen=True, slots=True, eq=False)
class Covered:
    """Everything painted in one frame: the rig's markers in order, then beads, tags."""

    markers: tuple[Painted, ...]
    features: tuple[PaintedFeature, ...]
    snapshot: Snapshot


class Painter:
    """Renderer of the markers of one view; every call is pure."""

    def __init__(self, view: View) -> None:
        """Prepare colours; CalibrationError: a marker of the rig has none."""
        self._view = view
        self._size = (view.optics.width_px, view.optics.height_px)
        self._tables = light.SrgbTables.make()
        rig = view.scene.rig
        self._colours = {
            m: light.marker_colour(n) for m, n in enumerate(rig.markers) if n not in rig.free_markers
        }
        self._shades = {
            m: (*light.shades(marker_colour, gloss=0.02), light.bgr_bytes(np.array(marker_colour) + 0.10))
            for m, marker_colour in self._colours.items()
        }
        self._sides = {m: light.face_shade(marker_colour, 0.25) for m, marker_colour in self._colours.items()}
        self._caps = {cap.marker: c for c, cap in enumerate(view.surface.caps)}
        self._boxes = {box.marker: box.corners for box in view.surface.boxes}
        self._objects = ObjectPainter(view, self._tables)

    def cover(self, snapshot: Snapshot, cards: tuple[Shape, ...]) -> Covered:
        """Every marker, bead and tag with what it covers, everything nearer cut out."""
        view, speed = self._view, snapshot.speed_uv
        caps, boxes = view.surface.caps, view.surface.boxes
        box_uv = np.array([snapshot.uv[box.corners] for box in boxes]).reshape(-1, 8, 2)
        ways = [*speed[view.cap_centre], *(speed[box.corners].mean(axis=0) for box in boxes)]
        outlines = [
            Shape(raster.hull(uv), way) for uv, way in zip((*snapshot.cap_uv, *box_uv), ways, strict=True)
        ]
        places = self._places(snapshot, box_uv)
        # Caps hide each other; boxes lie flat on the palm.
        touching = raster.overlaps(places.low[:, None], places.high[:, None], places.low, places.high)
        touching &= places.depth[:, None] > places.depth
        touching[:, len(caps) :] = touching[len(caps) :] = False
        markers = [
            raster.Marker(
                outlines[k],
                (
                    *surface,
                    *(outlines[n] for n in np.flatnonzero(touching[k])),
                    *things_before(snapshot, places, k, float(places.depth[k])),
                    *cards,
                ),
                view.own_finger(snapshot, k) if k < len(caps) else None,
            )
            for k, surface in enumerate(hand_before(snapshot, places))
        ]
        numbers = [marker.marker for marker in (*caps, *boxes)]
        points = [*view.cap_centre.tolist(), *(box.corners.start for box in boxes)]
        covers = raster.cover(markers, view.exposure_s, self._size)
        painted = [
            Painted(number, cover, float(snapshot.t_s[point]))
            for number, cover, point in zip(numbers, covers, points, strict=True)
        ]
        hand = list(zip(outlines, places.depth.tolist(), strict=True))
        features = self._objects.cover(snapshot, cards, hand) if view.objects.local.size else ()
        return Covered(tuple(sorted(painted, key=lambda item: item.marker)), tuple(features), snapshot)

    def _places(self, snapshot: Snapshot, box_uv: Float) -> Places:
        """Positions of the hand's markers: caps, then boxes, corners (B, 8, 2) [px]."""
        view = self._view
        boxes = [box.corners for box in view.surface.boxes]
        corners = snapshot.cap_uv, box_uv
        centre = snapshot.points[view.cap_centre]
        return Places(
            uv=np.concatenate([snapshot.uv[view.cap_centre], box_uv.mean(axis=1)]),
            depth=np.append(centre[:, 2], [snapshot.points[b, 2].mean() for b in boxes]),
            low=np.concatenate([uv.min(axis=1) for uv in corners]) - REACH_PX,
            high=np.concatenate([uv.max(axis=1) for uv in corners]) + REACH_PX,
            behind_palm=np.append(
                view.behind_palm(snapshot, centre), [not view.shows_back(snapshot)] * len(boxes)
            ),
            phalanx=np.array([3 * cap.finger + 2 for cap in view.surface.caps] + [NO_PHALANX] * len(boxes)),
        )

    def window(self, image: Image, group: list[AnyPainted], snapshot: Snapshot) -> tuple[int, int, Image]:
        """Draw and blur the window of a group, in linear light; its x, y and pixels."""
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
            box = cx0, cy0, cx1, cy1
            if isinstance(item, Painted):
                appearance = self._tables.decode(self._appearance(item, snapshot, box))
            else:
                appearance = self._objects.appearance(item, box)
            part = window[cy0 - y0 : cy1 - y0, cx0 - x0 : cx1 - x0]
            part += (appearance - part) * alpha
        window = cv2.GaussianBlur(window, (3, 3), LENS_SIGMA_PX)
        left, top = int(x0 > 0), int(y0 > 0)
        inner = window[top : -1 if y1 < height else None, left : -1 if x1 < width else None]
        return x0 + left, y0 + top, self._tables.encode(np.asarray(inner, dtype=np.float32))

    def _appearance(self, item: Painted, snapshot: Snapshot, box: Box) -> Image:
        """Colours of one marker's surface over a pixel box, as if it filled it."""
        x0, y0, x1, y1 = box
        appearance = np.empty((y1 - y0, x1 - x0, 3), dtype=np.uint8)
        cap = self._caps.get(item.marker)
        if cap is not None:
            base, *bands = self._shades[item.marker]
            cv2.rectangle(appearance, (0, 0), (x1 - x0, y1 - y0), base, cv2.FILLED)
            corners = snapshot.bands[cap] - raster.fixed(np.array([x0, y0]))
            for outline, colour in zip(corners, bands, strict=True):
                raster.fill(appearance, outline, colour)
            return appearance
        side = self._boxes[item.marker]
        cv2.rectangle(appearance, (0, 0), (x1 - x0, y1 - y0), self._sides[item.marker], cv2.FILLED)
        top = snapshot.points[side][:4]
        normal = unit(cross(top[1] - top[0], top[3] - top[0]))
        facing = float(normal @ self._view.to_light) * (-1.0 if float(normal @ top[0]) > 0.0 else 1.0)
        corners = raster.fixed(snapshot.uv[side][:4] - (x0, y0))
        raster.fill(appearance, corners, light.face_shade(self._colours[item.marker], facing))
        return appearance

    def clusters(self, painted: Covered) -> list[list[AnyPainted]]:
        """Group markers whose windows touch; without those outside or hidden."""
        groups: list[tuple[Box, list[AnyPainted]]] = []
        for item in (*painted.markers, *painted.features):
            cover = item.coverage
            height, width = cover.alpha.shape
            x0, y0 = cover.x - MARGIN_PX, cover.y - MARGIN_PX
            x1, y1 = cover.x + width + MARGIN_PX, cover.y + height + MARGIN_PX
            if x1 <= 0 or y1 <= 0 or x0 >= self._size[0] or y0 >= self._size[1] or not cover.alpha.any():
                continue
            box: Box = (x0, y0, x1, y1)
            members: list[AnyPainted] = [item]
            while touching := [group for group in groups if _touch(box, group[0])]:
                for other, others in touching:
                    box = _around(box, other)
                    members += others
                groups = [group for group in groups if group not in touching]
            groups.append((box, members))
        return [members for _, members in groups]

    def truth(self, painted: Covered) -> MarkerView:
        """What is visible of all markers, in the order of the rig, and of the objects."""
        count = len(self._view.scene.rig.markers)
        uv, t_s = np.full((count, 2), np.nan), np.full(count, np.nan)
        visible, area = np.zeros(count), np.zeros(count)
        for marker, cover, when in _of_markers(painted):
            uv[marker], t_s[marker] = raster.centroid(cover), when
            visible[marker], area[marker] = cover.share, float(cover.alpha.sum())
        objects = self._objects.truth(painted.snapshot, painted.features)
        return MarkerView(uv, visible, area, t_s, objects)


def _of_markers(painted: Covered) -> Iterator[tuple[int, Coverage, float]]:
    """Place in the rig, coverage and moment [s] of all markers, on hands and objects."""
    for item in painted.markers:
        yield item.marker, item.coverage, item.t_s
    for item in painted.features:
        if isinstance(item.feature, SeenBead) and item.feature.bead.marker is not None:
            yield item.feature.bead.marker, item.coverage, item.feature.t_s


def _around(a: Box, b: Box) -> Box:
    return min(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), max(a[3], b[3])


def _touch(a: Box, b: Box) -> bool:
    return a[0] <= b[2] and b[0] <= a[2] and a[1] <= b[3] and b[1] <= a[3]
