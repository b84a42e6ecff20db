"""What `Health` reports of the camera file in use.

Size, a number for the colours of each marker, and ranges that overlap.
"""

from itertools import combinations
from zlib import crc32

import msgspec

from common.calibration import CameraCalibration, HsvRange

_NAME = 64  # characters of a name in `Health`


def in_use(camera: CameraCalibration, markers: tuple[str, ...]) -> dict[str, float]:
    """Return metrics of the camera file in use.

    width_px, height_px; colour.<marker>, another number for another range; overlap.<one>..<other> [hues].

    Args:
        camera: The content in use.
        markers: Those of the rig; what the file knows of others does not matter here.
    """
    ranges = {name: colour for name in markers if (colour := (camera.markers or {}).get(name)) is not None}
    found = {"width_px": float(camera.width_px), "height_px": float(camera.height_px)}
    found |= {f"colour.{name}"[:_NAME]: _number(colour) for name, colour in ranges.items()}
    for (one, first), (other, second) in combinations(ranges.items(), 2):
        if hues := overlap(first, second):
            found[f"overlap.{one}..{other}"[:_NAME]] = float(hues)
    return found


def overlap(one: HsvRange, other: HsvRange) -> int:
    """Return how many hues two colour ranges share.

    0 where their saturations or values have none in common.
    """
    for axis in (1, 2):
        if one.hsv_low[axis] > other.hsv_high[axis] or other.hsv_low[axis] > one.hsv_high[axis]:
            return 0
    return len(_hues(one) & _hues(other))


def _hues(colour: HsvRange) -> set[int]:
    """The hues of a range, which may wrap through 0."""
    low, high = colour.hsv_low[0], colour.hsv_high[0]
    hues = 180
    return {hue % hues for hue in range(low, high + 1 + (hues if high < low else 0))}


def _number(colour: HsvRange) -> float:
    return float(crc32(msgspec.json.encode((colour.hsv_low, colour.hsv_high))))
