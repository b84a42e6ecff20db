"""Marker detector: frame in, marker centroids out.

A push machine. It holds one track per marker; a new recording gets a new detector (`fresh`). Markers of one paint, on
two hands, share a colour: which of its blobs is whose tracks decide as far as they go, and else the master. Where two
of them may have become one blob, neither is reported.

    scan     one table look-up, all colours at once; the whole frame or windows    scan, classify
    blobs    connected blobs per colour                                            classify
    decide   by prediction where a track answers; else by what belongs together    track, group
    measure  sub-pixel centroid of the visible marker colour, full resolution      centroid
    outline  where the colour fills only a part of a round marker: its circle      outline
    judge    how probable it is a marker; how far it may be off                    quality, track
"""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from common.arrays import Float, Image
from common.calibration import CameraCalibration, HsvRange
from slave.markers.centroid import PAD, Measured
from slave.markers.classify import Blob, ColourTable, table_of, with_fragments
from slave.markers.engine import NUMPY, Engine
from slave.markers.group import (
    CLICKED,
    TRACKED,
    Candidate,
    ColourAmbiguityMonitor,
    candidate,
    choose_all,
    connected,
    on_fringe,
)
from slave.markers.outline import Outline, outlines_of
from slave.markers.quality import CLEAR_CONTRAST, Evidence, clarity_of, evidence_of, probability_of
from slave.markers.scan import Scanned, Scanner
from slave.markers.track import (
    COVERED_PX,
    Ellipse,
    Track,
    Window,
    advance,
    assigned,
    centre_of,
    fits_occlusion,
    sigma_of,
)

NOT_SEEN = (math.nan,) * 11  # what is reported of a marker


@dataclass(frozen=True, slots=True)
class Detections:
    """Markers of one frame, in marker order; a row that is NaN in all was not seen.

    Attributes:
        uv: (M, 2) centroids of the visible marker area [px], distorted image; of the whole cap where something covers
            a part and the visible edge constrains it; of the whole disc where the colour is only a part of it.
        area: (M,) area [px^2] of what `uv` is the centroid of.
        quality: (M,) 0..1, the probability that it is a marker.
        sigma_px: (M,) standard deviation per axis of `uv` as an estimate of the centroid of all that the camera
            would see of the whole cap: noise, uncertainty of occlusion, size, motion.
        alt_uv: (M, 2) centroid of a second blob of the colour that may be the marker instead [px], NaN: none; in a
            frame with many only as the scan saw it, to a pixel or so.
        clarity: (M,) 0..1, how far `colour` is that of the marker alone: 1 is a whole, clear marker.
        colour: (M, 3) mean of the core in linear light 0..1: blue, green, red.
    """

    uv: Float
    area: Float
    quality: Float
    sigma_px: Float
    alt_uv: Float
    clarity: Float
    colour: Float

    @classmethod
    def none(cls, markers: int) -> "Detections":
        """So many markers, none of them seen."""
        shapes = ((2,), (), (), (), (2,), (), (3,))
        return cls(*(np.full((markers, *shape), np.nan) for shape in shapes))


