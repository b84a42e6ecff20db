"""What cameras whose stamps may lie report of a hand that moves in known ways, rolling shutter and noise included."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from common.arrays import Float
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import rotation_vector_to_matrix
from common.messages import MarkerDetections
from tests.hand_helpers import MARKERS, RIGHT, camera_models, palm, rig_file

ROW_TIME_US = 20.6
SHAPE = RIGHT.marker_points(RIGHT.forward(palm(at_m=np.zeros(3)), np.zeros((5, 4))), MARKERS)
SHAPE = SHAPE - SHAPE.mean(axis=0)
CENTRE = np.array([0.04, 0.0, 0.5])
Motion = Callable[[Float], Float]
"""Markers (..., M, 3) [m] at times (..., M) [s]: each marker at its own."""


def moving(
    way: Callable[[Float], Float],
    rotation: Callable[[Float], Float] | None = None,
    bend: Callable[[Float], Float] | None = None,
) -> Motion:
    """A hand on a way (..., 3) [m], turned by rotation vectors (..., 3), with tips moved by a share 0..1 of a fist."""

    def points(t_s: Float) -> Float:
        shape = np.broadcast_to(SHAPE, (*t_s.shape, 3)).copy()
        if bend is not None:
            share = bend(t_s)[..., :5, None]
            shape[..., :5, :] += share * np.array([0.0, 0.05, -0.03])
        if rotation is not None:
            rotations = Rotation.from_rotvec(rotation(t_s).reshape(-1, 3))
            shape = np.asarray(rotations.apply(shape.reshape(-1, 3)), np.float64).reshape(shape.shape)
        return shape + CENTRE + way(t_s)

    return points


def _along(*xyz: Float | float) -> Float:
    return np.stack(np.broadcast_arrays(*xyz), axis=-1)


def sideways(seed: int, rate_hz: float = 1.35, peak_m_s: float = 1.0) -> Motion:
    """Along the baseline and nowhere else: no epipolar line sees it."""
    w = 2.0 * np.pi * rate_hz
    return moving(lambda t: _along(peak_m_s / w * np.sin(w * t + seed), 0.0, 0.0))


def circling(seed: int, sense: float = 1.0) -> Motion:
    """A level circle: the depth truly follows the sideways velocity."""
    w = 2.0 * np.pi * 0.8
    return moving(lambda t: _along(0.12 * np.sin(w * t + seed), 0.0, sense * 0.07 * np.cos(w * t + seed)))


def resting(_seed: int) -> Motion:
    """Nothing moves."""
    return moving(lambda t: _along(0.0 * t, 0.0, 0.0))


def bending(seed: int) -> Motion:
    """Sideways, while all fingers open and close at another rate."""
    w = 2.0 * np.pi
    return moving(
        lambda t: _along(0.16 * np.sin(w * t + seed), 0.0, 0.0),
        bend=lambda t: 0.5 - 0.5 * np.cos(0.62 * w * t + 2.0 * seed),
    )


def natural(seed: int) -> Motion:
    """A random sum of waves: way, turns and every finger on its own; up to about 1 m/s."""
    rng = np.random.default_rng(1000 + seed)
    w, phase = 2.0 * np.pi * rng.uniform(0.1, 1.6, (6, 5)), rng.uniform(0.0, 2.0 * np.pi, (6, 5))
    size = np.array([0.1, 0.06, 0.06, 0.35, 0.35, 0.35])[:, None] * rng.uniform(0.2, 1.0, (6, 5)) / np.sqrt(w)
    finger_w, finger_phase = 2.0 * np.pi * rng.uniform(0.2, 1.5, 6), rng.uniform(0.0, 2.0 * np.pi, 6)

    def six(t: Float) -> Float:
        return (size * np.sin(w * t[..., None, None] + phase)).sum(axis=-1)

    return moving(
        lambda t: six(t)[..., :3],
        lambda t: six(t)[..., 3:],
        lambda t: 0.5 - 0.5 * np.cos(finger_w * t + finger_phase),
    )


def cameras(
    names: tuple[str, ...] = ("left", "right"), row_time_us: float = ROW_TIME_US
) -> dict[str, CameraModel]:
    """Parallel cameras 75 mm apart."""
    return camera_models(rig_file(names), row_time_us)


def misplaced(models: Mapping[str, CameraModel], seed: int, degrees: float = 0.1) -> dict[str, CameraModel]:
    """The same cameras as they really are: turned, shifted and bent a little against their calibration."""
    rng = np.random.default_rng(seed)
    out = dict(models)
    for name in list(models)[1:]:
        T = models[name].T_rig_camera.copy()
        T[:3, :3] = T[:3, :3] @ rotation_vector_to_matrix(rng.normal(0.0, np.radians(degrees), 3))
        T[:3, 3] += rng.normal(0.0, 1e-3, 3)
        bent = np.array([0.03, -0.03, 0.001, 0.001, 0.0]) * rng.normal(size=5)
        out[name] = replace(models[name], T_rig_camera=T, distortion=bent)
    return out


def seen(camera: CameraModel, motion: Motion, t_s: Float) -> Float:
    """Pixels (T, M, 2) of frames whose row 0 is exposed at `t_s` (T,), every marker at the time of its own row."""
    uv = np.full((len(t_s), len(MARKERS), 2), 0.5 * camera.height_px)
    for _ in range(4):
        uv = camera.project(motion(t_s[:, None] + 1e-9 * camera.row_time_ns * uv[..., 1]))
    return uv


def recorded(
    models: Mapping[str, CameraModel],
    motion: Motion,
    rate_hz: float,
    seconds: float,
    late_ms: Mapping[str, float],
    seed: int,
    *,
    noise_px: float = 0.15,
    lost: float = 0.02,
    wrong: float = 0.0,
) -> list[MarkerDetections]:
    """Messages of free-running cameras, in the order of their stamps; frames are `late_ms` later than these say."""
    rng = np.random.default_rng(seed)
    messages: list[MarkerDetections] = []
    for c, (name, camera) in enumerate(models.items()):
        period = (1.0 + 30e-6 * c) / rate_hz
        stamp_s: Float = (
            1.0
            + (rng.uniform(0.0, period) if c else 0.0)
            + period * np.arange(int(seconds * rate_hz), dtype=np.float64)
        )
        uv = seen(camera, motion, stamp_s + 1e-3 * late_ms.get(name, 0.0))
        uv += rng.normal(0.0, noise_px, uv.shape)
        mistaken = rng.random(uv.shape[:2]) < wrong
        uv[mistaken] += rng.normal(0.0, 30.0, (int(mistaken.sum()), 2))
        uv[rng.random(uv.shape[:2]) < lost] = np.nan
        messages += [message_of(name, k, t, uv[k]) for k, t in enumerate(stamp_s)]
    return sorted(messages, key=lambda message: message.t_ns)


def message_of(camera: str, seq: int, t_s: float, uv: Float) -> MarkerDetections:
    """One frame."""
    t_ns, mask = round(t_s * 1e9), np.where(np.isfinite(uv[:, 0]), 1.0, np.nan)
    return MarkerDetections(
        camera=camera,
        session=1,
        seq=seq,
        t_ns=t_ns,
        ready_t_ns=t_ns + 10_000_000,
        uv=uv,
        area=400.0 * mask,
        quality=mask,
        sigma_px=0.15 * mask,
        alt_uv=np.full_like(uv, np.nan),
    )
