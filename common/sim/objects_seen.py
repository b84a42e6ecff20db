"""Tracked objects as one camera sees them: outlines, shading, and how far away each part is behind a pixel."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from common.arrays import Float
from common.geometry import cross
from common.sim import light, raster
from common.sim.object_surface import BLOCK_FACES, Ball, Block, ObjectSurface, Rod, Sheet
from common.sim.raster import Shape
from common.sim.surface import rim, unit
from common.sim.things import LAYER_SINES, tube_rims

Colour = tuple[int, int, int]
Project = Callable[[Float], Float]
FACING_LEAST = 0.02  # cosine to the line of sight from which on a sheet shows its front


@dataclass(frozen=True, slots=True, eq=False)
class SeenPart:
    """A dark part, or a bead, in one image.

    Attributes:
        outline: (N, 2) [px].
        fills: Convex outlines (N, 2) [px] and their colours, in the order of drawing; none for a bead.
        ends_uv: (2, 2) [px], ends_depth: (2,) [m], ends_speed: (2, 2) [px/s] of its two ends; of what has none, its
            middle twice.
    """

    outline: Float
    fills: tuple[tuple[Float, Colour], ...]
    ends_uv: Float
    ends_depth: Float
    ends_speed: Float

    @property
    def shape(self) -> Shape:
        """Its outline, moving as its middle does."""
        return Shape(self.outline, self.ends_speed.mean(axis=0))

    def depth(self, uv: Float) -> Float:
        """Depth (...) [m] of its axis where that passes nearest to pixels (..., 2)."""
        share = self._share(uv)
        return self.ends_depth[0] * (1.0 - share) + self.ends_depth[1] * share

    def moved(self, corners: Float, seconds: float) -> Float:
        """Corners (N, 2) [px] of one of its outlines some time [s] later: each end goes its own way."""
        share = self._share(corners)[:, None]
        return corners + seconds * ((1.0 - share) * self.ends_speed[0] + share * self.ends_speed[1])

    def _share(self, uv: Float) -> Float:
        start, along = self.ends_uv[0], self.ends_uv[1] - self.ends_uv[0]
        return np.clip((uv - start) @ along / max(float(along @ along), 1e-9), 0.0, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class SeenBead:
    """A painted ball in one image.

    Attributes:
        bead: Which.
        at: (3,) its middle [m], camera frame.
        part: Its outline.
        bands: (LAYERS, N, 2) [px] its outline, then the parts on which the light falls more and more steeply.
        shine_uv: (2,) [px] where the paint mirrors the lamp; shine_px: radius of that spot.
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
    def shape(self) -> Shape:
        """Its outline."""
        return self.part.shape


@dataclass(frozen=True, slots=True, eq=False)
class SeenSheet:
    """A tag in one image.

    Attributes:
        sheet: Which.
        at: (3,) its middle [m], camera frame.
        paper_uv, square_uv: (4, 2) [px] corners of its paper and of its black square, each at the moment of its row.
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
    def shape(self) -> Shape:
        """Outline of its paper."""
        return Shape(self.paper_uv, self.speed)


@dataclass(frozen=True, slots=True, eq=False)
class SeenObjects:
    """All tracked objects in one image."""

    parts: tuple[SeenPart, ...] = ()
    beads: tuple[SeenBead, ...] = ()
    sheets: tuple[SeenSheet, ...] = ()

    def outlines(self) -> list[Float]:
        """Everything that can be seen of them (N, 2) [px]."""
        return [
            *(part.outline for part in self.parts),
            *(bead.part.outline for bead in self.beads),
            *(sheet.paper_uv for sheet in self.sheets if sheet.shows),
        ]


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Key points of the objects at their moments: (K, 3) [m] camera frame, (K, 2) [px], (K, 2) [px/s], (K,) [s]."""

    at: Float
    uv: Float
    speed_uv: Float
    t_s: Float


