"""Beads and tags of tracked objects: image coverage, appearance and ground truth.

As with a hand's markers (`painter`), everything nearer is cut out of the coverage, and the same coverage blends the
marker colour into the image.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.arrays import Float
from common.sim import light, raster
from common.sim.before import NO_PHALANX, REACH_PX, Places, hand_before, things_before
from common.sim.objects_seen import SeenBead, SeenPart, SeenSheet
from common.sim.raster import Coverage, Shape
from common.sim.tag_painter import sheet_appearance
from common.sim.view import Snapshot, View

Float32 = npt.NDArray[np.float32]
Box = tuple[int, int, int, int]


@dataclass(frozen=True, slots=True, eq=False)
class ObjectView:
    """Ground truth of what one camera sees of one tracked object in one frame.

    Features as `TrackedObjects.features`.

    Attributes:
        visible: (F,) visible share of the outline of each bead and of the paper of each tag, which is 0 from behind.
        corners_uv: (tags, 4, 2) [px] corners of the black squares, hidden or not, each where it is when its own row is
            exposed, as `tag_corners` has them; NaN from behind.
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
    """Renderer of the beads and tags of one view.

    It holds prepared colours; every call is pure.
    """

    def __init__(self, view: View, tables: light.SrgbTables) -> None:
        """Prepare colours.

        Raises:
            CalibrationError: A bead's marker has no colour.
        """
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
            snapshot: The image.
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
        """Return the linear light of the item's surface over a box of pixels.

        Shape (h, w, 3), over pixels x0, y0, x1, y1, as if the surface filled them.
        """
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
