"""Dark things and tracked objects in one image: outlines, shading, depth, tags.

Key points in space (`Points`) become the outlines, shading and depth of each part in one camera's image. A tag is ink
on paper in linear light, over a box of pixels, blurred by its motion.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import cv2
import numpy as np

from common.arrays import Float, Image
from common.calibration.object_profile import TagFamily
from common.geometry.tag_family import tag_image
from common.geometry.transforms import cross, transform
from common.sim import light, raster
from common.sim.light import AMBIENT, Float32
from common.sim.motion import Cylinder
from common.sim.raster import Int32, Shape
from common.sim.surface import LAYER_SINES, rim, tube_rims, unit
from common.sim.tracked import BLOCK_FACES, PAPER_CELLS, Ball, Block, ObjectSurface, Rod, Sheet

Colour = tuple[int, int, int]
Project = Callable[[Float], Float]  # points (..., 3) [m], camera frame -> pixels (..., 2)
_DARK = light.shades(light.THING_LINEAR_RGB)
# of a flat face, by the cosine to the light, from 0 to 1
_DARK_FACES = tuple(light.face_shade(light.THING_LINEAR_RGB, k / 64.0) for k in range(65))


def depth_along(uv: Float, start_uv: Float, stop_uv: Float, start_m: Float, stop_m: Float) -> Float:
    """Depth (...) [m] of lines between pixels (..., 2), where nearest to `uv`."""
    share = _share(uv, start_uv, stop_uv)
    return start_m * (1.0 - share) + stop_m * share


def _share(uv: Float, start: Float, stop: Float) -> Float:
    """Where (...) between `start` and `stop` (..., 2) pixels (..., 2) lie, 0 to 1."""
    along = stop - start
    square = np.maximum((along * along).sum(axis=-1), 1e-9)
    return np.clip(((uv - start) * along).sum(axis=-1) / square, 0.0, 1.0)


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
        bands: (LAYERS, N, 2) the parts on which the light falls more and more steeply, then the spot where the
            marker mirrors the lamp, in OpenCV's numbers (`raster.fixed`).
        t_s: The moment of its row [s], scene time.
    """

    marker: int
    at: Float
    part: SeenPart
    bands: Int32
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
    """All tracked objects in one image, in the order of `ObjectSurface`."""

    parts: tuple[SeenPart, ...] = ()
    beads: tuple[SeenBead, ...] = ()
    sheets: tuple[SeenSheet, ...] = ()

    @property
    def solid(self) -> tuple[SeenPart, ...]:
        """The parts, and those of the beads: whatever may hide something."""
        return (*self.parts, *(bead.part for bead in self.beads))

    def outlines(self) -> list[Float]:
        """Everything that can be seen of them (N, 2) [px]."""
        return [
            *(part.outline for part in self.solid),
            *(sheet.paper_uv for sheet in self.sheets if sheet.shows),
        ]


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

    def thing(self, ends: Float, later: Float, later_s: float, radius_m: float) -> SeenPart:
        """Picture of a cylinder with ends (2, 3) [m], `later_s` [s] on at `later`."""
        ends_uv = self.project(ends)
        velocity = (self.project(later) - ends_uv).mean(axis=0) / later_s
        rims_uv = self.project(self._rims(ends, radius_m))
        face = partial(light.face_shade, light.THING_LINEAR_RGB)
        return self._cylinder(ends, rims_uv, ends_uv, np.stack([velocity, velocity]), face)

    def objects(self, surface: ObjectSurface, points: Points) -> SeenObjects:
        """What is seen of the objects whose key points are there."""
        if not surface.local.size:
            return SeenObjects()
        rods = [part for part in surface.parts if isinstance(part, Rod)]
        balls = [*(part for part in surface.parts if isinstance(part, Ball)), *surface.beads]
        rims = [self._rims(points.at[rod.ends], rod.radius_m) for rod in rods]
        uv = project_all(self.project, (*rims, *(one for ball in balls for one in self._ball(ball, points))))
        parts: dict[int, SeenPart] = {}
        beads: list[SeenBead] = []
        for rod, rims_uv in zip(rods, uv, strict=False):
            ends = rod.ends
            parts[id(rod)] = self._cylinder(
                points.at[ends], rims_uv, points.uv[ends], points.speed_uv[ends], _dark_face
            )
        for k, ball in enumerate(balls):
            edge_uv, lit_uv, shine_uv = uv[len(rods) + 3 * k :][:3]
            size_px = self.focal_px * ball.radius_m / points.at[ball.middle, 2][0]
            bands = lit_uv[:, None] + (size_px * LAYER_SINES)[:, None, None] * self.circle
            bands[0] = edge_uv
            place = [ball.middle.start] * 2  # it has no ends, its middle stands for both
            fills = () if ball.marker is not None else tuple(zip(bands, _DARK, strict=True))
            part = SeenPart(edge_uv, fills, points.uv[place], points.at[place, 2], points.speed_uv[place])
            parts[id(ball)] = part
            if ball.marker is not None:
                shine_share = 0.15  # radius of the glossy spot, share of the bead's
                bands = np.stack([*bands[1:], shine_uv + shine_share * size_px * self.circle])
                at, t_s = points.at[place[0]], float(points.t_s[place[0]])
                beads.append(SeenBead(ball.marker, at, part, raster.fixed(bands), t_s))
        seen = (
            self._block(one, points) if isinstance(one, Block) else parts[id(one)] for one in surface.parts
        )
        return SeenObjects(
            tuple(seen), tuple(beads), tuple(self._sheet(sheet, points) for sheet in surface.sheets)
        )

    def _rims(self, ends: Float, radius_m: float) -> Float:
        """Shading edges (2, LAYERS, n, 3) [m] of a cylinder with ends (2, 3)."""
        axis = unit(ends[1] - ends[0])
        return np.stack([tube_rims(end, axis, radius_m, self.to_light, self.circle) for end in ends])

    def _ball(self, ball: Ball, points: Points) -> tuple[Float, Float, Float]:
        """Edge (n, 3) [m], shading centres (LAYERS, 3), where it mirrors the lamp (3,)."""
        middle, radius = points.at[ball.middle.start], ball.radius_m
        towards = unit(middle)
        shrink = 1.0 - radius**2 / (middle * middle).sum()  # the circle in which the rays touch the ball
        edge = middle * shrink + rim(towards, np.asarray(radius * np.sqrt(shrink)), self.circle)
        lit = middle + (radius * light.LAYER_COSINES)[:, None] * self.to_light
        return edge, lit, middle + radius * unit(self.to_light - towards)

    def _cylinder(
        self,
        ends: Float,
        rims_uv: Float,
        ends_uv: Float,
        ends_speed: Float,
        face_colour: Callable[[float], Colour],
    ) -> SeenPart:
        """A cylinder by its ends (2, 3) [m] and the edges of `_rims` [px]."""
        axis = unit(ends[1] - ends[0])
        layers = [raster.hull(rims_uv[:, k].reshape(-1, 2)) for k in range(rims_uv.shape[1])]
        front = 0 if float(axis @ ends[0]) > 0.0 else 1  # whose outward normal points to the camera
        cosine = float(axis @ self.to_light) * (1.0 if front else -1.0)
        fills = (*zip(layers, _DARK, strict=True), (rims_uv[front, 0], face_colour(cosine)))
        return SeenPart(layers[0], fills, ends_uv, ends[:, 2], ends_speed)

    def _block(self, block: Block, points: Points) -> SeenPart:
        corners, uv = points.at[block.corners], points.uv[block.corners]
        middle, rings = corners.mean(axis=0), corners[np.array(BLOCK_FACES)]
        normal = unit(cross(rings[:, 1] - rings[:, 0], rings[:, 3] - rings[:, 0]))
        out = normal * np.sign(np.vecdot(normal, rings.mean(axis=1) - middle))[:, None]
        fills = tuple(
            (uv[list(face)], _dark_face(float(side @ self.to_light)))
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


def _dark_face(cosine: float) -> Colour:
    """Colour of a dark flat face whose normal has that cosine to the light."""
    return _DARK_FACES[round(max(cosine, 0.0) * (len(_DARK_FACES) - 1))]


def ends_of(thing: Cylinder, T_camera_rig: Float) -> Float:
    """Middles of both ends (2, 3) [m], camera frame."""
    half = 0.5 * thing.length_m
    own = np.array([[0.0, 0.0, -half], [0.0, 0.0, half]])
    return transform(T_camera_rig, transform(thing.T_rig_object, own))


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
