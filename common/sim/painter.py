"""A painter draws markers, beads and tags and records their ground truth.

Pixel coverage is measured with everything nearer cut out, and the same coverage blends the marker's colour into the
image in linear light, so image and truth come from one drawing.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from common.arrays import Bool, Float, Image
from common.geometry.transforms import cross
from common.sim import light, raster
from common.sim.light import LENS_SIGMA_PX, Float32
from common.sim.objects_seen import Colour, SeenBead, SeenSheet, sheet_appearance
from common.sim.raster import Coverage, Int32, Shape
from common.sim.surface import unit
from common.sim.view import NO_PHALANX, Places, Snapshot, View, hand_before, things_before

Box = tuple[int, int, int, int]  # x0, y0, x1, y1 [px]
MARGIN_PX = 2


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
    """What is painted in one frame.

    Attributes:
        marker: Place in the rig; None of a tag.
        t_s: Scene time of its row [s].
        by, snapshot: Who paints it, and of what.
        feature: Bead or tag of an object; None of a marker on the hand.
    """

    marker: int | None
    coverage: Coverage
    t_s: float
    by: "Painter"
    snapshot: Snapshot
    feature: SeenBead | SeenSheet | None = None

    @property
    def box(self) -> Box:
        """The pixels that it may cover."""
        height, width = self.coverage.alpha.shape
        x, y = self.coverage.x, self.coverage.y
        return x, y, x + width, y + height


class Painter:
    """Renderer of the markers, beads and tags of one view; every call is pure."""

    def __init__(self, view: View) -> None:
        """Prepare colours; CalibrationError: a marker of hand or object has none."""
        self.view = view
        self._size = (view.optics.width_px, view.optics.height_px)
        rig, beads = view.scene.rig, view.scene.tracked.beads
        self._colours = {
            m: light.marker_colour(name)
            for m, name in enumerate(rig.markers)
            if name not in rig.free_markers or m in beads
        }
        self._shades = {
            m: (*light.shades(colour, gloss=0.02), light.bgr_bytes(np.array(colour) + 0.10))
            for m, colour in self._colours.items()
        }
        self._caps = {cap.marker: c for c, cap in enumerate(view.surface.caps)}
        self._boxes = {box.marker: box.corners for box in view.surface.boxes}

    def cover(
        self, snapshot: Snapshot, cards: tuple[Shape, ...], hands: Sequence[Shape] = ()
    ) -> list[Painted]:
        """Every marker in order, then beads and tags, everything nearer cut out.

        `hands`: outlines of the hands before this one.
        """
        view, speed = self.view, snapshot.speed_uv
        caps, boxes = view.surface.caps, view.surface.boxes
        box_uv = [snapshot.uv[box.corners] for box in boxes]
        corners_uv = (*snapshot.cap_uv, *box_uv)
        ways = [*speed[view.cap_centre], *(speed[box.corners].mean(axis=0) for box in boxes)]
        outlines = [Shape(raster.hull(uv), way) for uv, way in zip(corners_uv, ways, strict=True)]
        centre = snapshot.points[view.cap_centre]
        places = Places.of(
            [*snapshot.uv[view.cap_centre], *(uv.mean(axis=0) for uv in box_uv)],
            np.append(centre[:, 2], [snapshot.points[box.corners, 2].mean() for box in boxes]),
            corners_uv,
            np.append(view.behind_palm(snapshot, centre), [not view.shows_back(snapshot)] * len(boxes)),
            np.array([3 * cap.finger + 2 for cap in caps] + [NO_PHALANX] * len(boxes)),
        )
        # Caps hide each other; boxes lie flat on the palm.
        touching = raster.overlaps(places.low[:, None], places.high[:, None], places.low, places.high)
        touching &= places.depth[:, None] > places.depth
        touching[:, len(caps) :] = touching[len(caps) :] = False
        things = things_before(snapshot, places, places.depth)
        before = _over(hands, places)
        markers = [
            raster.Marker(
                outlines[k],
                (
                    *surface,
                    *(outlines[n] for n in np.flatnonzero(touching[k])),
                    *things[k],
                    *(hands[n] for n in np.flatnonzero(before[k]).tolist()),
                    *cards,
                ),
                view.own_finger(snapshot, k) if k < len(caps) else None,
            )
            for k, surface in enumerate(hand_before(snapshot, places))
        ]
        covers = raster.cover(markers, view.exposure_s, self._size)
        points = [*view.cap_centre.tolist(), *(box.corners.start for box in boxes)]
        painted = {
            on.marker: Painted(on.marker, cover, float(snapshot.t_s[point]), self, snapshot)
            for on, cover, point in zip((*caps, *boxes), covers, points, strict=True)
        }
        features = self._cover_features(snapshot, cards, outlines, places.depth)
        return [*(painted[marker] for marker in sorted(painted)), *features]

    def _cover_features(
        self, snapshot: Snapshot, cards: tuple[Shape, ...], hand: Sequence[Shape], hand_depth: Float
    ) -> list[Painted]:
        """Every bead and every tag that shows its front, behind the markers of the hand."""
        tracked = snapshot.tracked
        features = [*tracked.beads, *(sheet for sheet in tracked.sheets if sheet.shows)]
        if not features:
            return []
        on = [
            feature.part
            if isinstance(feature, SeenBead)
            else None
            if feature.sheet.on is None
            else tracked.parts[feature.sheet.on]
            for feature in features
        ]
        at = np.array([feature.at for feature in features])
        shapes = [feature.shape for feature in features]
        places = Places.of(
            [feature.uv for feature in features],
            at[:, 2],
            [shape.corners for shape in shapes],
            self.view.behind_palm(snapshot, at),
            np.full(len(features), NO_PHALANX),
        )
        over = _over(hand, places) & (hand_depth < places.depth[:, None])
        touching_m = 0.001  # a tag lies on what it is stuck on
        things = things_before(snapshot, places, places.depth - touching_m, on)
        markers = [
            raster.Marker(
                shapes[k],
                (*things[k], *surface, *(hand[n] for n in np.flatnonzero(over[k]).tolist()), *cards),
            )
            for k, surface in enumerate(hand_before(snapshot, places))
        ]
        covers = raster.cover(markers, self.view.exposure_s, self._size)
        return [
            Painted(
                feature.marker if isinstance(feature, SeenBead) else None,
                cover,
                feature.t_s,
                self,
                snapshot,
                feature,
            )
            for feature, cover in zip(features, covers, strict=True)
        ]

    def window(self, image: Image, group: list[Painted]) -> tuple[int, int, Image]:
        """Draw and blur the window of a group, in linear light; its x, y and pixels."""
        width, height = self._size
        every = np.array([item.box for item in group])
        x0, y0 = np.maximum(every[:, :2].min(axis=0) - MARGIN_PX, 0).tolist()
        x1, y1 = np.minimum(every[:, 2:].max(axis=0) + MARGIN_PX, self._size).tolist()
        window = light.decode(image[y0:y1, x0:x1])
        for item in group:
            x, y, right, bottom = item.box
            box = left, top, right, bottom = max(x, x0), max(y, y0), min(right, x1), min(bottom, y1)
            if left >= right or top >= bottom:
                continue
            alpha = item.coverage.alpha[top - y : bottom - y, left - x : right - x, None]
            part = window[top - y0 : bottom - y0, left - x0 : right - x0]
            part += (item.by._appearance(item, box) - part) * alpha
        window = cv2.GaussianBlur(window, (3, 3), LENS_SIGMA_PX)
        left, top = int(x0 > 0), int(y0 > 0)
        inner = window[top : -1 if y1 < height else None, left : -1 if x1 < width else None]
        return x0 + left, y0 + top, light.encode(np.asarray(inner, dtype=np.float32))

    def _appearance(self, item: Painted, box: Box) -> Float32:
        """Linear light (h, w, 3) as if the item's surface filled a box of pixels."""
        x0, y0, x1, y1 = box
        if isinstance(item.feature, SeenSheet):
            sheet = item.feature
            return sheet_appearance(sheet, raster.moments(sheet.shape, self.view.exposure_s), box)
        base, fills = self._fills(item, item.snapshot)
        appearance = np.empty((y1 - y0, x1 - x0, 3), dtype=np.uint8)
        appearance[:] = base
        corner = raster.fixed(np.array([x0, y0]))
        for outline, colour in fills:
            raster.fill(appearance, outline - corner, colour)
        return light.decode(appearance)

    def _fills(self, item: Painted, snapshot: Snapshot) -> tuple[Colour, list[tuple[Int32, Colour]]]:
        """Colour of a marker, and what is drawn over that, outlines as `raster.fixed`."""
        assert item.marker is not None
        if item.marker in self._boxes:
            side, colour = self._boxes[item.marker], self._colours[item.marker]
            top = snapshot.points[side][:4]
            normal = unit(cross(top[1] - top[0], top[3] - top[0]))
            facing = float(normal @ self.view.to_light) * (-1.0 if float(normal @ top[0]) > 0.0 else 1.0)
            above = raster.fixed(snapshot.uv[side][:4]), light.face_shade(colour, facing)
            return light.face_shade(colour, 0.25), [above]
        bead, (base, *colours) = item.feature, self._shades[item.marker]
        bands = bead.bands if isinstance(bead, SeenBead) else snapshot.bands[self._caps[item.marker]]
        return base, list(zip(bands, colours, strict=True))

    def clusters(self, painted: Sequence[Painted]) -> list[list[Painted]]:
        """Group markers whose windows touch; without those outside or hidden."""
        groups: list[tuple[Box, list[Painted]]] = []
        for item in painted:
            x0, y0, x1, y1 = item.box
            box = x0 - MARGIN_PX, y0 - MARGIN_PX, x1 + MARGIN_PX, y1 + MARGIN_PX
            outside = not _touch(box, (1, 1, self._size[0] - 1, self._size[1] - 1))
            if outside or not item.coverage.alpha.any():
                continue
            members = [item]
            while touching := [group for group in groups if _touch(box, group[0])]:
                for other, others in touching:
                    box = around(box, other)
                    members += others
                groups = [group for group in groups if group not in touching]
            groups.append((box, members))
        return [members for _, members in groups]

    def truth(self, painted: Sequence[Painted], snapshot: Snapshot) -> MarkerView:
        """What is visible of all markers, in the order of the rig, and of the objects."""
        view = self.view
        count = len(view.scene.rig.markers)
        uv, t_s = np.full((count, 2), np.nan), np.full(count, np.nan)
        visible, area = np.zeros(count), np.zeros(count)
        for item in painted:
            if item.marker is not None:
                uv[item.marker], t_s[item.marker] = raster.centroid(item.coverage), item.t_s
                visible[item.marker] = item.coverage.share
                area[item.marker] = float(item.coverage.alpha.sum())
        shares = {id(item.feature): item.coverage.share for item in painted}
        objects: dict[str, ObjectView] = {}
        for k, name in enumerate(view.scene.rig.objects):
            beads = snapshot.tracked.beads[view.objects.beads_of[k]]
            sheets = snapshot.tracked.sheets[view.objects.sheets_of[k]]
            corners = [s.square_uv if s.shows else np.full((4, 2), np.nan) for s in sheets]
            objects[name] = ObjectView(
                np.array([shares.get(id(feature), 0.0) for feature in (*beads, *sheets)]),
                np.array(corners).reshape(-1, 4, 2),
                np.array([feature.t_s for feature in (*beads, *sheets)]),
            )
        return MarkerView(uv, visible, area, t_s, objects)


def _over(shapes: Sequence[Shape], places: Places) -> Bool:
    """Which of S shapes (N, S) reach into the box of each of N markers."""
    low, high = (np.array([f(one.corners, axis=0) for one in shapes]) for f in (np.min, np.max))
    return raster.overlaps(low.reshape(-1, 2), high.reshape(-1, 2), places.low[:, None], places.high[:, None])


def around(a: Box, b: Box) -> Box:
    """The least box about two."""
    return min(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), max(a[3], b[3])


def _touch(a: Box, b: Box) -> bool:
    return a[0] <= b[2] and b[0] <= a[2] and a[1] <= b[3] and b[1] <= a[3]
