"""Frames with painted caps and exact truth, from fixed seeds, kind by kind: what detectors are measured on.

HSV ranges are those of a person who calibrates with care, fixed here, so that no change of the colour calibration
moves the scale. A sequence is one scene, drawn at random, for a few frames in which the caps move a little. Then a
camera follows: shot and read noise, ten linear bits, sRGB bytes (docs/measuring.md).
"""

import colorsys
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final, cast

import cv2
import msgspec
import numpy as np

from bench.markers.cap_image import Cap, Highlight, Light, Occluder, Rgb, Support, draw
from common.arrays import Float, Image
from common.calibration import CameraCalibration, HsvRange
from common.sim.light import (
    CARD_LINEAR_RGB,
    DESK_LINEAR_RGB,
    MARKER_LINEAR_RGB,
    SKIN_LINEAR_RGB,
    bgr_bytes,
    to_linear,
    to_srgb,
)

MORE_HUES: Final = (30, 55, 80, 102, 124, 150)  # between those of the six
MANY_HUES: Final = (27.0, 168.0)  # evenly from yellow to red, skin in the gap


def paints(count: int) -> dict[str, Rgb]:
    """Marker -> linear RGB reflectance; ValueError: not 6, 12 or 24 markers."""
    if count == 6:
        return dict(MARKER_LINEAR_RGB)
    if count == 12:
        return dict(MARKER_LINEAR_RGB) | {f"hue_{h}": _of_hsv(h, 0.8, 0.72) for h in MORE_HUES}
    if count == 24:
        return {f"hue_{h:.0f}": _of_hsv(h, 0.85, 0.75) for h in np.linspace(*MANY_HUES, count)}
    raise ValueError(f"{count} paints: there are sets of 6, 12 and 24")


def camera_file(count: int, size: tuple[int, int]) -> CameraCalibration:
    """The camera of `size` (width, height) [px] with the ranges of `count` markers."""
    named = paints(count)
    hsv = {name: _hsv(colour) for name, colour in named.items()}
    others = {name: [h for other, (h, _, _) in hsv.items() if other != name] for name in hsv}
    return camera_of(f"bench{count}", size, {name: _range(own, others[name]) for name, own in hsv.items()})


def camera_of(
    name: str, size: tuple[int, int], markers: dict[str, HsvRange], rate_hz: float = 60.0
) -> CameraCalibration:
    """A camera of `size` (width, height) [px] without a lens."""
    return CameraCalibration(
        version=1, name=name, width_px=size[0], height_px=size[1], frame_rate_hz=rate_hz, exposure_us=5000.0,
        analogue_gain=1.0, colour_gains=(1.0, 1.0), row_time_us=20.0, markers=markers,
    )  # fmt: skip


