"""Prior model of a wrist device and its hand, before the first strobe cycle."""

from dataclasses import dataclass, replace
from math import radians

import numpy as np

from common.arrays import Float
from common.errors import CalibrationError
from common.hand.limits import ABDUCTION, FLEXION
from common.hand.model import HandModel
from master.estimator.cubic import CubicLaw, lit
from master.estimator.flexion_synergy import DIP, PIP, FlexionSynergy
from master.estimator.wrist_device import Device
from master.rig.wrist import WristSetup

_DIP_PER_PIP = 0.5 * (2.0 / 3.0 + 0.84)  # between the ratios of both papers
_ASIDE_RAD = radians(25.0)
_BEYOND_RAD = radians(8.0)  # of limits: those of a hand file are a prior's, not a wall's
_DIP_SPREAD_RAD = radians(7.0)


@dataclass(frozen=True, slots=True, eq=False)
class WristModel:
    """A wrist device, and how the fingers that it sees bend.

    Attributes:
        device: As arrays.
        natural, slope: (5, 4) natural angles by the PIP: natural + slope PIP.
        frame: (4,) least and most x and y of the ray of a fingertip that is clearly in the image.
        frame_s: From the laser's frame to that of the LEDs.
        loose: Whether the wrist may bend before the device.
        tilt_rad: By which the IMU may have the vertical off.
        heading_rad: By which its heading may be off in the beginning; None: it may be any.
        natural_only: Whether fingers are taken to bend naturally, whatever is seen.
        cubic: The paper's law; None: the hand's own bones count.
    """

    device: Device
    base_rad: Float
    per_pip: Float
    frame: Float
    frame_s: float
    loose: bool
    tilt_rad: float
    heading_rad: float | None
    natural_only: bool
    cubic: CubicLaw | None

    @classmethod
    def of(cls, setup: WristSetup, *, loose: bool) -> "WristModel":
        """Lay out a device; `loose`: whether the wrist may bend.

        Raises:
            CalibrationError: The laser passes by the hand.
        """
        synergy, optics = FlexionSynergy.of(setup.model), setup.optics
        per_pip = synergy.per_pip.copy()
        if setup.model.profile.couplings is None and setup.solver_mode != "fk":
            per_pip[1:, DIP] = _DIP_PER_PIP
        ip_per_mcp = 1.1  # of thumbs: between those of grasps and the ratio of the limits
        per_pip[0, DIP] = ip_per_mcp
        base_rad = synergy.base_rad.copy()
        base_rad[0, DIP] = 0.0
        if not lit(setup, synergy):
            raise CalibrationError(
                "laser_plane, T_camera_palm: the laser meets no finger of this hand however it is bent: calibrate plane"
                " and palm"
            )
        size = np.array([optics.width_px, optics.height_px])
        centre = np.array([optics.matrix[0, 2], optics.matrix[1, 2]])
        focal = np.array([optics.matrix[0, 0], optics.matrix[1, 1]])
        inside_px = 20.0  # from the edge of the image: a fingertip there is clearly in it
        low, high = (inside_px - centre) / focal, (size - inside_px - centre) / focal
        return cls(
            Device.of(setup),
            base_rad,
            per_pip,
            np.array([low[0], high[0], low[1], high[1]]),
            setup.frame_s,
            loose,
            0.0 if setup.imu is None else setup.imu.orientation_sigma_rad,
            None if setup.imu is None else setup.imu.heading_sigma_rad,
            setup.solver_mode == "fk",
            CubicLaw(setup) if setup.cubic else None,
        )


def loosened(model: HandModel) -> HandModel:
    """Return the hand model with the loose couplings that a wrist device needs.

    The DIPs follow the PIP loosely, and the limits have room.
    """
    limits = model.limits_rad.copy()
    limits[1:, ABDUCTION] = -_ASIDE_RAD, _ASIDE_RAD
    limits[1:, [FLEXION, PIP, DIP], 0] -= _BEYOND_RAD
    limits[1:, [FLEXION, PIP, DIP], 1] += _BEYOND_RAD
    ratio = model.dip_per_pip
    if model.profile.couplings is None:
        ratio = _DIP_PER_PIP
    spread = max(model.dip_spread_rad, _DIP_SPREAD_RAD)
    return replace(
        model, tolerance_rad=np.zeros((5, 4)), limits_rad=limits, dip_per_pip=ratio, dip_spread_rad=spread
    )
