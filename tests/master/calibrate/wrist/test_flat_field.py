"""The flat field: from exact light, with noise, shine and gaps, against the field it was made with."""

import numpy as np
import pytest

from common.arrays import Float
from common.calibration.rig import FLAT_FIELD_TERMS, field_at, terms_of
from common.errors import FitError
from common.recording.frame_recording import Illumination
from common.sim.wrist.board import LED_LOBE, LENS_POWER, WristBoardRenderer
from master.calibrate.wrist.device import board_pose
from master.calibrate.wrist.flat_field import WhiteSamples, fit_flat_field, white_samples
from tests.master.calibrate.wrist.devices import BOARD, OPTICS, scene_of, view_of

AMBIENT, LED = Illumination.AMBIENT, Illumination.LED
V, U = np.mgrid[10:400:20, 20:640:20].astype(np.float64)
EVERYWHERE = np.stack([U.ravel(), V.ravel()], axis=1)


def truth(xy: Float, power: float = 3.2) -> Float:
    """A power of the cosine off the axis, as of the simulated device (lens and LEDs together), brighter to the left."""
    return (1.0 + (xy**2).sum(axis=1)) ** (-0.5 * power) * np.exp(-0.1 * xy[:, 0])


def samples(seed: int = 0, noise: float = 0.02, where: Float = EVERYWHERE, views: int = 20) -> WhiteSamples:
    """White paper at pixels (S, 2), each light `noise` off, of an unknown gain."""
    rng = np.random.default_rng(seed)
    xy = OPTICS.undistort(where)
    light = 3.7 * truth(xy) * (1.0 + noise * rng.standard_normal(len(xy)))
    return WhiteSamples(xy, where, light, rng.integers(0, views, len(xy)).astype(np.int64))


def worst_percent(fitted: Float, true: Float) -> float:
    """Largest relative error, of whatever gain fits best."""
    ratio = fitted / true
    return float(100.0 * np.abs(ratio / np.median(ratio) - 1.0).max())


@pytest.mark.parametrize("seed", range(2))
def test_the_field_comes_back_to_three_per_cent_and_in_the_corners_to_ten(seed: int) -> None:
    found = samples(seed)
    fit = fit_flat_field(found, OPTICS)
    assert worst_percent(field_at(fit.field, found.xy), truth(found.xy)) < 10.0
    middle = np.linalg.norm(found.xy, axis=1) < 0.6
    assert worst_percent(field_at(fit.field, found.xy[middle]), truth(found.xy[middle])) < 3.0
    assert 0.015 < fit.rms < 0.035
    assert fit.cross_validated_rms >= 0.95 * fit.rms


def test_it_is_one_on_the_axis_and_of_whole_degrees() -> None:
    fit = fit_flat_field(samples(), OPTICS)
    assert field_at(fit.field, np.zeros((1, 2))) == pytest.approx(1.0)
    assert len(fit.field.coefficients) in FLAT_FIELD_TERMS


def test_the_terms_are_in_the_order_of_the_file() -> None:
    # 1, x, y, x^2, x y, y^2, as `FlatField` says.
    np.testing.assert_allclose(terms_of(np.array([[2.0, 3.0]]), 2), [[1, 2, 3, 4, 6, 9]])


def test_shine_on_a_tenth_of_the_paper_changes_little() -> None:
    found = samples(1)
    light = found.light.copy()
    light[::10] *= 2.5
    fit = fit_flat_field(WhiteSamples(found.xy, found.uv, light, found.view), OPTICS)
    assert worst_percent(field_at(fit.field, found.xy), truth(found.xy)) < 8.0


def test_where_no_paper_was_the_field_stays_sane() -> None:
    # Only the middle cells' inner parts: the corners of the image are beyond every sample.
    inner = EVERYWHERE[(np.abs(EVERYWHERE - [320, 200]) < [240, 150]).all(axis=1)]
    fit = fit_flat_field(samples(2, where=inner), OPTICS)
    xy = OPTICS.undistort(EVERYWHERE)
    assert worst_percent(field_at(fit.field, xy), truth(xy)) < 25.0
    assert (field_at(fit.field, xy) > 0.0).all()


@pytest.mark.parametrize(
    ("corner", "name"),
    [((0, 0), "top left"), ((1, 0), "top right"), ((0, 1), "bottom left"), ((1, 1), "bottom right")],
)
def test_a_corner_without_paper_is_named(corner: tuple[int, int], name: str) -> None:
    at = np.array([640, 400]) * np.array(corner)
    far = (np.abs(EVERYWHERE - at) > [214, 134]).any(axis=1)
    with pytest.raises(FitError, match=f"no white squares at the {name} of the image"):
        fit_flat_field(samples(where=EVERYWHERE[far]), OPTICS)


def test_few_views_and_light_that_follows_no_law_are_refused() -> None:
    with pytest.raises(FitError, match="3 views with white squares"):
        fit_flat_field(samples(views=3), OPTICS)
    with pytest.raises(FitError, match="deviates"):
        fit_flat_field(samples(noise=0.15), OPTICS)
    nothing = WhiteSamples(np.empty((0, 2)), np.empty((0, 2)), np.empty(0), np.empty(0, np.int64))
    with pytest.raises(FitError, match="0 views"):
        fit_flat_field(nothing, OPTICS)


def test_rendered_white_squares_have_the_light_of_the_law() -> None:
    scene = scene_of(21, 6, anywhere=True)
    renderer = WristBoardRenderer(scene)
    leds = np.array(scene.rig.led)
    ratio: list[float] = []
    for pose in range(6):
        frames = {lit: renderer.render(pose, lit) for lit in (AMBIENT, LED)}
        try:
            placed = board_pose(view_of("0", frames), BOARD, OPTICS)
            xy, _, light = white_samples(frames[LED], frames[AMBIENT], placed, BOARD, OPTICS, leds)
        except FitError:
            continue
        ratio += (light / (1.0 + (xy**2).sum(axis=1)) ** (-0.5 * (LED_LOBE + LENS_POWER))).tolist()
    assert len(ratio) > 200
    assert np.std(ratio) / np.mean(ratio) < 0.05


def test_saturated_and_dark_boards_say_what_to_do() -> None:
    renderer = WristBoardRenderer(scene_of(21, 1, anywhere=True))
    frames = {lit: renderer.render(0, lit) for lit in (AMBIENT, LED)}
    placed = board_pose(view_of("0", frames), BOARD, OPTICS)
    white = np.full_like(frames[LED], 255)
    leds = np.zeros((1, 3))
    with pytest.raises(FitError, match="hold the board farther away"):
        white_samples(white, frames[AMBIENT], placed, BOARD, OPTICS, leds)
    with pytest.raises(FitError, match="hold the board nearer"):
        white_samples(frames[AMBIENT], frames[AMBIENT], placed, BOARD, OPTICS, leds)
