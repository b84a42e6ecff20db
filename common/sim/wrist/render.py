"""Renderer from scene to wrist camera frames: ambient, laser and LED.

Ambient is the light of the room alone.

Skin is shaded on a coarser grid (rays against the flesh, then Lambert), and enlarged; the laser line is drawn from its
exact curve, each piece as wide and as bright as the sheet of light is there, to parts of a pixel.
"""

from copy import copy

import cv2
import numpy as np

from common.arrays import Float, Image
from common.errors import CalibrationError
from common.geometry.tapered_capsules import Capsules, Plane
from common.recording.frame_recording import Illumination
from common.sim.wrist import light
from common.sim.wrist.scene import WristScene
from common.sim.wrist.stripe import draw_stripe
from common.sim.wrist.surface import HandSurface, SurfaceView

# For a camera that loses what it has no time to draw. Half the time; fingertips are found as often and as well, and
# the laser line is drawn to parts of a pixel of the picture whatever the step is.
LIVE_STEP = 4
LIVE_WRIST_RAD = np.radians(
    0.25
)  # the palm of a bent wrist is drawn anew by such steps: a tenth of a millimetre, twice
_ILLUMINATIONS = tuple(Illumination)  # frames of one strobe cycle differ in their noise, too
SATURATED = np.float32(300.0)  # levels: more cannot be seen, but would widen edges


class WristRenderer:
    """Renderer of one wrist scene.

    It holds prepared rays, the palm of a straight wrist, the room and noise; a frame is a pure function of t.
    """

    def __init__(
        # px between the rays that shade skin; 1 is twice as sharp and four times slower
        self,
        scene: WristScene,
        camera: str,
        step: int = 2,
        wrist_step_rad: float = 0.0,
    ) -> None:
        """Prepare all that stands still (some tenths of a second).

        Args:
            scene: What it looks at.
            camera: The one camera of its rig.
            step: Pixels between the rays that shade skin.
            wrist_step_rad: To multiples of this the bend is rounded at which the palm is drawn; 0: not at all.

        Raises:
            CalibrationError: No such camera.
        """
        if camera not in scene.rig.cameras:
            raise CalibrationError(f"rig {scene.rig.name!r}: cameras: no camera {camera!r}")
        self._scene = scene
        self._surface = HandSurface(scene, step, wrist_step_rad)
        self._room = light.Room.of(scene.ambient, scene.seed)
        self._leds = light.Leds(np.array(scene.rig.led, dtype=np.float64))
        optics = scene.optics
        self._sensor = light.Sensor(optics.height_px, optics.width_px, scene.seed)
        self._gain = 1.0
        self._behind = self._room.backdrop(self._surface.size, optics.width_px / self._surface.size[0])
        self._still = {
            lit: self._shaded(self._behind, self._surface.straight.seen, lit)
            for lit in (Illumination.AMBIENT, Illumination.LED)
        }

    def exposed(self, exposure_us: float, gains_bgr: Float) -> "WristRenderer":
        """Return a renderer of the same scene for a camera with other settings.

        It shares everything that was prepared.

        Args:
            exposure_us: Exposure [us]; so short that nothing smears.
            gains_bgr: Brightness (3,) against that of the camera file; the middle one counts, as the camera is grey.
        """
        other = copy(self)
        other._gain = float(gains_bgr[1])
        return other

    def render(self, t_s: float, lit: Illumination) -> Image:
        """Render the frame at mid-exposure at scene time `t_s`.

        Image (H, W), grey; `t_s` in [s]; lit by the room and by `lit`.
        """
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
        level += np.float32(light.BLACK_LEVEL)
        return self._sensor.bytes_of(level, 4 * round(t_s * 1e6) + _ILLUMINATIONS.index(lit))

    def _shaded(
        self, behind: Plane, surface: SurfaceView, lit: Illumination, things: Capsules | None = None
    ) -> Plane:
        """Return the shaded levels on the coarse grid.

        `behind` with skin in front of it, and things in the light of the LEDs.
        """
        shade = self._room.on_surface(surface.normals)
        if lit is Illumination.LED:
            shade += (
                self._leds.on_surface(surface.points, surface.normals, things)
                * self._surface.flat[surface.pixel]
            )
        level = behind.copy()
        level.reshape(-1)[surface.pixel] = shade * surface.albedo * np.float32(self._scene.reflectance)
        return level


def _sharp(coarse: Plane, size: tuple[int, int]) -> Plane:
    """Upsample levels to the full grid with edges as soft as the lens makes them.

    This concerns edges of skin in front of a window; they are not as coarse as the grid.
    """
    cut = cv2.GaussianBlur(np.minimum(coarse, SATURATED), (3, 3), 0.6)
    return np.asarray(cv2.resize(cut, size, interpolation=cv2.INTER_LINEAR), dtype=np.float32)
