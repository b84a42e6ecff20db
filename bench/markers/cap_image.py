"""One painted cap as a camera forms it: drawn in linear light, averaged over pixel area and exposure, truth exact.

A cap is an ellipse of paint on skin (a finger that goes on to one side, or a round patch), drawn on a fine grid and
box-averaged. In the frame of its unit circle it is shaded like a sphere segment (Lambert), has a white highlight, and
may lose the segment {q . n > h} to an edge in front of it. The centroid of the rest is known in closed form: a segment
of half angle t = acos(h) has area t - h sin t and its centroid at 2/3 sin^3 t / area.
"""

import math
from dataclasses import dataclass, replace
from typing import TypeAlias, cast

import cv2
import numpy as np
import numpy.typing as npt

from common.arrays import Float

Light: TypeAlias = npt.NDArray[np.float32]
Rgb: TypeAlias = tuple[float, float, float]

PAD = 2  # px around the paint that are drawn finely
AMBIENT = 0.38


@dataclass(frozen=True, slots=True)
class Support:
    """The skin under a cap: a capsule from `start` on, moving with the cap; length 0 is a round patch."""

    start: tuple[float, float]  # where its axis begins, from the cap's centre [px]
    angle: float  # direction of its axis [rad]
    length: float  # [px]
    half_width: float  # [px]
    colour: Rgb  # linear RGB
    round_: bool  # shaded like a cylinder; else flat


@dataclass(frozen=True, slots=True)
class Occluder:
    """An edge in front of the cap that hides `share` of its area, on the side `angle` [rad] of its unit circle."""

    angle: float
    share: float
    colour: Rgb

    @property
    def height(self) -> float:
        """Distance of the edge from the centre of the unit circle."""
        low, high = -1.0, 1.0
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if segment(middle)[0] > math.pi * self.share else (low, middle)
        return 0.5 * (low + high)


@dataclass(frozen=True, slots=True)
class Highlight:
    """A white spot on the paint: centre and radius in the cap's unit circle, strength in units of white."""

    x: float
    y: float
    radius: float
    strength: float


@dataclass(frozen=True, slots=True)
class Cap:
    """One cap at mid exposure."""

    u: float  # centre of the whole ellipse [px], (0, 0) = centre of the top-left pixel
    v: float
    a: float  # semi-axes [px]
    b: float
    angle: float  # direction of the axis a [rad]
    marker_colour: Rgb  # linear RGB reflectance
    bulge: float  # sine of the angle between the normals of rim and centre; 0 is flat
    support: Support | None = None
    highlight: Highlight | None = None
    occluder: Occluder | None = None

    def moved(self, du: float, dv: float) -> "Cap":
        """The same cap elsewhere."""
        return replace(self, u=self.u + du, v=self.v + dv)

    @property
    def whole(self) -> tuple[float, float]:
        """Centroid of all its paint, hidden or not [px]."""
        return self.u, self.v

    @property
    def visible(self) -> tuple[float, float, float]:
        """Centroid (u, v) [px] of the visible paint and its area [px^2], exact."""
        area = math.pi * self.a * self.b
        if self.occluder is None:
            return self.u, self.v, area
        share = self.occluder.share
        hidden, middle = segment(self.occluder.height)
        along = -hidden / math.pi * middle / (1.0 - share)
        x, y = along * math.cos(self.occluder.angle), along * math.sin(self.occluder.angle)
        c, s = math.cos(self.angle), math.sin(self.angle)
        u, v = self.u + c * self.a * x - s * self.b * y, self.v + s * self.a * x + c * self.b * y
        return u, v, area * (1.0 - share)


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """A piece of picture: premultiplied light and coverage (H, W, 4), its top-left pixel at (left, top)."""

    pixels: Light
    left: int
    top: int

    def onto(self, light: Light) -> None:
        """Lay it over a picture (H, W, 3) of linear light; what hangs over is cut."""
        height, width = self.pixels.shape[:2]
        x0, y0 = max(self.left, 0), max(self.top, 0)
        x1, y1 = min(self.left + width, light.shape[1]), min(self.top + height, light.shape[0])
        if x0 >= x1 or y0 >= y1:
            return
        own = self.pixels[y0 - self.top : y1 - self.top, x0 - self.left : x1 - self.left]
        below = light[y0:y1, x0:x1]
        below *= 1.0 - own[..., 3:]
        below += own[..., :3]


def segment(height: float) -> tuple[float, float]:
    """Area and distance of the centroid from the centre of the unit circle's segment beyond `height`."""
    t = math.acos(max(-1.0, min(1.0, height)))
    area = t - height * math.sin(t)
    return area, (2.0 / 3.0 * math.sin(t) ** 3 / area if area > 1e-12 else 1.0)


def draw(cap: Cap, to_light: Float, motion: tuple[float, float] = (0.0, 0.0), fine: int = 8) -> Patch:
    """The cap with its support, box-averaged over pixels and exposure.

    Args:
        to_light: Unit vector (3,) to the light: right, down, towards the camera.
        motion: Way (du, dv) [px] during the exposure, symmetric about `cap`.
        fine: Sub-pixels per pixel and axis where there is paint.
    """
    reach = max(cap.a, cap.b) + PAD
    near = _box(cap, reach, motion)
    far = _box(cap, _reach(cap), motion)
    patch = _exposed(cap, to_light, motion, far, 2)  # where there is only skin
    detail = _exposed(cap, to_light, motion, near, fine)
    x, y = near[0] - far[0], near[1] - far[1]
    patch[y : y + detail.shape[0], x : x + detail.shape[1]] = detail
    return Patch(patch, far[0], far[1])


