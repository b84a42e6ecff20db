"""Scenes for marker detectors: caps spread like those of a hand, on skin, over a table, drawn at random once.

Distributions are uniform and physical: radii, aspect, shading, light, highlights, skin, table tops, lens blur. None
of them is fitted to a detector.
"""

import math
from dataclasses import dataclass
from typing import Final, cast

import cv2
import numpy as np

from bench.markers.cap_image import Cap, Highlight, Light, Occluder, Rgb, Support, draw
from bench.markers.kinds import Kind, paints
from common.arrays import Float
from common.sim.light import CARD_LINEAR_RGB, DESK_LINEAR_RGB, SKIN_LINEAR_RGB

RADIUS: Final = (4.0, 12.0)  # px, of caps
LARGEST: Final = {6: 12.0, 12: 8.0, 24: 7.0}  # px, of a hand's typical cap: so that all hands have room
CLEAR: Final = 8.0  # radii between the caps and things on the table
TABLE_TOPS: Final[tuple[Rgb, ...]] = (
    DESK_LINEAR_RGB,
    (0.22, 0.13, 0.07),  # wood
    (0.55, 0.54, 0.50),  # paper
    (0.30, 0.31, 0.33),
    CARD_LINEAR_RGB,
)


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What stays the same during a sequence.

    Attributes:
        kind: Its kind.
        caps: One per marker, at the first frame, without occluders.
        occluders: One per marker.
        table: (H, W, 3) linear light without caps.
        to_light: (3,) unit vector.
        brightness: Of the light.
        lens_px: Standard deviation of the lens blur.
        velocity: (2,) of the hand [px per frame].
        wander_px: Standard deviation of each cap's own step from frame to frame.
    """

    kind: Kind
    caps: tuple[Cap, ...]
    occluders: tuple[Occluder, ...]
    table: Light
    to_light: Float
    brightness: float
    lens_px: float
    velocity: Float
    wander_px: float

    def light(self, caps: tuple[Cap, ...]) -> Light:
        """Linear light (H, W, 3) that a noiseless sensor would count, RGB."""
        light = self.table.copy()
        motion = tuple(self.velocity) if self.kind.blur_px else (0.0, 0.0)
        for cap in caps:
            draw(cap, self.to_light, motion).onto(light)
        light *= np.float32(self.brightness)
        return cast(Light, cv2.GaussianBlur(light, (0, 0), self.lens_px))


def make_scene(kind: Kind, rng: np.random.Generator) -> Scene:
    """Draw everything that a sequence keeps."""
    scale = kind.scale
    tilt, azimuth = rng.uniform(0.0, math.radians(60.0)), rng.uniform(0.0, 2.0 * math.pi)
    to_light = np.array(
        [math.sin(tilt) * math.cos(azimuth), math.sin(tilt) * math.sin(azimuth), math.cos(tilt)]
    )
    heading = rng.uniform(0.0, 2.0 * math.pi)
    speed = kind.blur_px or rng.uniform(0.0, 3.0)
    velocity = scale * speed * np.array([math.cos(heading), math.sin(heading)])
    hands = 1 if kind.count == 6 else 2
    travel = velocity * (kind.whole_frames + kind.frames)
    spots: list[tuple[float, float, float, float]] = []
    for hand in range(hands):
        box = (kind.size[0] * hand / hands, kind.size[0] * (hand + 1) / hands, kind.size[1])
        spots += _hand(rng, kind.count // hands, scale, LARGEST[kind.count], box, travel)
    colours = list(paints(kind.count).values())
    make = _finger_cap if kind.finger else _patch_cap
    caps = tuple(make(rng, *spot, colour) for spot, colour in zip(spots, colours, strict=True))
    occluders = tuple(
        Occluder(
            rng.uniform(0.0, 2.0 * math.pi),
            kind.hidden,
            _times(SKIN_LINEAR_RGB, 0.8) if rng.random() < 0.5 else CARD_LINEAR_RGB,
        )
        for _ in caps
    )
    table = _table(rng, kind.size)
    for _ in range(kind.objects):
        _lay_object(table, rng, caps, scale)
    return Scene(
        kind=kind,
        caps=caps,
        occluders=occluders,
        table=table,
        to_light=to_light,
        brightness=rng.uniform(0.6, 1.2),
        lens_px=rng.uniform(0.4, 0.7),
        velocity=velocity,
        wander_px=0.0 if kind.blur_px else 0.3 * scale,
    )


def _hand(
    rng: np.random.Generator,
    count: int,
    scale: float,
    largest: float,
    box: tuple[float, float, float],
    travel: Float,
) -> list[tuple[float, float, float, float]]:
    """Centre (u, v), radius [px] and direction to the wrist [rad] of the 6 or 12 caps of one hand, spread as a fan.

    Neighbours are 6 to 8 radii apart, so that no cap lies on another's finger.
    """
    size = scale * rng.uniform(RADIUS[0], largest)
    rotation = rng.uniform(0.0, 2.0 * math.pi)
    spread = [(k - 2) * math.radians(30.0) for k in range(5)]
    polar = [(16.0, t) for t in spread] + [(4.5 if count == 6 else 2.5, 0.0)]
    if count == 12:
        polar += [(9.6, t) for t in spread] + [(-4.5, 0.0)]
    places: list[tuple[float, float, float]] = []
    for away, t in polar:
        away *= size * rng.uniform(0.95, 1.05)
        t += rotation + math.radians(rng.uniform(-3.0, 3.0))
        places.append((away * math.cos(t), away * math.sin(t), t + math.pi))
    points = np.array(places)[:, :2]
    margin = 2.5 * size
    first = np.minimum(points.min(axis=0), (points + travel).min(axis=0)) - margin
    last = np.maximum(points.max(axis=0), (points + travel).max(axis=0)) + margin
    low = np.array([box[0], 0.0]) - first
    high = np.maximum(np.array([box[1], box[2]]) - last, low)
    du, dv = cast(Float, rng.uniform(low, high)).tolist()
    limits = scale * RADIUS[0], scale * RADIUS[1]
    radii = np.clip(size * rng.uniform(0.85, 1.18, len(places)), *limits)
    return [(u + du, v + dv, r, back) for (u, v, back), r in zip(places, radii.tolist(), strict=True)]


def _finger_cap(
    rng: np.random.Generator, u: float, v: float, radius: float, back: float, marker_colour: Rgb
) -> Cap:
    """A glossy cap at the end of a finger that goes on in the direction `back`."""
    back += math.radians(rng.uniform(-8.0, 8.0))
    stretch = math.sqrt(rng.uniform(0.85, 1.3))
    a, b = radius * stretch, radius / stretch
    half_width = b * rng.uniform(0.85, 1.0)
    behind = max(0.0, half_width - a) + 0.1 * radius
    skin = _times(SKIN_LINEAR_RGB, rng.uniform(0.7, 1.0))
    away, t = math.sqrt(rng.random()), rng.uniform(0.0, 2.0 * math.pi)
    return Cap(
        u=u,
        v=v,
        a=a,
        b=b,
        angle=back,
        marker_colour=marker_colour,
        bulge=rng.uniform(0.5, 0.98),
        support=Support(
            (behind * math.cos(back), behind * math.sin(back)), back, 3.5 * radius, half_width, skin, True
        ),
        highlight=Highlight(
            away * math.cos(t), away * math.sin(t), rng.uniform(0.0, 0.25), rng.uniform(0.4, 1.0)
        ),
    )


def _patch_cap(
    rng: np.random.Generator, u: float, v: float, radius: float, back: float, marker_colour: Rgb
) -> Cap:
    """A matt cap on a patch of skin, on its edge, or (one in five) on the table."""
    stretch = math.sqrt(rng.uniform(0.7, 1.0))
    place = rng.choice(3, p=(0.4, 0.4, 0.2))
    patch = radius * rng.uniform(1.6, 2.2)
    away = 0.0 if place == 0 else patch + radius * rng.uniform(-0.5, 0.5)
    t = back + math.radians(rng.uniform(-60.0, 60.0))
    skin = _times(SKIN_LINEAR_RGB, rng.uniform(0.7, 1.0))
    return Cap(
        u=u,
        v=v,
        a=radius / stretch,
        b=radius * stretch,
        angle=rng.uniform(0.0, math.pi),
        marker_colour=marker_colour,
        bulge=rng.uniform(0.3, 0.9),
        support=None
        if place == 2
        else Support((away * math.cos(t), away * math.sin(t)), 0.0, 0.0, patch, skin, False),
    )


def _table(rng: np.random.Generator, size: tuple[int, int]) -> Light:
    """Linear light (H, W, 3) of a table: plain, textured, or of two tops with an edge between them."""
    width, height = size
    choice = rng.choice(3)
    first, second = rng.choice(len(TABLE_TOPS), 2, replace=False)
    light = np.empty((height, width, 3), np.float32)
    light[:] = TABLE_TOPS[first]
    if choice == 2:
        t = rng.uniform(0.0, math.pi)
        x, y = np.arange(width) - width * rng.uniform(0.3, 0.7), np.arange(height) - height * 0.5
        far = np.clip(math.cos(t) * x[None, :] + math.sin(t) * y[:, None] + 0.5, 0.0, 1.0)[..., None]
        light += far.astype(np.float32) * (np.array(TABLE_TOPS[second], np.float32) - light)
    if choice > 0:
        texture = np.zeros((height, width), np.float32)
        for grain in (1.0, 4.0, 16.0):
            noise = rng.standard_normal((height, width), np.float32)
            across = grain * rng.uniform(0.7, 4.0)
            fine = cast(Light, cv2.GaussianBlur(noise, (0, 0), sigmaX=across, sigmaY=grain))
            texture += fine / np.float32(fine.std())
        texture *= np.float32(rng.uniform(0.02, 0.08))
        light *= np.clip(1.0 + texture, 0.5, 1.5)[..., None]
    return light


def _lay_object(table: Light, rng: np.random.Generator, caps: tuple[Cap, ...], scale: float) -> None:
    """A mug or a pen in the colour of one of the markers, where it touches neither cap nor finger."""
    height, width = int(table.shape[0]), int(table.shape[1])
    colour = caps[rng.integers(len(caps))].marker_colour
    pen = rng.random() < 0.5
    radius = scale * (rng.uniform(2.5, 5.0) if pen else rng.uniform(18.0, 45.0))
    half = scale * rng.uniform(40.0, 75.0) if pen else 0.0
    t = rng.uniform(0.0, math.pi)
    c, s = math.cos(t), math.sin(t)
    for _ in range(100):
        u, v = rng.uniform(0.0, width), rng.uniform(0.0, height)
        if all(_past(cap.u - u, cap.v - v, c, s, half) > radius + CLEAR * cap.a for cap in caps):
            break
    else:
        return  # the hand fills the picture
    x, y = np.arange(width, dtype=np.float32)[None, :] - u, np.arange(height, dtype=np.float32)[:, None] - v
    along, across = c * x + s * y, c * y - s * x
    away = np.hypot(along - np.clip(along, -half, half), across)
    cover = np.clip(radius - away + 0.5, 0.0, 1.0)[..., None].astype(np.float32)
    shade = 1.0 - 0.4 * np.clip(across / radius, -1.0, 1.0)[..., None].astype(np.float32)
    table += cover * (np.array(colour, np.float32) * shade * np.float32(0.8) - table)


def _past(x: float, y: float, c: float, s: float, half: float) -> float:
    """Distance [px] of a point from the axis of a thing, both from its centre."""
    along = c * x + s * y
    return math.hypot(along - max(-half, min(half, along)), c * y - s * x)


def _times(colour: Rgb, factor: float) -> Rgb:
    return colour[0] * factor, colour[1] * factor, colour[2] * factor
