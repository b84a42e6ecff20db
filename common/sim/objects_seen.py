"""Tracked objects in one image: outlines, shading and depth of each part.

The depth is how far away each part is behind a pixel.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.sim import raster
from common.sim.object_surface import Ball, Sheet
from common.sim.raster import Shape

Colour = tuple[int, int, int]


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
        return Shape(self.outline, 0.5 * (self.ends_speed[0] + self.ends_speed[1]))

    def speed(self, uv: Float) -> Float:
        """How fast (N, 2) [px/s] it moves at pixels (N, 2): each end goes its own way."""
        share = _share(uv, self.ends_uv[0], self.ends_uv[1])[:, None]
        return (1.0 - share) * self.ends_speed[0] + share * self.ends_speed[1]


@dataclass(frozen=True, slots=True, eq=False)
class SeenBead:
    """A painted ball in one image.

    Attributes:
        bead: Which.
        at: (3,) its middle [m], camera frame.
        part: Its outline.
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
    def uv(self) -> Float:
        """Its middle (2,) [px]."""
        return self.paper_uv.mean(axis=0)

    @property
    def shape(self) -> Shape:
        """Outline of its paper."""
        return Shape(self.paper_uv, self.speed)


@dataclass(frozen=True, slots=True, eq=False)
class SeenObjects:
    """All tracked objects in one image.

    Attributes:
        parts, beads, sheets: In the order of `ObjectSurface`.
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
        """Return the parts that pass in front of a pixel and reach into a box.

        Parts nearer than a depth at pixel (2,); box `low`, `high` (2,) [px].

        Its depth is that of its axis where that passes nearest to the pixel.
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
