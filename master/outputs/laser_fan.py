"""Drawable lines of a wrist device's laser light.

Rays of its fan, and arcs across them.
"""

import numpy as np

from common.arrays import Float
from common.calibration import RigCalibration
from master.outputs.palette import Rgb
from master.rig.wrist import WristSetup

LASER_RGB: Rgb = (235, 64, 52)
_FAN_RAD = np.radians(105.0)  # of the laser line of Digits, where the rig does not specify it
_REACH_M = (0.06, 0.12, 0.18)  # arcs; the fingers of a large hand end within the last


def fan_rays(rig: RigCalibration, setup: WristSetup) -> Float:
    """Return unit directions (K, 3) of the laser fan in the camera frame.

    Evenly spaced over the fan.

    Where the rig does not specify where its middle goes, that is the camera's view, as far as it lies in the plane.
    """
    laser = rig.laser
    ahead = np.array([0.0, 0.0, 1.0] if laser is None or laser.forward is None else laser.forward)
    ahead = ahead - (ahead @ setup.normal) * setup.normal
    ahead /= np.linalg.norm(ahead)
    across = np.cross(setup.normal, ahead)
    half = (_FAN_RAD if laser is None or laser.fan_rad is None else laser.fan_rad) / 2.0
    rays = 22  # about every 5 degrees
    angles = np.linspace(-half, half, rays)[:, None]
    return np.cos(angles) * ahead + np.sin(angles) * across


def fan(laser_m: Float, rays: Float) -> list[Float]:
    """Return the line strips (n, 3) [m] of a laser fan: rays, and arcs across.

    From `laser_m` (3,) along `rays` (K, 3).
    """
    outline = [np.stack([laser_m, laser_m + _REACH_M[-1] * ray]) for ray in rays]
    return outline + [laser_m + reach * rays for reach in _REACH_M]
