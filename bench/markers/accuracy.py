"""Errors of centroids against exact truth, kind by kind, ours and the published pipeline on the same frames."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from bench.markers.published import detect
from bench.markers.scene import KINDS, Kind, MarkerFrame, sequences
from bench.report import Row
from common.arrays import Bool, Float
from slave.markers.detector import MarkerDetector

_FREE_PX = 3.0  # a centroid farther from the truth than this and the radius is a wrong blob
_FLAG_SIGMA_PX = 0.2  # a marker that states more than the goal under occlusion is flagged
_SEQUENCES = {"base": 30, "finger_end": 30, "blur3": 20, "blur6": 20, "occluded15": 20, "320x240": 20}


@dataclass(frozen=True, slots=True, eq=False)
class Measurements:
    """All judged markers of one kind, N rows."""

    uv: Float  # (N, 2) centroids [px], NaN: not found
    published: Float  # the same by the published pipeline
    truth: Float  # (N, 2) centroid of the visible paint [px]
    whole: Float  # (N, 2) centroid of all paint [px]
    radius: Float  # (N,) [px]
    sigma: Float  # (N,) [px]

    @property
    def flagged(self) -> Bool:
        """(N,) whether the detector states that the centroid is uncertain."""
        return np.isfinite(self.uv[:, 0]) & (self.sigma > _FLAG_SIGMA_PX)


@dataclass(frozen=True, slots=True)
class Score:
    """Errors of one pipeline against one truth; wrong blobs are not errors but counted."""

    rms_px: float  # per axis
    median_px: float  # of the distance
    p95_px: float
    found: float  # share of the markers, wrong blobs not included
    wrong: int  # wrong blobs
    judged: int  # markers


def rows() -> Iterator[Row]:
    """Measure every kind: error per axis, and of whole caps behind an edge, what stays where nothing is flagged."""
    cv2.setNumThreads(1)
    for name, kind in KINDS.items():
        m = measure(kind, _SEQUENCES.get(name, 2 if kind.scale > 1.0 else 8))
        ours, theirs = score(m.uv, m.truth, m.radius), score(m.published, m.truth, m.radius)
        within, ratio = honesty(m)
        note = (
            f"published {theirs.rms_px:.3f}; 95 % {ours.p95_px:.3f}; found {100.0 * ours.found:.1f} % of {ours.judged},"
            f" wrong blobs {ours.wrong} (published {theirs.wrong}); {100.0 * within:.0f} % within 1.96 sigma,"
            f" RMS of error/sigma {ratio:.2f}; flagged {100.0 * float(m.flagged.mean()):.1f} %"
        )
        yield Row(f"{name}: error per axis", ours.rms_px, "px RMS", note)
        if kind.hidden > 0.0:
            kept = ~m.flagged & np.isfinite(m.uv[:, 0])
            plain = score(m.uv[kept], m.whole[kept], m.radius[kept])
            note = "to the whole cap; goal 0.2, or flagged"
            yield Row(f"{name}: of those not flagged", plain.rms_px, "px RMS", note)


def measure(kind: Kind, count: int, seed: int = 1, detector: Any = None) -> Measurements:
    """Run `count` sequences of a kind through `detector` (ours unless given) and the published pipeline."""
    camera = kind.camera
    ranges = [(camera.markers or {})[name] for name in kind.names]
    if detector is None:
        detector = MarkerDetector(camera, kind.names)
    found: list[tuple[Float, ...]] = []
    for frames in sequences(kind, count, seed):
        mine: Any = None
        for frame in frames:
            if mine is None:
                mine = detector.fresh(clicks(kind, frame) if kind.clicked else None)
            one = mine.push(frame.image, frame.t_ns)
            if frame.judged:
                truth = (frame.uv, frame.whole_uv, frame.radius)
                found.append((one.uv, detect(frame.image, ranges), *truth, one.sigma_px))
    return Measurements(*(np.concatenate(column) for column in zip(*found, strict=True)))


def clicks(kind: Kind, frame: MarkerFrame) -> dict[str, tuple[float, float]]:
    """Return a click on every marker."""
    return {name: (float(u), float(v)) for name, (u, v) in zip(kind.names, frame.uv, strict=True)}


def score(uv: Float, truth: Float, radius: Float) -> Score:
    """Compare centroids `uv` (N, 2) [px] with `truth`."""
    error = uv - truth
    away = np.hypot(error[:, 0], error[:, 1])
    seen = np.isfinite(away)
    right = seen & (away <= np.maximum(_FREE_PX, radius))
    if not right.any():
        return Score(np.nan, np.nan, np.nan, 0.0, int(seen.sum()), len(uv))
    rms = float(np.sqrt(np.mean(np.square(error[right]))))
    middle, p95 = np.percentile(away[right], [50.0, 95.0]).tolist()
    return Score(rms, middle, p95, float(right.mean()), int((seen & ~right).sum()), len(uv))


def honesty(m: Measurements) -> tuple[float, float]:
    """Return the share of errors per axis within 1.96 sigma, and RMS of error / sigma; of the whole cap's centroid."""
    ratio = (m.uv - m.whole) / m.sigma[:, None]
    away = np.hypot(*(m.uv - m.whole).T)
    ratio = ratio[away <= np.maximum(_FREE_PX, m.radius)].ravel()
    ratio = ratio[np.isfinite(ratio)]
    if not ratio.size:
        return np.nan, np.nan
    return float(np.mean(np.abs(ratio) <= 1.96)), float(np.sqrt(np.mean(np.square(ratio))))
