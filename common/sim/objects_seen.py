"""One image shows tracked objects: outlines, shading, depth, printed tags.

Key points in space (`Points`) become the outlines, shading and depth of each part in one camera's image. A tag is ink
on paper in linear light, over a box of pixels, blurred by its motion.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache

import cv2
import numpy as np

from common.arrays import Float, Image
from common.calibration.object_profile import TagFamily
from common.geometry.tag_family import tag_image
from common.geometry.transforms import cross
from common.sim import light, raster
from common.sim.light import AMBIENT, Float32
from common.sim.raster import Shape
from common.sim.surface import LAYER_SINES, rim, unit
from common.sim.tracked import BLOCK_FACES, PAPER_CELLS, Ball, Block, ObjectSurface, Rod, Sheet

Colour = tuple[int, int, int]


@dataclass(frozen=True, slots=True, eq=False)
class SeenPart:
    """A dark part, or a bead, in one image.

    Attributes:
        outline: (N, 2) [px].
        fills: Convex outlines (N, 2) [px] and their colours, in the order of drawing; none for a bead.
        ends_uv: (2, 2) [px], ends_depth: (2,) [m], ends_speed: (2, 2) [px/s] of its two ends; of what has
            none, its middle twice.
    """

    outline: Float
    fills: tuple[tuple[Float, Colour], ...]
    ends_uv: Float
    ends_depth: Float
    ends_speed: Float

    @property
    def shape(self) -> Shape:
        """Its outline, moving as its middle does."""
        return Shape(self.outline, 0.5 * (self.ends_speed[0] + self.ends_speed[1]))

    def speed(self, uv: Float) -> Float:
        """How fast (N, 2) [px/s] it moves at pixels (N, 2): each end goes its own way."""
        share = _share(uv, self.ends_uv[0], self.ends_uv[1])[:, None]
        return (1.0 - share) * self.ends_speed[0] + share * self.ends_speed[1]


@dataclass(frozen=True, slots=True, eq=False)
class SeenBead:
    """A painted ball in one image.

    Attributes:
        at: (3,) its middle [m], camera frame.
        bands: (LAYERS, N, 2) [px] its outline, then the parts on which the light falls more and more steeply.
        shine_uv: (2,) [px] where the marker mirrors the lamp; shine_px: radius of that spot.
        t_s: The moment of its row [s], scene time.
    """

    bead: Ball
    at: Float
    part: SeenPart
    bands: Float
    shine_uv: Float
    shine_px: float
    t_s: float

    @property
    def uv(self) -> Float:
        """Its middle (2,) [px]."""
        return self.part.ends_uv[0]

    @property
    def shape(self) -> Shape:
        """Its outline."""
        return self.part.shape


@dataclass(frozen=True, slots=True, eq=False)
class SeenSheet:
    """A tag in one image.

    Attributes:
        at: (3,) its middle [m], camera frame.
        paper_uv, square_uv: (4, 2) [px] corners of its paper and of its black square, each at the moment of
            its row.
        speed: (2,) [px/s].
        shows: Whether its front is turned to the camera.
        lit: Cosine of its front to the light.
        t_s: The moment of its middle row [s], scene time.
    """

    sheet: Sheet
    at: Float
    paper_uv: Float
    square_uv: Float
    speed: Float
    shows: bool
    lit: float
    t_s: float

    @property
    def uv(self) -> Float:
        """Its middle (2,) [px]."""
        return self.paper_uv.mean(axis=0)

    @property
    def shape(self) -> Shape:
        """Outline of its paper."""
        return Shape(self.paper_uv, self.speed)


@dataclass(frozen=True, slots=True, eq=False)
class SeenObjects:
    """All tracked objects in one image, in the order of `ObjectSurface`.

    Attributes:
        solid: The parts, and those of the beads: whatever may hide something. S of them.
        low, high: (S, 2) [px] boxes about their outlines.
        ends_uv, ends_depth: (S, 2, 2) [px], (S, 2) [m] as theirs.
    """

    parts: tuple[SeenPart, ...]
    beads: tuple[SeenBead, ...]
    sheets: tuple[SeenSheet, ...]
    solid: tuple[SeenPart, ...]
    low: Float
    high: Float
    ends_uv: Float
    ends_depth: Float

    @classmethod
    def of(
        cls, parts: Sequence[SeenPart], beads: Sequence[SeenBead], sheets: Sequence[SeenSheet]
    ) -> "SeenObjects":
        """Put them together."""
        solid = (*parts, *(bead.part for bead in beads))
        return cls(
            tuple(parts),
            tuple(beads),
            tuple(sheets),
            solid,
            np.array([part.outline.min(axis=0) for part in solid]).reshape(-1, 2),
            np.array([part.outline.max(axis=0) for part in solid]).reshape(-1, 2),
            np.array([part.ends_uv for part in solid]).reshape(-1, 2, 2),
            np.array([part.ends_depth for part in solid]).reshape(-1, 2),
        )

    def before(self, uv: Float, depth_m: float, low: Float, high: Float) -> list[SeenPart]:
        """Parts nearer than a depth [m] at pixel (2,) that reach into a box (2,) [px].

        The depth of a part is that of its axis where that passes nearest to the pixel.
        """
        if not self.solid:
            return []
        share = _share(uv, self.ends_uv[:, 0], self.ends_uv[:, 1])
        depth = self.ends_depth[:, 0] * (1.0 - share) + self.ends_depth[:, 1] * share
        chosen = (depth < depth_m) & raster.overlaps(self.low, self.high, low, high)
        return [self.solid[k] for k in np.flatnonzero(chosen)]

    def outlines(self) -> list[Float]:
        """Everything that can be seen of them (N, 2) [px]."""
        return [
            *(part.outline for part in self.parts),
            *(bead.part.outline for bead in self.beads),
            *(sheet.paper_uv for sheet in self.sheets if sheet.shows),
        ]


def _share(uv: Float, start: Float, stop: Float) -> Float:
    """Where (...) between `start` and `stop` (..., 2) pixels (..., 2) lie, 0 to 1."""
    along = stop - start
    return np.clip(
        ((uv - start) * along).sum(axis=-1) / np.maximum((along * along).sum(axis=-1), 1e-9), 0.0, 1.0
    )


NOTHING = SeenObjects.of((), (), ())


Project = Callable[[Float], Float]


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Key points: (K, 3) [m] camera frame, (K, 2) [px], (K, 2) [px/s], (K,) [s]."""

    at: Float
    uv: Float
    speed_uv: Float
    t_s: Float


