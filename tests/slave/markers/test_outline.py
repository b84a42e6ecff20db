"""The outline of a round marker of which the colour is a part, on drawn balls with exact centres and on a real one."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from common.arrays import Image
from common.calibration import HsvRange
from slave.markers.colours import calibrate
from slave.markers.detector import Detections, MarkerDetector
from slave.markers.outline import outline_of
from tests.slave.painted import camera

GREEN = HsvRange(hsv_low=(50, 70, 25), hsv_high=(70, 255, 255))
SIZE = (240, 200)
LENS_PX = 0.6
FINE = 4  # sub-pixels along each side of a pixel


def ball(u: float, v: float, radius: float, *, finger: bool = False, pale: bool = True) -> Image:
    """A green ball before a grey wall, its top pale; perhaps a finger before its right side."""
    x, y = np.meshgrid(*((np.arange(FINE * n) + 0.5) / FINE - 0.5 for n in SIZE))
    picture = np.full((*x.shape, 3), (128.0, 130.0, 134.0))
    inside = np.hypot(x - u, y - v) <= radius
    white = np.clip(-(y - v) / radius - 0.1, 0.0, 1.0)[..., None] * (1.0 if pale else 0.0)
    paint = np.array((55.0, 95.0, 50.0)) * (1.0 - white) + np.array((160.0, 172.0, 158.0)) * white
    picture[inside] = paint[inside]
    if finger:
        picture[np.hypot((x - u - 1.1 * radius) / 2.0, y - v) <= 0.35 * radius] = (60.0, 80.0, 130.0)
    small = cv2.GaussianBlur(cv2.resize(picture, SIZE, interpolation=cv2.INTER_AREA), (0, 0), LENS_PX)
    noise = np.random.default_rng(1).normal(0.0, 1.5, small.shape)
    return np.clip(np.rint(small + noise), 0, 255).astype(np.uint8)


def found_of(image: Image) -> Detections:
    return MarkerDetector(camera(*SIZE, {"ball": GREEN}), ("ball",)).push(image, 0)


@pytest.mark.parametrize("radius", [18.0, 30.0, 45.0])
@pytest.mark.parametrize("finger", [False, True])
def test_a_ball_with_a_pale_top_is_where_its_outline_is(radius: float, finger: bool) -> None:
    found = found_of(ball(118.3, 101.6, radius, finger=finger))
    connection_lost = math.hypot(found.uv[0, 0] - 118.3, found.uv[0, 1] - 101.6)
    assert connection_lost < 0.03 * radius
    assert connection_lost < 3.0 * found.sigma_px[0] < 0.3 * radius
    assert found.area[0] == pytest.approx(math.pi * radius**2, rel=0.1)
    assert found.quality[0] > 0.5


def test_a_clear_marker_is_not_sought_an_outline_of() -> None:
    image = ball(118.3, 101.6, 30.0, pale=False)
    detector = MarkerDetector(camera(*SIZE, {"ball": GREEN}), ("ball",))
    found = detector.push(image, 0)
    assert detector.evidence[0].outlined == 0.0
    assert math.hypot(found.uv[0, 0] - 118.3, found.uv[0, 1] - 101.6) < 0.1


def test_a_colour_without_an_outline_has_none_and_says_that_it_may_be_a_part() -> None:
    """A green that fades into the wall in all directions ends nowhere."""
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    share = np.exp(-((x - 120.0) ** 2 + 3.0 * (y - 100.0) ** 2) / 1800.0)[..., None]
    picture = share * (55.0, 95.0, 50.0) + (1.0 - share) * (128.0, 130.0, 134.0)
    picture += np.random.default_rng(2).normal(0.0, 1.5, picture.shape)
    detector = MarkerDetector(camera(*SIZE, {"ball": GREEN}), ("ball",))
    found = detector.push(np.clip(np.rint(picture), 0, 255).astype(np.uint8), 0)
    assert detector.evidence[0].outlined == 0.0
    assert found.sigma_px[0] > 0.3 * math.sqrt(found.area[0] / math.pi)


def test_nothing_measured_has_no_outline() -> None:
    image = ball(118.3, 101.6, 30.0)
    detector = MarkerDetector(camera(*SIZE, {"ball": GREEN}), ("ball",))
    blob = detector._scanner.whole(image, detector.table).blobs[0][0]
    (seen,) = detector._engine.measure(image, detector.table, [1], [blob], [True])
    assert seen is not None
    assert outline_of(image, seen._replace(window=np.zeros_like(seen.window))) is None


def test_a_real_ball_is_within_two_pixels_and_three_sigma_of_circles_marked_by_eye(
    root: Path, datasets: Path
) -> None:
    # tests/golden/real_ball.json: circles on enlarged frames, to about a pixel.
    marked = json.loads((root / "tests/golden/real_ball.json").read_text())["circles_u_v_radius_px"]
    images = {
        name: np.asarray(cv2.imread(str(datasets / f"real_ball/{name}.jpg")), np.uint8) for name in marked
    }
    colour = calibrate(images["0390"], {"ball": (790.0, 482.0)})[0].range
    detector = MarkerDetector(camera(1280, 720, {"ball": colour}), ("ball",))
    errors: list[float] = []
    ratios: list[float] = []
    for k, (name, (u, v, _)) in enumerate(marked.items()):
        found = detector.push(images[name], k * 200_000_000)
        errors.append(math.hypot(found.uv[0, 0] - u, found.uv[0, 1] - v))
        ratios.append(errors[-1] / float(found.sigma_px[0]))
        assert found.quality[0] > 0.5
    assert np.median(errors) < 2.0
    assert np.percentile(ratios, 95) < 3.0
