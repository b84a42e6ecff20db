"""What frames are by their content: rendered hands in four lights, and pictures that only look like the strobe's."""

from collections.abc import Callable
from functools import cache
from itertools import product

import cv2
import numpy as np
import pytest

from bench.wrist.strobe import Shown, rendered
from common.arrays import Bool, Image
from slave.wrist.strobe import SETTINGS, Evidence, brighter, coarse, evidence, unlit

LIGHTS = ("dark", "indoor", "bright")


@cache
def shown(ambient: str) -> list[Shown]:
    return rendered(ambient, cycles=6, seed=11)


def cells(ambient: str) -> list[Image]:
    return [coarse(one.image) for one in shown(ambient)]


@pytest.mark.parametrize("ambient", LIGHTS)
def test_every_cycle_is_known_by_its_content(ambient: str) -> None:
    found = cells(ambient)
    for dark, laser, led in zip(found[::3], found[1::3], found[2::3], strict=True):
        assert evidence(dark, laser, led).margin > 0.25


@pytest.mark.parametrize("ambient", [*LIGHTS, "sun"])
def test_no_other_three_kinds_are_taken_for_a_cycle(ambient: str) -> None:
    """All 26 other choices of three kinds, within one pose and over two; one in a thousand passes, of two poses."""
    found = cells(ambient)
    tried = passed = 0
    for pose, (i, j, k), others in product(range(5), product(range(3), repeat=3), product((0, 3), repeat=3)):
        if (i, j, k) == (0, 1, 2):
            continue
        three = (found[3 * pose + kind + other] for kind, other in zip((i, j, k), others, strict=True))
        taken = evidence(*three).margin > 0.0
        assert not taken or len(set(others)) == 2, (pose, i, j, k, others)
        passed += taken
        tried += 1
    assert tried == 5 * 26 * 8
    assert passed <= 1


@pytest.mark.parametrize("ambient", LIGHTS)
def test_it_is_seen_whether_the_leds_light_any_frame(ambient: str) -> None:
    found = cells(ambient)
    for dark, laser, led in zip(found[::3], found[1::3], found[2::3], strict=True):
        assert unlit([dark, laser, dark])
        assert unlit([led, led, led])
        assert not any(
            unlit(frames) for frames in ([dark, laser, led], [led, dark, laser], [dark, led, dark])
        )
        assert brighter(led, dark)
        assert brighter(led, laser)
        assert not any(brighter(*two) for two in ((dark, led), (laser, led), (laser, dark), (dark, laser)))


def swinging(share: float) -> Callable[[Image], Image]:
    """Ambient light of the room times 1 + share, whatever else is lit."""

    def swung(image: Image, ambient: Image) -> Image:
        more = np.clip(np.rint(image + share * (ambient.astype(np.float64) - 2.0)), 0, 255)
        return more.astype(np.uint8)

    return lambda image: swung(image, shown("indoor")[0].image)


@pytest.mark.parametrize("share", [-0.1, 0.1])
def test_lamps_that_swing_neither_hide_a_cycle_nor_make_one(share: float) -> None:
    dark, laser, led = (one.image for one in shown("indoor")[:3])
    swung = swinging(share)
    assert evidence(coarse(swung(dark)), coarse(laser), coarse(led)).margin > 0.25
    assert evidence(coarse(dark), coarse(swung(laser)), coarse(led)).margin > 0.25
    assert evidence(coarse(dark), coarse(laser), coarse(swung(led))).margin > 0.25
    assert unlit([coarse(dark), coarse(swung(dark))])
    assert not evidence(coarse(dark), coarse(laser), coarse(swung(dark))).margin > 0.0
    assert not evidence(coarse(dark), coarse(swung(dark)), coarse(led)).margin > 0.0


def panned(image: Image, behind: Bool, down: int) -> Image:
    """The picture with a bright window that has moved down by so many pixels behind the hand, where `behind` is set."""
    window = np.zeros_like(image)
    cv2.rectangle(window, (60, down - 60), (300, 40 + down), 255, -1)
    return np.where(behind, np.maximum(image, window), image)


@pytest.mark.parametrize("step", [-40, -20, -8, 8, 20, 40])
def test_a_window_that_moves_behind_the_hand_is_no_laser_and_does_not_hide_it(step: int) -> None:
    dark, laser, led = (one.image for one in shown("indoor")[:3])
    behind = led < dark + 8.0
    before, at, after = (
        coarse(panned(one, behind, 60 + k * step)) for k, one in enumerate((dark, dark, led))
    )
    assert not evidence(before, at, after).margin > 0.0
    assert not evidence(before, coarse(panned(dark, behind, 60 + 3 * step)), after).margin > 0.0
    hidden = abs(step) > 20  # px a frame: a cycle is left out then, and none is made up
    assert hidden or evidence(before, coarse(panned(laser, behind, 60 + step)), after).margin > 0.0


def test_a_line_that_no_led_lights_is_no_laser() -> None:
    """The laser's own frame, the hand gone from the LED frame but for the palm: the line hangs in the air."""
    dark, laser, led = (one.image for one in shown("dark")[:3])
    assert evidence(coarse(dark), coarse(laser), coarse(led)).margin > 0.25
    lines = np.flatnonzero((coarse(laser) > 60).any(axis=1))
    bare = led.copy()
    bare[: 8 * int(lines.max()) + 40] = dark[: 8 * int(lines.max()) + 40]
    assert not evidence(coarse(dark), coarse(laser), coarse(bare)).laser > 0.0


@pytest.mark.parametrize("level", [0, 2, 128, 255])
def test_even_pictures_determine_nothing(level: int) -> None:
    even = coarse(np.full((480, 640), level, np.uint8))
    assert unlit([even, even, even]) is (level < 255)
    assert evidence(even, even, even).margin == -np.inf


def test_saturated_pictures_are_unsure_and_not_unlit() -> None:
    white = coarse(np.full((480, 640), 255, np.uint8))
    assert not unlit([white, white, white])
    assert not brighter(white, white)


def test_colour_and_grey_pictures_are_alike() -> None:
    image = shown("indoor")[2].image
    np.testing.assert_array_equal(coarse(image), coarse(np.repeat(image[..., None], 3, axis=2)))


def test_the_margin_is_that_of_the_weakest() -> None:
    assert Evidence(3.0, 1.0, np.inf, 2.0).margin == 1.0
    assert Evidence(3.0, 1.0, -0.5, 2.0).margin == -0.5
    assert 0.0 < SETTINGS.led_least < 1.0
