"""Notify where a tracked marker is expected, and whether a blob there may be it.

The region of interest is the marker's last box, moved by its velocity and widened by `roi_margin` of the camera file
(Kalbfleisch: "40 px at 640x480 was best"), more the longer it was not seen. It decides *which* blob is the marker, and
where the frame is scanned at all when only windows are (`scan`).
"""

import math
from typing import NamedTuple

from slave.markers.blobs import Blob
from slave.markers.centroid import Measured

HOLD_NS = 500_000_000  # a marker not seen for longer is sought like a new one
VELOCITY_NS = 100_000_000  # a velocity is trusted no longer than this
SUDDEN = 2.5  # an area that changes by more between two frames is looked at closely


class Window(NamedTuple):
    """Expected region of one marker in one frame.

    It is both the gate for blobs and the region that is scanned.

    Attributes:
        u, v: Expected centroid [px].
        x, y: How far from there the centroid may be [px]: the margin and the marker's own side.
        margin: How much wider than the marker the window is, to each side [px].
        area: Last area of the scan's blob [px^2].
        largest: Area [px^2] beyond which a blob is something else.
    """

    u: float
    v: float
    x: float
    y: float
    margin: float
    area: float
    largest: float

    def cost(self, blob: Blob) -> float:
        """Return the cost of assigning `blob`.

        0 is perfect, about 1 is the rim of the window, inf is impossible.
        """
        x, y = abs(blob.u - self.u), abs(blob.v - self.v)
        if x > self.x or y > self.y or blob.area > self.largest:
            return math.inf
        return math.hypot(x, y) / self.margin + 0.5 * abs(math.log(blob.area / self.area))


class Track(NamedTuple):
    """What is known of one marker from its past.

    Attributes:
        u, v: Last centroid [px].
        du, dv: Velocity [px/s].
        area: Last area of the scan's blob [px^2].
        seen: Last measured area [px^2].
        whole: Area of the whole marker [px^2]: the largest seen, slowly forgotten.
        usual: Its area of late [px^2].
        covered: Something came in front of it, and has not gone.
        xx, xy, yy: Second central moments of its shape [px^2] of late, when it was not covered.
        width, height: Last box [px].
        t_ns: When it was last seen.
    """

    u: float
    v: float
    du: float
    dv: float
    area: float
    seen: float
    whole: float
    typical: float
    covered: bool
    xx: float
    xy: float
    yy: float
    width: float
    height: float
    t_ns: int

    def alive(self, t_ns: int) -> bool:
        """Return whether the track still predicts where the marker is."""
        return 0 <= t_ns - self.t_ns <= HOLD_NS

    def window(self, t_ns: int, image_width: int, roi_margin: float) -> "Window":
        """Predict where the marker may be at `t_ns`.

        At constant velocity for a short time, then anywhere about that place.

        `roi_margin`: how much wider than the marker the window is, share of the image width.
        """
        away_ns = t_ns - self.t_ns
        if away_ns > VELOCITY_NS:
            growth_per_s = 1.0  # of the image width: about 1 m/s at 0.6 m
            roi_margin += (away_ns - VELOCITY_NS) * 1e-9 * growth_per_s
            away_ns = VELOCITY_NS
        u, v = self.u + self.du * away_ns * 1e-9, self.v + self.dv * away_ns * 1e-9
        margin = image_width * roi_margin
        x, y = margin + self.width, margin + self.height
        largest = 4.0  # times the whole area
        return Window(u, v, x, y, margin, self.area, largest * self.whole + 40.0)

    def growing(self, t_ns: int) -> bool:
        """Whether the marker has not been seen for so long that its window grows."""
        return t_ns - self.t_ns > VELOCITY_NS

    def sudden(self, blob: Blob) -> bool:
        """Return whether the area of `blob` jumped against the last frame.

        The jump must be larger than the grid of the scan explains.
        """
        ratio = blob.area / self.area
        return not 1.0 / SUDDEN <= ratio <= SUDDEN and abs(blob.area - self.area) > 80.0

    def covers(self, area: float, t_ns: int) -> bool:
        """Whether something has come in front of the marker, or still is."""
        covered = 0.06  # share of the usual area that is missing while something is in front
        if 1.0 - area / self.typical <= covered:
            return False
        lost = 1.0 - area / self.seen
        covering = 0.08  # share of the area that must go from one frame to the next for that to begin, and
        rotating_per_s = 5.0  # what a finger that turns away loses: a radian in a fifth of a second
        return self.covered or lost > max(covering, rotating_per_s * (t_ns - self.t_ns) * 1e-9)

    def hidden(self, area: float) -> float:
        """Share of the usual area that is missing, 0..1."""
        return max(0.0, 1.0 - area / self.typical)


def advance(track: Track | None, seen: Measured, blob: Blob, t_ns: int) -> Track:
    """Return the track after one more observation.

    A track that was lost is reinitialised, without velocity.
    """
    u, v, area, xx, xy, yy = seen.u, seen.v, seen.area, seen.xx, seen.xy, seen.yy
    if area < 1.0:
        area = 1.0
    width, height = float(blob.right - blob.left), float(blob.bottom - blob.top)
    if track is None or not 0 < t_ns - track.t_ns <= HOLD_NS:
        whole = area if track is None else max(area, 0.5 * track.whole)
        return Track(u, v, 0.0, 0.0, blob.area, area, whole, area, False, xx, xy, yy, width, height, t_ns)
    dt_s = (t_ns - track.t_ns) * 1e-9
    whole = area
    if area < track.whole:
        whole_life_s = 2.0  # the memory of the marker's whole area
        whole += (track.whole - area) * math.exp(-dt_s / whole_life_s)
    du = dv = 0.0
    if dt_s <= VELOCITY_NS * 1e-9:
        du, dv = (u - track.u) / dt_s, (v - track.v) / dt_s
    # of its usual one: a finger turns in this time, something passes in front of it faster
    typical_life_s = 0.25
    keep = math.exp(-dt_s / typical_life_s)
    typical = area + (track.typical - area) * keep
    covered = track.covers(area, t_ns)
    if covered:
        xx, xy, yy = track.xx, track.xy, track.yy
    else:
        xx, xy, yy = xx + (track.xx - xx) * keep, xy + (track.xy - xy) * keep, yy + (track.yy - yy) * keep
    return Track(u, v, du, dv, blob.area, area, whole, typical, covered, xx, xy, yy, width, height, t_ns)
