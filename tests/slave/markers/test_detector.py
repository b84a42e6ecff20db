import math

import numpy as np
import pytest

from common.arrays import Image
from common.calibration import HsvRange
from slave.markers.detector import Detections, MarkerDetector
from tests.slave.painted import CENTRES, NAMES, RANGES, Disc, camera, finger, hand, marker_hsv, render

STEP_NS = 16_666_667
MUG = [Disc(marker_hsv(1), 560.0, 120.0, 17.0)]
DETECTOR = MarkerDetector(camera(), NAMES)


def push_all(images: list[Image], seeds: dict[str, tuple[float, float]] | None = None) -> list[Detections]:
    detector = DETECTOR.fresh(seeds)
    return [detector.push(image, i * STEP_NS) for i, image in enumerate(images)]


def off(found: Detections, u: float, v: float) -> np.ndarray:
    return np.hypot(*(found.uv - CENTRES - (u, v)).T)


def test_six_markers_of_a_hand_are_found_whole_and_certain() -> None:
    (found,) = push_all([render(hand())])
    assert (off(found, 300.0, 200.0) < 0.3).all()
    assert (found.quality > 0.8).all()


def test_each_is_measured_as_it_would_be_in_its_own_window() -> None:
    image = render(hand())
    tracked = push_all([render(hand(295.0, 200.0)), image])[1]
    reinitialise = push_all([image])[0]
    np.testing.assert_array_equal(tracked.uv, reinitialise.uv)


def test_a_missing_marker_is_nan_in_all_and_the_others_are_what_they_were() -> None:
    whole = push_all([render(hand())])[0]
    image = render(hand())
    image[90:120, 280:303] = render([])[90:120, 280:303]  # the middle finger's tip is gone
    found = push_all([render(hand()), image])[1]
    assert np.isnan(found.uv[2]).all()
    assert math.isnan(found.area[2])
    assert math.isnan(found.quality[2])
    rest = [0, 1, 3, 4, 5]
    np.testing.assert_allclose(found.uv[rest], whole.uv[rest], atol=0.05)


def test_a_lost_marker_comes_back_anywhere_on_the_hand_in_the_first_frame_that_shows_it() -> None:
    without = render([d for d in hand() if d.hsv != marker_hsv(2)])
    moved = [d for d in hand(240.0, 260.0) if d.hsv != marker_hsv(2)] + finger(2, 300.0, 170.0)
    frames = push_all([render(hand())] + [without] * 60 + [render(moved)])
    assert np.isnan(frames[60].uv[2]).all()
    assert np.hypot(*(frames[61].uv[2] - (300.0, 170.0))) < 0.3


def test_fast_motion_of_35_px_per_frame_is_followed_and_turned() -> None:
    us = [150.0, 185.0, 220.0, 255.0, 290.0, 325.0, 290.0, 255.0]
    for u, found in zip(us, push_all([render(hand(u)) for u in us]), strict=True):
        assert (off(found, u, 200.0) < 0.3).all()


def test_a_mug_of_the_same_colour_is_not_the_marker() -> None:
    for found in push_all([render(hand() + MUG)] * 3):
        assert (off(found, 300.0, 200.0) < 0.3).all()


def test_a_mug_is_not_taken_for_a_hidden_marker() -> None:
    without = [d for d in hand() if d.hsv != marker_hsv(1)]
    for found in push_all([render(hand() + MUG), *[render(without + MUG)] * 60]):
        assert not np.hypot(*(found.uv[1] - (560.0, 120.0))) < 30.0


def test_a_mug_near_a_fist_is_not_a_marker() -> None:
    fist = [Disc((12, 100, 200), 300.0, 200.0, 40.0), Disc(marker_hsv(5), 300.0, 200.0, 16.0)]
    (found,) = push_all([render([*fist, Disc(marker_hsv(1), 400.0, 180.0, 15.0)])])
    assert np.isfinite(found.uv[5]).all()
    assert np.isnan(found.uv[1]).all()


def test_clicks_decide_where_two_hands_show_the_same_colours() -> None:
    image = render(hand(150.0, 330.0) + hand(480.0, 330.0))
    seeds = {n: (480.0 + x, 330.0 + y) for n, (x, y) in zip(NAMES, CENTRES.tolist(), strict=True)}
    (found,) = push_all([image], seeds)
    assert (off(found, 480.0, 330.0) < 0.3).all()
    seeds = {n: (150.0 + x, 330.0 + y) for n, (x, y) in zip(NAMES, CENTRES.tolist(), strict=True)}
    (found,) = push_all([image], seeds)
    assert (off(found, 150.0, 330.0) < 0.3).all()


def test_a_single_marker_without_a_hand_is_found_from_30_to_23000_px() -> None:
    for radius in (4.0, 12.0, 40.0, 85.0):
        (found,) = push_all([render([Disc(marker_hsv(1), 300.0, 240.0, radius)])])
        assert found.uv[1] == pytest.approx((300.0, 240.0), abs=0.1)
        assert np.isnan(found.uv[[0, 2, 3, 4, 5]]).all()


