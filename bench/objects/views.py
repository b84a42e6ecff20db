"""Detections of a moving object by cameras, made of truth with noise as stated; nothing is drawn."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float
from common.calibration.object_profile import ObjectProfile
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import rigid, rotation_vector_to_matrix
from common.messages import MarkerDetections, TagDetections
from master.objects.surface import Features

Where = Callable[[float], Float]
"""Time [s] -> `T_rig_object` (4, 4)."""
HIDES = Callable[[str, int, float], bool]
"""Camera, feature, time [s] -> whether something is before it."""


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations per axis [px]: what stays of a feature in a camera, and what is new in each frame."""

    correlated_px: float = 0.1
    independent_px: float = 0.08

    @property
    def sigma_px(self) -> float:
        """Both."""
        return float(np.hypot(self.correlated_px, self.independent_px))


def wander(seed: int, centre_m: Float, speed_m_s: float, rotation_rad_s: float) -> Where:
    """A smooth way about a place (3,) [m], whose greatest speeds are about these; any turn to begin with."""
    rng = np.random.default_rng([seed, 5])
    first = rotation_vector_to_matrix(rng.normal(0.0, 0.5, 3))
    pace = 2.0 * np.pi * rng.uniform(0.35, 0.8, (2, 3))
    phase = rng.uniform(0.0, 2.0 * np.pi, (2, 3))
    size = np.array([[speed_m_s], [rotation_rad_s]]) / np.sqrt(2.0) / pace
    size = size * np.array([[1.0, 1.0, 0.6], [1.0, 1.0, 1.0]])

    def where(t_s: float) -> Float:
        way = size * np.sin(pace * t_s + phase)
        return rigid(rotation_vector_to_matrix(way[1]) @ first, centre_m + way[0])

    return where


def detections(
    profile: ObjectProfile,
    markers: tuple[str, ...],
    models: dict[str, CameraModel],
    where: Where,
    seconds: float,
    seed: int,
    *,
    noise: Noise = Noise(),
    hides: HIDES = lambda camera, feature, t_s: False,
    offset_s: float = 0.005,
) -> Iterator[MarkerDetections | TagDetections]:
    """Messages of all cameras in the order of their frames, each camera `offset_s` after the one before it."""
    rng = np.random.default_rng([seed, 7])
    features = Features.of(profile, markers)
    stays = {name: rng.normal(0.0, noise.correlated_px, (len(features.points), 2)) for name in models}
    period_s = 1.0 / 60.0
    for seq in range(int(seconds / period_s)):
        for c, (name, model) in enumerate(models.items()):
            t_s = seq * period_s + c * offset_s
            uv, shown = _seen(features, model, where, t_s)
            uv = uv + stays[name] + rng.normal(0.0, noise.independent_px, uv.shape)
            hidden = [k for k in range(features.count) if hides(name, k, t_s)]
            shown[hidden] = False
            yield from _messages(features, markers, name, seq, t_s, uv, shown, noise.sigma_px, model, where)


def _seen(features: Features, model: CameraModel, where: Where, t_s: float) -> tuple[Float, Bool]:
    """Pixels (P, 2) of all points, each at the time of its row, and which features (F,) the camera sees."""
    uv = np.empty((len(features.points), 2))
    rows = np.full(len(features.points), 0.5 * model.height_px)
    for _ in range(3):
        times = t_s + rows * model.row_time_ns * 1e-9
        poses = np.array([where(float(t)) for t in times])
        points = (poses[:, :3, :3] @ features.points[..., None])[..., 0] + poses[:, :3, 3]
        uv = model.project(points)
        rows = np.nan_to_num(uv[:, 1], nan=0.0)
    return uv, features.expected(where(t_s + 0.5 * model.height_px * model.row_time_ns * 1e-9), model, 0.8)


def _messages(
    features: Features,
    markers: tuple[str, ...],
    name: str,
    seq: int,
    t_s: float,
    uv: Float,
    shown: Bool,
    sigma_px: float,
    model: CameraModel,
    where: Where,
) -> Iterator[MarkerDetections | TagDetections]:
    t_ns = round(t_s * 1e9)
    ready_ns = t_ns + 12_000_000
    m, beads = len(markers), features.beads
    places = np.full((m, 2), np.nan)
    places[features.rows[shown[:beads]]] = uv[:beads][shown[:beads]]
    seen = np.isfinite(places[:, 0])
    away = np.linalg.norm(where(t_s)[:3, 3] - model.centre)
    area = np.pi * (np.array([*features.radius_m[:beads], 0.01])[0] * model.matrix[0, 0] / away) ** 2
    area, sigma = np.where(seen, area, np.nan), np.where(seen, sigma_px, np.nan)
    frame = (name, 1, seq, t_ns, ready_ns)
    yield MarkerDetections(*frame, places, area, np.where(seen, 1.0, 0.0), sigma, np.full((m, 2), np.nan))
    if not features.tag_ids:
        return
    found = sorted((features.tag_ids[k], k) for k in range(len(features.tag_ids)) if shown[beads + k])
    ids = np.array([number for number, _ in found], np.uint16)
    corners = np.array([uv[features.corners_of(k)] for _, k in found]).reshape(-1, 4, 2)
    yield TagDetections(*frame, ids, corners, np.full(len(found), sigma_px))
