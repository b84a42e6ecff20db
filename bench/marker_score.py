"""How far centroids are from the exact truth: ours and those of the published pipeline, on the same frames."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from bench.marker_frames import MarkerFrame, sequences
from bench.marker_kinds import Kind
from bench.seed_markers import detect
from common.arrays import Bool, Float, Image
from slave.markers.detector import MarkerDetector

FREE_PX: Final = 3.0  # a centroid farther from the truth than this and the radius is a wrong blob
FLAG_SIGMA_PX: Final = 0.2  # a marker that admits more than the goal under occlusion is flagged
FLAG_QUALITY: Final = 0.8  # the same, for a detector that knows no sigma


class Found(Protocol):
    """What a detector says of one frame, see `slave.markers.detector.Detections`."""

    @property
    def uv(self) -> Float:
        """(M, 2) [px]."""
        ...

    @property
    def quality(self) -> Float:
        """(M,) 0..1."""
        ...


class Detector(Protocol):
    """A detector of one camera."""

    def push(self, image: Image, t_ns: int) -> Found:
        """Detect in one frame."""
        ...

    def fresh(self, initial_uv: Mapping[str, tuple[float, float]] | None = None) -> "Detector":
        """One that has seen nothing yet; `initial_uv` are clicks in the first frame, marker -> (u, v) [px]."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Measurements:
    """All judged markers of one kind, N rows.

    Attributes:
        uv, published: (N, 2) centroids [px], NaN: not found.
        truth, whole: (N, 2) centroid of the visible paint, and of all paint [px].
        radius: (N,) [px].
        sigma: (N,) [px], NaN where the detector has none.
        flagged: (N,) the detector says that the centroid is uncertain.
    """

    uv: Float
    published: Float
    truth: Float
    whole: Float
    radius: Float
    sigma: Float
    flagged: Bool


@dataclass(frozen=True, slots=True)
class Score:
    """Errors of one pipeline against one truth; wrong blobs are not errors but counted.

    Attributes:
        rms_px: Per axis.
        median_px, p95_px: Of the distance.
        found: Share of the markers, wrong blobs not included.
        wrong: Wrong blobs.
        judged: Markers.
    """

    rms_px: float
    median_px: float
    p95_px: float
    found: float
    wrong: int
    judged: int


def measure(kind: Kind, count: int, seed: int = 1, detector: Detector | None = None) -> Measurements:
    """Run `count` sequences of a kind through `detector` (ours unless given) and the published pipeline."""
    camera = kind.camera
    ranges = [(camera.markers or {})[name] for name in kind.names]
    if detector is None:
        detector = MarkerDetector(camera, kind.names)
    rows: list[tuple[Float, ...]] = []
    for frames in sequences(kind, count, seed):
        mine: Detector | None = None
        for frame in frames:
            if mine is None:
                mine = detector.fresh(clicks(kind, frame) if kind.clicked else None)
            found = mine.push(frame.image, frame.t_ns)
            if frame.judged:
                rows.append(_row(frame, found, detect(frame.image, ranges)))
    uv, published, truth, whole, radius, sigma, flagged = (np.concatenate(c) for c in zip(*rows, strict=True))
    return Measurements(uv, published, truth, whole, radius, sigma, flagged != 0.0)


def clicks(kind: Kind, frame: MarkerFrame) -> dict[str, tuple[float, float]]:
    """A click on every marker."""
    return {name: (float(u), float(v)) for name, (u, v) in zip(kind.names, frame.uv, strict=True)}


def score(uv: Float, truth: Float, radius: Float) -> Score:
    """Errors of the centroids `uv` (N, 2) [px] against `truth`."""
    error = uv - truth
    away = np.hypot(error[:, 0], error[:, 1])
    seen = np.isfinite(away)
    right = seen & (away <= np.maximum(FREE_PX, radius))
    if not right.any():
        return Score(np.nan, np.nan, np.nan, 0.0, int(seen.sum()), len(uv))
    return Score(
        rms_px=float(np.sqrt(np.mean(np.square(error[right])))),
        median_px=float(np.median(away[right])),
        p95_px=float(np.percentile(away[right], 95.0)),
        found=float(right.mean()),
        wrong=int((seen & ~right).sum()),
        judged=len(uv),
    )


def honesty(m: Measurements) -> tuple[float, float]:
    """Share of the errors per axis within 1.96 sigma, and RMS of error / sigma; of the whole cap's centroid."""
    ratio = (m.uv - m.whole) / m.sigma[:, None]
    away = np.hypot(*(m.uv - m.whole).T)
    ratio = ratio[away <= np.maximum(FREE_PX, m.radius)].ravel()
    ratio = ratio[np.isfinite(ratio)]
    if not ratio.size:
        return np.nan, np.nan
    return float(np.mean(np.abs(ratio) <= 1.96)), float(np.sqrt(np.mean(np.square(ratio))))


def _row(frame: MarkerFrame, found: Found, published: Float) -> tuple[Float, ...]:
    seen = np.isfinite(found.uv[:, 0])
    sigma: Float | None = getattr(found, "sigma_px", None)
    if sigma is None:
        flagged = seen & (found.quality < FLAG_QUALITY)
        sigma = np.full(len(seen), np.nan)
    else:
        flagged = seen & (sigma > FLAG_SIGMA_PX)
    return (
        found.uv,
        published,
        frame.uv,
        frame.whole_uv,
        frame.radius,
        sigma,
        flagged.astype(np.float64),
    )
