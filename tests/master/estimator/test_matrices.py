"""Kernels of symmetric matrices against numpy."""

import numpy as np

from master.fabrik.linear_algebra import inverse_3_plus


def test_a_matrix_is_inverted_as_by_numpy() -> None:
    root = np.random.default_rng(7).normal(size=(3, 3))
    A, out = root @ root.T + 0.1 * np.eye(3), np.empty((3, 3))
    inverse_3_plus(A, 0.5, out)
    np.testing.assert_allclose(out, np.linalg.inv(A + 0.5 * np.eye(3)), rtol=1e-9)
