"""A renderer turns a wrist scene into camera frames: light, line, sensor.

Brightness is in levels of the sensor above black, at the exposure of the camera's file: 253 saturates. The rooms
differ by what falls on the hand, by how bright they are behind it, by how far the window saturates, and by sunlight
on skin. Skin is shaded on a coarser grid (rays against the hand, then Lambert), and enlarged; the laser line is drawn
from its exact curve to parts of a pixel, widened by the thickness of the sheet, with the glow of the skin beside it.

A lit point moves along its ray by s where the sheet is looked at h off its middle: the point stays on the skin when n
. (h m + s r) = 0, with n the normal of the skin, m that of the sheet, r the ray. So each piece between two rays is a
ribbon of parallelograms, each as bright as the Gaussian profile gives and as large as its picture.
"""

from copy import copy
from dataclasses import dataclass

import cv2
import numpy as np

from common.arrays import Bool, Float, Image
from common.errors import CalibrationError
from common.geometry.tapered_capsules import Capsules, Plane, first_hits, terms
from common.recording.frame_recording import Illumination
from common.sim.light import tile_place
from common.sim.wrist.capsules import ALBEDO, THING_GROUP
from common.sim.wrist.scene import WristScene
from common.sim.wrist.surface import HandSurface, SurfaceView

BLACK_LEVEL = 2.0
LASER_LEVEL = 2400.0  # of the middle of the line, on skin that faces the laser at SURFACE_AT_M
SURFACE_AT_M = 0.13
SHEET_SIGMA_M = 4.2e-4  # of the sheet of laser light
# what comes out of the skin beside the line: sigma [px], share of the line's light
GLOW = ((5.0, 0.13), (14.0, 0.10))
_TILE_MARGIN = 128
_LEVELS = {  # on the hand, behind it, of the window, of sun on skin
    "dark": (0.6, 0.4, 0.0, 0.0),
    "indoor": (24.0, 16.0, 330.0, 0.0),
    "bright": (68.0, 46.0, 900.0, 0.0),
    "sun": (95.0, 80.0, 2500.0, 190.0),
}


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """One ambient light.

    Attributes:
        hand, wall, window, sun: Levels on skin, behind it, of the window, and of sunlight that falls straight
            on skin.
        to_sky, to_sun: Unit vectors (3,), camera frame.
        seed: Of what stands in the room.
    """

    hand: float
    wall: float
    window: float
    sun: float
    to_sky: Float
    to_sun: Float
    seed: int

    @classmethod
    def of(cls, name: str, seed: int) -> "Room":
        """The room called dark, indoor, bright or sun."""
        rng = np.random.default_rng([seed, 31])
        sky = np.array([rng.uniform(-0.6, 0.6), -1.0, rng.uniform(-0.6, 0.2)])
        sun = np.array([rng.uniform(-1.0, 1.0), -0.8, rng.uniform(-0.5, 0.1)])
        return cls(*_LEVELS[name], sky / np.linalg.norm(sky), sun / np.linalg.norm(sun), seed)

    def on_surface(self, normals: Plane) -> Plane:
        """Levels (N,) of plain skin with normals (N, 3): light from all sides, sun."""
        shade: Plane = self.hand * (0.75 + 0.25 * (normals @ self.to_sky.astype(np.float32)))
        if self.sun > 0.0:
            shade += self.sun * np.maximum(normals @ self.to_sun.astype(np.float32), 0.0)
        return shade

    def backdrop(self, size: tuple[int, int], step: float) -> Plane:
        """Background (H, W), `size` = (W, H): a wall, things out of focus, a window.

        `step` is how many pixels of the camera one of the backdrop is.
        """
        rng = np.random.default_rng([self.seed, 33])
        width, height = size
        wall = np.full((height, width), self.wall, dtype=np.float32)
        wall *= (1.0 + np.linspace(-0.25, 0.25, width) * rng.uniform(-1.0, 1.0)).astype(np.float32)
        for _ in range(7):
            middle, half = rng.uniform(0.0, 1.0, 2), rng.uniform(0.05, 0.25, 2)
            _box(wall, middle - half, middle + half, self.wall * rng.uniform(0.4, 1.8))
        if self.window > 0.0:
            low = np.array([rng.uniform(0.0, 0.6), rng.uniform(-0.2, 0.05)])
            high = low + np.array([rng.uniform(0.25, 0.4), rng.uniform(0.4, 0.65)])
            bar = low[0] + rng.uniform(0.4, 0.6) * (high[0] - low[0])
            _box(wall, low, high, self.window)
            _box(wall, np.array([bar, low[1]]), np.array([bar + 0.02, high[1]]), 0.2 * self.window)
        out = np.asarray(cv2.GaussianBlur(wall, (0, 0), 7.0 / step), dtype=np.float32)
        # The lens scatters a little of the window everywhere.
        veil = np.asarray(cv2.GaussianBlur(wall, (0, 0), 120.0 / step), dtype=np.float32)
        return np.asarray(cv2.addWeighted(out, 1.0, veil, 0.006, 0.0), dtype=np.float32)


