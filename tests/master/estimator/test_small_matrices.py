"""Kernels of small symmetric matrices against numpy."""

import numpy as np

from master.estimator.small_matrices import factor, inverse, inverse_3, substitute


def test_small_matrices_are_solved_as_by_numpy() -> None:
    rng = np.random.default_rng(7)
    root = rng.normal(size=(8, 8))
    A, b = root @ root.T + 0.1 * np.eye(8), rng.normal(size=8)
    L, out, full = np.zeros((8, 8)), np.empty(8), np.empty((8, 8))
    held = np.zeros(8, np.bool_)
    held[[2, 5]] = True
    assert factor(A, held, L)
    substitute(L, b, held, out)
    np.testing.assert_allclose(out[~held], np.linalg.solve(A[np.ix_(~held, ~held)], b[~held]), rtol=1e-9)
    assert (out[held] == 0.0).all()
    assert inverse(A, 2.0, full)
    np.testing.assert_allclose(full, 2.0 * np.linalg.inv(A), rtol=1e-8)
    assert not inverse(-A, 1.0, full)
    small = np.empty((3, 3))
    inverse_3(A[:3, :3], 0.5, small)
    np.testing.assert_allclose(small, np.linalg.inv(A[:3, :3] + 0.5 * np.eye(3)), rtol=1e-9)
