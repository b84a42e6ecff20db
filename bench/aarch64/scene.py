"""Renders, on the host and uncounted, what is counted on: marked hands, and a curl before a wrist device."""

from pathlib import Path

import cv2
import msgspec
import numpy as np

from bench.aarch64.frames import SIX, TWELVE, WRIST, MarkedFrames, StrobedFrames, write, write_strobed
from bench.report import rig_files
from common.arrays import Image
from common.calibration import HsvRange
from common.sim.render import Renderer
from common.sim.scene import Scene
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import WristScene
from slave.cameras.synthetic import STROBE

OPEN_S = 20.0  # an open hand: all six markers in view
COUNT = 11  # forth and back a period of twenty frames
CURL = "curl"


def rendered() -> dict[str, MarkedFrames]:
    """The sets SIX and TWELVE, from the standard scene and the rig `desk`."""
    rig, cameras, hand = rig_files("desk")
    name = rig.cameras[0]
    renderer = Renderer(Scene.standard(rig, cameras, hand), name)
    images = [renderer.render(OPEN_S + 1.0 / 60.0 * k) for k in range(COUNT)]
    six = MarkedFrames(cameras[name], rig.markers, images)
    return {SIX: six, TWELVE: with_second_hand(six)}


def strobed() -> StrobedFrames:
    """Triples of a curl before the wrist device of the rig `wrist`."""
    rig, cameras, hand = rig_files("wrist")
    name = rig.cameras[0]
    camera = cameras[name]
    renderer = WristRenderer(WristScene.by_name(CURL, rig, cameras, hand, 7), name)
    curl_s = 0.5  # begins where fingers bend
    images = [renderer.render(curl_s + k / camera.frame_rate_hz, STROBE[k % 3]) for k in range(3 * COUNT)]
    return StrobedFrames(rig, camera, hand, images)


def write_all(folder: Path) -> None:
    """Write every set to a folder of its name in `folder`."""
    for name, marked in rendered().items():
        write(folder / name, marked)
    write_strobed(folder / WRIST, strobed())


def with_second_hand(six: MarkedFrames) -> MarkedFrames:
    """Twice the markers: the same hues, brighter, as caps on skin in a row on the other side of the picture."""
    ranges: dict[str, HsvRange] = dict(six.camera.markers or {})
    second: dict[str, tuple[int, int, int]] = {}
    for name in six.names:
        low, high = ranges[name].hsv_low, ranges[name].hsv_high
        hue = (low[0] + high[0]) // 2 if low[0] <= high[0] else 0
        second[f"{name}2"] = (hue, 200, 250)
        second_value = 236  # HSV value from which a colour is the second hand's
        first_high = (high[0], 255, second_value - 1)
        second_low = (low[0], low[1], second_value)
        ranges[f"{name}2"] = msgspec.structs.replace(ranges[name], hsv_low=second_low, hsv_high=high)
        ranges[name] = msgspec.structs.replace(ranges[name], hsv_high=first_high)
    camera = msgspec.structs.replace(six.camera, markers=ranges)
    images = [_painted(image, list(second.values())) for image in six.images]
    return MarkedFrames(camera, (*six.names, *second), images)


def _painted(image: Image, colours: list[tuple[int, int, int]]) -> Image:
    image = image.copy()
    for k, hsv in enumerate(colours):
        pixel = np.asarray(cv2.cvtColor(np.array([[hsv]], np.uint8), cv2.COLOR_HSV2BGR))[0, 0]
        u, v = 60 + 28 * k, 60 + 11 * (k % 2)
        cv2.circle(image, (u, v + 14), 12, (140, 165, 215), -1, cv2.LINE_AA)  # skin
        cv2.circle(image, (u, v), 8, [int(c) for c in pixel], -1, cv2.LINE_AA)
    return image
