"""Quality as a probability: what speaks for a marker raises it, and photographs without paint have little of it."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from common.calibration import CameraCalibration, load
from slave.markers.detector import MarkerDetector
from slave.markers.quality import WEIGHTS, Evidence, _hue, clarity_of, evidence_of, probability_of
from slave.markers.white_balance import hsv
from tests.slave.painted import NAMES, RANGES, Disc, camera, marker_hsv, render

SIX = ("thumb", "index", "middle", "ring", "little", "back")
CLEAR = Evidence(
    contrast=math.log(18.0), unclear=0.0, outlined=0.0, fullness=0.95, slender=0.1, hue=0.02,
    alternative=0.0, ragged=0.0, cut=0.0,
)  # fmt: skip


def test_a_clear_marker_is_nearly_certain() -> None:
    assert probability_of(CLEAR) > 0.98


@pytest.mark.parametrize(
    ("name", "worse"),
    [
        ("contrast", 0.5),
        ("unclear", 1.0),
        ("fullness", 0.5),
        ("slender", 1.2),
        ("hue", 1.0),
        ("alternative", 1.0),
        ("ragged", 1.0),
        ("cut", 1.0),
    ],
)
def test_each_entry_counts_the_right_way(name: str, worse: float) -> None:
    assert probability_of(CLEAR._replace(**{name: worse})) < probability_of(CLEAR)


def test_an_outline_makes_up_for_a_contrast_that_is_not_clear() -> None:
    pale = CLEAR._replace(contrast=math.log(2.5), unclear=1.0, fullness=0.92, slender=0.25)
    assert probability_of(pale._replace(outlined=0.7)) > 0.99 > 0.9 > probability_of(pale)


def test_the_probability_is_bounded_whatever_the_evidence() -> None:
    for far in (-1e6, 1e6):
        assert 0.0 <= probability_of(Evidence(*[far] * len(WEIGHTS))) <= 1.0


def test_the_hue_is_that_of_opencv() -> None:
    rng = np.random.default_rng(0)
    for light in rng.uniform(0.0, 1.0, (200, 3)):
        expected = hsv(light)
        assert _hue(*light.tolist()) == pytest.approx(float(expected[0]), abs=1e-6)
    assert _hue(0.3, 0.3, 0.3) == 0.0


def test_another_light_does_not_change_what_the_colour_says() -> None:
    detector = MarkerDetector(camera(), NAMES)
    image = render([Disc(marker_hsv(1), 300.0, 240.0, 12.0)])
    blob = detector._scanner.whole(image, detector.table).blobs[1][0]
    (seen,) = detector._engine.measure(image, detector.table, [detector.table.bits[1]], [blob], [True])
    assert seen is not None
    gains = (0.7, 1.0, 1.3)
    warm = seen._replace(colour=[c * g for c, g in zip(seen.colour, gains, strict=True)])
    plain = evidence_of(seen, (1.0, 1.0, 1.0), RANGES["index"], 0.0, False)
    assert evidence_of(warm, gains, RANGES["index"], 0.0, False) == pytest.approx(plain)
    assert plain.hue < 0.1
    assert 0.0 < clarity_of(seen, 4.0 * seen.area) < 0.6 < clarity_of(seen, seen.area) <= 1.0


def test_a_bare_hand_has_few_likely_markers(root: Path, datasets: Path) -> None:
    own = load(root / "calib_json/cameras/left.json", CameraCalibration)
    files = sorted((datasets / "real_bare_hand").glob("*.jpg"))[::8]
    assert files
    table = MarkerDetector(own, SIX).table
    likely = 0
    for file in files:
        image = np.asarray(cv2.imread(str(file)), np.uint8)
        here = camera(image.shape[1], image.shape[0], own.markers)
        likely += int((MarkerDetector(here, SIX, table=table).push(image, 0).quality > 0.5).sum())
    assert likely <= 0.2 * len(files)


def test_a_tracked_marker_keeps_its_quality_and_a_rival_near_it_lowers_it() -> None:
    detector = MarkerDetector(camera(), NAMES)
    alone = render([Disc(marker_hsv(1), 300.0, 240.0, 12.0)])
    both = render([Disc(marker_hsv(1), 300.0, 240.0, 12.0), Disc(marker_hsv(1), 345.0, 240.0, 12.0)])
    qualities = [
        float(detector.push(image, k * 16_666_667).quality[1]) for k, image in enumerate([alone] * 8 + [both])
    ]
    assert min(qualities[:8]) > 0.9
    assert qualities[8] < qualities[7] - 0.01
