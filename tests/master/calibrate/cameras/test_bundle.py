"""The bundle against finite differences, against OpenCV's calibrations, and against truth."""

from dataclasses import replace

import cv2
import numpy as np

from common.arrays import Float
from master.calibrate.cameras.boards import board_corners
from master.calibrate.cameras.bundle import (
    Bundle,
    Free,
    Observation,
    _jacobian,
    _retracted,
    _stacked,
    predict,
    rms,
    solve,
)
from tests.master.calibrate.cameras.board_scenes import SIZE, Scene, scene


def _problem(truth: Scene, noise_px: float, seed: int) -> tuple[list[Observation], Bundle]:
    """All corners of all views, and a bundle near the truth."""
    rng = np.random.default_rng(seed)
    observations: list[Observation] = []
    for v in range(len(truth.T_rig_board)):
        for c, camera in enumerate(truth.lenses):
            uv = truth.corners(v, camera)
            uv = uv + rng.normal(0.0, noise_px, uv.shape)
            observations.append(Observation(c, v, np.arange(len(uv)), uv))
    drawn = board_corners(truth.board)
    exact = Bundle(
        np.stack(list(truth.lenses.values())),
        np.tile((np.array(SIZE) - 1.0) / 2.0, (len(truth.lenses), 1)),
        np.stack(list(truth.T_camera_rig.values())),
        truth.T_rig_board,
        drawn,
        truth.shape_m.copy(),
        np.zeros(len(truth.lenses)),
    )
    cameras, views = len(truth.lenses), len(truth.T_rig_board)
    shared = np.concatenate(
        [
            (rng.normal(size=(cameras, 9)) * ([3, 3, 3, 3, 0.01, 0.01, 1e-4, 1e-4, 0.01])).ravel(),
            rng.normal(0.0, 1e-3, (cameras, 6)).ravel(),
            np.zeros(cameras + 3 * len(drawn)),
        ]
    )
    shared[9 * cameras : 9 * cameras + 6] = 0.0
    start = _retracted(replace(exact, shape_m=0 * drawn), shared, rng.normal(0.0, 2e-3, (views, 6)))
    return observations, start


def _all_free(cameras: int, *, shape: bool) -> Free:
    return Free(np.ones((cameras, 9), np.bool_), np.arange(cameras) > 0, shape)


def test_derivatives_are_those_of_the_prediction() -> None:
    truth = scene(1, cameras=2, views=2)
    observations, bundle = _problem(truth, 0.0, 1)
    seen = observations[3]
    by_lens, by_camera, by_view, by_shape = (by[0] for by in _jacobian(_stacked([seen], 54)[0], bundle)[1:])
    corners = len(bundle.drawn_m)
    cases: list[tuple[int, Float, float]] = [
        *((9 + i, by_lens[:, :, i], 1e-4 if i < 4 else 1e-6) for i in range(9)),
        *((18 + 6 + i, by_camera[:, :, i], 1e-6) for i in range(6)),
    ]
    for at, expected, step in cases:
        shared = np.zeros(32 + 3 * corners)
        shared[at] = step
        up, down = (predict(_retracted(bundle, sign * shared, np.zeros((2, 6))), seen) for sign in (1, -1))
        np.testing.assert_allclose((up - down) / (2 * step), expected, rtol=1e-4, atol=1e-3)
    for i in range(6):
        own = np.zeros((2, 6))
        own[1, i] = 1e-6
        up, down = (predict(_retracted(bundle, np.zeros(32 + 3 * corners), s * own), seen) for s in (1, -1))
        np.testing.assert_allclose((up - down) / 2e-6, by_view[:, :, i], rtol=1e-4, atol=1e-3)
    for i in range(3):
        shared = np.zeros(32 + 3 * corners)
        shared[32 + 3 * 7 + i] = 1e-6
        up, down = (predict(_retracted(bundle, s * shared, np.zeros((2, 6))), seen) for s in (1, -1))
        change = (up - down) / 2e-6
        np.testing.assert_allclose(change[7], by_shape[7, :, i], rtol=1e-4, atol=1e-3)
        assert not np.delete(change, 7, axis=0).any()  # a corner's own place moves nothing else


