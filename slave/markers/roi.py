"""Say where a tracked marker is expected, and whether a blob there may be it.

The region of interest is the marker's last box, moved by its velocity and widened by 40 px at 640 px image width
(Kalbfleisch: "40 px at 640x480 was best"), more the longer it was not seen. It decides *which* blob is the
marker; the scan has looked at the whole frame anyway, so a marker outside its window costs nothing.
"""

import math
from dataclasses import dataclass

from slave.markers.blobs import Blob
from slave.markers.centroid import Measured

MARGIN = 40.0 / 640.0  # of the image width
HOLD_NS = 500_000_000  # a marker not seen for longer is sought like a new one
VELOCITY_NS = 100_000_000  # a velocity is trusted no longer than this
GROWTH_PER_S = 1.0  # of the image width: about 1 m/s at 0.6 m
WHOLE_LIFE_S = 2.0  # the memory of the marker's whole area
LARGEST = 4.0  # times the whole area
SUDDEN = 2.5  # an area that changes by more between two frames is looked at closely


@dataclass(frozen=True, slots=True)
class Track:
    """What is known of one marker from its past.

    Attributes:
        u, v: Last centroid [px].
        du, dv: Velocity [px/s].
        area: Last area [px^2].
        whole: Area of the whole marker [px^2]: the largest seen, slowly forgotten.
        width, height: Last box [px].
        t_ns: When it was last seen.
    """

    u: float
    v: float
    du: float
    dv: float
    area: float
    whole: float
    width: float
    height: float
    t_ns: int

    def alive(self, t_ns: int) -> bool:
        """Whether the track still says where the marker is."""
        return 0 <= t_ns - self.t_ns <= HOLD_NS

    def predicted(self, t_ns: int) -> tuple[float, float]:
        """Expected centroid (u, v) [px] at `t_ns`, constant velocity for a short time, then at rest."""
        dt_s = min(t_ns - self.t_ns, VELOCITY_NS) * 1e-9
        return self.u + self.du * dt_s, self.v + self.dv * dt_s

    def cost(self, blob: Blob, t_ns: int, image_width: int) -> float:
        """How badly `blob` fits: 0 is perfect, about 1 is the rim of the window, inf is impossible."""
        u, v = self.predicted(t_ns)
        growth = max(0.0, (t_ns - self.t_ns - VELOCITY_NS) * 1e-9) * GROWTH_PER_S
        margin = image_width * (MARGIN + growth)
        x, y = abs(blob.u - u), abs(blob.v - v)
        if x > margin + self.width or y > margin + self.height or blob.area > LARGEST * self.whole + 40.0:
            return math.inf
        return math.hypot(x, y) / margin + 0.5 * abs(math.log(blob.area / self.area))

    def sudden(self, blob: Blob) -> bool:
        """Whether the area of `blob` jumped against the last frame."""
        ratio = blob.area / self.area
        return not 1.0 / SUDDEN <= ratio <= SUDDEN


def advance(track: Track | None, seen: Measured, blob: Blob, t_ns: int) -> Track:
    """The track after one more sighting; a track that was lost starts anew, without velocity."""
    width, height = float(blob.right - blob.left), float(blob.bottom - blob.top)
    area = max(seen.area, 1.0)
    if track is None or not 0 < t_ns - track.t_ns <= HOLD_NS:
        whole = area if track is None else max(area, 0.5 * track.whole)
        return Track(seen.u, seen.v, 0.0, 0.0, area, whole, width, height, t_ns)
    dt_s = (t_ns - track.t_ns) * 1e-9
    whole = max(area, area + (track.whole - area) * math.exp(-dt_s / WHOLE_LIFE_S))
    du, dv = (seen.u - track.u) / dt_s, (seen.v - track.v) / dt_s
    if dt_s > VELOCITY_NS * 1e-9:
        du = dv = 0.0
    return Track(seen.u, seen.v, du, dv, area, whole, width, height, t_ns)
