"""What may lie before a marker, a bead or a tag in one image: outlines of skin, sleeve, things and other markers."""

import numpy as np

from common.arrays import Bool, Float
from common.sim import raster
from common.sim.objects_seen import SeenPart
from common.sim.raster import Shape
from common.sim.surface import CAPSULES, SLEEVE_SPHERES
from common.sim.view import PHALANGES, Snapshot, View

REACH_PX = 8.0  # room for motion during the exposure


def skin_before(view: View, snapshot: Snapshot, uv: Float, depth: Float, low: Float, high: Float) -> Bool:
    """Which phalanges (N, PHALANGES) reach into the boxes `low`, `high` (N, 2) before the depths (N,) [m]."""
    skin = snapshot.outlines[:PHALANGES, 0]
    touched = raster.overlaps(low[:, None], high[:, None], skin.min(axis=1), skin.max(axis=1))
    return touched & (view.phalanx_depth(snapshot, uv) < depth[:, None])


def phalanges(snapshot: Snapshot, chosen: Bool) -> list[Shape]:
    """Outlines of the chosen phalanges."""
    return [
        Shape(
            snapshot.outlines[k, 0],
            0.5 * (snapshot.speed_uv[CAPSULES[k, 0]] + snapshot.speed_uv[CAPSULES[k, 1]]),
        )
        for k in np.flatnonzero(chosen)
    ]


def sleeve_before(view: View, snapshot: Snapshot, marker: Shape, depth_m: float) -> list[Shape]:
    """The sleeve, where it may lie before a marker at that depth."""
    reach = snapshot.discs_px[list(SLEEVE_SPHERES), 0, None]
    ends = snapshot.uv[list(SLEEVE_SPHERES)]
    low, high = marker.corners.min(axis=0), marker.corners.max(axis=0)
    if not raster.overlaps(low, high, (ends - reach).min(axis=0), (ends + reach).max(axis=0)):
        return []
    before = view.sleeve_depth(snapshot, marker.corners.mean(axis=0)) < depth_m
    if not before or view.looks_into_sleeve(snapshot):
        return []
    return [Shape(view.sleeve(snapshot), snapshot.speed_uv[SLEEVE_SPHERES[0]])]


def things_before(
    snapshot: Snapshot, box: tuple[Float, Float], uv: Float, depth_m: float, but: SeenPart | None = None
) -> list[Shape]:
    """Outlines of things, and of parts of tracked objects, that pass before a marker at a pixel (2,) and a depth.

    Args:
        snapshot: The image.
        box: Low and high corner (2,) [px] of the marker, with room for motion.
        uv: Its middle [px].
        depth_m: How far away it is.
        but: What cannot hide it: its own bead, or what it is stuck on.
    """
    found = [thing.shape for thing in snapshot.things if float(thing.depth(uv)) < depth_m]
    return found + [part.shape for part in snapshot.tracked.before(uv, depth_m, *box) if part is not but]
