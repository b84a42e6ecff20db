import math
from pathlib import Path

import cv2
import numpy as np

from slave.markers.colours import calibrate
from slave.markers.detector import MarkerDetector
from tests.slave.painted import camera

# tests/golden/calib_colors_left.md: truth.npz `uv` minus (264, 122)
TRUTH = {
    "thumb": (17.041, 109.726),
    "index": (71.204, 27.767),
    "middle": (102.029, 17.326),
    "ring": (129.523, 33.863),
    "little": (155.400, 66.758),
}
LIMIT_PX = 0.4  # the thumb's cap ends in its own shadow; the other four stay below 0.25


def test_colours_and_centroids_of_a_rendered_hand(root: Path) -> None:
    image = cv2.imread(str(root / "tests/golden/calib_colors_left.png"))
    assert image is not None
    image = np.asarray(image, dtype=np.uint8)
    rows = calibrate(image, TRUTH)
    assert all(row.own > 0.99 and not row.others and row.skin == 0.0 for row in rows)
    height, width = image.shape[:2]
    detector = MarkerDetector(camera(width, height, {row.name: row.range for row in rows}), tuple(TRUTH))
    found = detector.push(image, 0)
    errors = {n: math.hypot(*(found.uv[i] - uv)) for i, (n, uv) in enumerate(TRUTH.items())}
    assert errors["thumb"] < LIMIT_PX
    assert max(e for n, e in errors.items() if n != "thumb") < 0.25