def _box(image: Plane, low: Float, high: Float, level: float) -> None:
    """Fill a box given in shares of the picture."""
    size = np.array(image.shape[::-1])
    (x0, y0), (x1, y1) = (np.rint(corner * size).astype(int).tolist() for corner in (low, high))
    cv2.rectangle(image, (x0, y0), (x1, y1), level, -1)


def led_levels(led_m: Float, points: Plane, normals: Plane, before: Capsules | None = None) -> Plane:
    """Levels (N,) of skin at (N, 3) [m] by LEDs (L, 3) [m]: inverse square, cosine.

    Only `before` throws shadows: those of one finger on another are narrow, so near to the lens are the LEDs.
    """
    leds = led_m.astype(np.float32)
    faced = normals @ leds.T - np.einsum("ij,ij->i", normals, points)[:, None]
    square = np.einsum("ij,ij->i", points, points)[:, None] - 2.0 * (points @ leds.T)
    square += (leds * leds).sum(axis=1)
    np.maximum(faced, 0.0, out=faced)
    if before is not None:
        for led, place in enumerate(leds):
            faced[_in_shadow(before, place, points, square[:, led]), led] = 0.0
    faced /= square * np.sqrt(square)
    led_level = 88.0  # of skin that faces the LEDs at SURFACE_AT_M on the axis
    return faced.sum(axis=1) * np.float32(led_level * SURFACE_AT_M**2 / len(leds))


def _in_shadow(before: Capsules, origin: Plane, points: Plane, square: Plane) -> Bool:
    """Whether a body blocks light from an origin (3,) [m] to points (N, 3) [m].

    `square` (N,) [m^2] are their squared distances.
    """
    far = np.sqrt(square)
    ways = np.ascontiguousarray(((points - origin) / far[:, None]).T)
    known = terms(before, origin.astype(np.float64), np.float32)
    reach = np.min([first_hits(body, ways) for body in known.T], axis=0)
    shadow_gap_m = 0.001  # nearer to a body nothing is in its shadow: it may be on the body itself
    return reach < far - np.float32(shadow_gap_m)


class Sensor:
    """Adds noise, from a tile drawn once, and cuts at what a byte holds."""

    def __init__(self, height: int, width: int, seed: int) -> None:
        rng = np.random.default_rng([seed, 32])
        self._tile = rng.standard_normal((height + _TILE_MARGIN, width + _TILE_MARGIN), dtype=np.float32)
        level = np.arange(256, dtype=np.float32)
        read_variance, shot_variance = 0.35, 0.032  # of the noise [levels^2], and per level
        self._sigma = np.sqrt(read_variance + shot_variance * np.maximum(level - BLACK_LEVEL, 0.0))

    def bytes_of(self, level: Plane, key: int) -> Image:
        """Image (H, W) of levels, black at BLACK_LEVEL; one key, one noise."""
        height, width = level.shape
        _, y, x = tile_place(key)
        y, x = y % _TILE_MARGIN, x % _TILE_MARGIN
        noise = cv2.LUT(cv2.convertScaleAbs(level), self._sigma)
        cv2.multiply(noise, self._tile[y : y + height, x : x + width], dst=noise)
        return np.asarray(cv2.add(noise, level, dtype=cv2.CV_8U), dtype=np.uint8)  # rounded, and cut


LAYERS = np.linspace(-2.4, 2.4, 11)  # across the sheet, in its sigmas


