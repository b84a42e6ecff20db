"""Renderer from scene to camera image, with the truth of what each marker shows.

Order of drawing: desk; of each hand, the nearer wholly before the farther, finger parts, palm and things from far to
near, each as nested outlines that make it look round; sleeve (first where the camera looks into it); motion blur; card;
markers (see `painter`); lens blur; the light, where it is not the calibrated one; noise.

Another light multiplies the finished picture, channel by channel, in linear light. A highlight that is already white
there stays as bright as a white marker in the new light, also where a real one would outshine it. Another exposure or
gain of the camera does the same (`Renderer.exposed`), and a longer exposure smears more.
"""

from collections.abc import Iterable
from copy import copy
from functools import reduce

import cv2
import numpy as np

from common.arrays import Float, Image
from common.geometry.srgb import gain_tables
from common.sim import light, raster
from common.sim.light import LENS_SIGMA_PX, NoiseTiles, desk_image
from common.sim.objects_seen import Colour, SeenPart
from common.sim.painter import Box, MarkerView, Painted, Painter, around
from common.sim.raster import Shape
from common.sim.scene import DESK_DEPTH_M, Scene
from common.sim.surface import CAPSULES, PALM_HULL
from common.sim.view import LAYERS, Snapshot, View, outlines_of

_PALM = list(PALM_HULL)
ROOTS = (0, 3, 6, 9, 12)  # capsules that begin at the palm
_Shown = tuple[Snapshot, list[Painted]]  # what is seen of one hand, and what is painted on it


