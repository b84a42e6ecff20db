"""Standard deviation of a measured centroid [px], from the measurement itself.

Five independent causes, added in squares; the numbers are those of generated caps (bench/marker_accuracy):

    edge    the rim is known to a fraction of a pixel; a shift of one side moves the centroid the more the smaller
            the marker, and the less clear its contrast; shading and highlights keep a part at any size
    motion  the cap's shading does not smear like its outline
    cover   something in front hides a share h: a straight edge moves the centroid of a disc by 0.9 h r
            (segment of a circle, small h), one direction of two
    cut     the border of the image does the same, unseen
    colour  where the contrast is so low that the surroundings may be the marker as well, its colour may be a part of
            it; an outline (`outline`) knows how well it fits, and takes the place of all but the motion
"""

import math

from slave.markers.centroid import Measured
from slave.markers.outline import Outline
from slave.markers.quality import CLEAR_CONTRAST
from slave.markers.roi import Track

BLUR = 0.04  # px per px of way during the exposure
COVERED_PX = 0.15  # a centre found from the edge that is left


def sigma_of(
    seen: Measured, before: Track | None, track: Track, exposure_s: float, outline: Outline | None = None
) -> float:
    """Standard deviation per axis of the centroid [px].

    Args:
        seen: The measurement.
        before: The track before it; None: the marker was not tracked.
        track: The track after it.
        exposure_s: Exposure time.
        outline: The marker's outline, where the measurement is that of its disc.
    """
    if outline is not None:
        return math.hypot(outline.sigma, BLUR * math.hypot(track.du, track.dv) * exposure_s)
    radius = math.sqrt((seen.area if seen.area > 1.0 else 1.0) / math.pi)
    edge_px2 = 0.45  # error times radius
    least_px = 0.06  # at any radius
    edge = math.hypot(edge_px2 / radius, least_px)
    clear = 15.0  # contrast below which the edge is less sure
    if seen.contrast < clear:
        edge *= clear / max(seen.contrast, 1.0)
    blur = BLUR * math.hypot(track.du, track.dv) * exposure_s
    persistent = 0.3  # how much of a slow loss of area is cover, and not the finger turning away
    hidden = persistent * (1.0 - seen.area / track.whole) if seen.area < track.whole else 0.0
    if before is not None and track.covered:
        hidden = max(hidden, before.hidden(seen.area))
    # cover
    cover = 0.65 * hidden * radius / (1.0 - min(hidden, 0.8)) if hidden > 0.0 else 0.0
    # of the radius
    cut = 0.3 * radius if seen.cut else 0.0
    # of the radius: a part of the marker's colour that has no outline
    partial = 0.5 * radius if seen.contrast < CLEAR_CONTRAST else 0.0
    sigma = math.sqrt(edge * edge + blur * blur + cover * cover + cut * cut + partial * partial)
    thin = 2.0  # times, for a sliver
    return thin * sigma if seen.thin else sigma