@dataclass(frozen=True, slots=True, eq=False)
class Looks:
    """How one camera looks: towards the light (3,), camera frame; `unit_circle`s; points (..., 3) [m] to pixels."""

    to_light: Float
    circle: Float
    focal_px: float
    project: Project
    thing: tuple[Colour, ...] = field(default_factory=lambda: light.shades(light.THING_LINEAR_RGB))

    def seen(self, surface: ObjectSurface, points: Points) -> SeenObjects:
        """What a camera sees of the objects whose key points are there."""
        parts = tuple(self._part(part, points) for part in surface.parts)
        beads = tuple(self._bead(bead, points) for bead in surface.beads)
        return SeenObjects(parts, beads, tuple(self._sheet(sheet, points) for sheet in surface.sheets))

    def _part(self, part: Rod | Block | Ball, points: Points) -> SeenPart:
        if isinstance(part, Rod):
            return self._rod(part, points)
        if isinstance(part, Block):
            return self._block(part, points)
        outline, bands = self._ball(points.at[part.middle][0], part.radius_m)
        return self._whole(part.middle, outline, tuple(zip(bands, self.thing, strict=True)), points)

    def _rod(self, rod: Rod, points: Points) -> SeenPart:
        ends = points.at[rod.ends]
        axis = unit(ends[1] - ends[0])
        rims = self.project(
            np.stack([tube_rims(end, axis, rod.radius_m, self.to_light, self.circle) for end in ends])
        )
        layers = [raster.hull(rims[:, k].reshape(-1, 2)) for k in range(rims.shape[1])]
        front = 0 if float(axis @ ends[0]) > 0.0 else 1  # whose outward normal points to the camera
        cosine = float(axis @ self.to_light) * (1.0 if front else -1.0)
        face = rims[front, 0], light.face_shade(light.THING_LINEAR_RGB, cosine)
        fills = (*zip(layers, self.thing, strict=True), face)
        return SeenPart(layers[0], fills, points.uv[rod.ends], ends[:, 2], points.speed_uv[rod.ends])

    def _block(self, block: Block, points: Points) -> SeenPart:
        corners, uv = points.at[block.corners], points.uv[block.corners]
        middle = corners.mean(axis=0)
        fills: list[tuple[Float, Colour]] = []
        for face in BLOCK_FACES:
            ring = corners[list(face)]
            normal = unit(cross(ring[1] - ring[0], ring[3] - ring[0]))
            out = normal if float(normal @ (ring.mean(axis=0) - middle)) > 0.0 else -normal
            if float(out @ ring[0]) < 0.0:
                shade = light.face_shade(light.THING_LINEAR_RGB, float(out @ self.to_light))
                fills.append((uv[list(face)], shade))
        return self._whole(block.corners, raster.hull(uv), tuple(fills), points)

    def _whole(
        self, place: slice, outline: Float, fills: tuple[tuple[Float, Colour], ...], points: Points
    ) -> SeenPart:
        """A part without ends: its middle stands for both."""
        uv, speed = points.uv[place].mean(axis=0), points.speed_uv[place].mean(axis=0)
        depth = np.full(2, points.at[place, 2].mean())
        return SeenPart(outline, fills, np.stack([uv, uv]), depth, np.stack([speed, speed]))

    def _ball(self, middle: Float, radius_m: float) -> tuple[Float, Float]:
        """Outline (N, 2) [px] of a ball at (3,) [m], and its shading (LAYERS, N, 2)."""
        d2 = float(middle @ middle)
        shrink = 1.0 - radius_m**2 / d2  # the circle in which the rays touch the ball
        edge = middle * shrink + rim(middle / np.sqrt(d2), np.array(radius_m * np.sqrt(shrink)), self.circle)
        outline = self.project(edge)
        lit = self.project(middle + (radius_m * light.LAYER_COSINES)[:, None] * self.to_light)
        size = self.focal_px * radius_m / float(middle[2]) * LAYER_SINES
        bands = lit[:, None] + size[:, None, None] * self.circle
        bands[0] = outline
        return outline, bands

    def _bead(self, bead: Ball, points: Points) -> SeenBead:
        middle = points.at[bead.middle][0]
        outline, bands = self._ball(middle, bead.radius_m)
        half = unit(self.to_light - unit(middle))
        return SeenBead(
            bead,
            middle,
            self._whole(bead.middle, outline, (), points),
            bands,
            self.project(middle + bead.radius_m * half),
            self.focal_px * bead.radius_m / float(middle[2]),
            float(points.t_s[bead.middle][0]),
        )

    def _sheet(self, sheet: Sheet, points: Points) -> SeenSheet:
        at, uv = points.at[sheet.corners], points.uv[sheet.corners]
        middle = at[:4].mean(axis=0)
        out = unit(cross(at[1] - at[0], at[3] - at[0])) * -1.0  # corners go clockwise as it is printed
        return SeenSheet(
            sheet,
            middle,
            uv[:4],
            uv[4:],
            points.speed_uv[sheet.corners].mean(axis=0),
            -float(out @ middle) / float(np.linalg.norm(middle)) > FACING_LEAST,
            float(out @ self.to_light),
            float(points.t_s[sheet.corners].mean()),
        )
