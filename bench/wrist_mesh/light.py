"""Shading of the samples: LEDs, the laser line with what it scatters in the skin, and the room's light.

Everything is Lambert's law on smooth normals. The constants were fitted to the rendered recordings' pictures.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bench.wrist_mesh.hand_mesh import HandMesh, Posed
from bench.wrist_mesh.line import Fan
from bench.wrist_mesh.raster import SUPER, Samples
from common.arrays import Float, Int
from common.kernels import kernel

LED_ROUGH = 0.888  # exponent of the cosine of incidence: skin is rough and scatters
SKIRT_NEAR = 0.25  # the skirt falls with this power of the distance less than the line
LED_FALL = 1.81  # exponent of the distance; what the hand throws back onto itself is among it
LED_LOBE = 1.22  # exponent of the cosine to the camera's axis: the LEDs' lobe, and the lens's vignetting


class Optics(NamedTuple):
    """Constants of the light, in grey values of the picture.

    Attributes:
        led: At 1 m below one LED, squarely lit [grey m^1.81].
        core: Of the laser's line at 1 m [grey m].
        core_m: Standard deviation of the line's thickness [m].
        skirt: Of what the skin scatters beside the line [grey m^0.75].
        skirt_m: Standard deviation of its breadth on the skin [m].
        skirt_cosine, skirt_slope: Exponents of the skirt: of the cosine of incidence, and of the square of the sine
            between skin and sheet of light.
        shadow_m: How far beyond the first surface the laser still reaches [m].
    """

    led: float = 0.483
    core: float = 268.0
    core_m: float = 0.000374
    skirt: float = 30.9
    skirt_m: float = 0.00213
    skirt_cosine: float = 0.97
    skirt_slope: float = -0.58
    shadow_m: float = 0.0015


def shade(
    samples: Samples,
    hand_mesh: HandMesh,
    posed: Posed,
    ambient: Float,
    leds: Float,
    fan: Fan,
    reach_m: Float,
    constants: Optics,
) -> tuple[Float, Float, Float, Float]:
    """Grey values (H, W) that the room, the laser and the LEDs add, black left out, and the hand's coverage (H, W).

    Args:
        samples: What the camera sees.
        hand_mesh, posed: The hand.
        ambient: The room's light on each vertex (V,) [grey].
        leds: (L, 3) [m].
        fan: The laser.
        reach_m: How far its rays go, as in `Curve`.
        constants: Of the light.
    """
    height, width = samples.face.shape[0] // SUPER, samples.face.shape[1] // SUPER
    out = np.zeros((4, height, width))
    sheet = np.stack([fan.origin, fan.normal, fan.forward, fan.across])
    reach = np.where(np.isfinite(reach_m), reach_m, 1e9)
    numbers = np.array(constants)
    arrays = posed.verts, posed.normals, ambient, hand_mesh.albedo, hand_mesh.faces
    _shade(samples.face, samples.share, *arrays, leds, sheet, fan.half_rad, reach, numbers, out)
    return out[0], out[1], out[2], out[3]


@kernel
def _shade(
    face: npt.NDArray[np.int32],
    share: npt.NDArray[np.float32],
    verts: Float,
    normals: Float,
    ambient: Float,
    albedo: Float,
    faces: Int,
    leds: Float,
    sheet: Float,
    half: float,
    reach: Float,
    numbers: Float,
    out: Float,
) -> None:
    led, core, core_m, skirt, skirt_m, skirt_cosine, skirt_slope, shadow_m = numbers
    rows, columns = face.shape
    part = 1.0 / (SUPER * SUPER)
    step = 2.0 * half / (len(reach) - 1)
    x, n = np.empty(3), np.empty(3)
    for row in range(rows):
        for column in range(columns):
            f = face[row, column]
            if f < 0:
                continue
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            wb, wc = share[row, column, 0], share[row, column, 1]
            wa = 1.0 - wb - wc
            for k in range(3):
                x[k] = wa * verts[a, k] + wb * verts[b, k] + wc * verts[c, k]
                n[k] = wa * normals[a, k] + wb * normals[b, k] + wc * normals[c, k]
            n /= np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
            v, u = row // SUPER, column // SUPER
            pale = wa * albedo[a] + wb * albedo[b] + wc * albedo[c]
            out[0, v, u] += part * pale * (wa * ambient[a] + wb * ambient[b] + wc * ambient[c])
            out[3, v, u] += part
            total = 0.0
            for k in range(len(leds)):
                dx, dy, dz = leds[k, 0] - x[0], leds[k, 1] - x[1], leds[k, 2] - x[2]
                d2 = dx * dx + dy * dy + dz * dz
                across = n[0] * dx + n[1] * dy + n[2] * dz
                if across > 0.0 and dz < 0.0:
                    d = np.sqrt(d2)
                    total += (across / d) ** LED_ROUGH * (-dz / d) ** LED_LOBE / d**LED_FALL
            out[2, v, u] += part * pale * led * total
            # The line: where the steepest way down the skin meets the plane, and whether the laser reaches that.
            ox, oy, oz = x[0] - sheet[0, 0], x[1] - sheet[0, 1], x[2] - sheet[0, 2]
            away = ox * sheet[1, 0] + oy * sheet[1, 1] + oz * sheet[1, 2]
            if abs(away) > 0.012:
                continue
            tilt = n[0] * sheet[1, 0] + n[1] * sheet[1, 1] + n[2] * sheet[1, 2]
            slope = max(1.0 - tilt * tilt, 0.15)
            if abs(away) > 0.012 * np.sqrt(slope):
                continue
            go = away / slope
            ox -= go * (sheet[1, 0] - tilt * n[0])
            oy -= go * (sheet[1, 1] - tilt * n[1])
            oz -= go * (sheet[1, 2] - tilt * n[2])
            ahead = ox * sheet[2, 0] + oy * sheet[2, 1] + oz * sheet[2, 2]
            aside = ox * sheet[3, 0] + oy * sheet[3, 1] + oz * sheet[3, 2]
            if ahead <= 0.0:
                continue
            angle = np.arctan2(aside, ahead)
            k = int(np.rint((angle + half) / step))
            if k < 0 or k >= len(reach):
                continue
            far = np.sqrt(ahead * ahead + aside * aside)
            past = far - reach[k]
            if past > shadow_m + 0.5 * abs(go):
                continue
            cosine = -(n[0] * ox + n[1] * oy + n[2] * oz) / far
            on = abs(go) * np.sqrt(slope)
            if cosine <= 0.0:
                continue
            glow = (
                skirt
                * far**SKIRT_NEAR
                * slope**skirt_slope
                * cosine**skirt_cosine
                * np.exp(-0.5 * (on / skirt_m) ** 2)
            )
            glow += core * cosine * np.exp(-0.5 * (away / core_m) ** 2)
            out[1, v, u] += part * pale * glow / far
