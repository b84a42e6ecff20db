"""Where fingers are to reach, and where the back looks, by hand."""

import numpy as np

from master.fabrik.fabrik import back_normal_of, targets_of
from tests.hand_helpers import palm


def test_targets_lie_between_fit_and_measurement_by_their_variances() -> None:
    T, places = palm(np.array([5.0, 10.0, 15.0])), np.tile([0.01, 0.02, -0.1], (3, 1))
    places = places @ T[:3, :3].T + T[:3, 3]
    points = places + np.array([0.0, 0.0, 0.01])
    points[2] = np.nan
    cov, out = np.stack([np.zeros((3, 3)), 1e-6 * np.eye(3), np.full((3, 3), np.nan)]), np.empty((3, 3))
    targets_of(points, cov, T, places, 1e-6, out)
    found = out @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(found[0], points[0], atol=1e-12)
    np.testing.assert_allclose(found[1] - points[1], [0.0, 0.0, -0.005], atol=1e-12)
    assert np.isnan(out[2]).all()


def test_the_back_faces_the_cameras_that_see_most_of_it() -> None:
    centres, out = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), np.zeros(3)
    points, focal = np.array([[0.0, 0.0, 1.0], [np.nan] * 3]), np.array([500.0, 500.0])
    for area, x in (
        ([[4.0], [4.0]], 0.0),
        ([[np.nan], [4.0]], 1.0),
        ([[4.0], [np.nan]], -1.0),
        ([[np.nan]] * 2, 0.0),
    ):
        assert back_normal_of(points, np.array(area), centres, focal, out)
        expected = np.array([x, 0.0, -1.0])
        np.testing.assert_allclose(out, expected / np.linalg.norm(expected), atol=1e-12)
    assert not back_normal_of(np.full((2, 3), np.nan), np.ones((2, 1)), centres, focal, out)