@dataclass(frozen=True, slots=True, eq=False)
class Appearances:
    """Viewing parameters of one camera: light (3,), camera frame, focal length [px]."""

    to_light: Float
    circle: Float
    focal_px: float
    project: Project
    thing: tuple[Colour, ...] = field(default_factory=lambda: light.shades(light.THING_LINEAR_RGB))
    faces: tuple[Colour, ...] = field(
        # by the cosine to the light, from 0 to 1
        default_factory=lambda: tuple(light.face_shade(light.THING_LINEAR_RGB, k / 64.0) for k in range(65))
    )

    def seen(self, surface: ObjectSurface, points: Points) -> SeenObjects:
        """What a camera sees of the objects whose key points are there."""
        if not surface.local.size:
            return NOTHING
        rods = [part for part in surface.parts if isinstance(part, Rod)]
        balls = [*(part for part in surface.parts if isinstance(part, Ball)), *surface.beads]
        rod_rims, (edges, lit, shine) = self._rims(rods, points), self._ball_points(balls, points)
        uv = project_all(self.project, (rod_rims, edges, lit, shine))
        round_parts: dict[int, SeenPart] = {}
        for k, rod in enumerate(rods):
            round_parts[id(rod)] = self._rod(rod, uv[0][k], points)
        bands = self._bands(balls, uv[1], uv[2], points)
        for k, ball in enumerate(balls):
            fills = () if ball.marker is not None else tuple(zip(bands[k], self.thing, strict=True))
            place = [ball.middle.start] * 2  # it has no ends, its middle stands for both
            round_parts[id(ball)] = SeenPart(
                uv[1][k], fills, points.uv[place], points.at[place, 2], points.speed_uv[place]
            )
        parts = [
            self._block(part, points) if isinstance(part, Block) else round_parts[id(part)]
            for part in surface.parts
        ]
        first = len(balls) - len(surface.beads)
        beads = [
            SeenBead(
                bead,
                points.at[bead.middle][0],
                round_parts[id(bead)],
                bands[first + k],
                uv[3][first + k],
                float(self.focal_px * bead.radius_m / points.at[bead.middle, 2][0]),
                float(points.t_s[bead.middle][0]),
            )
            for k, bead in enumerate(surface.beads)
        ]
        return SeenObjects.of(parts, beads, [self._sheet(sheet, points) for sheet in surface.sheets])

    def _rims(self, rods: Sequence[Rod], points: Points) -> Float:
        """Shading edges (R, 2, LAYERS, n, 3) [m] of rods; see `surface.tube_rims`."""
        ends = np.array([points.at[rod.ends] for rod in rods]).reshape(-1, 2, 3)
        radius = np.array([rod.radius_m for rod in rods])
        axis = unit(ends[:, 1] - ends[:, 0])
        across = self.to_light - (axis @ self.to_light)[:, None] * axis
        middle = (radius[:, None] * light.LAYER_COSINES)[..., None] * across[:, None]
        layers = np.broadcast_to(axis[:, None], middle.shape)
        rims = middle[:, :, None] + rim(layers, radius[:, None] * LAYER_SINES, self.circle)
        return ends[:, :, None, None] + rims[:, None]

    def _ball_points(self, balls: Sequence[Ball], points: Points) -> tuple[Float, Float, Float]:
        """Edges (B, n, 3) [m], shading centres (B, LAYERS, 3), lamp's mirror (B, 3)."""
        middle = np.array([points.at[ball.middle][0] for ball in balls]).reshape(-1, 3)
        radius = np.array([ball.radius_m for ball in balls])
        d2 = (middle * middle).sum(axis=1)
        shrink = 1.0 - radius**2 / d2  # the circle in which the rays touch the ball
        towards = unit(middle)
        edge = (middle * shrink[:, None])[:, None] + rim(towards, radius * np.sqrt(shrink), self.circle)
        lit = middle[:, None] + (radius[:, None] * light.LAYER_COSINES)[..., None] * self.to_light
        return edge, lit, middle + radius[:, None] * unit(self.to_light - towards)

    def _bands(self, balls: Sequence[Ball], edges_uv: Float, lit_uv: Float, points: Points) -> Float:
        """Shading (B, LAYERS, n, 2) [px] of balls, the first their outlines."""
        size = np.array([self.focal_px * ball.radius_m / points.at[ball.middle, 2][0] for ball in balls])
        bands = lit_uv[:, :, None] + (size[:, None] * LAYER_SINES)[..., None, None] * self.circle
        bands[:, 0] = edges_uv
        return bands

    def _rod(self, rod: Rod, rims_uv: Float, points: Points) -> SeenPart:
        ends = points.at[rod.ends]
        axis = unit(ends[1] - ends[0])
        layers = [raster.hull(rims_uv[:, k].reshape(-1, 2)) for k in range(rims_uv.shape[1])]
        front = 0 if float(axis @ ends[0]) > 0.0 else 1  # whose outward normal points to the camera
        cosine = float(axis @ self.to_light) * (1.0 if front else -1.0)
        face = rims_uv[front, 0], self._face(cosine)
        fills = (*zip(layers, self.thing, strict=True), face)
        return SeenPart(layers[0], fills, points.uv[rod.ends], ends[:, 2], points.speed_uv[rod.ends])

    def _face(self, cosine: float) -> Colour:
        """Colour of a dark flat face whose normal has that cosine to the light."""
        return self.faces[round(max(cosine, 0.0) * (len(self.faces) - 1))]

    def _block(self, block: Block, points: Points) -> SeenPart:
        corners, uv = points.at[block.corners], points.uv[block.corners]
        middle, rings = corners.mean(axis=0), corners[np.array(BLOCK_FACES)]
        normal = unit(cross(rings[:, 1] - rings[:, 0], rings[:, 3] - rings[:, 0]))
        out = normal * np.sign(np.vecdot(normal, rings.mean(axis=1) - middle))[:, None]
        fills = tuple(
            (uv[list(face)], self._face(float(side @ self.to_light)))
            for face, side, corner in zip(BLOCK_FACES, out, rings[:, 0], strict=True)
            if float(side @ corner) < 0.0
        )
        at, speed = uv.mean(axis=0), points.speed_uv[block.corners].mean(axis=0)
        depth = np.full(2, middle[2])
        return SeenPart(raster.hull(uv), fills, np.stack([at, at]), depth, np.stack([speed, speed]))

    def _sheet(self, sheet: Sheet, points: Points) -> SeenSheet:
        at, uv = points.at[sheet.corners], points.uv[sheet.corners]
        middle = at[:4].mean(axis=0)
        out = unit(cross(at[3] - at[0], at[1] - at[0]))  # the corners go clockwise as it is printed
        facing_least = 0.02  # cosine to the line of sight from which on a sheet shows its front
        return SeenSheet(
            sheet,
            middle,
            uv[:4],
            uv[4:],
            points.speed_uv[sheet.corners].mean(axis=0),
            -float(out @ middle) / float(np.linalg.norm(middle)) > facing_least,
            float(out @ self.to_light),
            float(points.t_s[sheet.corners].mean()),
        )


