"""Whether the laser and the LED frames of a recording were seen through one lens.

Those of a camera were. A rendered recording may join passes of two renderers, of which one takes the principal point on
the wrong side of the image's middle: the light of the LEDs then lies beside that of the laser by twice the distance of
the two, and every place found in it is off by as much. The laser's line ends at the sides of each finger, where the
LEDs show its outline: so what is left between the two is measured, across, for the frames as they are and moved back by
what a mirrored principal point does. For recordings alone: a camera cannot have it, and a hand in motion can look
like it for a moment.
"""

from collections.abc import Iterable

import cv2
import numpy as np

from common.arrays import Float, Image
from common.camera_model import CameraModel
from slave.wrist.background import lit
from slave.wrist.strobe import Triple

_LIT = 40  # grey levels of the laser's line
_OVER_HIGH = 1.5  # a line across a finger is wider than high
_NARROWEST_PX = 16
_INWARD, _OUTWARD = 10, 26  # px along a row, from the end of a line, in which the outline is sought
_PLATEAU = 6  # px inside the finger, which tell how bright it is
_DIMMEST = 8.0
_ENDS = 8  # of each side, to know the shift
_LEAST_PX = 2.0  # a shift below this cannot be told from the blur of the line's ends, and does no harm
_LEFT = 0.4  # share of that shift which may be left where it is believed


def led_shift(triples: Iterable[Triple], optics: CameraModel) -> Float:
    """By how much (2,) [px] the LED frames show the hand beside where the laser frames do; zeros: they agree.

    Args:
        triples: Of one recording; at rest or not.
        optics: The camera.
    """
    middle = 0.5 * np.array([optics.width_px - 1.0, optics.height_px - 1.0])
    mirrored = -2.0 * (optics.matrix[:2, 2] - middle)
    if abs(mirrored[0]) < _LEAST_PX:
        return np.zeros(2)
    kept = list(triples)
    as_it_is, moved_back = _across(kept, np.zeros(2)), _across(kept, -mirrored)
    if moved_back is None or abs(moved_back) > _LEFT * abs(mirrored[0]):
        return np.zeros(2)
    return mirrored if as_it_is is None or abs(moved_back) < abs(as_it_is) else np.zeros(2)


def shifted(image: Image, by_px: Float) -> Image:
    """The image (H, W) moved by (2,) [px]; what comes in is black."""
    if not by_px.any():
        return image
    matrix = np.array([[1.0, 0.0, by_px[0]], [0.0, 1.0, by_px[1]]])
    height, width = image.shape
    return np.asarray(cv2.warpAffine(image, matrix, (width, height), flags=cv2.INTER_LINEAR), np.uint8)


def _across(triples: list[Triple], by_px: Float) -> float | None:
    """How much farther right than the lines the outlines are [px], the LED frames moved by (2,); None: not known."""
    found = [end for triple in triples for end in _ends(triple, by_px)]
    left, right = ([off for side, off in found if side == which] for which in (-1, 1))
    if min(len(left), len(right)) < _ENDS:
        return None
    # How far inside the outline a line ends is the same on both sides, and cancels.
    return 0.5 * (float(np.median(left)) + float(np.median(right)))


def _ends(triple: Triple, by_px: Float) -> list[tuple[int, float]]:
    """For each end of a line on a finger its side, -1 left or 1 right, and how much farther right the outline is."""
    ambient = triple.ambient.image
    line = (lit(triple.laser.image, ambient) > _LIT).astype(np.uint8)
    led = shifted(lit(triple.led.image, ambient), by_px)
    led = cv2.GaussianBlur(led, (0, 0), 1.0).astype(np.float64)
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(line, connectivity=8)
    found: list[tuple[int, float]] = []
    for label, (x, y, width, height, _) in enumerate(boxes.tolist()):
        if label == 0 or width < _NARROWEST_PX or width < _OVER_HIGH * height:
            continue
        for side, column in ((-1, x), (1, x + width - 1)):
            rows = np.flatnonzero(labels[y : y + height, column] == label)
            off = _outline(led, column, y + round(float(rows.mean())), side)
            if off is not None:
                found.append((side, side * off))
    return found


def _outline(led: Float, column: int, row: int, side: int) -> float | None:
    """How far outside `column` a finger's outline is [px], on the side -1 or 1 of a row; None: there is none."""
    columns = column + side * np.arange(-_INWARD, _OUTWARD)
    if row < 1 or row > led.shape[0] - 2 or columns.min() < 0 or columns.max() >= led.shape[1]:
        return None
    profile = led[row - 1 : row + 2, columns].mean(axis=0)
    half = 0.5 * float(np.median(profile[:_PLATEAU]))
    below = np.flatnonzero(profile < half)
    if half < _DIMMEST or len(below) == 0 or below[0] == 0:
        return None
    k = int(below[0])
    return k - 1 + float((profile[k - 1] - half) / (profile[k - 1] - profile[k])) - _INWARD
