"""Two cameras that nobody synchronised, and markers that cross in front of them: exact projections, row by row.

The rig is the desk's: 75 mm apart, 497 px, lenses that distort. The second camera runs late by any offset; a marker is
seen when its own row is exposed, as the mean over the exposure, with noise. What `FrameSync` and `triangulate` make of
the messages is held against the exact place at the moment of each instant.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import msgspec
import numpy as np

from bench.report import CALIBRATION, inside
from common.arrays import Bool, Float
from common.geometry.camera_model import CameraModel
from common.messages import MarkerDetections
from master.estimator.sensors import CameraArrays
from master.fabrik.intersection import triangulate
from master.fabrik.sync import FrameSet, FrameSync
from master.rig.setup import load_setup

DEPTH_M, SPEED_M_S = 0.5, 1.0
SIGMA_PX = 0.08
MARKERS = 24
SECONDS = 0.44  # at 1 m/s as long as both cameras see the whole way
START_NS = 1_000_000_000
_MIDDLE_M = np.array([0.0375, 0.0, DEPTH_M])
_ROUNDS = 4  # of "the row decides the time, the time the row"
_GAUSS = np.polynomial.legendre.leggauss(3)
_TRACK = 4  # instants until every camera has a track, and are not scored

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
    """How the cameras run.

    Attributes:
        rate_hz: Of both.
        offset_s: How much later the second camera exposes.
        sigma_px: Centroid noise per axis.
        exposure_s: Of each camera.
        t_sigma_s: Standard deviation of the cameras' stamps, one error for each camera and run; the messages say so.
    """

    rate_hz: float
    offset_s: float
    sigma_px: float = SIGMA_PX
    exposure_s: tuple[float, float] = (0.005, 0.005)
    t_sigma_s: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """Errors of K triangulated markers.

    Attributes:
        depth: (K,) error of the depth [%].
        across_mm: (K,) error across the sight [mm].
        chi2: (K,) squared error in units of the claimed covariance.
        waited_s: (I,) between each instant and the centre row of the frame that completed it [s].
    """

    depth: Float
    across_mm: Float
    chi2: Float
    waited_s: Float

    @property
    def covered(self) -> float:
        """Share of the places inside their 95 % region [%]."""
        return inside(self.chi2)


def outcome(motion: Making, shooting: Shooting, treatment: Treatment, seeds: range) -> Outcome:
    """Errors over all markers, instants and seeds."""
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
            chi2.append(np.einsum("mi,mij,mj->m", error, np.linalg.inv(found.cov_m2[ok]), error))
            waited.append(wait_s)
    return Outcome(np.concatenate(depth), np.concatenate(across), np.concatenate(chi2), np.array(waited))


def _epochs(
    cameras: dict[str, CameraModel],
    motion: Motion,
    shooting: Shooting,
    treatment: Treatment,
    rng: np.random.Generator,
) -> Iterator[tuple[FrameSet, float]]:
    """Instants of one run, and how long each waited."""
    streams = [
        list(_stream(name, c, model, motion, shooting, rng))
        for c, (name, model) in enumerate(cameras.items())
    ]
    known = cameras
    if treatment in ("uncorrected", "row time ignored"):
        known = {name: replace(model, row_time_ns=0.0) for name, model in cameras.items()}
    if treatment == "uncorrected":  # the k-th frame with the k-th: all that a common start gives
        streams = [
            [
                msgspec.structs.replace(m, t_ns=START_NS + round(m.seq * 1e9 / shooting.rate_hz))
                for m in stream
            ]
            for stream in streams
        ]
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
            if count > _TRACK and not epoch.missing.any():
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
