"""Colours of a hand, the same in the viewer and in the picture.

Okabe & Ito, 2008: safe for colour-blind eyes.
"""

import numpy as np
import numpy.typing as npt

from common.messages import Source

Rgb = tuple[int, int, int]

SOURCE_RGB: dict[Source, Rgb] = {
    Source.NONE: (130, 130, 130),
    Source.MEASURED: (0, 158, 115),
    Source.SOLVED: (86, 180, 233),
    Source.HELD: (230, 159, 0),
    Source.WRIST: (204, 121, 167),
}
SOURCE_MEANING: dict[Source, str] = {
    Source.NONE: "no pose",
    Source.MEASURED: "measured by a marker",
    Source.SOLVED: "solved from markers",
    Source.HELD: "held (lost from sight)",
    Source.WRIST: "from the wrist device",
}
TRUTH_RGB: Rgb = (170, 170, 178)
LIMIT_RGB: Rgb = (213, 60, 40)
RAY_RGB: Rgb = (240, 228, 66)
TOUCH_RGB: dict[bool, Rgb] = {False: (240, 228, 66), True: (213, 60, 40)}  # whether a finger touches
GESTURE_RGB: dict[str, Rgb] = {
    "pose": (235, 235, 240),
    "pinch": (204, 121, 167),
    "dial": (240, 228, 66),
    "tap": (230, 159, 0),
    "point": (86, 180, 233),
}
_SERIES: tuple[Rgb, ...] = (
    (230, 159, 0),
    (86, 180, 233),
    (0, 158, 115),
    (240, 228, 66),
    (204, 121, 167),
    (213, 94, 0),
)


def series_rgb(index: int) -> Rgb:
    """Colour of finger or marker number `index`; after six they repeat."""
    return _SERIES[index % len(_SERIES)]


def pack(colours: list[Rgb], alpha: int = 255) -> npt.NDArray[np.uint32]:
    """Colours as Rerun stores them, 0xRRGGBBAA."""
    rgb = np.array(colours, np.uint32).reshape(-1, 3)
    return ((rgb[:, 0] << 24) | (rgb[:, 1] << 16) | (rgb[:, 2] << 8) | alpha).astype(np.uint32)


def dim(colours: npt.NDArray[np.uint32]) -> npt.NDArray[np.uint32]:
    """Half as bright: each byte is halved, the alpha stays whole."""
    return (((colours >> 1) & 0x7F7F7F00) | 0xFF).astype(np.uint32)
