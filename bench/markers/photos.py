"""Photographs without markers, and the same with markers drawn into them.

Whatever is found in a photograph without markers is false. Any will do: `PHALANX_PHOTOS` names a folder with one folder
of pictures per source. The hand before the desk of the data sets is one source more.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from bench.markers.frames import expose
from bench.markers.kinds import KINDS, Kind
from bench.markers.scene import make_scene
from bench.report import datasets
from common.arrays import Float, Image
from common.geometry.srgb import gain_tables
from common.sim.light import to_linear

WIDTH: Final = 640  # px, to which a photograph is scaled
BARE_EVERY: Final = 4  # of the pairs of a bare hand, which differ little
COVERED: Final = 0.3  # share of the caps that something covers,
HIDDEN: Final = 0.4  # and of such a cap, at most
CUT: Final = 0.15  # share of the pictures that begin in a cap
PAINTED: Final = ("finger_end", "base", "noise", "blur3")  # kinds whose caps are drawn


@dataclass(frozen=True, slots=True, eq=False)
class Photo:
    """A photograph (H, W, 3) BGR without paint, and the set that it is from."""

    source: str
    image: Image


@dataclass(frozen=True, slots=True, eq=False)
class Painted:
    """A photograph with caps.

    Attributes:
        kind: Whose caps they are; its camera finds them.
        image: (H, W, 3) BGR.
        uv: (M, 2) centroids [px]; NaN: not drawn.
        radius: (M,) [px].
    """

    kind: Kind
    image: Image
    uv: Float
    radius: Float


def photos() -> list[Photo]:
    """The photographs at hand, in a fixed order; none where there are no folders."""
    found: list[Photo] = []
    if root := os.environ.get("PHALANX_PHOTOS"):
        for folder in sorted(path for path in Path(root).iterdir() if path.is_dir()):
            found += _read(folder.name, sorted(folder.iterdir()))
    return found + _read("bare_hand", sorted((datasets() / "real_bare_hand").glob("*.jpg"))[::BARE_EVERY])


def _read(source: str, files: list[Path]) -> list[Photo]:
    found: list[Photo] = []
    for file in files:
        image = cv2.imread(str(file))
        if image is not None:
            scale = WIDTH / image.shape[1]
            small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            found.append(Photo(source, np.ascontiguousarray(small, np.uint8)))
    return found


def painted(photo: Photo, rng: np.random.Generator) -> Painted:
    """Some of the caps of a generated hand on a photograph in place of a table."""
    height, width = photo.image.shape[:2]
    kind = replace(KINDS[PAINTED[rng.integers(len(PAINTED))]], size=(width, height))
    scene = make_scene(kind, rng)
    table = to_linear(photo.image[..., ::-1] / 255.0).astype(np.float32) / np.float32(scene.brightness)
    shown: list[int] = rng.permutation(len(scene.caps))[: rng.integers(1, len(scene.caps) + 1)].tolist()
    caps = [
        replace(cap, occluder=replace(occluder, share=rng.uniform(0.1, HIDDEN)))
        if rng.random() < COVERED
        else cap
        for cap, occluder in zip(scene.caps, scene.occluders, strict=True)
    ]
    light = replace(scene, table=table).light(tuple(caps[m] for m in shown))
    image = expose(light, kind.noise, rng)
    uv = np.full((len(caps), 2), np.nan)
    uv[shown] = [caps[m].visible[:2] for m in shown]
    radius = np.array([np.sqrt(cap.a * cap.b) for cap in caps])
    if rng.random() < CUT:
        first = round(float(uv[shown[0], 0] + 0.5 * radius[shown[0]] * rng.uniform(-1.0, 1.0)))
        first = min(max(first, 0), 3 * width // 4)
        image, uv = np.ascontiguousarray(image[:, first:]), uv - (first, 0.0)
        kind = replace(kind, size=(width - first, height))
    return Painted(kind, image, uv, radius)


def as_by_another_camera(image: Image, rng: np.random.Generator) -> Image:
    """The picture under another exposure and white balance, with some haze, now and then as JPEG."""
    gains = np.exp(rng.normal(0.0, (0.08, 0.02, 0.08)) + rng.normal(0.0, 0.15))
    image = np.asarray(cv2.LUT(image, gain_tables(gains).T[None]), np.uint8)
    haze = rng.uniform(0.0, 0.15)
    image = np.asarray(cv2.addWeighted(image, 1.0 - haze, np.full_like(image, 160), haze, 0.0), np.uint8)
    if rng.random() < 0.5:
        data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(70, 96))])[1]
        image = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)
    return np.ascontiguousarray(image)


def halves(image: Image) -> Iterator[Image]:
    """Four overlapping parts of a picture, each scaled to its size: the same things, larger."""
    height, width = image.shape[:2]
    for v in (0, height // 3):
        for u in (0, width // 3):
            part = image[v : v + 2 * height // 3, u : u + 2 * width // 3]
            yield np.ascontiguousarray(
                cv2.resize(part, (width, height), interpolation=cv2.INTER_CUBIC), np.uint8
            )
