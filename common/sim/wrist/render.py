"""Scene -> frames of the wrist camera: by ambient light, by the laser, by the LEDs.

Skin is shaded on a coarser grid (rays against the flesh, then Lambert), and enlarged; the laser line is drawn from its
exact curve, each piece as wide and as bright as the sheet of light is there, to parts of a pixel.
"""

from copy import copy

import cv2
import numpy as np

from common.arrays import Float, Image
from common.errors import CalibrationError
from common.frame_recording import Illumination
from common.sim.wrist import light
from common.sim.wrist.light import Plane
from common.sim.wrist.scene import WristScene
from common.sim.wrist.skin import Skin, SkinView
from common.sim.wrist.stripe import draw_stripe

REAL_TIME_STEP = 2  # px between the rays that shade skin; 1 is twice as sharp and four times slower


class WristRenderer:
    """Images of one scene. It holds prepared rays, the palm, the room and noise; a frame is a pure function of t."""

    def __init__(self, scene: WristScene, camera: str, step: int = REAL_TIME_STEP) -> None:
        """Prepare all that stands still (some tenths of a second).

        Args:
            scene: What it looks at.
            camera: The one camera of its rig.
            step: Pixels between the rays that shade skin.

        Raises:
            CalibrationError: No such camera.
        """
        if camera not in scene.rig.cameras:
            raise CalibrationError(f"rig {scene.rig.name!r}: cameras: no camera {camera!r}")
        self._scene = scene
        optics = scene.optics
        self._skin = Skin(scene, step)
        self._room = light.ROOMS[scene.ambient]
        self._backdrop = light.backdrop(self._room, optics, scene.seed, self._skin.size)
        self._sensor = light.Sensor(optics.height_px, optics.width_px, scene.seed)
        self._led = np.array(scene.rig.led, dtype=np.float64)
        self._gain = 1.0

    def exposed(self, exposure_us: float, gains_bgr: Float) -> "WristRenderer":
        """The same scene before a camera with other settings; shares all that was prepared.

        Args:
            exposure_us: Exposure [us].
            gains_bgr: Brightness (3,) against that of the camera file; the middle one counts, as the camera is grey.
        """
        other = copy(self)
        other._gain = float(gains_bgr[1])
        return other

    def render(self, t_s: float, lit: Illumination) -> Image:
        """Image (H, W), grey, of the frame at mid-exposure at scene time `t_s` [s], lit by the room and by `lit`."""
        bodies = self._scene.flesh.bodies(self._scene.joints_at(t_s))
        view = self._skin.look(bodies)
        level = self._ambient(view)
        if lit is Illumination.LED:
            shade = light.led_light(view.points, view.normals, self._led)
            shade *= np.float32(light.LED_LEVEL) * view.albedo * self._skin.flat(view.pixel)
            level.reshape(-1)[view.pixel] += shade
        optics = self._scene.optics
        full = cv2.resize(level, (optics.width_px, optics.height_px), interpolation=cv2.INTER_LINEAR)
        if lit is Illumination.LASER:
            draw_stripe(full, self._scene, bodies, self._skin, view)
        if self._gain != 1.0:
            full *= self._gain
        return self._sensor.bytes_of(full, round(t_s * 1e6))

    def _ambient(self, view: SkinView) -> Plane:
        """Levels on the coarse grid by the light of the room."""
        level = self._backdrop.copy()
        if self._room.hand > 0.0:
            sky = 0.62 - 0.3 * view.normals[:, 1] + 0.1 * view.normals[:, 0]
            level.reshape(-1)[view.pixel] = self._room.hand * view.albedo * sky
        return level
