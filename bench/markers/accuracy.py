"""Errors of centroids against exact truth, kind by kind, ours and the published pipeline on the same frames.

python -m bench marker_accuracy base blur6 --sequences 30 --seed 2      some kinds, other frames
"""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, cast

import cv2
import numpy as np

from bench.markers.frames import MarkerFrame, generator, sequences, variance
from bench.markers.kinds import KINDS, Kind
from bench.markers.published import detect
from bench.markers.scene import make_scene
from bench.report import Row, show
from common.arrays import Bool, Float, Image
from slave.markers.detector import MarkerDetector

_FREE_PX = 3.0  # a centroid farther from the truth than this and the radius is a wrong blob
_FLAG_SIGMA_PX = 0.2  # a marker that states more than the goal under occlusion is flagged
_GOALS = {"base": 0.07, "finger_end": 0.10, "blur6": 0.12}
_HIDDEN_GOAL = 0.20
_SEQUENCES = {"base": 30, "finger_end": 30, "blur3": 20, "blur6": 20, "occluded15": 20, "320x240": 20}
_LARGE, _USUAL, _FLOOR = 2, 8, 6  # sequences of the large sizes, of other kinds, for the Cramer-Rao bound
_HALF_STEP = 0.125  # px: sub-pixels are 1/8 px


class Found(Protocol):
    """A detector's result of one frame, see `slave.markers.detector.Detections`."""

    @property
    def uv(self) -> Float:
        """(M, 2) [px]."""
        ...

    @property
    def sigma_px(self) -> Float:
        """(M,) [px]."""
        ...


class Detector(Protocol):
    """A detector of one camera."""

    def push(self, image: Image, t_ns: int) -> Found:
        """Detect in one frame."""
        ...

    def fresh(self, initial_uv: Mapping[str, tuple[float, float]] | None = None) -> "Detector":
        """Return one that has seen nothing yet; `initial_uv` are clicks in the first frame, marker -> (u, v) [px]."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Measurements:
    """All judged markers of one kind, N rows.

    Attributes:
        uv, published: (N, 2) centroids [px], NaN: not found.
        truth, whole: (N, 2) centroid of the visible paint, and of all paint [px].
        radius: (N,) [px].
        sigma: (N,) [px].
    """

    uv: Float
    published: Float
    truth: Float
    whole: Float
    radius: Float
    sigma: Float

    @property
    def flagged(self) -> Bool:
        """(N,) whether the detector states that the centroid is uncertain."""
        return np.isfinite(self.uv[:, 0]) & (self.sigma > _FLAG_SIGMA_PX)


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


def rows() -> Iterator[Row]:
    """Measure every kind."""
    cv2.setNumThreads(1)
    for name, kind in KINDS.items():
        count = _SEQUENCES.get(name, _LARGE if kind.scale > 1.0 else _USUAL)
        yield from rows_of(name, measure(kind, count))


def rows_of(name: str, m: Measurements) -> Iterator[Row]:
    """Return the rows of one kind."""
    ours, theirs = score(m.uv, m.truth, m.radius), score(m.published, m.truth, m.radius)
    hidden = KINDS[name].hidden > 0.0
    note = f"published {theirs.rms_px:.3f}; median {ours.median_px:.3f}, 95 % {ours.p95_px:.3f}"
    if name in _GOALS:
        floor = np.sqrt(np.mean(np.square(floor_px(KINDS[name], _FLOOR))))
        note += f"; goal {_GOALS[name]}, Cramer-Rao {floor:.3f}"
    within, ratio = honesty(m)
    found, flagged = (
        f"of {ours.judged}; published {100.0 * theirs.found:.1f}",
        100.0 * float(m.flagged.mean()),
    )
    yield Row(f"{name}: error per axis", ours.rms_px, "px RMS", note)
    yield Row(f"{name}: found", 100.0 * ours.found, "%", found)
    yield Row(f"{name}: wrong blobs", ours.wrong, "count", f"published {theirs.wrong}; goal 0")
    yield Row(
        f"{name}: errors within 1.96 sigma", 100.0 * within, "%", f"goal 95; RMS of error/sigma {ratio:.2f}"
    )
    note = "" if hidden else "nothing is hidden"
    yield Row(f"{name}: flagged (sigma > {_FLAG_SIGMA_PX} px)", flagged, "%", note)
    if hidden:
        whole, theirs = score(m.uv, m.whole, m.radius), score(m.published, m.whole, m.radius)
        kept = ~m.flagged & np.isfinite(m.uv[:, 0])
        plain, goal = score(m.uv[kept], m.whole[kept], m.radius[kept]), f"goal {_HIDDEN_GOAL}, or flagged"
        yield Row(f"{name}: error to the whole cap", whole.rms_px, "px RMS", f"published {theirs.rms_px:.3f}")
        yield Row(f"{name}: the same, of those not flagged", plain.rms_px, "px RMS", goal)


def measure(kind: Kind, count: int, seed: int = 1, detector: Detector | None = None) -> Measurements:
    """Run `count` sequences of a kind through `detector` (ours unless given) and the published pipeline."""
    camera = kind.camera
    ranges = [(camera.markers or {})[name] for name in kind.names]
    if detector is None:
        detector = MarkerDetector(camera, kind.names)
    found: list[tuple[Float, ...]] = []
    for frames in sequences(kind, count, seed):
        mine: Detector | None = None
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


def floor_px(kind: Kind, count: int, seed: int = 1) -> Float:
    """Return the Cramér-Rao bound per axis [px] of every marker of the first frames of `count` sequences, (N,).

    For independent Gaussian noise the Fisher information of the place p = (u, v) is J = sum (dL/dp)^T (dL/dp) / var
    over the pixels, L the noiseless light; the derivative comes from the frames' own generator by central differences.
    """
    floors: list[float] = []
    for k in range(count):
        scene = make_scene(kind, generator(kind, k, seed))
        inverse = 1.0 / variance(scene.light(scene.caps), kind.noise)
        slopes = [
            (
                scene.light(tuple(c.moved(du, dv) for c in scene.caps))
                - scene.light(tuple(c.moved(-du, -dv) for c in scene.caps))
            )
            / (2.0 * _HALF_STEP)
            for du, dv in ((_HALF_STEP, 0.0), (0.0, _HALF_STEP))
        ]
        for cap in scene.caps:
            reach = max(cap.a, cap.b) + 3.0 + 0.5 * kind.blur_px
            window = np.s_[
                max(round(cap.v - reach), 0) : round(cap.v + reach) + 1,
                max(round(cap.u - reach), 0) : round(cap.u + reach) + 1,
            ]
            su, sv, weight = slopes[0][window], slopes[1][window], inverse[window]
            uu, uv, vv = ((a * b * weight).sum() for a, b in ((su, su), (su, sv), (sv, sv)))
            covariance = cast(Float, np.linalg.inv(np.array([[uu, uv], [uv, vv]], np.float64)))
            floors.append(float(np.sqrt(np.trace(covariance) / 2.0)))
    return np.array(floors)


def main(arguments: Sequence[str]) -> None:
    """Print the rows of some kinds."""
    parser = argparse.ArgumentParser(prog="python -m bench marker_accuracy", description=__doc__)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("--sequences", type=int, default=_USUAL, help="of each kind")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    if unknown := sorted(set(options.kinds) - KINDS.keys()):
        parser.error(f"unknown kind {unknown[0]!r}; there are {', '.join(KINDS)}")
    cv2.setNumThreads(1)
    for name in options.kinds or KINDS:
        show(rows_of(name, measure(KINDS[name], options.sequences, options.seed)))
