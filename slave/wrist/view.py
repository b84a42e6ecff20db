"""Know device and hand before the first frame, and sample what fingers reach.

Knowledge of the slave of a wrist device before the first frame.

Device and hand, and the LEDs that light it.

Sample the workspace of the fingers of a hand as points along their bones.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.calibration import CameraCalibration, HandProfile, RigCalibration
from common.calibration.rig import FlatField
from common.hand.model import CHAINS, HandModel
from common.hand.wrist import WristDevice


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


PER_BONE = 6  # points along each bone
NEAREST_M = 0.03  # what is nearer to the camera is not seen as a finger


def finger_postures(view: WristView, *counts: int) -> Float:
    """Return postures (P, 5, 4) [rad] of index ... little in their limits.

    With so many abductions, flexions, PIP flexions.
    """
    low, high = view.model.limits_rad[1].T
    out = _all(*[_spread(low[k], high[k], n) for k, n in enumerate(counts)], np.zeros(1))
    dip_per_pip = 0.84  # of natural flexion (Kim et al. 2012)
    pip, dip = 2, 3
    out[..., dip] = dip_per_pip * out[..., pip]
    return out


def thumb_postures(view: WristView, *counts: int) -> Float:
    """Return postures (P, 5, 4) [rad] of the thumb in its limits.

    With so many values of each of its four angles.
    """
    low, high = view.model.limits_rad[0].T
    return _all(*(_spread(low[k], high[k], n) for k, n in enumerate(counts)))


def _spread(low: float, high: float, count: int) -> Float:
    """So many values (count,) from low to high; a single one is 0."""
    return np.linspace(low, high, count, dtype=np.float64) if count > 1 else np.zeros(1)


def _all(*values: Float) -> Float:
    """Return all combinations (P, 5, 4) of given values of the four angles [rad].

    The same for every finger.
    """
    grid = np.stack(np.meshgrid(*values, indexing="ij"), axis=-1).reshape(-1, 1, 4)
    return np.broadcast_to(grid, (len(grid), 5, 4)).copy()


def along_bones(view: WristView, angles: Float) -> Float:
    """Return points along the fingers' bones of postures (P, 5, 4).

    The points (P, 5, 3 PER_BONE, 3) [m] are in the palm frame, root first.
    """
    joints = view.model.chains(angles).position_m
    return _between(joints[:, :, :, None, :]).reshape(*joints.shape[:2], -1, 3)


def radius_along(view: WristView) -> Float:
    """Radius (5, 3 PER_BONE) [m] of the fingers at the points of `along_bones`."""
    return _between(view.model.radius_m[CHAINS][:, :, None, None]).reshape(5, -1)


def _between(ends: Float) -> Float:
    """Interpolate values (..., 3, PER_BONE, K) along three bones.

    From those (..., 4, 1, K) at their ends.
    """
    share = np.linspace(0.0, 1.0, PER_BONE, dtype=np.float64)[:, None]
    return ends[..., :-1, :, :] * (1.0 - share) + ends[..., 1:, :, :] * share


def in_image(view: WristView, palm_m: Float) -> tuple[Float, Float]:
    """Project points (..., 3) in the palm frame to pixels and depths.

    Pixels (..., 2) and depths (...) [m]; what is too near is held off.
    """
    camera = palm_m @ view.T_camera_palm[:3, :3].T + view.T_camera_palm[:3, 3]
    depth = camera[..., 2]
    held = np.concatenate([camera[..., :2], np.maximum(depth, NEAREST_M)[..., None]], axis=-1)
    return view.optics.project(held), depth