class MarkerDetector:
    """Finds the markers of one camera, frame by frame. Holds one track per marker.

    Attributes:
        markers: What it seeks, in the order of its rows and of the bits of `table`, the colour table in use.
        ranges: Marker -> its range in the camera file, under the light of calibration.
        windows_only: Only windows of tracked markers are scanned, and strips for lost ones; the first frame is scanned
            whole. May change between two frames.
        ambiguity: Things of a marker's colour that are none, as far as scans saw them.
        evidence: Marker row -> what its quality was made of, of those that were judged in the last frame.
    """

    def __init__(
        self,
        camera: CameraCalibration,
        markers: tuple[str, ...],
        initial_uv: Mapping[str, tuple[float, float]] | None = None,
        table: ColourTable | None = None,
        engine: Engine = NUMPY,
        free: Collection[str] = (),
    ) -> None:
        """Build the colour table (0.3 s) unless one is given.

        Args:
            camera: Camera file with `markers` filled.
            markers: Marker names in the order of the rig.
            initial_uv: Marker -> (u, v) [px], a pixel on that marker in the first frame, where known.
            table: Table built before from the same ranges.
            engine: What scans and measures.
            free: Those of the markers that sit on no hand: neither skin nor neighbours are expected about them.

        Raises:
            CalibrationError: The camera has no colour range for a marker.
        """
        self._camera = camera
        self._exposure_s = camera.exposure_us * 1e-6
        self._margin = camera.roi_margin
        self.markers = markers
        self.table = table_of(markers, camera.markers, f"camera {camera.name!r}") if table is None else table
        self.ranges: Mapping[str, HsvRange] = camera.markers or {}
        self._free = tuple(markers.index(name) for name in free)
        self._engine = engine
        engine.prepare(self.table)
        self._initial_uv = {
            markers.index(name): uv for name, uv in (initial_uv or {}).items() if name in markers
        }
        rows_of: dict[int, list[int]] = {}
        for m, bit in enumerate(self.table.bits):
            rows_of.setdefault(bit, []).append(m)
        self._colours = list(rows_of.values())  # rows of each colour: of one marker, or of one on every hand
        self._alike = [rows_of[bit] for bit in self.table.bits]
        self._shared = len(self._colours) < len(markers)
        self._tracks: list[Track | None] = [None] * len(markers)
        self._scanner = Scanner(camera.width_px, camera.height_px, engine)
        self._last_ns: int | None = None  # time of the last frame
        self._frame = 0  # frames so far
        self._outlined: set[int] = set()  # markers whose outline holds more than their colour
        self._gains = (1.0, 1.0, 1.0)  # of the light against calibration, blue first
        self.windows_only = False
        self.ambiguity = ColourAmbiguityMonitor(markers)
        self.evidence: dict[int, Evidence] = {}

    def fresh(self, initial_uv: Mapping[str, tuple[float, float]] | None = None) -> "MarkerDetector":
        """Return a detector of the same camera and colour table without any tracks."""
        free = [self.markers[m] for m in self._free]
        other = MarkerDetector(self._camera, self.markers, initial_uv, self.table, self._engine, free)
        other.windows_only, other._gains = self.windows_only, self._gains
        return other

    def push(self, image: Image, t_ns: int) -> Detections:
        """Detect in one frame (H, W, 3) BGR; only differences of its rising time matter.

        Raises ValueError: the image is not of the camera's size, or not 8-bit colour.
        """
        size = (self._camera.height_px, self._camera.width_px, 3)
        if image.shape != size or image.dtype != np.uint8:
            raise ValueError(f"image {image.shape} {image.dtype}, the camera file says {size} uint8")
        image = np.ascontiguousarray(image)
        width = self._camera.width_px
        alive = [track if track is not None and track.alive(t_ns) else None for track in self._tracks]
        windows = [None if track is None else track.window(t_ns, width, self._margin) for track in alive]
        scanned = self._look(image, t_ns, windows)
        blobs = scanned.blobs
        chosen = self._decide(scanned, windows)
        if self._shared:
            blobs = [self._but_of_others(m, blobs[rows[0]], chosen) for m, rows in enumerate(self._alike)]
        self.ambiguity.push(blobs, chosen)
        self._initial_uv = {}
        rows = list(chosen)
        alternatives: dict[int, Blob] = {}
        shift_px: dict[int, float] = {}
        for m in rows:
            if len(blobs[m]) > 1:
                track = alive[m]
                known = (math.inf, math.nan) if track is None else (track.extent, track.whole)
                chosen[m], shift_px[m] = with_fragments(chosen[m], blobs[m], *known)
                alternative = self._alternative(
                    chosen[m], blobs[m], self._foreign(m, scanned.blobs), windows[m]
                )
                if alternative is not None:
                    alternatives[m] = alternative
        # An alternative costs as much as a marker, so only two are measured in one frame.
        closely = sorted(alternatives, key=lambda m: -alternatives[m].area)[:2]
        asked = [(m, chosen[m]) for m in rows] + [(m, alternatives[m]) for m in closely]
        every = scanned.blobs
        alone = [len(every[m]) == 1 or _alone(blob, every[m]) for m, blob in asked]
        bits = [self.table.bits[m] for m, _ in asked]
        measured = self._engine.measure(image, self.table, bits, [blob for _, blob in asked], alone)
        for m, seen in zip(closely, measured[len(rows) :], strict=True):
            if seen is not None:
                alternatives[m] = alternatives[m]._replace(u=seen.u, v=seen.v)
        fringe = 0.2  # share of foreign neighbours from which a thin sliver counts as a colour fringe
        sliver = 14.0  # px^2; a thinner sliver cannot be distinguished from a fringe
        seen_as = {
            m: seen
            for m, seen in zip(rows, measured, strict=False)
            if seen is not None and not (seen.thin and (seen.foreign > fringe or seen.area < sliver))
        }
        if self._shared:
            for m in [m for m, seen in seen_as.items() if self._merged(m, seen, chosen, windows)]:
                del seen_as[m]
        self.evidence, self._frame = {}, self._frame + 1
        due = {m for m in seen_as if alive[m] is None}
        outlines = outlines_of(image, seen_as, due, self._outlined, self._frame)
        reports: dict[int, tuple[float, ...]] = {}
        for m, seen in seen_as.items():
            blob, shift = chosen[m], shift_px.get(m, 0.0)
            reports[m] = self._report(
                m, alive[m], seen, outlines.get(m), blob, alternatives.get(m), t_ns, shift
            )
        digits = 6  # of what is reported: what comes after them differs between processors
        table = np.array([reports.get(m, NOT_SEEN) for m in range(len(self.markers))]).round(digits)
        return Detections(
            table[:, :2], table[:, 2], table[:, 3], table[:, 4], table[:, 5:7], table[:, 7], table[:, 8:]
        )

    @property
    def plain(self) -> "MarkerDetector":
        """Itself, as of the detectors that wrap one."""
        return self

    def adopt(self, other: "MarkerDetector") -> None:
        """Go on with the tracks of another detector, of the markers that both seek."""
        self._initial_uv = {}
        if other.markers == self.markers:
            self._tracks, self._scanner, self.ambiguity = other._tracks, other._scanner, other.ambiguity
            self._last_ns, self._frame, self._outlined = other._last_ns, other._frame, other._outlined
        else:
            tracks = dict(zip(other.markers, other._tracks, strict=True))
            self._tracks = [tracks.get(name) for name in self.markers]

    def tune(self, camera: CameraCalibration) -> None:
        """Apply a changed exposure (motion smears) or margin. From any thread."""
        self._exposure_s, self._margin = camera.exposure_us * 1e-6, camera.roi_margin

    def recolour(self, table: ColourTable, gains: tuple[float, float, float]) -> None:
        """Go on with another prepared table, of a light with `gains` against calibration."""
        self.table, self._gains = table, gains

    def _report(
        self,
        m: int,
        before: Track | None,
        seen: Measured,
        outline: Outline | None,
        blob: Blob,
        alternative: Blob | None,
        t_ns: int,
        shift_px: float,
    ) -> tuple[float, ...]:
        """Report one marker and continue its track; `before`: the track, if alive."""
        other = (math.nan, math.nan) if alternative is None else (alternative.u, alternative.v)
        support = 0.0 if outline is None or seen.contrast >= CLEAR_CONTRAST else outline.support
        # sides of the marker: an alternative so near may be taken for it in the next frame
        near = math.hypot(other[0] - seen.u, other[1] - seen.v) < 3.0 * math.sqrt(blob.area)  # NaN is not
        lonely = alternative is None if before is None else before.lonely
        clear = seen.contrast >= CLEAR_CONTRAST and not (seen.cut or seen.thin)
        # frames: a clear marker that is tracked is judged in one of so many, and stays what it was between
        judged = 6
        if before is None or not clear or near or m % judged == self._frame % judged:
            colour = self.ranges[self.markers[m]]
            self.evidence[m] = evidence_of(seen, self._gains, colour, support, near or not lonely)
            quality = probability_of(self.evidence[m])
        else:
            quality = before.quality
        if outline is not None:
            seen = outline.measured(seen)
        self._tracks[m] = track = advance(self._tracks[m], seen, blob, t_ns, quality, lonely)
        sigma = sigma_of(seen, before, track, self._exposure_s, outline)
        u, v, area = seen.u, seen.v, seen.area
        smear = math.hypot(track.du, track.dv) * self._exposure_s
        smeared = 2.0  # px of way during the exposure from which an edge is no edge
        if before is not None and track.covered and smear < smeared and clear:
            shape, x, y = Ellipse(before.xx, before.xy, before.yy), u - seen.left, v - seen.top
            whole = centre_of(seen.window, shape, x, y)
            hidden = before.hidden(seen.area)
            if whole is not None and fits_occlusion(hidden, shape, whole.u - x, whole.v - y):
                u, v, area = seen.left + whole.u, seen.top + whole.v, before.typical
                sigma = math.hypot(COVERED_PX, whole.rms)
        sigma = math.hypot(sigma, shift_px)
        clarity = clarity_of(seen, track.whole) * (0.5 if near else 1.0)
        blue, green, red = seen.colour
        return u, v, area, quality, sigma, *other, clarity, blue, green, red

    def _alternative(
        self, blob: Blob, options: list[Blob], foreign: list[Blob], window: Window | None
    ) -> Blob | None:
        """Return the largest other blob that may be the marker by size and motion."""
        alternative = 0.3  # of the marker's area: a smaller blob is no alternative, nor one as much larger
        least, most = alternative * blob.area, blob.area / alternative
        others = (
            b
            for b in options
            if least < b.area < most
            and not blob.holds(b.u, b.v)
            and (window is None or math.isfinite(window.cost(b)))
            and not on_fringe(b, foreign)
        )
        return max(others, key=lambda b: b.area, default=None)

    def _foreign(self, m: int, blobs: list[list[Blob]]) -> list[Blob]:
        """The largest blobs of the other colours, as many as there are markers of each."""
        return [b for rows in self._colours if m not in rows for b in blobs[rows[0]][: len(rows)]]

    def _but_of_others(self, m: int, options: list[Blob], chosen: Mapping[int, Blob]) -> list[Blob]:
        """The blobs of a marker's colour without those of its like on other hands."""
        taken = [chosen[n] for n in self._alike[m] if n != m and n in chosen]
        return [blob for blob in options if all(blob is not other for other in taken)]

    def _merged(
        self, m: int, seen: Measured, chosen: Mapping[int, Blob], windows: list[Window | None]
    ) -> bool:
        """Whether a blob may hold its like of another hand, too, that is not seen."""
        track, blob = self._tracks[m], chosen[m]
        reach = 0.5 * math.sqrt(blob.area)  # how far off the place may be at which that is expected
        largest = 1.12  # of the area of late: more is not of this marker alone
        return any(
            n not in chosen
            and (window := windows[n]) is not None
            and blob.holds(window.u, window.v, reach)
            and (track is None or seen.area > largest * track.typical)
            for n in self._alike[m]
            if n != m
        )

    def _look(self, image: Image, t_ns: int, windows: list[Window | None]) -> Scanned:
        """Scan the frame as far as it has to be."""
        last_ns, self._last_ns = self._last_ns, t_ns
        if not self.windows_only or not self._scanner.began:
            return self._scanner.whole(image, self.table)
        lost: list[int] = []
        places: list[tuple[Window, ...]] = []
        for m, (track, window) in enumerate(zip(self._tracks, windows, strict=True)):
            seen = track is not None and track.t_ns == last_ns
            if not seen:
                lost.append(m)
            if track is None or window is None or (track.growing(t_ns) and not seen):
                places.append(())  # what has grown is more to look at than strips
            elif max(abs(window.u - track.u), abs(window.v - track.v)) <= window.margin:
                places.append((window,))
            else:
                places.append((window, window._replace(u=track.u, v=track.v)))  # it may have come to rest
        return self._scanner.around(image, self.table, places, lost)

    def _decide(self, scanned: Scanned, windows: list[Window | None]) -> dict[int, Blob]:
        """Marker row -> blob; by prediction alone where that answers for all seen."""
        blobs = scanned.blobs
        tracked: dict[int, Blob] = {}
        certain = not self._initial_uv
        for rows in self._colours:
            options = blobs[rows[0]]
            if not options:
                continue
            found = assigned(rows, windows, options)
            certain = certain and len(found) in (len(rows), len(options))
            for m, blob in found.items():
                tracked[m] = blob
                track = self._tracks[m]
                certain = certain and not (track is not None and track.sudden(blob))
        if certain and connected([blob for m, blob in tracked.items() if m not in self._free]):
            return tracked
        candidates: list[Candidate] = []
        for m, *more in self._colours:
            others = self._foreign(m, blobs)
            for blob in blobs[m]:
                bonus = max(self._bonus(n, blob, tracked.get(n)) for n in (m, *more))
                skin = scanned.skin_share(self.table.skin, blob)
                candidates.append(candidate(m, blob, skin, on_fringe(blob, others), bonus))
        clicked = {c.marker for c in candidates if c.bonus >= CLICKED}
        candidates = [c for c in candidates if c.bonus >= CLICKED or c.marker not in clicked]
        slots = {rows[0]: len(rows) for rows in self._colours}
        chosen: dict[int, Blob] = {}
        for c in choose_all([c for c in candidates if c.marker not in self._free], slots):
            rows = [m for m in self._alike[c.marker] if m not in chosen]
            own = [m for m in rows if tracked.get(m) is c.blob]
            chosen[(own or [m for m in rows if m not in tracked] or rows)[0]] = c.blob
        for m in self._free:
            # One that was tracked is followed; one that appears is the largest that is no rim of another colour.
            mine = [c for c in candidates if c.marker == m and (c.bonus > 0.0 or not c.fringe)]
            if mine:
                chosen[m] = max(mine, key=lambda c: (c.bonus, c.blob.area)).blob
        return chosen

    def _sudden(self, m: int, blob: Blob) -> bool:
        """Whether a marker's area jumped."""
        track = self._tracks[m]
        return track is not None and track.sudden(blob)

    def _bonus(self, m: int, blob: Blob, tracked: Blob | None) -> float:
        initial_uv = self._initial_uv.get(m)
        click_reach = 6  # px between a click and the scanned box of its marker
        if initial_uv is not None and blob.holds(*initial_uv, click_reach):
            return CLICKED + math.sqrt(blob.area)  # the click names it; of its fragments take the largest
        return TRACKED if blob is tracked and not self._sudden(m, blob) else 0.0


def _alone(blob: Blob, options: list[Blob]) -> bool:
    """Return whether no other blob of the colour is in the window of `blob`."""
    return not any(
        b.meets(blob, PAD)
        for b in options
        if not (
            b.left >= blob.left and b.right <= blob.right and b.top >= blob.top and b.bottom <= blob.bottom
        )
    )


def ambiguity_counts(detector: MarkerDetector | None) -> dict[str, int]:
    """Counts of `Health`: ambiguous.<marker>, frames with other things of its colour."""
    frames = {} if detector is None else detector.ambiguity.frames
    return {f"ambiguous.{name}": count for name, count in frames.items()}


def ambiguity_metrics(detector: MarkerDetector | None) -> dict[str, float]:
    """Metrics of `Health`: ambiguous.<marker>.u and .v, its last place [px]."""
    places = [] if detector is None else list(detector.ambiguity.places.items())  # the loop may add one
    return {
        f"ambiguous.{name}.{axis}": value for name, at in places for axis, value in zip("uv", at, strict=True)
    }
