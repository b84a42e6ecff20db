"""Tracked objects as one camera sees them.

From key points in space to outlines and shading (`objects_seen`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from common.arrays import Float
from common.geometry.transforms import cross
from common.sim import light, raster
from common.sim.object_surface import BLOCK_FACES, Ball, Block, ObjectSurface, Rod, Sheet
from common.sim.objects_seen import NOTHING, Colour, SeenBead, SeenObjects, SeenPart, SeenSheet
from common.sim.surface import rim, unit
from common.sim.things import LAYER_SINES

Project = Callable[[Float], Float]


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Key points of the objects at their times.

    (K, 3) [m] camera frame, (K, 2) [px], (K, 2) [px/s], (K,) [s].
    """

    at: Float
    uv: Float
    speed_uv: Float
    t_s: Float


@dataclass(frozen=True, slots=True, eq=False)
class Appearances:
    """Viewing parameters of one camera.

    Direction towards the light (3,), camera frame; `unit_circle`; points (..., 3) [m] to pixels.
    """

    to_light: Float
    circle: Float
    focal_px: float
    project: Project
    thing: tuple[Colour, ...] = field(default_factory=lambda: light.shades(light.THING_LINEAR_RGB))
    faces: tuple[Colour, ...] = field(default_factory=lambda: _faces())

    def seen(self, surface: ObjectSurface, points: Points) -> SeenObjects:
        """What a camera sees of the objects whose key points are there."""
        if not surface.local.size:
            return NOTHING
        rods = [part for part in surface.parts if isinstance(part, Rod)]
        balls = [*(part for part in surface.parts if isinstance(part, Ball)), *surface.beads]
        rod_rims, (edges, lit, shine) = self._rims(rods, points), self._ball_points(balls, points)
        uv = self._project_all((rod_rims, edges, lit, shine))
        round_parts: dict[int, SeenPart] = {}
        for k, rod in enumerate(rods):
            round_parts[id(rod)] = self._rod(rod, uv[0][k], points)
        bands = self._bands(balls, uv[1], uv[2], points)
        for k, ball in enumerate(balls):
            fills = () if ball.marker is not None else tuple(zip(bands[k], self.thing, strict=True))
            round_parts[id(ball)] = _whole(ball.middle.start, uv[1][k], fills, points)
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
        """Return the shading edges of all rods at their ends.

        Shape (R, 2, LAYERS, n, 3) [m]; see `things.tube_rims`.
        """
        ends = np.array([points.at[rod.ends] for rod in rods]).reshape(-1, 2, 3)
        radius = np.array([rod.radius_m for rod in rods])
        axis = unit(ends[:, 1] - ends[:, 0])
        across = self.to_light - (axis @ self.to_light)[:, None] * axis
        middle = (radius[:, None] * light.LAYER_COSINES)[..., None] * across[:, None]
        layers = np.broadcast_to(axis[:, None], middle.shape)
        rims = middle[:, :, None] + rim(layers, radius[:, None] * LAYER_SINES, self.circle)
        return ends[:, :, None, None] + rims[:, None]

    def _ball_points(self, balls: Sequence[Ball], points: Points) -> tuple[Float, Float, Float]:
        """Return the edges, shading centres and lamp reflections of balls.

        Edges (B, n, 3) [m] of the balls, centres (B, LAYERS, 3) of their shading, points (B, 3) where they mirror the
        lamp.
        """
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

    def _project_all(self, parts: tuple[Float, ...]) -> list[Float]:
        """Project arrays of points (..., 3) in one call."""
        uv = self.project(np.concatenate([part.reshape(-1, 3) for part in parts]))
        ends = np.cumsum([part.size // 3 for part in parts])[:-1]
        return [
            flat.reshape(*part.shape[:-1], 2) for flat, part in zip(np.split(uv, ends), parts, strict=True)
        ]


def _whole(point: int, outline: Float, fills: tuple[tuple[Float, Colour], ...], points: Points) -> SeenPart:
    """A ball: it has no ends, its middle stands for both."""
    place = [point, point]
    return SeenPart(outline, fills, points.uv[place], points.at[place, 2], points.speed_uv[place])


def _faces() -> tuple[Colour, ...]:
    """Colours of dark faces by the cosine to the light, from 0 to 1."""
    return tuple(light.face_shade(light.THING_LINEAR_RGB, k / 64.0) for k in range(65))
