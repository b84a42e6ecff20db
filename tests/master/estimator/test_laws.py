"""Laws of the estimator's kernels: each derivative against finite differences, rows against plain algebra."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.arrays import Float
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import rigid, rotation_vector_to_matrix
from common.records import boxed, record
from master.estimator.kinematics import BodyPoints, Scratch
from master.estimator.parameters import HandParameters
from master.estimator.problem import Observations
from master.estimator.sensors import CameraArrays
from tests.hand_helpers import BACK_NORMAL, MARKERS, any_rotation
from tests.master.estimator.fitted import PAIR
from tests.master.estimator.kernels import marker_rows_at, project_at
from tests.master.estimator.whole import CAMERAS, MODELS, H, Whole, silent

seeds = st.integers(0, 2**32 - 1)


# -- cameras -------------------------------------------------------------------------------------------------------


@given(seeds)
@settings(max_examples=40)
def test_an_image_point_moves_with_the_point_as_the_jacobian_says(seed: int) -> None:
    rng, arrays = np.random.default_rng(seed), CameraArrays.of(CAMERAS)
    point = rng.uniform([-0.1, -0.1, 0.3], [0.2, 0.1, 0.9])
    for c, camera in enumerate(CAMERAS):
        uv, J, ends = np.empty(2), np.empty((2, 3)), np.empty((2, 2))
        assert project_at(arrays, c, point, uv, J)
        np.testing.assert_allclose(uv, camera.project(point), atol=1e-9)
        for k in range(3):
            for end, sign in enumerate((1.0, -1.0)):
                project_at(arrays, c, point + sign * H * np.eye(3)[k], ends[end], np.empty((2, 3)))
            np.testing.assert_allclose(J[:, k], (ends[0] - ends[1]) / (2 * H), rtol=1e-5, atol=1e-3)


def test_a_point_behind_a_camera_is_not_projected() -> None:
    uv, J = np.full(2, 7.0), np.full((2, 3), 7.0)
    assert not project_at(CameraArrays.of(CAMERAS), 0, np.array([0.0, 0.0, -0.1]), uv, J)
    assert (uv == 7.0).all()
    assert (J == 7.0).all()


# -- rows of one marker ---------------------------------------------------------------------------------------------


def observed_of(rng: np.random.Generator, points: Float, cameras: tuple[CameraModel, ...]) -> Observations:
    """Rays of markers some pixels off, and what may be wrong with each marker itself."""
    observed = Observations.empty(len(cameras), len(points))
    for c, camera in enumerate(cameras):
        observed.uv[c] = camera.project(points) + rng.normal(0.0, 3.0, (len(points), 2))
    observed.weight[:] = rng.uniform(0.5, 4.0, observed.weight.shape)
    for m in range(len(points)):
        root = rng.normal(size=(3, 3))
        observed.own[m] = 1e5 * (root @ root.T + np.eye(3))
    observed.seen[:] = True
    return observed


@given(seeds)
@settings(max_examples=30)
def test_rows_of_a_marker_are_the_marginal_of_its_rays_over_what_is_wrong_with_it(seed: int) -> None:
    """The normal equations of place and shift, without the shift."""
    rng, arrays = np.random.default_rng(seed), CameraArrays.of(CAMERAS)
    point, work = rng.uniform([-0.1, -0.1, 0.4], [0.2, 0.1, 0.8]), record(Scratch)
    observed = observed_of(rng, np.tile(point, (6, 1)), CAMERAS)
    cost, chi2 = marker_rows_at(arrays, observed, 1, point, boxed(work))
    A, r, w = np.zeros((4, 6)), np.zeros(4), np.repeat(observed.weight[:, 1], 2)
    for c in range(len(CAMERAS)):
        uv, J = np.empty(2), np.empty((2, 3))
        project_at(arrays, c, point, uv, J)
        rows = slice(2 * c, 2 * c + 2)
        A[rows, :3], A[rows, 3:], r[rows] = J, J, uv - observed.uv[c, 1]
    normal, pull = A.T @ (w[:, None] * A), A.T @ (w * r)
    normal[3:, 3:] += observed.own[1]
    gain = normal[:3, 3:] @ np.linalg.inv(normal[3:, 3:])
    scale = np.abs(normal[:3, :3]).max()
    np.testing.assert_allclose(work.H, normal[:3, :3] - gain @ normal[3:, :3], atol=1e-9 * scale)
    np.testing.assert_allclose(work.g, pull[:3] - gain @ pull[3:], atol=1e-9 * np.abs(pull).max())
    least = 0.5 * (w @ r**2) - 0.5 * pull[3:] @ np.linalg.solve(normal[3:, 3:], pull[3:])
    assert cost == pytest.approx(least, rel=1e-9)
    assert 0.0 <= chi2 <= 2.0 * cost + 1e-9


@given(seeds)
@settings(max_examples=30)
def test_the_gradient_of_a_marker_is_that_of_its_cost(seed: int) -> None:
    rng, arrays = np.random.default_rng(seed), CameraArrays.of(CAMERAS)
    point, work = rng.uniform([-0.1, -0.1, 0.4], [0.2, 0.1, 0.8]), record(Scratch)
    observed = observed_of(rng, np.tile(point, (6, 1)), CAMERAS)
    observed.own[:] = 1e15 * np.eye(3)  # nothing is wrong with the markers

    def cost(step: Float) -> float:
        return marker_rows_at(arrays, observed, 5, point + step, boxed(record(Scratch)))[0]

    marker_rows_at(arrays, observed, 5, point, boxed(work))
    numeric = np.array([(cost(H * e) - cost(-H * e)) / (2 * H) for e in np.eye(3)])
    np.testing.assert_allclose(work.g, numeric, atol=1e-5 * np.abs(numeric).max())


def test_a_marker_that_many_cameras_see_is_no_surer_than_its_paint() -> None:
    arrays, work = CameraArrays.of(PAIR * 8), record(Scratch)
    observed = observed_of(np.random.default_rng(1), np.full((6, 3), 0.5), PAIR * 8)
    observed.weight[:], observed.own[:] = 1e4, 1e6 * np.eye(3)
    marker_rows_at(arrays, observed, 5, np.full(3, 0.5), boxed(work))
    np.testing.assert_allclose(np.linalg.eigvalsh(work.H), 1e6, rtol=1e-2)


# -- the whole hand -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MODELS)
@given(seeds)
@settings(max_examples=25)
def test_points_move_with_the_angles_as_the_jacobian_says(name: str, seed: int) -> None:
    model = MODELS[name]
    parameters = HandParameters.of(model)
    x = np.random.default_rng(seed).uniform(parameters.low, parameters.high)
    points = BodyPoints.markers(model, parameters, MARKERS)

    def place(x: Float) -> Float:
        return points.place(model.chains(parameters.angles(x)))

    chains = model.chains(parameters.angles(x))
    J = points.jacobian(chains, points.place(chains), x)
    for k in range(len(x)):
        e = H * np.eye(len(x))[k]
        np.testing.assert_allclose(J[:, :, k], (place(x + e) - place(x - e)) / (2 * H), atol=1e-8)


def past(whole: Whole) -> None:
    rng, epoch_prior = whole.rng, whole.epoch_prior
    epoch_prior.own_w2[:], epoch_prior.own[:] = rng.uniform(0.0, 9.0, whole.n), rng.normal(size=whole.n)
    epoch_prior.past_w2[:], epoch_prior.past[:] = rng.uniform(0.0, 9.0, whole.n), rng.normal(size=whole.n)
    # Near the last pose the sine stands for the angle.
    near = rotation_vector_to_matrix(rng.normal(0.0, 1e-3, 3)) @ whole.T[:3, :3]
    epoch_prior.palm[:] = rigid(near, whole.T[:3, 3] + rng.normal(0.0, 0.01, 3))
    epoch_prior.palm_w2[:] = np.repeat([20.0, 3e3], 3)
    epoch_prior.line_of_sight[:], epoch_prior.depth_w2[0] = any_rotation(rng)[:, 0], 5e4


def back_normal(whole: Whole) -> None:
    whole.epoch_prior.back_normal[:], whole.epoch_prior.back_normal_w2[0] = BACK_NORMAL, 7.0


def orientation(whole: Whole) -> None:
    """Of an IMU on the palm."""
    rng, epoch_prior = whole.rng, whole.epoch_prior
    epoch_prior.forearm[:3, :3] = rotation_vector_to_matrix(rng.normal(0.0, 0.8, 3)) @ whole.T[:3, :3]
    root = rng.normal(size=(3, 3))
    epoch_prior.orientation_info[:], epoch_prior.oriented[0] = root @ root.T, 1.0


def place(whole: Whole) -> None:
    whole.epoch_prior.place[:], whole.epoch_prior.place_w2[0] = whole.rng.normal(0.0, 0.1, 3), 9.0


def extras(whole: Whole) -> None:
    root = whole.rng.normal(size=(len(whole.z), len(whole.z)))
    whole.epoch_prior.z_info[:], whole.epoch_prior.z[:] = root @ root.T, whole.rng.normal(size=len(whole.z))


def points(whole: Whole) -> None:
    rng, observed = whole.rng, whole.observed
    observed.seen[:] = observed.triangulated[:] = True
    observed.point[:] = whole.points + rng.normal(0.0, 0.02, (6, 3))
    root = rng.normal(0.0, 300.0, (6, 3, 3))
    observed.information[:] = root @ root.swapaxes(1, 2)


def rays(whole: Whole) -> None:
    """Of markers with nothing wrong with themselves: what is, is in the law of a marker's rows."""
    seen = observed_of(whole.rng, whole.points, CAMERAS)
    for mine, theirs in zip(whole.observed, seen, strict=True):
        mine[:] = theirs
    whole.observed.own[:] = 1e15 * np.eye(3)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize(
    ("what", "share"),
    [
        (past, 1e-4),
        (back_normal, 1e-6),
        (orientation, 1e-5),
        (place, 1e-6),
        (extras, 1e-6),
        (points, 1e-5),
        (rays, 1e-4),
    ],
)
def test_the_gradient_of_each_kind_of_row_is_the_derivative_of_its_cost(
    name: str, what: Callable[[Whole], None], share: float
) -> None:
    for seed in range(6):
        whole = Whole(MODELS[name], seed)
        silent(whole)
        what(whole)
        whole.check(share)


@pytest.mark.parametrize("name", MODELS)
def test_the_gradient_of_the_posture_prior_is_the_derivative_of_its_cost(name: str) -> None:
    for seed in range(6):
        Whole(MODELS[name], seed).check(1e-5)


@pytest.mark.parametrize("name", MODELS)
def test_all_kinds_of_rows_add_up(name: str) -> None:
    """Each by itself, with numbers drawn anew, and then all of them on one hand."""
    whole, kinds = Whole(MODELS[name], 3), (past, back_normal, orientation, place, extras, points)
    posture_prior = whole.posture_prior
    _, total, _ = whole.cost()
    for kind in kinds:
        one = Whole(MODELS[name], 3)
        silent(one)
        one.rng = np.random.default_rng(7)
        kind(one)
        total = total + one.cost()[1]
        whole.rng = np.random.default_rng(7)
        kind(whole)
    assert whole.posture_prior is posture_prior
    _, gradient, _ = whole.cost()
    np.testing.assert_allclose(gradient, total, atol=1e-9 * np.abs(total).max())