def draw_stripe(level: Plane, scene: WristScene, bodies: Capsules, hand: Plane) -> None:
    """Add the laser line to the levels (H, W) in place.

    The line glows where skin is, by `hand` (h, w), a coarser grid: what skin gives back, about 1, and 0 where
    none is. Things glow as little as they give back, so not at all here.
    """
    sheet, optics = scene.sheet, scene.optics
    curve = sheet.cross(bodies)
    chords = np.flatnonzero(curve.joined)
    chords = chords[curve.seen[chords] & curve.seen[chords + 1]]
    points = curve.points[chords]
    ray = curve.rays[chords]
    normals = bodies.normals(curve.body[chords], points)
    least_cosine = 0.12  # skin that the laser grazes flatter is lit as if it were this steep
    facing = np.maximum(-np.einsum("ij,ij->i", normals, ray), least_cosine)
    rise = sheet.normal + ((normals @ sheet.normal) / facing)[:, None] * ray
    uv = optics.project(points)
    nudge_m = 1e-4
    way = (optics.project(points + nudge_m * rise) - uv) / nudge_m  # px per metre across the sheet
    piece = optics.project(curve.points[chords + 1]) - uv
    heights = LAYERS * SHEET_SIGMA_M
    area = np.abs(piece[:, 0] * way[:, 1] - piece[:, 1] * way[:, 0]) * (heights[1] - heights[0])
    reach = np.linalg.norm(points - sheet.origin, axis=1)
    given_back = np.where(curve.group[chords] == THING_GROUP, ALBEDO, scene.reflectance)
    middle = LASER_LEVEL * given_back * facing * (SURFACE_AT_M / reach) * area
    amount = middle[:, None] * np.exp(-0.5 * LAYERS**2)
    place = (uv + 0.5 * piece)[:, None] + heights[:, None] * way[:, None]
    _spread(level, place.reshape(-1, 2), amount.ravel(), hand)


def _spread(level: Plane, place: Float, amount: Float, hand: Plane) -> None:
    """Add light at places (N, 2) [px], each on four pixels, blurred by lens and skin."""
    height, width = level.shape
    inside = ((place > 1.0) & (place < np.array([width - 2.0, height - 2.0]))).all(axis=1)
    place, amount = place[inside], amount[inside]
    if not len(place):
        return
    edge_px = 40
    x0, y0 = np.maximum(place.min(axis=0).astype(int) - edge_px, 0).tolist()
    x1, y1 = np.minimum(place.max(axis=0).astype(int) + edge_px, [width, height]).tolist()
    w, h = x1 - x0, y1 - y0
    at = place - np.array([x0, y0])
    corner = at.astype(np.int64)
    fx, fy = (at - corner).T
    index = corner[:, 1] * w + corner[:, 0]
    four = np.concatenate([index, index + 1, index + w, index + w + 1])
    share = np.concatenate([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy]) * np.tile(amount, 4)
    line = np.bincount(four, share, w * h).reshape(h, w).astype(np.float32)
    glow = _glow(line, hand, (x0, y0, x1, y1), width)
    lens_sigma_px = 0.9
    light = cv2.GaussianBlur(line, (0, 0), lens_sigma_px)
    light += cv2.resize(glow, (w, h), interpolation=cv2.INTER_LINEAR)
    level[y0:y1, x0:x1] += light


