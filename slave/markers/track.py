"""Track one marker: its window, its centre if covered, its deviation.

Window: the last box, moved by its velocity and widened by `roi_margin` (Kalbfleisch: "40 px at 640x480 was best"),
more the longer the marker was not seen. It decides which blob is the marker, and where only windows are scanned.

Centre of a covered cap: 15 % hidden moves the centroid by an eighth of the radius. The cap's shape before is known
(an ellipse with the second moments of its shares), so only its place is sought: the distances of the visible edge and
of the ellipse along rays from a point inside give the shift by least squares. Rays on which the cap ends too early
see the edge of the thing in front; they are rejected by their residual, one side only, until nothing changes.

Deviation of the centroid [px]: independent causes, added in squares (numbers of bench/markers/accuracy):

    edge    the rim is known to a fraction of a pixel; it counts more the smaller the marker and the less its contrast;
            shading and highlights keep a part at any size
    motion  the cap's shading does not smear like its outline
    cover   a hidden share h behind a straight edge moves the centroid of a disc by 0.9 h r (small h), one direction
            of two; the border of the image does the same, unseen
    colour  at low contrast the colour may be a part of the marker; an outline knows how well it fits, and takes the
            place of all but the motion
"""

import math
from collections.abc import Sequence
from itertools import permutations
from typing import NamedTuple, cast

import cv2
import numpy as np

from common.arrays import Float, Float32
from slave.markers.centroid import Measured
from slave.markers.classify import Blob
from slave.markers.outline import Outline
from slave.markers.quality import CLEAR_CONTRAST

HOLD_NS = 500_000_000  # a marker not seen for longer is sought like a new one
VELOCITY_NS = 100_000_000  # a velocity is trusted no longer than this
SUDDEN = 2.5  # an area that changes by more between two frames is looked at closely


class Window(NamedTuple):
    """Expected region of one marker: the gate for blobs, and what is scanned."""

    u: float  # expected centroid u, v [px]
    v: float
    x: float  # how far the centroid may be off, x, y [px]: the margin and the marker's own side
    y: float
    margin: float  # how much wider than the marker the window is, to each side [px]
    area: float  # last area of the scan's blob [px^2]
    largest: float  # area [px^2] beyond which a blob is something else

    def cost(self, blob: Blob) -> float:
        """Cost of assigning `blob`: 0 perfect, about 1 at the rim, inf impossible."""
        x, y = abs(blob.u - self.u), abs(blob.v - self.v)
        if x > self.x or y > self.y or blob.area > self.largest:
            return math.inf
        return math.hypot(x, y) / self.margin + 0.5 * abs(math.log(blob.area / self.area))


def assigned(rows: Sequence[int], windows: Sequence[Window | None], blobs: Sequence[Blob]) -> dict[int, Blob]:
    """Give each of some markers, by its window, its own blob, at the least cost.

    One that finds none costs as much as any blob that it can; each blob is of one marker. `windows`: of all markers.
    """
    if len(rows) == 1 and (window := windows[rows[0]]) is not None:
        cost, k = min([(window.cost(blob), k) for k, blob in enumerate(blobs)])
        return {rows[0]: blobs[k]} if math.isfinite(cost) else {}
    known = {m: window for m in rows if (window := windows[m]) is not None}
    lost = 3.0  # cost of a marker that is not seen: more than that of any blob in its window
    costs = [[min(w.cost(blob), lost) for blob in blobs] + [lost] * len(known) for w in known.values()]
    columns = range(len(blobs) + len(known))
    best = min(
        permutations(columns, len(known)),
        key=lambda ks: sum(own[k] for own, k in zip(costs, ks, strict=True)),
        default=(),
    )
    pairs = zip(known, costs, best, strict=False)
    return {m: blobs[k] for m, own, k in pairs if k < len(blobs) and own[k] < lost}


class Track(NamedTuple):
    """What is known of one marker from its past."""

    u: float  # last centroid u, v [px]
    v: float
    du: float  # velocity du, dv [px/s]
    dv: float
    area: float  # last area of the scan's blob [px^2]
    seen: float  # last measured area [px^2]
    whole: float  # area of the whole marker [px^2]: the largest seen, slowly forgotten
    typical: float  # its area of late [px^2]
    covered: bool  # something came in front of it, and has not gone
    xx: float  # second central moments of its shape [px^2] of late, when it was not covered
    xy: float
    yy: float
    width: float  # width, height: last box [px]
    height: float
    t_ns: int  # when it was last seen
    quality: float  # probability that it is a marker, as last judged
    lonely: bool  # no other blob might have been it when it was found

    def alive(self, t_ns: int) -> bool:
        """Return whether the track still predicts where the marker is."""
        return 0 <= t_ns - self.t_ns <= HOLD_NS

    def window(self, t_ns: int, image_width: int, roi_margin: float) -> "Window":
        """Predict where the marker may be at `t_ns`.

        At constant velocity for a short time, then anywhere about that place. `roi_margin`: how much wider than the
        marker the window is, share of the image width.
        """
        elapsed_ns = t_ns - self.t_ns
        if elapsed_ns > VELOCITY_NS:
            growth_per_s = 1.0  # of the image width: about 1 m/s at 0.6 m
            roi_margin += (elapsed_ns - VELOCITY_NS) * 1e-9 * growth_per_s
            elapsed_ns = VELOCITY_NS
        u, v = self.u + self.du * elapsed_ns * 1e-9, self.v + self.dv * elapsed_ns * 1e-9
        margin = image_width * roi_margin
        x, y = margin + self.width, margin + self.height
        largest = 4.0  # times the whole area
        return Window(u, v, x, y, margin, self.area, largest * self.whole + 40.0)

    @property
    def extent(self) -> float:
        """Largest width or height of the whole marker [px]."""
        return 1.3 * max(self.width, self.height) + 2.0

    def growing(self, t_ns: int) -> bool:
        """Whether the marker has not been seen for so long that its window grows."""
        return t_ns - self.t_ns > VELOCITY_NS

    def sudden(self, blob: Blob) -> bool:
        """Return whether the area of `blob` jumped by more than the grid explains."""
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