def _range(own: tuple[int, int, int], others: list[int]) -> HsvRange:
    hue, saturation, value = own
    obstacles = [*others, 11]  # skin
    below = min(((hue - h) % 180) / 2.0 for h in obstacles)
    above = min(((h - hue) % 180) / 2.0 for h in obstacles)
    hue_margin = 14
    low = (hue - int(min(hue_margin, below - 0.5))) % 180
    high = (hue + int(min(hue_margin, above - 0.5))) % 180
    least, dark = round(max(50, 0.45 * saturation)), round(max(25, 0.3 * value))
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
    """What the frames of one kind show; lengths are for 640 px of image width and scale with it."""

    name: str  # its name
    finger: bool = True  # caps at finger ends with a highlight; else matt ones on skin, its edge, the table
    clicked: bool = False  # a click in the first frame: on a bare table a cap looks like any other object
    blur_px: float = 0.0  # way during the exposure
    hidden: float = 0.0  # share of the paint that an edge hides, in the frames after `whole_frames`
    noise: float = 1.0  # times the usual noise
    objects: int = 0  # things of the markers' colours on the table: mugs and pens
    count: int = 6  # markers
    size: tuple[int, int] = (640, 480)  # width, height [px]
    whole_frames: int = 0  # frames before those that are judged
    frames: int = 4  # judged frames of one sequence

    @property
    def camera(self) -> CameraCalibration:
        """The camera file of these frames."""
        still = camera_file(self.count, self.size)
        if not self.blur_px:
            return still
        # Blurred caps move by the way of one frame: such a camera exposes from frame to frame.
        return msgspec.structs.replace(still, exposure_us=1e6 / still.frame_rate_hz)

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
    """What stays the same during a sequence."""

    kind: Kind  # its kind
    caps: tuple[Cap, ...]  # one per marker, at the first frame, without occluders
    occluders: tuple[Occluder, ...]  # one per marker
    table: Light  # (H, W, 3) linear light without caps
    to_light: Float  # (3,) unit vector
    brightness: float  # of the light
    lens_px: float  # standard deviation of the lens blur
    velocity: Float  # (2,) of the hand [px per frame]
    wander_px: float  # standard deviation of each cap's own step from frame to frame

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
    occluders: list[Occluder] = []
    for _ in caps:
        angle = rng.uniform(0.0, 2.0 * math.pi)
        colour = _times(SKIN_LINEAR_RGB, 0.8) if rng.random() < 0.5 else CARD_LINEAR_RGB
        occluders.append(Occluder(angle, kind.hidden, colour))
    table = _table(rng, kind.size)
    for _ in range(kind.objects):
        _lay_object(table, rng, caps, scale)
    brightness, lens_px = rng.uniform(0.6, 1.2), rng.uniform(0.4, 0.7)
    wander_px = 0.0 if kind.blur_px else 0.3 * scale
    return Scene(kind, caps, tuple(occluders), table, to_light, brightness, lens_px, velocity, wander_px)


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
    bulge, begins = rng.uniform(0.5, 0.98), (behind * math.cos(back), behind * math.sin(back))
    finger = Support(begins, back, 3.5 * radius, half_width, skin, True)
    spot = Highlight(away * math.cos(t), away * math.sin(t), rng.uniform(0.0, 0.25), rng.uniform(0.4, 1.0))
    return Cap(u, v, a, b, back, marker_colour, bulge, finger, spot)


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
    under = Support((away * math.cos(t), away * math.sin(t)), 0.0, 0.0, patch, skin, False)
    angle, bulge, on = rng.uniform(0.0, math.pi), rng.uniform(0.3, 0.9), None if place == 2 else under
    return Cap(u, v, radius / stretch, radius * stretch, angle, marker_colour, bulge, on)


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


STEP_NS: Final = 16_666_667
BITS: Final = 1023
ENCODED: Final = np.rint(255.0 * to_srgb(np.arange(BITS + 1) / BITS)).astype(np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class MarkerFrame:
    """One frame and its truth, M markers in the order of `Kind.names`."""

    image: Image  # (H, W, 3) BGR
    t_ns: int  # mid-exposure time
    uv: Float  # (M, 2) centroid of the visible paint, mean over the exposure [px]
    whole_uv: Float  # (M, 2) centroid of the paint as if nothing hid it [px]
    area: Float  # (M,) visible area [px^2]
    visible: Float  # (M,) visible share
    radius: Float  # (M,) sqrt(a b) of the whole ellipse [px]
    judged: bool  # whether it counts; frames that only let a tracker learn do not


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
    seen, whole = np.array([cap.visible for cap in caps]), np.array([cap.whole for cap in caps])
    visible = np.array([1.0 - c.occluder.share if c.occluder else 1.0 for c in caps])
    radius = np.array([math.sqrt(cap.a * cap.b) for cap in caps])
    image = expose(scene.light(caps), scene.kind.noise, rng)
    return MarkerFrame(image, k * STEP_NS, seen[:, :2], whole, seen[:, 2], visible, radius, judged)


def variance(light: Light, noise: float) -> Light:
    """Variance of the sensor's noise at each level of linear light."""
    full_well = 6000.0  # electrons at white: shot noise
    read_noise = 0.002  # of white: together 1.7 grey levels at mid grey
    return np.float32(noise**2) * (light / np.float32(full_well) + np.float32(read_noise**2))


def expose(light: Light, noise: float, rng: np.random.Generator) -> Image:
    """What the camera delivers for linear light (H, W, 3) RGB: noise, ten linear bits, sRGB bytes, BGR."""
    signal = light + np.sqrt(variance(light, noise)) * rng.standard_normal(light.shape, np.float32)
    codes = np.clip(signal * np.float32(BITS) + np.float32(0.5), 0, BITS).astype(np.uint16)
    return np.ascontiguousarray(ENCODED[codes[..., ::-1]])
