"""Rigid geometry against scipy, and its laws."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from common.arrays import Float
from common.geometry.transforms import (
    axis_rotation,
    cross,
    fit_rigid,
    intersect_plane,
    invert,
    matrix_of,
    matrix_to_quaternion,
    quaternion_product,
    quaternion_to_matrix,
    rigid,
    rotation_vector_to_matrix,
    skew,
    transform,
)

vectors = arrays(np.float64, 3, elements=st.floats(-10.0, 10.0))
quaternions = arrays(np.float64, 4, elements=st.floats(-1.0, 1.0)).filter(
    lambda q: float(np.linalg.norm(q)) > 1e-3
)


def scipy_matrix(q_wxyz: Float) -> Float:
    return Rotation.from_quat(np.roll(q_wxyz, -1, axis=-1)).as_matrix()


@given(quaternions)
def test_quaternion_to_matrix_is_scipys(q: Float) -> None:
    np.testing.assert_allclose(quaternion_to_matrix(q), scipy_matrix(q), atol=1e-12)


@given(quaternions, quaternions)
def test_one_quaternion_in_plain_numbers_turns_as_one_in_an_array(p: Float, q: Float) -> None:
    one, other = (tuple((each / np.linalg.norm(each)).tolist()) for each in (p, q))
    np.testing.assert_allclose(matrix_of(one), scipy_matrix(p), atol=1e-12)
    product = matrix_of(quaternion_product(one, other))
    np.testing.assert_allclose(product, scipy_matrix(p) @ scipy_matrix(q), atol=1e-12)


@given(quaternions)
def test_quaternion_round_trips_up_to_its_sign(q: Float) -> None:
    q = q / np.linalg.norm(q)
    back = matrix_to_quaternion(quaternion_to_matrix(q))
    assert back[0] >= 0.0
    assert min(np.abs(back - q).max(), np.abs(back + q).max()) < 1e-12


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, -2, 3]])
@pytest.mark.parametrize("angle", [0.0, 1e-9, np.pi - 1e-9, np.pi, np.pi + 1e-9])
def test_quaternion_is_exact_near_no_turn_and_half_turns(axis: list[float], angle: float) -> None:
    matrix = Rotation.from_rotvec(angle * np.array(axis) / np.linalg.norm(axis)).as_matrix()
    np.testing.assert_allclose(quaternion_to_matrix(matrix_to_quaternion(matrix)), matrix, atol=1e-14)


def test_quaternions_of_a_whole_hand_at_once_equal_one_by_one() -> None:
    q = np.random.default_rng(7).normal(size=(4, 26, 4))
    matrices = quaternion_to_matrix(q)
    assert matrices.shape == (4, 26, 3, 3)
    np.testing.assert_allclose(matrices, scipy_matrix(q.reshape(-1, 4)).reshape(4, 26, 3, 3), atol=1e-12)
    back = matrix_to_quaternion(matrices)
    for i in range(4):
        np.testing.assert_array_equal(back[i, 3], matrix_to_quaternion(matrices[i, 3]))


def test_a_nan_quaternion_stays_alone() -> None:
    q = np.array([[1.0, 0.0, 0.0, 0.0], [np.nan, 0.0, 0.0, 0.0]])
    matrices = quaternion_to_matrix(q)
    np.testing.assert_array_equal(np.isnan(matrices).any(axis=(1, 2)), [False, True])
    np.testing.assert_array_equal(np.isnan(matrix_to_quaternion(matrices)).any(axis=1), [False, True])


@given(vectors)
def test_rotation_vector_is_scipys(vector: Float) -> None:
    np.testing.assert_allclose(
        rotation_vector_to_matrix(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-12
    )


@pytest.mark.parametrize("size", [0.0, 1e-300, 1e-9, 0.9e-8, 1.1e-8, 1e-6])
def test_small_rotation_vectors_stay_rotations(size: float) -> None:
    vector = size * np.array([0.6, 0.0, 0.8])
    np.testing.assert_allclose(
        rotation_vector_to_matrix(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-15
    )


@given(
    arrays(np.float64, (5, 1, 3), elements=st.floats(-1e3, 1e3)),
    arrays(np.float64, (4, 3), elements=st.floats(-1e3, 1e3)),
)
def test_cross_is_numpys_also_over_many_at_once(a: Float, b: Float) -> None:
    np.testing.assert_allclose(cross(a, b), np.cross(a, b), rtol=1e-12, atol=1e-9)


@given(vectors, vectors)
def test_skew_is_the_cross_product(a: Float, b: Float) -> None:
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
@given(angle=st.floats(-7.0, 7.0))
def test_axis_rotation_is_right_handed(axis: int, angle: float) -> None:
    expected = Rotation.from_rotvec(angle * np.eye(3)[axis]).as_matrix()
    np.testing.assert_allclose(axis_rotation(axis, angle), expected, atol=1e-14)


@given(quaternions, vectors, arrays(np.float64, (4, 2, 3), elements=st.floats(-1.0, 1.0)))
def test_inverse_undoes_a_transform(q: Float, translation: Float, points: Float) -> None:
    T_a_b = rigid(quaternion_to_matrix(q), translation)
    np.testing.assert_allclose(transform(invert(T_a_b), transform(T_a_b, points)), points, atol=1e-12)
    np.testing.assert_allclose(invert(T_a_b) @ T_a_b, np.eye(4), atol=1e-12)


def test_transform_maps_b_to_a() -> None:
    # b stands 1 m to the right of a, turned by +90 deg about z: b's x axis is a's y axis.
    T_a_b = rigid(axis_rotation(2, np.pi / 2), np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(transform(T_a_b, np.array([2.0, 0.0, 0.0])), [1.0, 2.0, 0.0], atol=1e-15)


@given(quaternions, vectors, st.integers(3, 12), st.integers(0, 2**31))
def test_fit_rigid_is_exact_on_exact_points(q: Float, translation: Float, count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    T_a_b = rigid(quaternion_to_matrix(q), translation)
    points = rng.normal(size=(count, 3))
    weight = rng.uniform(0.1, 5.0, count)
    np.testing.assert_allclose(fit_rigid(transform(T_a_b, points), points), T_a_b, atol=1e-9)
    np.testing.assert_allclose(fit_rigid(transform(T_a_b, points), points, weight), T_a_b, atol=1e-9)


def test_fit_rigid_never_mirrors() -> None:
    points = np.random.default_rng(7).normal(size=(10, 3))
    T = fit_rigid(points * [-1.0, 1.0, 1.0], points)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


def test_fit_rigid_of_noisy_points_is_scipys_and_weight_zero_is_absence() -> None:
    rng = np.random.default_rng(7)
    points = rng.normal(size=(8, 3))
    seen = transform(rigid(axis_rotation(1, 0.7), np.array([0.1, 0.2, 0.3])), points) + rng.normal(
        0, 0.01, (8, 3)
    )
    weight = rng.uniform(0.5, 2.0, 8)
    mean_a, mean_b = np.average(seen, 0, weight), np.average(points, 0, weight)
    oracle = Rotation.align_vectors(seen - mean_a, points - mean_b, weight)[0]
    np.testing.assert_allclose(fit_rigid(seen, points, weight)[:3, :3], oracle.as_matrix(), atol=1e-9)
    spoiled = np.vstack([seen, [[9.0, 9.0, 9.0]]])
    again = fit_rigid(spoiled, np.vstack([points, [[0.0, 0.0, 0.0]]]), np.append(weight, 0.0))
    np.testing.assert_allclose(again, fit_rigid(seen, points, weight), atol=1e-12)


@given(vectors, vectors, vectors, st.floats(-5.0, 5.0))
def test_ray_meets_the_plane_on_the_plane_and_ahead(o: Float, d: Float, n: Float, offset: float) -> None:
    point = intersect_plane(o, d, n, offset)
    assert np.isnan(point).all() or np.isfinite(point).all()
    if np.isfinite(point).all():
        far = (
            1.0 + float(np.linalg.norm(point)) + float(np.linalg.norm(o))
        )  # rounding goes with both ends of the ray
        scale = 1.0 + abs(offset) + float(np.linalg.norm(n)) * far
        assert abs(float(point @ n) - offset) < 1e-9 * scale
        assert float((point - o) @ d) >= 0.0


def test_parallel_backward_and_missing_rays_are_nan_and_stay_alone() -> None:
    direction = np.array(
        [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [np.nan, 0.0, 1.0], [1.0, 0.0, 1.0]]
    )
    points = intersect_plane(np.zeros(3), direction, np.array([0.0, 0.0, 1.0]), 2.0)
    np.testing.assert_array_equal(np.isnan(points).all(axis=1), [False, True, True, True, False])
    np.testing.assert_allclose(points[[0, 4]], [[0.0, 0.0, 2.0], [2.0, 0.0, 2.0]])
