"""Laser segments: drawn lines to parts of a pixel, rendered ones to parts of a millimetre, and nothing else."""

from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
import pytest

from common.arrays import Float, Image
from common.recording.frame_recording import Illumination
from slave.cameras.synthetic import STROBE
from slave.wrist.laser import Fingers, laser_lines, separate
from slave.wrist.runs import lines
from slave.wrist.strobe import lit
from slave.wrist.workspace import workspace_of
from tests.slave.wrist.wrist_frames import VIEW, renderer, scene, seen_at

BLACK = np.zeros((400, 640), dtype=np.uint8)
INDEX = 1
VISIBLE_M = 2e-3


def drawn(
    row: Callable[[Float], Float], columns: tuple[int, int], peak: float, sigma_px: float = 2.0
) -> Image:
    """A Gaussian line; above 255 it is cut, as a sensor does."""
    u = np.arange(640.0)
    v = np.arange(400.0)[:, None]
    across = (v - row(u)) / np.hypot(1.0, np.gradient(row(u)))
    image = peak * np.exp(-0.5 * (across / sigma_px) ** 2) * ((u >= columns[0]) & (u <= columns[1]))
    return np.clip(image, 0.0, 255.0).astype(np.uint8)


@cache
def curled_fingers() -> Fingers:
    """The fingers of a curled hand in the dark, as the LEDs show them."""
    device = renderer("curl@dark")
    return separate(lit(device.render(0.0, Illumination.LED), device.render(0.0, Illumination.AMBIENT)), VIEW)


@pytest.mark.parametrize("peak", [60.0, 200.0, 2000.0])
def test_rows_are_exact_to_parts_of_a_pixel_dim_or_saturated(peak: float) -> None:
    def row(u: Float) -> Float:
        return 300.3 + 0.21 * (u - 300.0)

    runs, _ = lines(drawn(row, (280, 330), peak), 200)
    np.testing.assert_array_equal(runs.column, np.arange(280, 331))
    errors = runs.row - row(runs.column.astype(np.float64))
    assert np.sqrt(np.mean(errors**2)) < 0.12
    assert abs(errors.mean()) < 0.03


def test_a_jump_ends_a_line() -> None:
    def row(u: Float) -> Float:
        return np.where(u < 300, 290.0, 310.0)

    runs, _ = lines(drawn(row, (280, 320), 200.0), 200)
    broken = runs.column[[*(runs.first[1:] - 1), -1]]
    assert 320 in broken
    assert np.isin(broken, [299, 300, 320]).all()


def test_the_centroid_weighs_length_and_not_columns() -> None:
    """Half of a line runs flat, half of it steeply: twice the length a column by the steep half."""
    truth = scene("curl@dark").truth(0.0)
    u0, v0 = truth.laser_uv[1 + INDEX]

    def row(u: Float) -> Float:
        return v0 + np.maximum(u - u0, 0.0) * np.sqrt(3.0)

    fingers = curled_fingers()
    found = laser_lines(drawn(row, (round(u0) - 12, round(u0) + 12), 220.0), fingers, VIEW)
    flat, steep = 12.0, 24.0
    expected = u0 + (steep * 6.0 - flat * 6.0) / (flat + steep)
    assert found.uv[INDEX, 0] == pytest.approx(expected, abs=1.0)
    assert found.length_px[INDEX] == pytest.approx(flat + steep, rel=0.15)


def test_a_line_in_parts_has_more_uncertainty_by_what_its_parts_would_move_it() -> None:
    truth = scene("curl@dark").truth(0.0)
    u0, v0 = truth.laser_uv[1 + INDEX]
    fingers = curled_fingers()
    sigma_px: list[float] = []
    for apart in (0.0, 12.0, 24.0):

        def row(u: Float, apart: float = apart) -> Float:
            return np.where(u < u0, v0, v0 - apart)

        found = laser_lines(drawn(row, (round(u0) - 14, round(u0) + 10), 220.0), fingers, VIEW)
        sigma_px.append(float(found.sigma_px[INDEX]))
    whole, near, far = sigma_px
    assert whole < 1.0 < near < far


@pytest.mark.parametrize("image", [BLACK, np.full_like(BLACK, 255), np.full_like(BLACK, 40)])
def test_an_image_without_a_line_has_none(image: Image) -> None:
    found = laser_lines(image, separate(BLACK, VIEW), VIEW)
    assert np.isnan(found.uv).all()
    assert np.isnan(found.sigma_px).all()
    assert np.isnan(found.length_px).all()