def advance(
    track: Track | None, seen: Measured, blob: Blob, t_ns: int, quality: float, lonely: bool
) -> Track:
    """Return the track after an observation; a lost one begins without velocity."""
    u, v, area, xx, xy, yy = seen.u, seen.v, max(seen.area, 1.0), seen.xx, seen.xy, seen.yy
    box = float(blob.right - blob.left), float(blob.bottom - blob.top)
    rest = *box, t_ns, quality, lonely
    if track is None or not 0 < t_ns - track.t_ns <= HOLD_NS:
        whole = area if track is None else max(area, 0.5 * track.whole)
        return Track(u, v, 0.0, 0.0, blob.area, area, whole, area, False, xx, xy, yy, *rest)
    dt_s = (t_ns - track.t_ns) * 1e-9
    whole = area
    if area < track.whole:
        whole_life_s = 2.0  # the memory of the marker's whole area
        whole += (track.whole - area) * math.exp(-dt_s / whole_life_s)
    du = dv = 0.0
    if dt_s <= VELOCITY_NS * 1e-9:
        du, dv = (u - track.u) / dt_s, (v - track.v) / dt_s
    # memory of its usual area: a finger turns in this time, something passes in front of it faster
    typical_life_s = 0.25
    keep = math.exp(-dt_s / typical_life_s)
    typical = area + (track.typical - area) * keep
    covered = track.covers(area, t_ns)
    if covered:
        xx, xy, yy = track.xx, track.xy, track.yy
    else:
        xx, xy, yy = xx + (track.xx - xx) * keep, xy + (track.xy - xy) * keep, yy + (track.yy - yy) * keep
    return Track(u, v, du, dv, blob.area, area, whole, typical, covered, xx, xy, yy, *rest)


RAYS = 48
KEEP = (RAYS // 2, RAYS * 11 // 20)  # rays that the first rounds trust
_ANGLES = np.arange(RAYS, dtype=np.float64) * (2.0 * math.pi / RAYS)
DIRECTIONS: Float = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1).astype(np.float64)

# Segments of a unit disc behind a straight edge: share of the area, and the way of the rest's centroid.
_CHORD: Float = np.linspace(0.999, 0.0, 200)
_SHARE: Float = (np.arccos(_CHORD) - _CHORD * np.sqrt(1.0 - _CHORD**2)) / math.pi
_WAY: Float = 2.0 / 3.0 * (1.0 - _CHORD**2) ** 1.5 / (math.pi * (1.0 - _SHARE))


class Ellipse(NamedTuple):
    """Second central moments [px^2] of a filled ellipse with edge x' C^-1 x = 4."""

    xx: float
    xy: float
    yy: float


class Centre(NamedTuple):
    """Centre of a cap (u, v) in its window and RMS of its edge about it [px]."""

    u: float
    v: float
    rms: float