def _glow(line: Plane, hand: Plane, box: tuple[int, int, int, int], width: int) -> Plane:
    """Glow of the skin around a line, at a quarter of its size; none off the skin."""
    h, w = line.shape
    size = -(-w // 4), -(-h // 4)
    coarse = cv2.resize(line, size, interpolation=cv2.INTER_AREA)
    glow = np.zeros(size[::-1], dtype=np.float32)
    for sigma, part in GLOW:
        glow += part * np.asarray(cv2.GaussianBlur(coarse, (0, 0), 0.25 * sigma))
    x0, y0, x1, y1 = (round(side * hand.shape[1] / width) for side in box)
    glow *= cv2.resize(hand[y0:y1, x0:x1], size, interpolation=cv2.INTER_AREA)
    return glow


# For a camera that loses what it has no time to draw. Half the time; fingertips are found as often and as well, and
# the laser line is drawn to parts of a pixel of the picture whatever the step is.
LIVE_STEP = 4
# the palm of a bent wrist is drawn anew by such steps: a tenth of a millimetre, twice
LIVE_WRIST_RAD = np.radians(0.25)
_ILLUMINATIONS = tuple(Illumination)  # frames of one strobe cycle differ in their noise, too
SATURATED = np.float32(300.0)  # levels: more cannot be seen, but would widen edges


class WristRenderer:
    """Renderer of one wrist scene; a frame is a pure function of t.

    Holds prepared rays, the palm of a straight wrist, the room and noise.
    """

    def __init__(self, scene: WristScene, camera: str, step: int = 2, wrist_step_rad: float = 0.0) -> None:
        """Prepare all that stands still (some tenths of a second).

        Args:
            step: Pixels between the rays that shade skin; 1 is twice as sharp and four times slower.
            wrist_step_rad: To multiples of this the bend is rounded at which the palm is drawn; 0: not at
                all.

        Raises:
            CalibrationError: No such camera.
        """
        if camera not in scene.rig.cameras:
            raise CalibrationError(f"rig {scene.rig.name!r}: cameras: no camera {camera!r}")
        self._scene = scene
        self._surface = HandSurface(scene, step, wrist_step_rad)
        self._room = Room.of(scene.ambient, scene.seed)
        self._led_m = np.array(scene.rig.led, dtype=np.float64)
        optics = scene.optics
        self._sensor = Sensor(optics.height_px, optics.width_px, scene.seed)
        self._gain = 1.0
        self._behind = self._room.backdrop(self._surface.size, optics.width_px / self._surface.size[0])
        self._still = {
            lit: self._shaded(self._behind, self._surface.straight.seen, lit)
            for lit in (Illumination.AMBIENT, Illumination.LED)
        }

    def exposed(self, exposure_us: float, gains_bgr: Float) -> "WristRenderer":
        """Return a renderer of the same scene for a camera with other settings.

        The exposure is so short that nothing smears; of the gains (3,), against the camera file, the middle
        one counts, as the camera is grey.
        """
        other = copy(self)
        other._gain = float(gains_bgr[1])
        return other

    def render(self, t_s: float, lit: Illumination) -> Image:
        """Image (H, W), grey, mid-exposure at scene time `t_s` [s]: room and `lit`."""
        state = self._scene.motion.at(t_s)
        bodies = self._scene.bodies_of(state)
        palm = self._surface.palm(bodies, state.wrist_angles_rad)
        fingers = self._surface.appearance(bodies, palm)
        leds = lit is Illumination.LED
        count = len(self._scene.capsules.group)
        things = bodies.of(slice(count, None)) if len(bodies.start_m) > count else None
        if palm is self._surface.straight and not (leds and things):
            behind = self._still[Illumination.LED if leds else Illumination.AMBIENT]
        else:
            behind = self._shaded(self._behind, palm.seen, lit, things)
        coarse = self._shaded(behind, fingers, lit, things)
        optics = self._scene.optics
        level = _sharp(coarse, (optics.width_px, optics.height_px))
        if lit is Illumination.LASER:
            hand = np.zeros(self._surface.size[::-1], dtype=np.float32)
            for seen in (palm.seen, fingers):
                hand.reshape(-1)[seen.pixel] = seen.albedo**2  # through the skin, and out again
            draw_stripe(level, self._scene, bodies, hand)
        if self._gain != 1.0:
            level *= np.float32(self._gain)
        level += np.float32(BLACK_LEVEL)
        return self._sensor.bytes_of(level, 4 * round(t_s * 1e6) + _ILLUMINATIONS.index(lit))

    def _shaded(
        self, behind: Plane, surface: SurfaceView, lit: Illumination, things: Capsules | None = None
    ) -> Plane:
        """Levels on the coarse grid: `behind` with skin in front, and things lit by LEDs."""
        shade = self._room.on_surface(surface.normals)
        if lit is Illumination.LED:
            levels = led_levels(self._led_m, surface.points, surface.normals, things)
            shade += levels * self._surface.flat[surface.pixel]
        level = behind.copy()
        level.reshape(-1)[surface.pixel] = shade * surface.albedo * np.float32(self._scene.reflectance)
        return level


def _sharp(coarse: Plane, size: tuple[int, int]) -> Plane:
    """Upsample levels to the full grid, edges of skin as soft as the lens has them."""
    cut = cv2.GaussianBlur(np.minimum(coarse, SATURATED), (3, 3), 0.6)
    return np.asarray(cv2.resize(cut, size, interpolation=cv2.INTER_LINEAR), dtype=np.float32)