class Renderer:
    """Renderer of one scene by one camera; a frame is a pure function of t."""

    def __init__(self, scene: Scene, camera: str) -> None:
        """Prepare all (some 0.1 s); CalibrationError: no such camera, no such colour."""
        self._painters = tuple(Painter(View(one, camera)) for one in (scene, *scene.others))
        self._view = self._painters[0].view
        optics = self._view.optics
        place = scene.rig.cameras.index(camera)
        self._size = (optics.width_px, optics.height_px)
        self._desk = desk_image(optics, DESK_DEPTH_M, scene.seed)
        self._noise = NoiseTiles(optics.height_px, optics.width_px, scene.seed * 64 + place)
        self._skin = light.shades(light.SKIN_LINEAR_RGB, gloss=0.01)
        self._sleeve = light.shades(light.SLEEVE_LINEAR_RGB)
        self._light = scene.light
        self._gains_bgr = np.ones(3)
        self._card = light.face_shade(light.CARD_LINEAR_RGB, 0.8)

    def exposed(self, exposure_us: float, gains_bgr: Float) -> "Renderer":
        """Return a renderer of the same scene for a camera with other settings.

        Args:
            exposure_us: Exposure [us], which smears what moves.
            gains_bgr: Brightness (3,) of the channels in linear light, blue first, against that of the camera
                file that the scene was made with. The noise stays as it is.
        """
        other = copy(self)
        other._painters = tuple(Painter(one.view.exposed(exposure_us)) for one in self._painters)
        other._view = other._painters[0].view
        other._gains_bgr = np.array(gains_bgr, dtype=np.float64)
        return other

    def render(self, t_s: float) -> Image:
        """Image (H, W, 3) BGR; row 0 is at mid-exposure at scene time `t_s` [s]."""
        return self._draw(t_s)[0]

    def markers(self, t_s: float) -> MarkerView:
        """Truth of that frame, of the first hand, without the image."""
        return self._truth(self._cover(t_s)[0])[0]

    def observe(self, t_s: float) -> tuple[Image, MarkerView]:
        """Image of one frame, and its truth of the first hand."""
        image, hands = self.observe_all(t_s)
        return image, hands[0]

    def observe_all(self, t_s: float) -> tuple[Image, tuple[MarkerView, ...]]:
        """Image of one frame, and its truth of each hand."""
        image, hands = self._draw(t_s)
        return image, self._truth(hands)

    def _truth(self, hands: list[_Shown]) -> tuple[MarkerView, ...]:
        return tuple(
            painter.truth(painted, snapshot)
            for painter, (snapshot, painted) in zip(self._painters, hands, strict=True)
        )

    def _cover(self, t_s: float) -> tuple[list[_Shown], tuple[Shape, ...]]:
        """What is seen of each hand, and the cards before them."""
        snapshots = [painter.view.snapshot(t_s) for painter in self._painters]
        cards = self._view.cards(snapshots[0])
        shown: dict[int, _Shown] = {}
        before: list[Shape] = []
        for k in sorted(range(len(snapshots)), key=lambda k: _depth_m(snapshots[k])):
            shown[k] = snapshots[k], self._painters[k].cover(snapshots[k], cards, before)
            before += outlines_of(snapshots[k]) if len(snapshots) > 1 else []
        return [shown[k] for k in range(len(snapshots))], cards

    def _draw(self, t_s: float) -> tuple[Image, list[_Shown]]:
        """Image of one frame, and what of each hand is in it."""
        hands, cards = self._cover(t_s)
        image = self._desk.copy()
        boxes: list[Box] = []
        for snapshot, _ in sorted(hands, key=lambda one: -_depth_m(one[0])):
            self._draw_hand(image, snapshot)
            box = self._hand_box(snapshot, cards)
            self._smear(image, box, snapshot)
            if outlines := snapshot.tracked.outlines():
                points = np.vstack(outlines)
                box = around(box, self._box(points.min(axis=0) - 6.0, points.max(axis=0) + 6.0))
            boxes.append(box)
        for card in cards:
            raster.fill(image, raster.fixed(card.corners), self._card)
        painter, painted = self._painters[0], [item for _, every in hands for item in every]
        windows = [painter.window(image, group) for group in painter.clusters(painted)]
        left, top, right, bottom = reduce(around, boxes)
        roi = image[top:bottom, left:right]
        cv2.GaussianBlur(roi, (3, 3), LENS_SIGMA_PX, dst=roi)
        for x, y, patch in windows:
            image[y : y + patch.shape[0], x : x + patch.shape[1]] = patch
        gains_bgr = self._gains_bgr
        if self._light is not None:
            gains_bgr = gains_bgr * self._light.at(max(t_s, 0.0) % self._view.scene.period_s).gains_bgr()
        if (gains_bgr != 1.0).any():
            image = np.asarray(cv2.LUT(image, gain_tables(gains_bgr).T[None]), dtype=np.uint8)
        self._noise.add_to(image, round(t_s * 1e6))
        return image, hands

    def _draw_hand(self, image: Image, snapshot: Snapshot) -> None:
        corners = raster.fixed(snapshot.outlines)
        depth = snapshot.points[:, 2]
        palm_depth = float(depth[_PALM].mean())
        parts: list[tuple[float, tuple[int, ...] | SeenPart]] = [(palm_depth, ())]
        parts += [(float(one.ends_depth.mean()), one) for one in (*snapshot.things, *snapshot.tracked.parts)]
        phalanges = depth[CAPSULES].mean(axis=1).tolist()
        for part in _finger_parts(snapshot):
            # A part that grows out of the palm goes under its edge, wherever the rest of it is.
            margin = part[0] in ROOTS
            far = sum(phalanges[k] for k in part) / len(part)
            parts.append((max(far, palm_depth + 1e-6) if margin else far, part))
        palm = [
            (raster.fixed(web), raster.fixed(hull))
            for web, hull in zip(snapshot.web, snapshot.palm, strict=True)
        ]
        sleeve = list(zip(snapshot.sleeve, self._sleeve, strict=True))
        if snapshot.into_sleeve:
            _fill(image, sleeve)
        raster.fill(image, raster.fixed(snapshot.cuff_uv[0]), self._card)  # the dark inside of the sleeve
        for _, part in sorted(parts, key=lambda item: -item[0]):
            if isinstance(part, SeenPart):
                if part in snapshot.things:
                    _fill(image, part.fills)  # smeared later, with the hand
                else:
                    self._draw_part(image, part, snapshot)
                continue
            for layer in range(LAYERS):
                shapes = [corners[k, layer] for k in part] if part else [*palm[layer]]
                round_layer = 2
                if not part and layer >= round_layer:
                    shapes += [corners[k, layer] for k in ROOTS]  # knuckles and thumb flow out of the palm
                for shape in shapes:
                    raster.fill(image, shape, self._skin[layer])
        if not snapshot.into_sleeve:
            _fill(image, sleeve)

    def _draw_part(self, image: Image, part: SeenPart, snapshot: Snapshot) -> None:
        """Draw an object's part, blurred by its motion beyond the hand's, which follows."""
        own = part.shape.velocity
        speed = float(np.hypot(*own))
        smeared = float(np.hypot(*self._way(snapshot))) / self._view.exposure_s
        left = 1.0 - min(smeared / max(speed, 1e-9), 1.0)
        moments = left * raster.moments(Shape(part.outline, left * own), self._view.exposure_s)
        margin = 2.0 + np.abs(moments).max() * np.abs(part.ends_speed).max(axis=0)
        low = np.clip(np.floor(part.outline.min(axis=0) - margin), 0, self._size).astype(int)
        high = np.clip(np.ceil(part.outline.max(axis=0) + margin) + 1, 0, self._size).astype(int)
        if (low >= high).any():
            return
        under = image[low[1] : high[1], low[0] : high[0]]
        if len(moments) == 1:
            _fill(under, ((outline - low, colour) for outline, colour in part.fills))
            return
        fills = [(outline - low, part.speed(outline), colour) for outline, colour in part.fills]
        total = np.zeros(under.shape, np.float32)
        for moment in moments:
            drawn = under.copy()
            _fill(drawn, ((corners + moment * speed_uv, colour) for corners, speed_uv, colour in fills))
            cv2.accumulate(drawn, total)
        under[:] = np.rint(total / len(moments))

    def _box(self, low: Float, high: Float) -> Box:
        """Box of pixels about (2,) ... (2,) [px], inside the image."""
        size = np.array(self._size)
        x0, y0 = np.clip(np.floor(low), 0, size - 1).astype(int).tolist()
        x1, y1 = np.clip(np.ceil(high), 1, size).astype(int).tolist()
        return x0, y0, x1, y1

    def _hand_box(self, snapshot: Snapshot, cards: tuple[Shape, ...]) -> Box:
        """Box of the hand, of cards and things."""
        spread, discs = snapshot.discs_px[:, 0, None] + 6.0, snapshot.discs_uv[:, 0]
        outlines = (*(card.corners for card in cards), *(thing.outline for thing in snapshot.things))
        return self._box(
            np.vstack([discs - spread, *outlines]).min(axis=0),
            np.vstack([discs + spread, *outlines]).max(axis=0),
        )

    def _way(self, snapshot: Snapshot) -> Float:
        """How far (2,) [px] the palm moves during the exposure."""
        return snapshot.palm_speed * self._view.exposure_s

    def _smear(self, image: Image, box: Box, snapshot: Snapshot) -> None:
        """Motion blur of the skin: halves of the palm's way averaged, twice."""
        way = self._way(snapshot)
        roi = image[box[1] : box[3], box[0] : box[2]]
        for share in (0.5, 0.25):
            dx, dy = round(float(way[0]) * share), round(float(way[1]) * share)
            if dx == 0 and dy == 0:
                continue
            # Moved half to each side, so that the middle stays at mid-exposure.
            height, width = roi.shape[:2]
            padded = cv2.copyMakeBorder(roi, abs(dy), abs(dy), abs(dx), abs(dx), cv2.BORDER_REPLICATE)
            ay, ax = abs(dy) + dy // 2, abs(dx) + dx // 2
            a, b = (padded[y : y + height, x : x + width] for y, x in ((ay, ax), (ay - dy, ax - dx)))
            cv2.addWeighted(a, 0.5, b, 0.5, 0, roi)


def _depth_m(snapshot: Snapshot) -> float:
    """How far a hand's palm is from the camera."""
    return float(snapshot.points[_PALM, 2].mean())


def _fill(image: Image, fills: Iterable[tuple[Float, Colour]]) -> None:
    for outline, colour in fills:
        raster.fill(image, raster.fixed(outline), colour)


def _finger_parts(snapshot: Snapshot) -> list[tuple[int, ...]]:
    """Capsules of every finger, cut where it is strongly bent."""
    way = snapshot.points[CAPSULES[:, 1]] - snapshot.points[CAPSULES[:, 0]]
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
    bend_cosine = 0.6  # a finger bent more than this is drawn in two parts, each at its own depth
    straight = (way[1:] * way[:-1]).sum(axis=1) >= bend_cosine
    parts: list[tuple[int, ...]] = []
    for f in range(5):
        part = (3 * f,)
        for k in (3 * f + 1, 3 * f + 2):
            if straight[k - 1]:
                part = (*part, k)
            else:
                parts.append(part)
                part = (k,)
        parts.append(part)
    return parts