def centre_of(share: Float32, shape: Ellipse, u: float, v: float) -> Centre | None:
    """Centre of a partly covered cap; None: the visible edge does not determine it.

    `share`: (H, W) 0..1 of a window; `shape`: of the whole cap; (u, v): centroid of what is visible [px].
    """
    determinant = shape.xx * shape.yy - shape.xy**2
    if determinant <= 0.0:
        return None
    inverse: Float = np.array([[shape.yy, -shape.xy], [-shape.xy, shape.xx]]) / determinant
    longest = 2.0 * math.sqrt(0.5 * (shape.xx + shape.yy) + math.hypot(0.5 * (shape.xx - shape.yy), shape.xy))
    seen: Float = _edge(share, np.array([u, v]), 2.0 * longest + 2.0)
    points: Float = np.array([u, v]) + seen[:, None] * DIRECTIONS
    centre: Float = np.array([u, v])
    own = np.ones(RAYS, np.bool_)
    residual: Float = np.zeros(RAYS)
    rounds = 6
    for iteration in range(rounds):
        offset = points - centre
        inner = offset @ inverse
        level = np.sqrt(np.maximum((offset * inner).sum(axis=1), 1e-9))  # 2 on the ellipse
        slope: Float = inner / level[:, None]
        length = np.sqrt(np.maximum((slope * slope).sum(axis=1), 1e-9))
        residual = (level - 2.0) / length  # distance from the ellipse, outwards positive
        short_px = 0.6  # a ray that ends so much before the ellipse sees something else
        # At first the centre is off by a part of the radius, and the own edge is where the distances are largest.
        least = -short_px if iteration >= len(KEEP) else float(np.sort(residual)[RAYS - KEEP[iteration]])
        kept = residual >= least
        left = 0.45  # share of the rays that must be left
        if kept.sum() < left * RAYS:
            return None
        normal: Float = slope[kept] / length[kept, None]
        try:
            shift: Float = np.linalg.solve(normal.T @ normal, normal.T @ residual[kept]).astype(np.float64)
        except np.linalg.LinAlgError:
            return None  # no edge about the centroid: that of a thin crescent lies beside its pixels
        centre += shift
        done_px = 0.06  # a shift that changes nothing
        if iteration >= len(KEEP) and float(np.abs(shift).max()) < done_px:
            break
        own = kept
    rms = float(np.sqrt(np.mean(np.square(residual[own]))))
    fit_px = 0.35  # RMS of their residuals
    if rms > fit_px or float(np.hypot(*(centre - (u, v)))) > longest:
        return None
    return Centre(float(centre[0]), float(centre[1]), rms)


def fits_occlusion(hidden: float, shape: Ellipse, du: float, dv: float) -> bool:
    """Return whether an occlusion can have moved the centroid by (du, dv) [px].

    `hidden`: share of the cap. Of all parts of one area the segment behind a straight edge lies farthest out, so
    nothing moves the centroid more: in a unit disc whose edge is at d by 2/3 (1 - d^2)^1.5 / (pi (1 - h)). An ellipse
    is such a disc, stretched.
    """
    determinant = shape.xx * shape.yy - shape.xy**2
    if determinant <= 0.0:
        return False
    squared = (du * du * shape.yy - 2.0 * du * dv * shape.xy + dv * dv * shape.xx) / determinant
    radius = 2.0 * math.sqrt(math.sqrt(determinant))  # of a disc of the same area
    unsure = 0.05  # by so much the hidden share may be larger than estimated from the areas,
    unsure_px = 0.3  # and a centre off: two standard deviations
    return 0.5 * math.sqrt(squared) <= float(np.interp(hidden + unsure, _SHARE, _WAY)) + unsure_px / radius


def _edge(share: Float32, start: Float, reach: float) -> Float:
    """Distance (RAYS,) [px] from `start` to the edge: marker colour summed on rays."""
    step_px = 0.5
    steps = (np.arange(math.ceil(reach / step_px)) + 0.5) * step_px
    x = (start[0] + DIRECTIONS[:, :1] * steps).astype(np.float32)
    y = (start[1] + DIRECTIONS[:, 1:] * steps).astype(np.float32)
    along = cast(Float32, cv2.remap(share, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT))
    # Marker pixels beyond a gap are not on this ray's stretch: only what comes before the first empty step counts.
    gone = np.maximum.accumulate(along < 0.1, axis=1)
    return np.where(gone, 0.0, along).sum(axis=1) * step_px


BLUR = 0.04  # px per px of way during the exposure
COVERED_PX = 0.15  # a centre found from the edge that is left


def sigma_of(
    seen: Measured, before: Track | None, track: Track, exposure_s: float, outline: Outline | None = None
) -> float:
    """Standard deviation per axis of the centroid [px]; `outline`: of its disc."""
    blur = BLUR * math.hypot(track.du, track.dv) * exposure_s
    if outline is not None:
        return math.hypot(outline.sigma, blur)
    radius = math.sqrt(max(seen.area, 1.0) / math.pi)
    edge_px2 = 0.45  # error times radius
    least_px = 0.06  # at any radius
    edge = math.hypot(edge_px2 / radius, least_px)
    clear = 15.0  # contrast below which the edge is less sure
    if seen.contrast < clear:
        edge *= clear / max(seen.contrast, 1.0)
    persistent = 0.3  # how much of a slow loss of area is cover, and not the finger turning away
    hidden = persistent * (1.0 - seen.area / track.whole) if seen.area < track.whole else 0.0
    if before is not None and track.covered:
        hidden = max(hidden, before.hidden(seen.area))
    cover = 0.65 * hidden * radius / (1.0 - min(hidden, 0.8)) if hidden > 0.0 else 0.0
    cut = 0.3 * radius if seen.cut else 0.0
    # a part of the marker's colour that has no outline
    partial = 0.5 * radius if seen.contrast < CLEAR_CONTRAST else 0.0
    sigma = math.sqrt(edge * edge + blur * blur + cover * cover + cut * cut + partial * partial)
    thin = 2.0  # times, for a sliver
    return thin * sigma if seen.thin else sigma
