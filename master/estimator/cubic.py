"""The printed cubic: PIP by the distance of the laser point (Kim et al. 2012).

    PIP [deg] = -0.0003 d^3 + 0.059 d^2 - 4.07 d + 119.75        d in mm

It needs no bones: d is how far the laser point is from where that finger's point comes nearest to the device (the
paper takes that for the knuckle), along the finger's principal axis of motion. So it runs from 119.75 degrees at d = 0
to none at d = 102.06 mm, and outside it stays there. The axis is what a guided curl measured (`finger_lines` of the
rig), or else that of the simulated curl. A thumb has no PIP, and is left to the natural curve.

As a law of any particular hand it is wrong by 12 to 20 degrees, and one digit more in 0.0003 would move its root
between 71 and 152 mm: it is here to compare with (`forward` of the rig: "cubic").
"""

import numpy as np

from common.arrays import Float
from common.calibration.wrist import FingerLine
from common.hand.model import FINGERS
from common.kernels import kernel
from common.messages.records import boxed
from master.estimator.finger_lines import on_line, principal_line
from master.estimator.finger_surface import OWN_MOVES, Surface, laser_centroid, look
from master.estimator.flexion_synergy import FlexionSynergy
from master.estimator.hand_tables import HandTables
from master.estimator.parameters import HandParameters
from master.estimator.wrist_device import Device, flexed_palm
from master.rig.wrist import WristSetup

ROOT_MM = 102.06
_POLYNOMIAL = (-0.0003, 0.059, -4.07, 119.75)


def cubic_pip(distance_m: Float) -> Float:
    """Return the PIP angle [rad] by the printed law.

    It is clamped outside 0 ... 102.06 mm; NaN where the distance is NaN.
    """
    d = np.clip(1e3 * distance_m, 0.0, ROOT_MM)
    return np.radians(np.clip(np.polyval(_POLYNOMIAL, d), 0.0, _POLYNOMIAL[-1]))


@kernel
def _laser_points(
    boxed_hand: Float, boxed_device: Float, angles: Float, boxed_work: Float, out: Float
) -> None:
    """Write laser points (C, 5, 3) [m] of hands of angles (C, 20).

    NaN where the laser misses a finger.
    """
    palm, axes = np.zeros((4, 4)), np.zeros((2, 3))
    hand, device, work = boxed_hand[0], boxed_device[0], boxed_work[0]
    flexed_palm(device.palm, 0.0, 0.0, palm, axes)
    for c in range(angles.shape[0]):
        for f in range(5):
            look(hand, device, palm, axes, angles[c], f, OWN_MOVES, work)
            lit = laser_centroid(device, f, work) > 0.0
            for i in range(3):
                out[c, f, i] = work.laser_centroid[i] if lit else np.nan


def lit(setup: WristSetup, synergy: FlexionSynergy) -> bool:
    """Return whether the laser meets a finger that closes naturally."""
    return bool(np.isfinite(_curl(setup, synergy)[:, 1:, 0]).any())


def simulated_lines(setup: WristSetup) -> tuple[FingerLine, ...]:
    """Return the lines (5) of a whole curl of the simulated hand.

    The fingers are neither spread nor crossed.
    """
    points = _curl(setup, FlexionSynergy.of(setup.model))
    return tuple(principal_line(points[np.isfinite(points[:, f, 0]), f]) for f in range(5))


def _curl(setup: WristSetup, synergy: FlexionSynergy) -> Float:
    """Return laser points (C, 5, 3) [m] of a hand that closes.

    NaN where the laser misses a finger.
    """
    model = setup.model
    curls = 31
    branch = 0.75  # of a curl: after that the last phalanx folds into the light, and the line jumps to it
    share = np.linspace(0.0, branch, curls)[:, None]
    curl = synergy.range_rad[:, 0] + share * (synergy.range_rad[:, 1] - synergy.range_rad[:, 0])
    angles = synergy.angles(curl, np.zeros_like(curl)).reshape(curls, 20)
    points = np.empty((curls, 5, 3))
    tables = HandTables.of(model, HandParameters.of(model))
    _laser_points(boxed(tables), boxed(Device.of(setup)), angles, boxed(Surface.empty()), points)
    return points


class CubicLaw:
    """Printed law that maps laser points of one device to angles.

    What it holds was prepared by the constructor.
    """

    def __init__(self, setup: WristSetup) -> None:
        simulated = simulated_lines(setup)
        self.lines = tuple(setup.lines.get(name, line) for name, line in zip(FINGERS, simulated, strict=True))

    def __call__(self, points_m: Float) -> Float:
        """Return the PIPs (5,) [rad] of laser points (5, 3) [m].

        The points are on the laser plane, in the camera frame. NaN: not seen, and for the thumb.
        """
        pip = np.full(5, np.nan)
        for f, line in enumerate(self.lines[1:], start=1):
            along, _ = on_line(points_m[f], line)
            pip[f] = cubic_pip((1.0 - along) * (line.range_m[1] - line.range_m[0]))
        return pip
