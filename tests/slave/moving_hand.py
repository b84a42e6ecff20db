"""Frames of a moving, painted hand for the tests of automatic colours, and what may be wrong with them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np

from common.arrays import Bool, Float, Image
from common.calibration import CameraCalibration, HandProfile, HsvRange, RigCalibration, load
from common.geometry.srgb import gain_tables
from common.sim.light import desk_image
from common.sim.render import Renderer
from common.sim.scene import DESK_DEPTH_M, Scene
from slave.markers.classify import in_range

TREE = Path(__file__).resolve().parents[2] / "calib_json"
RIG = load(TREE / "rigs/desk.json", RigCalibration)
NAMES = RIG.markers
CAMERAS = {name: load(TREE / f"cameras/{name}.json", CameraCalibration) for name in RIG.cameras}
HANDS = {side: load(TREE / f"hands/default-{side}.json", HandProfile) for side in ("left", "right")}

MUG, MUG_PX = (500, 160), 38  # beside the hand's way
LID, LID_PX = (260, 120), 12  # in its way
GREEN, BLUE = (75, 140, 25), (150, 60, 30)  # BGR, as green and blue as the paints


@dataclass(frozen=True)
class Moving:
    """Frames of one camera with their truth.

    `uv` (F, M, 2) and `visible` (F, M) of the markers; `desk` is the picture without a hand.
    """

    images: list[Image]
    uv: Float
    visible: Float
    area: Float
    desk: Image


Change: TypeAlias = Callable[[Moving], Moving]


def scene(seed: int) -> Scene:
    return Scene.standard(RIG, CAMERAS, HANDS["right"], seed)


@cache
def moving(seed: int, camera: str, times: tuple[float, ...]) -> Moving:
    world = scene(seed)
    renderer = Renderer(world, camera)
    pairs = [renderer.observe(t) for t in times]
    return Moving(
        [image for image, _ in pairs],
        np.array([view.uv for _, view in pairs]),
        np.array([view.visible for _, view in pairs]),
        np.array([view.area for _, view in pairs]),
        desk_image(world.optics[camera], DESK_DEPTH_M, seed),
    )


def seconds(start_s: float, length_s: float = 5.0, frames: int = 30) -> tuple[float, ...]:
    return tuple(np.linspace(start_s, start_s + length_s, frames).tolist())


def each(change: Callable[[Image, int], Image], frames: Moving) -> Moving:
    images = [change(image, k) for k, image in enumerate(frames.images)]
    return Moving(images, frames.uv, frames.visible, frames.area, frames.desk)


def bare(image: Image, desk: Image) -> Bool:
    """Where the desk is seen."""
    near = np.asarray(cv2.absdiff(image, desk)).max(axis=2) < 14
    opened = cv2.morphologyEx(near.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return np.asarray(cv2.morphologyEx(opened, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) != 0)


def cluttered(frames: Moving) -> Moving:
    """A green mug and a lid, and a blue pen, on the desk: the hand hides them where it passes."""

    def change(image: Image, k: int) -> Image:
        things = image.copy()
        cv2.circle(things, MUG, MUG_PX, GREEN, -1)
        cv2.circle(things, LID, LID_PX, GREEN, -1)
        cv2.line(things, (120, 300), (180, 360), BLUE, 7)
        here = bare(image, frames.desk) & (things != image).any(axis=2)
        noise = np.random.default_rng(k).normal(0.0, 1.7, image.shape)
        grainy = np.clip(np.round(things + noise), 0, 255).astype(np.uint8)
        return np.where(here[..., None], grainy, image)

    return each(change, frames)


def white_balanced(*gains: float) -> Change:
    """Another white balance or exposure: linear light times gains of blue, green, red."""
    tables = gain_tables(gains)

    def change(image: Image, _k: int) -> Image:
        return np.stack([tables[c][image[..., c]] for c in range(3)], axis=-1)

    return lambda frames: each(change, frames)


def noisy(sigma: float) -> Change:
    def change(image: Image, k: int) -> Image:
        noise = np.random.default_rng([k, 5]).normal(0.0, sigma, image.shape)
        return np.clip(np.round(image + noise), 0, 255).astype(np.uint8)

    return lambda frames: each(change, frames)


def on_wood(frames: Moving) -> Moving:
    """A desk of the colour of skin."""
    tint = np.array((70, 110, 160)) / frames.desk.reshape(-1, 3).mean(axis=0)

    def change(image: Image, _k: int) -> Image:
        tinted = np.clip(image * tint, 0, 255).astype(np.uint8)
        return np.where(bare(image, frames.desk)[..., None], tinted, image)

    return each(change, frames)


def repainted(marker: str, hue: int) -> Change:
    """One marker in another hue."""
    colour = (CAMERAS["left"].markers or {})[marker]

    def change(image: Image, _k: int) -> Image:
        hsv = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2HSV), dtype=np.uint8)
        hsv[in_range(hsv, colour), 0] = hue
        return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR), dtype=np.uint8)

    return lambda frames: each(change, frames)


def with_watch(frames: Moving) -> Moving:
    """An orange-red strap below the back of the hand would be skin; this one is lilac."""
    lilac = np.asarray(cv2.cvtColor(np.array([[(126, 200, 180)]], np.uint8), cv2.COLOR_HSV2BGR))[0, 0]

    def change(image: Image, k: int) -> Image:
        faded = image.copy()
        u, v = np.round(frames.uv[k, NAMES.index("back")]).astype(int)
        cv2.rectangle(faded, (u - 9, v + 38), (u + 9, v + 48), [int(c) for c in lilac], -1)
        return faded

    return each(change, frames)


def mirrored(frames: Moving) -> Moving:
    return each(lambda image, _k: np.ascontiguousarray(image[:, ::-1]), frames)


def own_and_foreign(frames: Moving, ranges: Mapping[str, HsvRange]) -> tuple[float, float]:
    """Share of well visible markers whose centre is in their range, and in that of another one."""
    own: list[bool] = []
    foreign: list[bool] = []
    for k, image in enumerate(frames.images):
        for m, name in enumerate(NAMES):
            if frames.visible[k, m] < 0.8 or frames.area[k, m] < 60:
                continue
            u, v = np.round(frames.uv[k, m]).astype(int)
            patch = np.asarray(cv2.cvtColor(image[v : v + 1, u : u + 1], cv2.COLOR_BGR2HSV), dtype=np.uint8)
            inside = {n: bool(in_range(patch, r)[0, 0]) for n, r in ranges.items()}
            own.append(inside.pop(name))
            foreign.append(any(inside.values()))
    return float(np.mean(own)), float(np.mean(foreign))
