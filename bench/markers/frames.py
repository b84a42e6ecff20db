"""Sequences of frames with painted caps and exact truth, from fixed seeds: what marker detectors are measured on.

A sequence is one scene for a few frames: the caps move a little from frame to frame, so that a tracker is in its
normal mode. Then a camera follows: shot and read noise, ten linear bits, sRGB bytes.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bench.markers.cap_image import Cap, Light
from bench.markers.kinds import Kind
from bench.markers.scene import Scene, make_scene
from common.arrays import Float, Image
from common.sim.light import to_srgb

STEP_NS: Final = 16_666_667
FULL_WELL: Final = 6000.0  # electrons at white: shot noise
READ_NOISE: Final = 0.002  # of white: together 1.7 grey levels at mid grey
BITS: Final = 1023
ENCODED: Final = np.rint(255.0 * to_srgb(np.arange(BITS + 1) / BITS)).astype(np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class MarkerFrame:
    """One frame and its truth, M markers in the order of `Kind.names`.

    Attributes:
        image: (H, W, 3) BGR.
        t_ns: Mid-exposure time.
        uv: (M, 2) centroid of the visible paint, mean over the exposure [px].
        whole_uv: (M, 2) centroid of the paint as if nothing hid it [px].
        area: (M,) visible area [px^2].
        visible: (M,) visible share.
        radius: (M,) sqrt(a b) of the whole ellipse [px].
        judged: Whether it counts; frames that only let a tracker learn do not.
    """

    image: Image
    t_ns: int
    uv: Float
    whole_uv: Float
    area: Float
    visible: Float
    radius: Float
    judged: bool


def sequences(kind: Kind, count: int, seed: int = 1) -> Iterator[Iterator[MarkerFrame]]:
    """`count` sequences; the k-th depends on kind, seed and k alone, so a shorter run is a part of a longer one."""
    for k in range(count):
        yield frames_of(kind, generator(kind, k, seed))


def generator(kind: Kind, k: int, seed: int = 1) -> np.random.Generator:
    """The generator from which the k-th sequence is drawn."""
    return np.random.default_rng([seed, k, *kind.name.encode()])


def frames_of(kind: Kind, rng: np.random.Generator) -> Iterator[MarkerFrame]:
    """The frames of one sequence."""
    scene = make_scene(kind, rng)
    caps = scene.caps
    for k in range(kind.whole_frames + kind.frames):
        if k > 0:
            steps = scene.velocity + rng.normal(0.0, scene.wander_px, (len(caps), 2))
            caps = tuple(cap.moved(du, dv) for cap, (du, dv) in zip(caps, steps.tolist(), strict=True))
        judged = k >= kind.whole_frames
        shown = caps
        if judged and kind.hidden:
            shown = tuple(replace(c, occluder=o) for c, o in zip(caps, scene.occluders, strict=True))
        yield frame_of(scene, shown, k, rng, judged=judged)


def frame_of(
    scene: Scene, caps: tuple[Cap, ...], k: int, rng: np.random.Generator, *, judged: bool = True
) -> MarkerFrame:
    """The k-th frame of a scene, its caps as given, and the truth of the scene's own caps."""
    seen = np.array([cap.visible for cap in caps])
    return MarkerFrame(
        image=expose(scene.light(caps), scene.kind.noise, rng),
        t_ns=k * STEP_NS,
        uv=seen[:, :2],
        whole_uv=np.array([cap.whole for cap in caps]),
        area=seen[:, 2],
        visible=np.array([1.0 - c.occluder.share if c.occluder else 1.0 for c in caps]),
        radius=np.array([math.sqrt(cap.a * cap.b) for cap in caps]),
        judged=judged,
    )


def variance(light: Light, noise: float) -> Light:
    """Variance of the sensor's noise at each level of linear light."""
    return np.float32(noise**2) * (light / np.float32(FULL_WELL) + np.float32(READ_NOISE**2))


def expose(light: Light, noise: float, rng: np.random.Generator) -> Image:
    """What the camera delivers for linear light (H, W, 3) RGB: noise, ten linear bits, sRGB bytes, BGR."""
    signal = light + np.sqrt(variance(light, noise)) * rng.standard_normal(light.shape, np.float32)
    codes = np.clip(signal * np.float32(BITS) + np.float32(0.5), 0, BITS).astype(np.uint16)
    return np.ascontiguousarray(ENCODED[codes[..., ::-1]])