def test_one_camera_is_calibrated_as_by_opencv() -> None:
    truth = scene(2, cameras=1, views=12)
    observations, start = _problem(truth, 0.2, 2)
    solution = solve(observations, start, _all_free(1, shape=False), sigma_px=0.0)
    objects = [start.drawn_m.astype(np.float32)] * 12
    images = [o.uv.astype(np.float32) for o in observations]
    matrix = np.array([[500.0, 0, 319.5], [0, 500.0, 239.5], [0, 0, 1]])
    error, matrix, distortion, *_ = cv2.calibrateCamera(
        objects,
        images,
        SIZE,
        matrix,
        np.zeros(5),
        flags=cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=(3, 500, 1e-14),
    )
    assert abs(rms(solution.residuals) - error) < 1e-6
    lens = solution.bundle.lenses[0]
    np.testing.assert_allclose(lens[:4], [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]], atol=2e-3)
    np.testing.assert_allclose(lens[4:], np.ravel(distortion), atol=2e-4)


def test_two_cameras_are_calibrated_as_by_opencv() -> None:
    truth = scene(3, cameras=2, views=12)
    observations, start = _problem(truth, 0.2, 3)
    solution = solve(observations, start, _all_free(2, shape=False), sigma_px=0.0)
    objects = [start.drawn_m.astype(np.float32)] * 12
    left, right = ([o.uv.astype(np.float32) for o in observations if o.camera == c] for c in (0, 1))
    matrices = [np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]]) for lens in start.lenses]
    found = cv2.stereoCalibrate(
        objects,
        left,
        right,
        matrices[0],
        start.lenses[0, 4:].copy(),
        matrices[1],
        start.lenses[1, 4:].copy(),
        SIZE,
        flags=cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=(3, 500, 1e-14),
    )
    error, first, _, second, _, rotation, move = found[:7]
    assert abs(rms(solution.residuals) - error) < 1e-4
    bundle = solution.bundle
    np.testing.assert_allclose(bundle.lenses[:, 0], [first[0, 0], second[0, 0]], atol=0.02)
    T = bundle.T_camera_rig[1]
    np.testing.assert_allclose(1e3 * T[:3, 3], 1e3 * np.ravel(move), atol=0.01)
    assert np.degrees(np.linalg.norm(cv2.Rodrigues(T[:3, :3].T @ np.asarray(rotation))[0])) < 0.002


def test_the_shape_of_a_bent_board_is_found_and_the_lens_is_better_for_it() -> None:
    truth = scene(4, cameras=2, views=20, shape_mm=0.2)
    observations, start = _problem(truth, 0.05, 4)
    bent = solve(observations, start, _all_free(2, shape=True), sigma_px=0.05)
    flat = solve(observations, start, _all_free(2, shape=False))
    assert rms(flat.residuals) > 1.5 * rms(bent.residuals)
    true = np.array([lens[0] for lens in truth.lenses.values()])
    off = [np.abs(s.bundle.lenses[:, 0] - true).max() for s in (bent, flat)]
    assert off[0] < 0.5 * off[1]
    # What a shift, a turn or another size of the whole board would explain is no shape.
    inner = np.column_stack([start.drawn_m[:, :2], np.ones(len(start.drawn_m))])
    left = truth.shape_m[:, 2] - inner @ np.linalg.lstsq(inner, truth.shape_m[:, 2], rcond=None)[0]
    found = (
        bent.bundle.shape_m[:, 2] - inner @ np.linalg.lstsq(inner, bent.bundle.shape_m[:, 2], rcond=None)[0]
    )
    assert 1e3 * np.sqrt(((left - found) ** 2).mean()) < 0.05


def test_standard_deviations_are_those_of_repeated_sessions() -> None:
    truth = scene(5, cameras=2, views=8)
    off: list[Float] = []
    for seed in range(24):
        observations, start = _problem(truth, 0.2, seed)
        solution = solve(observations, start, _all_free(2, shape=False))
        right = solution.bundle.T_camera_rig[1][:3, 3] - truth.T_camera_rig["right"][:3, 3]
        focal = solution.bundle.lenses[:, 0] - [lens[0] for lens in truth.lenses.values()]
        sd = [solution.lens_sd(0)[0], solution.lens_sd(1)[0], *solution.place_sd(1)[3:]]
        off.append(np.array([*focal, *right]) / sd)
    # 24 repetitions know a standard deviation to 15 %.
    np.testing.assert_allclose(np.sqrt((np.array(off) ** 2).mean(axis=0)), 1.0, atol=0.45)


def test_a_board_out_of_sight_of_every_pixel_does_not_end_the_fit_of_the_others() -> None:
    truth = scene(6, cameras=2, views=6)
    observations, start = _problem(truth, 0.1, 6)
    start.T_rig_board[0, 2, 3] = 1e180  # all derivatives by its place are zero
    solution = solve(observations, start, _all_free(2, shape=False), cauchy_px=0.5)
    near = [r for o, r in zip(observations, solution.residuals, strict=True) if o.view > 0]
    assert rms(near) < 0.2