def test_what_passes_in_front_of_a_marker_moves_it_little_and_is_reported() -> None:
    image = render(hand())
    whole = push_all([image, image])[1]
    hidden = image.copy()
    hidden[:, :263] = render([])[:, :263]  # the edge of something, 2 px left of the index cap's centre
    found = push_all([image, image, hidden])[2]
    assert np.hypot(*(found.uv[1] - whole.uv[1])) < 0.5
    assert found.sigma_px[1] > 1.3 * whole.sigma_px[1]
    assert 0.0 < found.clarity[1] < 0.9 * whole.clarity[1]


def test_a_marker_first_seen_half_hidden_is_measured_as_it_is() -> None:
    hidden = render(hand())
    hidden[:, :266] = render([])[:, :266]
    (found,) = push_all([hidden])
    assert found.uv[1, 0] > 267.0
    assert found.area[1] < 0.6 * math.pi * 49.0


def test_a_rival_of_the_same_colour_within_reach_is_named() -> None:
    second = [Disc(marker_hsv(1), 245.0, 145.0, 7.0)]
    frames = push_all([render(hand())] * 2 + [render(hand() + second)] * 2)
    assert np.isnan(frames[1].alt_uv).all()
    for found in frames[2:]:
        assert (off(found, 300.0, 200.0)[[0, 1, 3, 4, 5]] < 0.3).all()
        assert np.hypot(*(found.alt_uv[1] - (245.0, 145.0))) < 0.5
        assert np.isnan(found.alt_uv[[0, 3, 4, 5]]).all()


@pytest.mark.parametrize("radius", [5.0, 7.0])
@pytest.mark.parametrize("gap", [6.0, 9.0, 12.0])
@pytest.mark.parametrize("angle", [-2.8, 3.6, 4.2])
def test_a_thing_near_a_marker_never_seen_before_is_an_alternative_not_a_part_of_it(
    radius: float, gap: float, angle: float
) -> None:
    connection_lost = 7.0 + gap + radius
    thing = 265.0 + connection_lost * math.cos(angle), 110.0 + connection_lost * math.sin(angle)
    for found in push_all([render([*hand(), Disc(marker_hsv(1), *thing, radius)])] * 2):
        place, alternative = (np.hypot(*(uv[1] - (265.0, 110.0))) for uv in (found.uv, found.alt_uv))
        assert min(place, alternative) < 0.3
        assert np.hypot(*(found.alt_uv[1] - thing)) < 0.3 or np.hypot(*(found.uv[1] - thing)) < 0.3


def test_a_piece_split_off_is_joined_with_more_uncertainty_where_the_whole_is_not_known() -> None:
    whole, empty = render([Disc(marker_hsv(1), 300.0, 240.0, 30.0)]), render([])
    split = whole.copy()
    split[242:258] = empty[242:258]  # something in front, across the cap
    new, known = push_all([split])[0], push_all([whole, whole, split])[2]
    for found in (new, known):
        assert np.hypot(*(found.uv[1] - (300.0, 240.0))) < 6.0  # 12 px without the piece
        assert np.isnan(found.alt_uv[1]).all()
    assert new.sigma_px[1] > 3.0
    assert known.sigma_px[1] < 0.8 * new.sigma_px[1]


def test_an_empty_frame_finds_nothing_and_noise_is_nothing() -> None:
    for noise in (0.0, 4.0):
        (found,) = push_all([render([], noise=noise)])
        assert np.isnan(found.uv).all()
        assert np.isnan(found.area).all()
        assert np.isnan(found.quality).all()


def test_a_frame_of_another_size_or_kind_is_refused() -> None:
    with pytest.raises(ValueError, match="camera file says"):
        DETECTOR.fresh().push(np.zeros((240, 320, 3), np.uint8), 0)
    with pytest.raises(ValueError, match="camera file says"):
        DETECTOR.fresh().push(np.zeros((480, 640, 3), np.float32), 0)  # pyright: ignore[reportArgumentType]


def test_a_free_marker_is_found_wherever_it_lies_next_to_a_hand_or_alone() -> None:
    ranges = {**RANGES, "puck": HsvRange(hsv_low=(0, 150, 40), hsv_high=(4, 255, 255))}
    names = (*NAMES, "puck")
    puck = (2, 230, 180)
    detector = MarkerDetector(camera(ranges=ranges), names, free=("puck",))
    alone = detector.fresh().push(render([Disc(puck, 60.0, 420.0, 8.0)]), 0)
    np.testing.assert_allclose(alone.uv[6], (60.0, 420.0), atol=0.1)
    detector = detector.fresh()
    images = [render([Disc(puck, 60.0, 420.0, 8.0)])] * 2 + [
        render([*hand(), Disc(puck, 60.0, 420.0, 8.0)])
    ] * 3
    images += [render([*hand(), Disc(puck, 560.0, 60.0, 8.0)])] * 2  # set down elsewhere
    for k, image in enumerate(images):
        found = detector.push(image, k * STEP_NS)
        place = (60.0, 420.0) if k < 5 else (560.0, 60.0)
        np.testing.assert_allclose(found.uv[6], place, atol=0.1)
        if k >= 2:
            assert (np.hypot(*(found.uv[:6] - CENTRES - (300.0, 200.0)).T) < 0.3).all()
    bound = MarkerDetector(camera(ranges=ranges), names).push(images[2], 0)
    assert np.isnan(bound.uv[6]).all()  # a marker of the hand would not be believed there