def project_all(project: Project, parts: tuple[Float, ...]) -> list[Float]:
    """Project arrays of points (..., 3) in one call."""
    uv = project(np.concatenate([part.reshape(-1, 3) for part in parts]))
    ends = np.cumsum([part.size // 3 for part in parts])[:-1]
    return [flat.reshape(*part.shape[:-1], 2) for flat, part in zip(np.split(uv, ends), parts, strict=True)]


INK, PAPER = 0.035, 0.72  # reflectance of toner and of office paper
PAPER_BGR = np.array([0.97, 1.0, 1.0])
TEXELS = 8  # of a cell, when the tag is near
_BLEED = 4  # texels of paper beyond its edge: what covers it decides where it ends


@cache
def printed(family: TagFamily, number: int) -> Image:
    """Reflectance (n, n) of a tag with its paper, 255 = 1, `TEXELS` a cell."""
    cells = tag_image(family, number, round(PAPER_CELLS)) / 255.0
    ink = np.kron(INK + (PAPER - INK) * cells, np.ones((TEXELS, TEXELS)))
    return np.pad(np.rint(255.0 * ink), _BLEED, mode="edge").astype(np.uint8)


def sheet_appearance(seen: SeenSheet, moments_s: Float, box: tuple[int, int, int, int]) -> Float32:
    """Linear light (h, w, 3), blue first, of a tag as if it filled a box of pixels.

    Args:
        moments_s: Moments (n,) of the exposure, relative to its middle [s].
        box: x0, y0, x1, y1.
    """
    x0, y0, x1, y1 = box
    texture = printed(seen.sheet.family, seen.sheet.number)
    own = len(texture) - 2 * _BLEED
    edge = _BLEED - 0.5 + own * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    fine = 4  # rays per pixel and axis
    size = (fine * (x1 - x0), fine * (y1 - y0))
    total = np.zeros(size[::-1], np.float32)
    for moment in moments_s:
        # A pixel's middle is a whole number, its rays lie evenly about it.
        uv = (seen.paper_uv + moment * seen.speed - [x0, y0] + 0.5) * fine - 0.5
        way = cv2.getPerspectiveTransform(edge.astype(np.float32), uv.astype(np.float32))
        drawn = cv2.warpPerspective(
            texture, way, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        cv2.accumulate(drawn, total)
    grey = cv2.resize(total, (x1 - x0, y1 - y0), interpolation=cv2.INTER_AREA)
    light = (AMBIENT + (1.0 - AMBIENT) * max(seen.lit, 0.0)) / (255.0 * len(moments_s))
    return (grey[..., None] * (light * PAPER_BGR)).astype(np.float32)
