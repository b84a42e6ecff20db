"""The kinds of frames on which marker detectors are measured, their marker colours and camera files.

HSV ranges follow the rule of a person who calibrates with care: hue half-way to the neighbours and to skin, saturation
down to that of a half covered pixel, value down to the shadow side. It is fixed here, so that a change of the colour
calibration does not move the scale on which detectors are measured.
"""

import colorsys
from dataclasses import dataclass
from typing import Final

import cv2
import msgspec
import numpy as np

from bench.markers.cap_image import Rgb
from common.calibration import CameraCalibration, HsvRange
from common.sim.light import MARKER_LINEAR_RGB, bgr_bytes, to_linear

MORE_HUES: Final = (30, 55, 80, 102, 124, 150)  # between those of the six
MANY: Final = 24
MANY_HUES: Final = (27.0, 168.0)  # evenly from yellow to red, skin in the gap
SKIN_HUE: Final = 11
HUE_MARGIN: Final = 14
SATURATION_SHARE, SATURATION_LEAST = 0.45, 50
VALUE_SHARE, VALUE_LEAST = 0.3, 25


def paints(count: int) -> dict[str, Rgb]:
    """Marker -> linear RGB reflectance.

    Raises:
        ValueError: Not 6, 12 or 24 markers.
    """
    if count == 6:
        return dict(MARKER_LINEAR_RGB)
    if count == 12:
        return dict(MARKER_LINEAR_RGB) | {f"hue_{h}": _of_hsv(h, 0.8, 0.72) for h in MORE_HUES}
    if count == MANY:
        return {f"hue_{h:.0f}": _of_hsv(h, 0.85, 0.75) for h in np.linspace(*MANY_HUES, MANY)}
    raise ValueError(f"{count} paints: there are sets of 6, 12 and {MANY}")


def camera_file(count: int, size: tuple[int, int]) -> CameraCalibration:
    """The camera of `size` (width, height) [px] with the ranges of `count` markers."""
    named = paints(count)
    hsv = {name: _hsv(colour) for name, colour in named.items()}
    return CameraCalibration(
        version=1,
        name=f"bench{count}",
        width_px=size[0],
        height_px=size[1],
        frame_rate_hz=60.0,
        exposure_us=5000.0,
        analogue_gain=1.0,
        colour_gains=(1.0, 1.0),
        row_time_us=20.0,
        markers={
            name: _range(own, [h for other, (h, _, _) in hsv.items() if other != name])
            for name, own in hsv.items()
        },
    )


def _range(own: tuple[int, int, int], others: list[int]) -> HsvRange:
    hue, saturation, value = own
    obstacles = [*others, SKIN_HUE]
    below = min(((hue - h) % 180) / 2.0 for h in obstacles)
    above = min(((h - hue) % 180) / 2.0 for h in obstacles)
    low = (hue - int(min(HUE_MARGIN, below - 0.5))) % 180
    high = (hue + int(min(HUE_MARGIN, above - 0.5))) % 180
    least = round(max(SATURATION_LEAST, SATURATION_SHARE * saturation))
    dark = round(max(VALUE_LEAST, VALUE_SHARE * value))
    return HsvRange(hsv_low=(low, least, dark), hsv_high=(high, 255, 255))


def _hsv(colour: Rgb) -> tuple[int, int, int]:
    pixel = np.array([[bgr_bytes(np.array(colour))]], np.uint8)
    h, s, v = (int(c) for c in np.asarray(cv2.cvtColor(pixel, cv2.COLOR_BGR2HSV))[0, 0])
    return h, s, v


def _of_hsv(hue: float, saturation: float, value: float) -> Rgb:
    r, g, b = to_linear(np.array(colorsys.hsv_to_rgb(hue / 180.0, saturation, value)))
    return float(r), float(g), float(b)


@dataclass(frozen=True, slots=True)
class Kind:
    """What the frames of one kind show; lengths are for 640 px of image width and scale with it.

    Attributes:
        name: Its name.
        finger: Caps at finger ends with a highlight; else matt ones on skin, on its edge, on the bare table.
        clicked: A user has said which blob is which marker in the first frame: a cap on a bare table looks
            like any object of its colour.
        blur_px: Way during the exposure.
        hidden: Share of the paint that an edge hides, in the frames after `whole_frames`.
        noise: Times the usual noise.
        objects: Things of the markers' colours on the table: mugs and pens.
        count: Markers.
        size: Width, height [px].
        whole_frames: Frames before those that are judged.
        frames: Judged frames of one sequence.
    """

    name: str
    finger: bool = True
    clicked: bool = False
    blur_px: float = 0.0
    hidden: float = 0.0
    noise: float = 1.0
    objects: int = 0
    count: int = 6
    size: tuple[int, int] = (640, 480)
    whole_frames: int = 0
    frames: int = 4

    @property
    def camera(self) -> CameraCalibration:
        """The camera file of these frames."""
        still = camera_file(self.count, self.size)
        # Blurred caps move by the way of one frame: such a camera exposes from frame to frame.
        return (
            msgspec.structs.replace(still, exposure_us=1e6 / still.frame_rate_hz) if self.blur_px else still
        )

    @property
    def names(self) -> tuple[str, ...]:
        """The markers, in the order of every array."""
        return tuple(paints(self.count))

    @property
    def scale(self) -> float:
        """Of all lengths."""
        return self.size[0] / 640.0


KINDS: Final = {
    kind.name: kind
    for kind in (
        Kind("base", finger=False, clicked=True),
        Kind("finger_end"),
        Kind("blur3", blur_px=3.0),
        Kind("blur6", blur_px=6.0),
        Kind("occluded15", hidden=0.15, whole_frames=6, frames=2),
        Kind("noise", finger=False, clicked=True, noise=2.0),
        Kind("clutter", objects=3),
        Kind("twelve", count=12),
        Kind("twentyfour", count=24),
        Kind("320x240", size=(320, 240)),
        Kind("1280x960", size=(1280, 960)),
        Kind("1456x1088", size=(1456, 1088)),
    )
}
