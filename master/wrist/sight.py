"""How sure it is what a wrist device saw of a finger: its laser point on the plane, and its tip in the image.

To the noise of the sensing comes what the model of the hand does not know: skin whose thickness is not that of this
person, what calibration leaves of plane and palm, and the part of the line that is not seen. The centroid of a line
shorter than expected is off across by up to half of what is missing, and by a third of that along, as skin curves away.
A tip is moved to the side by hinges that are not quite where the hand file has them, as far as bones are long.
"""

import numpy as np

from common.arrays import Float
from master.wrist.fingertip import Fingertips
from master.wrist.setup import WristSetup
from master.wrist.skin import SPREAD, Skin

_WHOLE = 0.75  # a line seen to this share of its length is not missing a part
HARDLY = 0.5  # less of it than this is no measurement of the finger
_CURVES = 1 / 3
_HINGE_RAD = np.radians(4.0)  # by which the axes of real hinges lie askew to those of a hand file
_PALM_M2 = (7e-4) ** 2  # what calibration leaves of plane and palm: a palm pitched by 0.2 degrees, and 0.3 mm


class SightNoise:
    """The noise of one device and hand. What it holds was prepared by the constructor."""

    def __init__(self, setup: WristSetup) -> None:
        self._skin_m2 = (SPREAD * Skin.of(setup.model).palmar_m.mean(axis=1)) ** 2
        beyond_m = Fingertips.of(setup.model).beyond_m
        self._tip_m2 = (SPREAD * beyond_m) ** 2 + _PALM_M2
        self._lever_m = np.linalg.norm(setup.model.bone_m[:, 1:], axis=-1).sum(axis=1) + beyond_m
        hinge = setup.T_camera_palm[:2, 0] / np.linalg.norm(setup.T_camera_palm[:2, 0])
        self._rolled_m2 = (_HINGE_RAD * self._lever_m)[:, None, None] ** 2 * np.outer(hinge, hinge)
        self._focal_px = setup.optics.matrix[0, 0]

    def laser_m2(self, cov_m2: Float, distance_m: Float, whole_px: Float, shown: Float) -> Float:
        """Covariances (5, 2, 2) [m^2] of points on the plane (across, along), finite.

        Args:
            cov_m2: (5, 2, 2) of the sensing; NaN: not seen.
            distance_m: (5,) of the points along the optical axis.
            whole_px: (5,) length of the lines if nothing hides a part of them.
            shown: (5,) share of it that was seen.
        """
        seen = np.isfinite(cov_m2[:, 0, 0]) & np.isfinite(distance_m)
        noise = np.where(seen[:, None, None], cov_m2, 0.0)
        missing = np.clip(_WHOLE - shown, 0.0, None) * whole_px / self._focal_px * distance_m
        hidden = np.where(seen, 0.5 * missing, 0.0) ** 2 / 3.0
        noise[:, 0, 0] += 0.25 * self._skin_m2 + _PALM_M2 + hidden
        noise[:, 1, 1] += self._skin_m2 + _PALM_M2 + _CURVES**2 * hidden
        return noise

    def tip(self, sigma_px: Float, distance_m: Float) -> Float:
        """Covariances (5, 2, 2) of tips (x / z, y / z).

        Args:
            sigma_px: (5,) of the sensing; NaN: not seen.
            distance_m: (5,) about how far away they are.
        """
        sensed = (sigma_px / self._focal_px) ** 2 + self._tip_m2 / distance_m**2
        return sensed[:, None, None] * np.eye(2) + self._rolled_m2 / distance_m[:, None, None] ** 2

    def turn_rad(self, sigma_px: Float, distance_m: Float) -> Float:
        """By how much a PIP turns (5,) to move a tip across the sight by its standard deviation; NaN: not seen."""
        return sigma_px / self._focal_px * distance_m / self._lever_m

    @staticmethod
    def shown(whole_px: Float, laser_px: Float) -> Float:
        """Shares (5,) of lines that were seen; 1 where their length is not known. None is longer than the whole."""
        whole = np.maximum(whole_px, 1.0)
        return np.nan_to_num(np.clip(laser_px, 0.0, whole) / whole, nan=1.0)

    @staticmethod
    def hidden(shown: Float) -> Float:
        """Of lines seen to these shares: 0 whole ... 1 hardly any (5,)."""
        return np.clip((_WHOLE - shown) / (_WHOLE - HARDLY), 0.0, 1.0)