def _reach(cap: Cap) -> float:
    """Radius [px] around the centre within which anything is drawn."""
    reach = (3.2 if cap.occluder is not None else 1.0) * max(cap.a, cap.b) + PAD + 1
    if cap.support is not None:
        support = cap.support
        reach = max(reach, math.hypot(*support.start) + support.length + support.half_width + 1)
    return reach


def _box(cap: Cap, reach: float, motion: tuple[float, float]) -> tuple[int, int, int, int]:
    """left, top, width, height [px]."""
    x, y = reach + 0.5 * abs(motion[0]), reach + 0.5 * abs(motion[1])
    left, top = math.floor(cap.u - x), math.floor(cap.v - y)
    return left, top, math.ceil(cap.u + x) - left + 1, math.ceil(cap.v + y) - top + 1


def _exposed(
    cap: Cap, to_light: Float, motion: tuple[float, float], box: tuple[int, int, int, int], fine: int
) -> Light:
    """Premultiplied light and coverage (H, W, 4) of the box, averaged over exposure and pixels."""
    left, top, width, height = box
    way = math.hypot(*motion)
    step = 0.25  # px of motion between two drawn moments of the exposure
    steps = 1 if way == 0.0 else math.ceil(way / step)
    pad = math.ceil(0.5 * max(abs(motion[0]), abs(motion[1]))) + 1 if steps > 1 else 0
    x = (np.arange(-pad * fine, (width + pad) * fine) + 0.5) / fine - 0.5 + left - cap.u
    y = (np.arange(-pad * fine, (height + pad) * fine) + 0.5) / fine - 0.5 + top - cap.v
    canvas = _paint(cap, x.astype(np.float32)[None, :], y.astype(np.float32)[:, None], to_light, fine)
    if steps > 1:
        # Moments symmetric about the middle, rounded symmetrically: their mean place is exactly the cap's.
        epochs = (np.arange(steps) + 0.5) / steps - 0.5
        mean = np.zeros((height * fine, width * fine, 4), np.float32)
        for dx, dy in np.rint(fine * epochs[:, None] * np.array(motion)).astype(int).tolist():
            mean += canvas[
                pad * fine - dy : (pad + height) * fine - dy, pad * fine - dx : (pad + width) * fine - dx
            ]
        canvas = mean / np.float32(steps)
    return cast(Light, cv2.resize(canvas, (width, height), interpolation=cv2.INTER_AREA))


def _paint(cap: Cap, x: Light, y: Light, to_light: Float, fine: int) -> Light:
    """Light and coverage (H, W, 4) of sub-pixels at (x, y) [px] from the cap's centre, `fine` per pixel.

    The paint's own edges are soft over one sub-pixel, or its centroid would be off by up to 0.006 px.
    """
    out = np.zeros((y.size, x.size, 4), np.float32)
    if cap.support is not None:
        _lay_support(out, cap.support, x, y, to_light)
    c, s = math.cos(cap.angle), math.sin(cap.angle)
    p, q = (c * x + s * y) / cap.a, (c * y - s * x) / cap.b
    rho = np.sqrt(p * p + q * q) + np.float32(1e-6)
    pa, qb = p / cap.a, q / cap.b
    slope = np.sqrt(pa * pa + qb * qb) / rho
    cover = np.clip(0.5 - fine * (rho - 1.0) / slope, 0.0, 1.0)
    inside = cover > 0.0
    p_in, q_in = p[inside], q[inside]
    # Normals tilt away from the camera towards the rim; the light is turned into the frame of the ellipse.
    tilt = np.minimum(cap.bulge * cap.bulge * (p_in * p_in + q_in * q_in), 1.0)
    lx, ly = c * to_light[0] + s * to_light[1], c * to_light[1] - s * to_light[0]
    cosine = cap.bulge * (p_in * lx + q_in * ly) + np.sqrt(1.0 - tilt) * to_light[2]
    shade = AMBIENT + (1.0 - AMBIENT) * np.maximum(cosine, 0.0)
    colour = np.ones((p_in.size, 4), np.float32)
    colour[:, :3] = shade[:, None] * np.array(cap.marker_colour, np.float32)
    if cap.highlight is not None and cap.highlight.radius > 0.0:
        spot = cap.highlight
        away = np.hypot(p_in - spot.x, q_in - spot.y) / spot.radius
        colour[:, :3] += (spot.strength * np.clip(2.0 - 2.0 * away, 0.0, 1.0))[:, None]
    out[inside] += cover[inside][:, None] * (colour - out[inside])
    if cap.occluder is not None:
        n, m = math.cos(cap.occluder.angle), math.sin(cap.occluder.angle)
        beyond, aside = p * n + q * m - cap.occluder.height, p * m - q * n
        hides = np.clip(0.5 + fine * beyond / math.hypot(n / cap.a, m / cap.b), 0.0, 1.0)
        hides *= (beyond < 2.0) & (np.abs(aside) < 1.4)
        out += hides[..., None] * (np.array((*cap.occluder.colour, 1.0), np.float32) - out)
    return out


def _lay_support(out: Light, support: Support, x: Light, y: Light, to_light: Float) -> None:
    c, s = math.cos(support.angle), math.sin(support.angle)
    dx, dy = x - support.start[0], y - support.start[1]
    along, across = c * dx + s * dy, c * dy - s * dx
    past = along - np.clip(along, 0.0, support.length)
    inside = past * past + across * across <= support.half_width**2
    t = across[inside] / support.half_width
    cosine = np.full(t.shape, to_light[2])
    if support.round_:
        cosine = t * (c * to_light[1] - s * to_light[0]) + np.sqrt(1.0 - t * t) * to_light[2]
    shade = AMBIENT + (1.0 - AMBIENT) * np.maximum(cosine, 0.0)
    out[inside, :3] = shade[:, None] * np.array(support.colour)
    out[inside, 3] = 1.0
