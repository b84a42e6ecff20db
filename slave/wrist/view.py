"""Knowledge of the slave of a wrist device before the first frame.

Device and hand, and the LEDs that light it.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.calibration import CameraCalibration, HandProfile, RigCalibration
from common.calibration.wrist import FlatField
from common.hand.model import HandModel
from common.hand.wrist_device import WristDevice


@dataclass(frozen=True, slots=True, eq=False)
class WristView(WristDevice):
    """A wrist rig, its camera and its hand, checked.

    Attributes:
        led_m: LEDs (L, 3) [m]; none known: (0, 3).
        flat_field: What the LEDs make of a white surface, where it was measured.
    """

    led_m: Float
    flat_field: FlatField | None

    @classmethod
    def of(cls, rig: RigCalibration, camera: CameraCalibration, hand: HandProfile) -> "WristView":
        """Bring the three files together.

        Raises:
            CalibrationError: As of `WristDevice.joined`, or a joint of the hand is wrong.
        """
        device = WristDevice.joined(rig, camera, HandModel.of(hand))
        return cls(
            optics=device.optics,
            model=device.model,
            T_camera_palm=device.T_camera_palm,
            normal=device.normal,
            offset_m=device.offset_m,
            led_m=np.array(rig.led or (), dtype=np.float64).reshape(-1, 3),
            flat_field=rig.flat_field,
        )
