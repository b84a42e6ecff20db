"""Depth of a moving hand from unsynchronised cameras: errors by rate, offset, motion and treatment.

Exact projections, row by row: the desk's cameras (75 mm apart, 497 px, lenses that distort), the second late by
any offset; a marker is seen when its own row is exposed, as the mean over the exposure, with noise. What `FrameSync`
and `triangulate` make of the messages is held against the exact place, over many seeds. Baseline: frames paired by
their number.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import msgspec
import numpy as np

from bench.played import START_NS
from bench.report import CALIBRATION, Row, chi_squares, inside
from common.arrays import Bool, Float
from common.geometry.camera_model import CameraModel
from common.messages import MarkerDetections
from master.estimator.sensors import CameraArrays
from master.fabrik.intersection import triangulate
from master.fabrik.sync import FrameSet, FrameSync
from master.rig.setup import load_setup

DEPTH_M, SPEED_M_S = 0.5, 1.0
MARKERS = 24
SECONDS = 0.44  # at 1 m/s as long as both cameras see the whole way
_MIDDLE_M = np.array([0.0375, 0.0, DEPTH_M])
_ROUNDS = 4  # of "the row decides the time, the time the row"
_GAUSS = np.polynomial.legendre.leggauss(3)

Motion = Callable[[Float], Float]
"""Places (..., M, 3) [m], rig frame, of the markers, each at its own time (..., M) [s]."""
Making = Callable[[np.random.Generator], Motion]
Treatment = Literal["uncorrected", "row time ignored", "interpolate", "predict"]


def _homes(rng: np.random.Generator, rows_m: float = 0.06) -> Float:
    """Middles of the ways (M, 3) [m]."""
    return _MIDDLE_M + rng.uniform([-0.02, -rows_m, -0.03], [0.02, rows_m, 0.03], (MARKERS, 3))


def _ways(rng: np.random.Generator) -> Float:
    """Unit vectors (M, 3), mostly across the sight."""
    way = rng.normal(size=(MARKERS, 3)) * [1.0, 1.0, 0.25]
    return way / np.linalg.norm(way, axis=1, keepdims=True)


def resting(rng: np.random.Generator) -> Motion:
    """A hand laid down."""
    home = _homes(rng)
    return lambda t: home + 0.0 * t[..., None]


def crossing(rng: np.random.Generator) -> Motion:
    """1 m/s sideways, straight and steady, on rows from the top to the bottom of the image."""
    home, way = _homes(rng, 0.17), rng.choice([-1.0, 1.0], (MARKERS, 1)) * [SPEED_M_S, 0.0, 0.0]
    return lambda t: home + way * (t - SECONDS / 2)[..., None]


def swing(amplitude_m: float) -> Making:
    """To and fro in any direction, 1 m/s in the middle: the shorter the way, the harder it turns."""

    def made(rng: np.random.Generator) -> Motion:
        home, way, phase = _homes(rng, 0.02), _ways(rng), rng.uniform(0.0, 2.0 * np.pi, MARKERS)
        rotation = SPEED_M_S / amplitude_m
        return lambda t: home + way * (amplitude_m * np.sin(rotation * t + phase))[..., None]

    return made


def reach(rng: np.random.Generator) -> Motion:
    """From rest to rest along the path of least jerk (Flash, Hogan 1985): 0.2 m, 1 m/s at its peak."""
    home, way = _homes(rng), _ways(rng)
    start, lasts = rng.uniform(-0.2, 0.3, MARKERS), 1.875 * 0.2 / SPEED_M_S

    def at(t: Float) -> Float:
        x = np.clip((t - start) / lasts, 0.0, 1.0)
        return home + way * (0.2 * (x**3 * (10.0 - 15.0 * x + 6.0 * x * x) - 0.5))[..., None]

    return at


MOTIONS: dict[str, Making] = {
    "rest": resting,
    "crossing": crossing,
    "swing 20 cm": swing(0.2),
    "swing 10 cm": swing(0.1),
    "swing 5 cm": swing(0.05),
    "reach": reach,
}


@dataclass(frozen=True, slots=True)
class Shooting:
    """How the cameras run."""

    rate_hz: float  # of both
    offset_s: float  # how much later the second camera exposes
    sigma_px: float = 0.08  # centroid noise per axis
    exposure_s: tuple[float, float] = (0.005, 0.005)  # of each camera
    t_sigma_s: float = 0.0  # of the stamps: one error for each camera and run; the messages have it


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """Errors of K triangulated markers."""

    depth: Float  # (K,) error of the depth [%]
    across_mm: Float  # (K,) error across the sight [mm]
    chi2: Float  # (K,) squared error in units of the claimed covariance
    waited_s: Float  # (I,) between each moment and the centre row of the frame that completed it [s]

    @property
    def covered(self) -> float:
        """Share of the places inside their 95 % region [%]."""
        return inside(self.chi2)


def outcome(motion: Making, shooting: Shooting, treatment: Treatment, seeds: range) -> Outcome:
    """Errors over all markers, moments and seeds."""
    cameras = load_setup(CALIBRATION, "desk").models
    arrays = CameraArrays.of(tuple(cameras.values()))
    depth: list[Float] = []
    across: list[Float] = []
    chi2: list[Float] = []
    waited: list[float] = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        moving = motion(rng)
        for epoch, wait_s in _epochs(cameras, moving, shooting, treatment, rng):
            found = triangulate(arrays, epoch.uv, epoch.sigma_px)
            truth = moving(np.full(MARKERS, (epoch.t_ns - START_NS) * 1e-9))
            ok = np.isfinite(found.points_m[:, 0])
            error = (found.points_m - truth)[ok]
            depth.append(100.0 * error[:, 2] / truth[ok, 2])
            across.append(1e3 * np.hypot(error[:, 0], error[:, 1]))
            chi2.append(chi_squares(error, found.cov_m2[ok]))
            waited.append(wait_s)
    return Outcome(np.concatenate(depth), np.concatenate(across), np.concatenate(chi2), np.array(waited))


def _epochs(
    cameras: dict[str, CameraModel],
    motion: Motion,
    shooting: Shooting,
    treatment: Treatment,
    rng: np.random.Generator,
) -> Iterator[tuple[FrameSet, float]]:
    """Moments of one run, and how long each waited."""
    streams = [
        list(_stream(name, c, model, motion, shooting, rng))
        for c, (name, model) in enumerate(cameras.items())
    ]
    known = cameras
    if treatment in ("uncorrected", "row time ignored"):
        known = {name: replace(model, row_time_ns=0.0) for name, model in cameras.items()}
    if treatment == "uncorrected":  # the k-th frame with the k-th: all that a common start gives
        streams = [[_by_number(m, shooting.rate_hz) for m in stream] for stream in streams]
    sync = FrameSync(
        known,
        dict.fromkeys(known, shooting.rate_hz),
        MARKERS,
        policy="predict" if treatment == "predict" else "interpolate",
        continuous=treatment != "uncorrected",
    )
    count = 0
    for message in sorted((m for stream in streams for m in stream), key=lambda m: m.t_ns):
        model = known[message.camera]
        centre_ns = message.t_ns + 0.5 * (model.height_px - 1) * model.row_time_ns
        for epoch in sync.push(message):
            count += 1
            if count > 4 and not epoch.missing.any():  # until then not every camera has a track
                yield epoch, max(centre_ns - epoch.t_ns, 0.0) * 1e-9


def _stream(
    name: str, c: int, camera: CameraModel, motion: Motion, shooting: Shooting, rng: np.random.Generator
) -> Iterator[MarkerDetections]:
    """What camera number `c` sends."""
    starts = np.arange(round(SECONDS * shooting.rate_hz)) / shooting.rate_hz + c * shooting.offset_s
    stamp_error_s = shooting.t_sigma_s * float(rng.normal())
    uv = centroids(camera, motion, starts, shooting.exposure_s[c])
    uv = uv + rng.normal(0.0, shooting.sigma_px, uv.shape)
    inside: Bool = np.all((uv >= 0) & (uv < [camera.width_px, camera.height_px]), axis=-1)
    uv[~inside] = np.nan
    nowhere = np.full((MARKERS, 2), np.nan)
    for seq, (start, places, ok) in enumerate(zip(starts, uv, inside, strict=True)):
        t_ns = START_NS + round((start + stamp_error_s) * 1e9)
        area, quality, sigma = (np.where(ok, value, np.nan) for value in (150.0, 1.0, shooting.sigma_px))
        yield MarkerDetections(
            name, 1, seq, t_ns, t_ns, places, area, quality, sigma, nowhere, shooting.t_sigma_s * 1e9
        )


def centroids(camera: CameraModel, motion: Motion, starts_s: Float, exposure_s: float) -> Float:
    """Centroids (K, M, 2) [px], means over the exposure, in frames whose row 0 is exposed about `starts_s` (K,) [s]."""
    row_s = camera.row_time_ns * 1e-9
    rows = np.full((len(starts_s), MARKERS), 0.5 * (camera.height_px - 1))
    uv = np.zeros((*rows.shape, 2))
    for _ in range(_ROUNDS):
        middle = starts_s[:, None] + row_s * rows
        uv = np.zeros_like(uv)
        for x, weight in zip(*_GAUSS, strict=True):
            uv += 0.5 * weight * camera.project(motion(middle + 0.5 * x * exposure_s))
        rows = uv[..., 1]
    return uv


RATES_HZ = (30.0, 60.0, 90.0)
_OFFSETS_MS = (0.0, 2.0, 4.2, 6.2, 8.3, 10.4, 12.5, 16.7)
_POLICIES: tuple[Treatment, ...] = ("interpolate", "predict")
_SEEDS = range(2)
_GOAL = 2.0  # %


def rows() -> Iterator[Row]:
    """Measure depth errors [%], coverage [%] and waiting [ms]; worst offset, with the others in the note."""
    for rate in RATES_HZ:
        for treatment in ("uncorrected", "row time ignored"):
            found = _at_offsets("crossing", rate, treatment, range(1))
            across = np.percentile(np.concatenate([one.across_mm for one in found]), 95)
            note = f"baseline; across the line of sight {across:.1f} mm"
            yield _errors(f"{rate:.0f} Hz, crossing at 1 m/s, {treatment}", found, note)
    for policy in _POLICIES:
        for rate in RATES_HZ:
            yield from _corrected(policy, rate)
    for t_sigma_ms in (0.1, 0.3, 1.0):
        for motion in ("crossing", "swing 10 cm"):
            shooting = Shooting(60.0, 6e-3, t_sigma_s=t_sigma_ms * 1e-3)
            found = outcome(MOTIONS[motion], shooting, "interpolate", range(30))
            name = f"60 Hz, {motion}, stamps wrong by {t_sigma_ms} ms (sd): 95 % cover"
            yield Row(name, found.covered, "%", "goal 90 to 98")


def _at_offsets(motion: str, rate_hz: float, treatment: Treatment, seeds: range = _SEEDS) -> list[Outcome]:
    """One outcome for each offset."""
    return [outcome(MOTIONS[motion], Shooting(rate_hz, 1e-3 * ms), treatment, seeds) for ms in _OFFSETS_MS]


def _corrected(policy: Treatment, rate: float) -> Iterator[Row]:
    for motion in MOTIONS:
        found = _at_offsets(motion, rate, policy)
        yield _errors(f"{rate:.0f} Hz, {motion}, {policy}", found, f"goal {_GOAL:g}, stretch 0.5")
        covered = [one.covered for one in found]
        yield Row("  95 % regions cover, least", min(covered), "%", f"most {max(covered):.1f}; goal 90 to 98")
        if motion == "rest":  # a hand laid down: standard deviation of its depth at half a metre
            spread = [float(one.depth.std()) * 5.0 for one in found]
            plain = outcome(MOTIONS["rest"], Shooting(60.0, 0.0), "uncorrected", _SEEDS).depth.std() * 5.0
            note = f"least {min(spread):.2f}; of single frames {plain:.2f}"
            yield Row("  depth jitter, worst offset", max(spread), "mm", note)
            waited = 1e3 * np.concatenate([one.waited_s for one in found])
            note = f"most {waited.max():.1f}"
            yield Row("  waits for the other camera, mean", float(waited.mean()), "ms", note)


def _errors(name: str, found: Sequence[Outcome], note: str) -> Row:
    p95 = [float(np.percentile(np.abs(one.depth), 95)) for one in found]
    every = np.abs(np.concatenate([one.depth for one in found]))
    by_offset = " ".join(f"{value:.2f}" for value in p95)
    spread = f"median {np.median(every):.2f}, max {every.max():.2f}"
    return Row(f"{name}: p95", max(p95), "%", f"{spread}; {note}; p95 by offset {by_offset}")


def _by_number(message: MarkerDetections, rate_hz: float) -> MarkerDetections:
    """The message with the time that its number gives it."""
    return msgspec.structs.replace(message, t_ns=START_NS + round(message.seq * 1e9 / rate_hz))
