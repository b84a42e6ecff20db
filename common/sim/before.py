"""Occluders of a marker, a bead or a tag in one image.

Outlines of skin, sleeve, things and other markers.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.sim import raster
from common.sim.objects_seen import SeenPart
from common.sim.raster import Shape
from common.sim.surface import CAPSULES, SLEEVE_SPHERES
from common.sim.view import PHALANGES, Snapshot

REACH_PX = 8.0  # room for motion during the exposure
NO_PHALANX = -1


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Where N markers are in one image.

    Attributes:
        uv: (N, 2) [px] their middles.
        depth: (N,) [m].
        low, high: (N, 2) [px] boxes about their outlines, with room for motion.
        behind_palm: (N,) the palm lies before it, if anywhere.
        phalanx: (N,) which it sits on, so that this one does not hide it, or NO_PHALANX.
    """

    uv: Float
    depth: Float
    low: Float
    high: Float
    behind_palm: Bool
    phalanx: Int


def hand_before(snapshot: Snapshot, places: Places) -> list[list[Shape]]:
    """Return the outlines of hand parts that may occlude each marker.

    The phalanges, the sleeve and the palm.
    """
    surface = _phalanges_before(snapshot, places)
    speed = 0.5 * snapshot.speed_uv[CAPSULES].sum(axis=1)
    sleeve = Shape(snapshot.sleeve[0], snapshot.speed_uv[SLEEVE_SPHERES[0]])
    palm = Shape(snapshot.palm[0], snapshot.palm_speed)
    return [
        [
            *(Shape(snapshot.outlines[k, 0], speed[k]) for k in np.flatnonzero(phalanges)),
            *([sleeve] if covered else []),
            *([palm] if behind else []),
        ]
        for phalanges, covered, behind in zip(
            surface, _sleeve_before(snapshot, places).tolist(), places.behind_palm.tolist(), strict=True
        )
    ]


def things_before(
    snapshot: Snapshot, places: Places, k: int, depth_m: float, but: SeenPart | None = None
) -> Sequence[Shape]:
    """Return the outlines of things that pass before marker `k`.

    Nearer than a depth; parts of tracked objects are included.

    `but` cannot hide it: its own bead, or what it is stuck on.
    """
    if not (snapshot.things or snapshot.tracked.solid):
        return ()
    uv = places.uv[k]
    found = [thing.shape for thing in snapshot.things if float(thing.depth(uv)) < depth_m]
    parts = snapshot.tracked.before(uv, depth_m, places.low[k], places.high[k])
    return found + [part.shape for part in parts if part is not but]


def _phalanges_before(snapshot: Snapshot, places: Places) -> Bool:
    """Which phalanges (N, PHALANGES) reach into the box of a marker before it."""
    surface = snapshot.outlines[:, 0]
    found = raster.overlaps(
        places.low[:, None], places.high[:, None], surface.min(axis=1), surface.max(axis=1)
    ) & (_depth_along(snapshot, places.uv[:, None], CAPSULES[:, 0], CAPSULES[:, 1]) < places.depth[:, None])
    return found & (places.phalanx[:, None] != np.arange(PHALANGES))


def _sleeve_before(snapshot: Snapshot, places: Places) -> Bool:
    """Whether (N,) the sleeve reaches into the box of a marker before it."""
    sleeve = snapshot.sleeve[0]
    touched = raster.overlaps(places.low, places.high, sleeve.min(axis=0), sleeve.max(axis=0))
    nearer = _depth_along(snapshot, places.uv, *SLEEVE_SPHERES) < places.depth
    return touched & nearer & (not snapshot.into_sleeve)


def _depth_along(snapshot: Snapshot, uv: Float, a: Int | int, b: Int | int) -> Float:
    """Return the depth (...) [m] of lines where they pass nearest to `uv`.

    Lines from key points `a` to `b`; `uv` (..., 2) [px].
    """
    start, along = snapshot.uv[a], snapshot.uv[b] - snapshot.uv[a]
    share = ((uv - start) * along).sum(axis=-1) / np.maximum((along * along).sum(axis=-1), 1e-9)
    share = np.minimum(np.maximum(share, 0.0), 1.0)
    return np.asarray(snapshot.points[a, 2] * (1.0 - share) + snapshot.points[b, 2] * share)
