"""Frame in, marker centroids out: scan everything, decide which blob is which marker, measure it.

A push machine. It holds one track per marker, nothing else; a new recording gets a new detector (`fresh`).

    scan     one table look-up on every second pixel, all colours at once         classify
    blobs    connected blobs per colour                                          blobs
    decide   by prediction where a track answers; else by what belongs together  roi, group
    measure  sub-pixel centroid of the visible paint, full resolution            centroid
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from common.arrays import Float, Image
from common.calibration import CameraCalibration
from slave.markers.blobs import Blob, find_blobs, with_fragments
from slave.markers.centroid import Measured, measure
from slave.markers.classify import ColourTable, table_of
from slave.markers.group import CLICKED, TRACKED, Candidate, choose, linked, on_fringe, skin_share
from slave.markers.roi import Track, advance

CLICK_REACH = 6  # px between a click and the scanned box of its marker
FRINGE = 0.2  # share of foreign neighbours from which a thin sliver counts as a colour fringe
SLIVER = 14.0  # px^2; a thinner sliver cannot be told from a fringe
CLEAR_CONTRAST = 6.0  # standard deviations between paint and surroundings that deserve full quality
SMALL = 40.0  # px^2 below which the centroid of a cap is uncertain
CLEAR_SIGMA_PX, DOUBT_SIGMA_PX = 0.1, 0.6  # of a centroid of full quality; added where there is none


@dataclass(frozen=True, slots=True)
class Detections:
    """Markers of one frame, in marker order; a row that is NaN in all was not seen.

    Attributes:
        uv: (M, 2) centroids of the visible paint [px], distorted image.
        area: (M,) visible area [px^2].
        quality: (M,) 0..1; 1 is a whole, unambiguous, clear marker.
        sigma_px: (M,) standard deviation per axis of `uv` as an estimate of the centroid of all that the camera
            would see of the whole cap: noise, doubt of occlusion, size.
        rival_uv: (M, 2) centroid of a second blob of the colour that may be the marker instead [px]; NaN: none.
    """

    uv: Float
    area: Float
    quality: Float
    sigma_px: Float
    rival_uv: Float


class MarkerDetector:
    """Finds the markers of one camera, frame by frame. Holds one track per marker."""

    def __init__(
        self,
        camera: CameraCalibration,
        markers: tuple[str, ...],
        seeds: Mapping[str, tuple[float, float]] | None = None,
        table: ColourTable | None = None,
    ) -> None:
        """Build the colour table (0.3 s) unless one is given.

        Args:
            camera: Camera file with `markers` filled.
            markers: Marker names in the order of the rig.
            seeds: Marker -> (u, v) [px], a pixel on that marker in the first frame, where known.
            table: Table built before from the same ranges.

        Raises:
            CalibrationError: The camera has no colour range for a marker.
        """
        self._camera = camera
        self._names = markers
        self._table = table_of(markers, camera.markers, f"camera {camera.name!r}") if table is None else table
        self._seeds = {markers.index(name): uv for name, uv in (seeds or {}).items() if name in markers}
        self._tracks: list[Track | None] = [None] * len(markers)

    def fresh(self, seeds: Mapping[str, tuple[float, float]] | None = None) -> "MarkerDetector":
        """A detector of the same camera that has seen nothing yet; shares the colour table."""
        return MarkerDetector(self._camera, self._names, seeds, self._table)

    def push(self, image: Image, t_ns: int) -> Detections:
        """Detect in one frame.

        Args:
            image: (H, W, 3) BGR of the camera's size.
            t_ns: Time of the frame [ns], rising; only differences matter.

        Raises:
            ValueError: The image is not of the camera's size, or not 8-bit colour.
        """
        size = (self._camera.height_px, self._camera.width_px, 3)
        if image.shape != size or image.dtype != np.uint8:
            raise ValueError(f"image {image.shape} {image.dtype}, the camera file says {size} uint8")
        image = np.ascontiguousarray(image)
        blobs = find_blobs(self._table.half_codes(image), self._table.bits)
        chosen = self._decide(image, blobs, t_ns)
        self._seeds = {}
        count = len(self._names)
        uv, area, quality = np.full((count, 2), np.nan), np.full(count, np.nan), np.full(count, np.nan)
        rival_uv = np.full((count, 2), np.nan)
        rows = list(chosen)
        extents = [self._extent(m, t_ns) for m in rows]
        for m, extent in zip(rows, extents, strict=True):
            if len(blobs[m]) > 1:
                chosen[m] = with_fragments(chosen[m], blobs[m], extent)
        measured = measure(
            image, self._table, [self._table.bits[m] for m in rows], [chosen[m] for m in rows], extents
        )
        for m, seen in zip(rows, measured, strict=True):
            blob, track = chosen[m], self._tracks[m]
            if seen is None or (seen.thin and (seen.foreign > FRINGE or seen.area < SLIVER)):
                continue
            self._tracks[m] = track = advance(track, seen, blob, t_ns)
            uv[m] = seen.u, seen.v
            area[m] = seen.area
            rivals = _rivals(blob, blobs[m])
            quality[m] = _quality(seen, track, near_rival=bool(rivals))
            if rivals:
                largest = max(rivals, key=lambda b: b.area)
                rival_uv[m] = largest.u, largest.v
        sigma_px = CLEAR_SIGMA_PX + DOUBT_SIGMA_PX * (1.0 - quality)
        return Detections(uv, area, quality, sigma_px, rival_uv)

    def _extent(self, m: int, t_ns: int) -> float:
        """Largest side of the whole marker [px] as far as its track knows, else inf."""
        track = self._tracks[m]
        if track is None or not track.alive(t_ns):
            return math.inf
        return 1.3 * max(track.width, track.height) + 2.0

    def _decide(self, image: Image, blobs: list[list[Blob]], t_ns: int) -> dict[int, Blob]:
        """Marker row -> its blob, by prediction alone where that answers for every colour in the image."""
        width = image.shape[1]
        tracked: dict[int, Blob] = {}
        certain = not self._seeds
        for m, options in enumerate(blobs):
            track = self._tracks[m]
            if not options:
                continue
            if track is None or not track.alive(t_ns):
                certain = False
                continue
            costs = [track.cost(blob, t_ns, width) for blob in options]
            cost = min(costs)
            if math.isfinite(cost):
                tracked[m] = options[costs.index(cost)]
                certain &= not track.sudden(tracked[m])
            else:
                certain = False
        if certain and _connected(tracked):
            return tracked
        candidates: list[Candidate] = []
        for m, options in enumerate(blobs):
            others = [blob for n, rest in enumerate(blobs) if n != m for blob in rest[:1]]
            for blob in options:
                bonus = self._bonus(m, blob, tracked.get(m))
                candidates.append(Candidate(m, blob, skin_share(image, blob), on_fringe(blob, others), bonus))
        clicked = {c.marker for c in candidates if c.bonus >= CLICKED}
        candidates = [c for c in candidates if c.bonus >= CLICKED or c.marker not in clicked]
        return {m: c.blob for m, c in choose(candidates).items()}

    def _bonus(self, m: int, blob: Blob, tracked: Blob | None) -> float:
        seed = self._seeds.get(m)
        if seed is not None:
            x = max(blob.left - seed[0], seed[0] - blob.right, 0.0)
            y = max(blob.top - seed[1], seed[1] - blob.bottom, 0.0)
            if max(x, y) <= CLICK_REACH:
                return CLICKED + math.sqrt(blob.area)  # the click names it; of its fragments take the largest
        track = self._tracks[m]
        return TRACKED if blob is tracked and track is not None and not track.sudden(blob) else 0.0


def _connected(chosen: Mapping[int, Blob]) -> bool:
    """Whether every chosen blob is linked to another one; skin is taken as given, since the past vouches."""
    nodes = [Candidate(m, blob, 1.0, False, 0.0) for m, blob in chosen.items()]
    return len(nodes) < 2 or all(any(linked(a, b) for b in nodes if b is not a) for a in nodes)


def _quality(seen: Measured, track: Track, *, near_rival: bool) -> float:
    """0..1: how far the centroid can be trusted to be the centroid of the whole cap's visible side."""
    quality = math.sqrt(min(1.0, seen.area / track.whole)) * min(1.0, seen.contrast / CLEAR_CONTRAST)
    quality *= math.sqrt(min(1.0, seen.area / SMALL))
    if seen.cut:
        quality *= 0.5
    if seen.thin:
        quality *= 0.4
    if near_rival:
        quality *= 0.5
    return max(0.01, min(1.0, quality))


def _rivals(blob: Blob, options: list[Blob]) -> list[Blob]:
    """The other blobs of its colour, near it and not much smaller, that may be the marker instead."""
    others = [b for b in options if b.area > 0.3 * blob.area and not _within(b, blob)]
    return [b for b in others if math.hypot(b.u - blob.u, b.v - blob.v) < 3.0 * math.sqrt(blob.area)]


def _within(piece: Blob, blob: Blob) -> bool:
    return blob.left <= piece.u <= blob.right and blob.top <= piece.v <= blob.bottom
