"""The pose of an object from pixels made by the camera model: exact without noise, honest with it."""

import numpy as np
import pytest

from bench.objects.views import Where, wander
from common.arrays import Float
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import matrix_to_rotation_vector, rigid, rotation_vector_to_matrix
from master.estimator.sensors import CameraArrays
from master.objects.fit import Motion, Observations, PoseFit

POINTS = np.array([[0.0, 0.0, 0.115], [0.052, 0.0, -0.084], [-0.052, 0.0, -0.084], [0.0, 0.04, 0.0]])
BEADS = np.full(4, 0.009)
NO_FLOOR = np.full(4, 1e-3)


def cameras() -> tuple[CameraModel, ...]:
    matrix = np.array([[497.0, 0.0, 321.3], [0.0, 497.0, 238.1], [0.0, 0.0, 1.0]])
    lens = np.array([0.06, -0.12, 0.0004, -0.0006, 0.03])
    other = rigid(rotation_vector_to_matrix(np.array([0.01, -0.02, 0.0])), np.array([0.075, 0.0, 0.0]))
    return tuple(CameraModel(matrix, lens, T, 640, 480, 20600.0) for T in (np.eye(4), other))


def outline_middle(camera: CameraModel, middle: Float, radius: float) -> Float:
    """Where the outline of a ball has its middle, by its tangent cone cut with the image plane."""
    c = camera.T_camera_rig[:3, :3] @ middle + camera.T_camera_rig[:3, 3]
    away = float(np.linalg.norm(c))
    ahead, half = c / away, np.arcsin(radius / away)
    side = np.cross(ahead, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    turn = np.linspace(0.0, 2.0 * np.pi, 721)[:-1, None]
    rays = np.cos(half) * ahead + np.sin(half) * (np.cos(turn) * side + np.sin(turn) * np.cross(ahead, side))
    edge = rays[:, :2] / rays[:, 2:]
    # Middle of a conic from its five coefficients.
    x, y = (edge - edge.mean(axis=0)).T * 1e2
    a, b, d, e, g = np.linalg.lstsq(np.stack([x * x, x * y, y * y, x, y], 1), np.ones(len(x)), rcond=None)[0]
    return np.linalg.solve([[2 * a, b], [b, 2 * d]], [-e, -g]) * 1e-2 + edge.mean(axis=0)


def seen(
    where: Where, noise_px: float = 0.0, seed: int = 0, points: tuple[int, ...] = (0, 1, 2, 3)
) -> Observations:
    """What both cameras see in four frames each, 5 ms apart, every point at the time of its row."""
    rng = np.random.default_rng(seed)
    rows: list[tuple[int, int, float, float, float]] = []
    for c, camera in enumerate(cameras()):
        for frame in (-0.033, -0.0167, 0.0, 0.0167):
            for p in points:
                t = frame + 0.005 * c
                u = v = 0.0
                for _ in range(4):
                    T = where(t)
                    xy = outline_middle(camera, T[:3, :3] @ POINTS[p] + T[:3, 3], BEADS[p])
                    u, v = camera.distort(xy)
                    t = frame + 0.005 * c + (v - 240.0) * 20.6e-6
                rows.append((c, p, t, u, v))
    c, p, t, u, v = np.array(rows).T
    uv = np.stack([u, v], axis=1) + rng.normal(0.0, noise_px, (len(c), 2))
    sigma = np.full(len(c), max(noise_px, 0.05))
    point, nothing = p.astype(int), np.zeros(len(c))
    return Observations(c.astype(int), point, t, uv, sigma, nothing, point, now=nothing == 0.0)


def error(T: Float, truth: Float) -> tuple[float, float]:
    """Millimetres and degrees."""
    turn = matrix_to_rotation_vector(T[:3, :3] @ truth[:3, :3].T)
    return 1e3 * float(np.linalg.norm(T[:3, 3] - truth[:3, 3])), float(np.degrees(np.linalg.norm(turn)))


@pytest.mark.parametrize("seed", [1, 2])
def test_a_moving_object_is_found_from_unsynchronised_rolling_shutters(seed: int) -> None:
    where = wander(seed, np.array([0.04, 0.0, 0.5]), 0.5, np.pi)
    fit = PoseFit(CameraArrays.of(cameras()), POINTS, BEADS, NO_FLOOR)
    observations = seen(where)
    start = rigid(rotation_vector_to_matrix(np.array([0.1, -0.1, 0.1])), np.array([0.01, -0.01, 0.02]))
    found = fit(observations, Motion.still(where(0.0) @ start))
    assert found is not None
    mm, deg = error(found.motion.T, where(0.0))
    assert mm < 0.15
    assert deg < 0.1
    assert found.used.all()


def test_two_beads_do_not_determine_the_rotation_about_their_line() -> None:
    where = wander(4, np.array([0.04, 0.0, 0.5]), 0.5, np.pi)
    observations = seen(where, points=(0, 1))
    found = PoseFit(CameraArrays.of(cameras()), POINTS, BEADS, NO_FLOOR)(
        observations, Motion.still(where(0.0))
    )
    assert found is not None
    size, axes = np.linalg.eigh(found.cov[3:6, 3:6])
    line = where(0.0)[:3, :3] @ (POINTS[1] - POINTS[0])
    assert np.sqrt(size[-1]) > 1.0
    assert abs(axes[:, -1] @ line) / np.linalg.norm(line) > 0.99


def test_a_bead_that_is_another_thing_costs_itself() -> None:
    where = wander(5, np.array([0.04, 0.0, 0.5]), 0.3, 1.0)
    observations = seen(where, 0.1)
    wrong = observations.point == 3
    observations.uv[wrong] += [40.0, -25.0]
    found = PoseFit(CameraArrays.of(cameras()), POINTS, BEADS, NO_FLOOR)(
        observations, Motion.still(where(0.0))
    )
    assert found is not None
    assert not found.used[wrong].any()
    assert found.used[~wrong].all()
    mm, deg = error(found.motion.T, where(0.0))
    assert mm < 2.0
    assert deg < 1.5


def test_its_covariance_is_honest() -> None:
    squares: list[float] = []
    fit = PoseFit(CameraArrays.of(cameras()), POINTS, BEADS, NO_FLOOR)
    for seed in range(30):
        where = wander(seed, np.array([0.04, 0.0, 0.5]), 0.4, 2.0)
        observations = seen(where, 0.2, seed)
        found = fit(observations, Motion.still(where(0.0)))
        assert found is not None
        truth = where(0.0)
        off = np.concatenate(
            [
                truth[:3, 3] - found.motion.T[:3, 3],
                matrix_to_rotation_vector(truth[:3, :3] @ found.motion.T[:3, :3].T),
            ]
        )
        squares.append(float(off @ np.linalg.solve(found.cov[:6, :6], off)) / 6.0)
    # Most of an error is taken to stay from frame to frame; here all of it is new, so that it is overstated.
    assert 0.1 < np.mean(squares) < 1.2


def test_behind_the_cameras_there_is_no_pose() -> None:
    where = wander(6, np.array([0.04, 0.0, 0.5]), 0.0, 0.0)
    observations = seen(where)
    behind = rigid(np.eye(3), np.array([0.0, 0.0, -0.5]))
    fit = PoseFit(CameraArrays.of(cameras()), POINTS, BEADS, NO_FLOOR)
    assert fit(observations, Motion.still(behind)) is None