def test_noise_is_no_line() -> None:
    for seed, top in ((1, 30), (2, 255)):
        noise = np.random.default_rng(seed).integers(0, top, BLACK.shape).astype(np.uint8)
        assert np.isnan(laser_lines(noise, separate(BLACK, VIEW), VIEW).uv).all()


def test_what_no_finger_can_reach_is_not_a_finger() -> None:
    """A bright line at the lower corners, and one over the ball of the thumb drawn where a finger would be."""
    image = BLACK.copy()
    cv2.line(image, (5, 470), (60, 470), 250, 5)
    found = laser_lines(image, separate(BLACK, VIEW), VIEW)
    assert np.isnan(found.uv[1:]).all()


def test_less_than_two_millimetres_of_line_is_not_reported() -> None:
    workspace = workspace_of(VIEW)
    row, column = (8 * np.argwhere(workspace.cells[2])[workspace.cells[2].sum() // 2]).tolist()
    image = drawn(lambda u: np.full_like(u, float(row)), (column, column + 2), 220.0)
    assert np.isnan(laser_lines(image, separate(BLACK, VIEW), VIEW).uv).all()


@pytest.mark.parametrize("name", ["curl@dark", "curl@bright", "spread@indoor"])
def test_rendered_fingers_are_met_within_six_tenths_of_a_millimetre(name: str) -> None:
    errors, owned = laser_errors(name, 20, 31)
    assert np.nanmedian(errors, axis=0).max() < 0.6e-3
    assert owned >= 0.95


def test_a_thumb_whose_line_runs_on_over_its_ball_is_met_within_half_a_finger_with_more_uncertainty() -> None:
    one, device = scene("poses@indoor", 31), renderer("poses@indoor", 31)
    off: list[float] = []
    for k in range(16):
        laser, led, truth = seen_at(one, device, one.period_s * k / 16)
        found = laser_lines(laser, separate(led, VIEW), VIEW)
        if truth.laser_len_vis[1] >= VISIBLE_M:
            off.append(float(np.linalg.norm(VIEW.on_plane(found.uv)[0] - truth.laser_pt[1])))
            assert not (np.abs(found.uv[0] - truth.laser_uv[1]) > 3.0 * found.sigma_px[0]).any()
    assert np.isfinite(off).sum() >= 5
    assert np.nanmedian(off) < 4e-3
    assert np.nanmax(off) < 8e-3


def laser_errors(name: str, count: int, seed: int) -> tuple[Float, float]:
    """Distances (T, 4) [m] of index ... little from the truth, and the share of visible ones within 6 mm of theirs."""
    one, device = scene(name, seed), renderer(name, seed)
    out = np.full((count, 4), np.nan)
    seen = np.zeros((count, 4), dtype=np.bool_)
    for k in range(count):
        laser, led, truth = seen_at(one, device, one.period_s * k / count)
        found = laser_lines(laser, separate(led, VIEW), VIEW)
        seen[k] = truth.laser_len_vis[2:6] >= 2e-3
        out[k] = np.linalg.norm(VIEW.on_plane(found.uv) - truth.laser_pt[1:6], axis=1)[1:]
    out[~seen] = np.nan
    return out, float((out[seen] < 6e-3).mean())


def test_uncertainty_is_that_of_the_errors_and_more_where_the_leds_show_nothing() -> None:
    one, device = scene("curl@indoor", 41), renderer("curl@indoor", 41)
    off: list[Float] = []
    for k in range(12):
        t = one.period_s * k / 12
        ambient, laser, led = (lit(device.render(t, kind), BLACK) for kind in STROBE)
        fingers = separate(lit(led, ambient), VIEW)
        found = laser_lines(lit(laser, ambient), fingers, VIEW)
        truth = one.truth(t)
        off.append(
            (np.abs(found.uv - truth.laser_uv[1:6]) / found.sigma_px[:, None])[
                truth.laser_len_vis[1:6] > VISIBLE_M
            ]
        )
        null_detector = laser_lines(lit(laser, ambient), separate(BLACK, VIEW), VIEW)
        both = np.isfinite(found.sigma_px) & np.isfinite(null_detector.sigma_px)
        assert (null_detector.sigma_px[both] > 3.5).all()
    deviations = np.concatenate(off)
    deviations = deviations[np.isfinite(deviations)]
    assert 0.3 < np.quantile(deviations, 0.68) < 1.3
