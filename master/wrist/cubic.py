"""The law printed in the paper: PIP [deg] = -0.0003 d^3 + 0.059 d^2 - 4.07 d + 119.75, d in mm (Digits, UIST 2012).

It needs no bones: d is how far the laser point is from where that finger's point comes nearest to the device (the
paper takes that for the knuckle), along the finger's principal axis of motion. So it runs from 119.75 degrees at d = 0
to none at d = 102.06 mm, and outside it stays there. What deviates from the axis sideways is abduction, seen from the
knuckle: atan(deviation / distance). The axis is what a guided curl measured (`finger_lines` of the rig), or else that
of the simulated curl. A thumb has no PIP, and is left to the table.

As a law of any particular hand it is wrong by 12 to 20 degrees, and one digit more in 0.0003 would move its root
between 71 and 152 mm: it is here to compare with (`forward` of the rig: "cubic").
"""

from dataclasses import replace

import numpy as np

from common.arrays import Float
from common.geometry import transform
from common.hand_model import CHAINS, FINGERS
from common.wrist_calibration import FingerLine
from master.wrist.finger_lines import on_line, principal_line
from master.wrist.forward import ForwardTable
from master.wrist.invert import Closed
from master.wrist.laser_plane import PlaneAxes
from master.wrist.setup import WristSetup

ROOT_MM = 102.06
_POLYNOMIAL = (-0.0003, 0.059, -4.07, 119.75)


def cubic_pip(distance_m: Float) -> Float:
    """PIP [rad] by the printed law, clamped outside 0 ... 102.06 mm; NaN where the distance is."""
    d = np.clip(1e3 * distance_m, 0.0, ROOT_MM)
    return np.radians(np.clip(np.polyval(_POLYNOMIAL, d), 0.0, _POLYNOMIAL[-1]))


def simulated_lines(table: ForwardTable, axes: PlaneAxes) -> tuple[FingerLine, ...]:
    """The lines (5) of a whole curl of the simulated hand, fingers neither spread nor crossed."""
    straight = np.abs(table.abduction_rad).argmin(axis=1)
    return tuple(
        principal_line(axes.space(table.point_m[f, table.length_px[f, :, a] > 0.0, a]))
        for f, a in enumerate(straight)
    )


class CubicLaw:
    """Reads laser points of one device by the printed law. What it holds was prepared by the constructor."""

    def __init__(self, setup: WristSetup, table: ForwardTable) -> None:
        self._axes = PlaneAxes.of(setup)
        simulated = simulated_lines(table, self._axes)
        self.lines = tuple(setup.lines.get(name, line) for name, line in zip(FINGERS, simulated, strict=True))
        self._knuckle = transform(setup.T_camera_palm, setup.model.rest_position_m[CHAINS[:, 0]])
        towards_thumb = setup.model.side_sign * setup.T_camera_palm[:3, 0]
        self._aside = np.stack([_across(line, setup.normal, towards_thumb) for line in self.lines])

    def __call__(self, point_m: Float, closed: Closed) -> Closed:
        """What the law says of points (5, 2) on the plane instead of the table, whose doubt it keeps."""
        points = self._axes.space(point_m)
        closing, abduction = closed.closing_rad.copy(), closed.abduction_rad.copy()
        for f, line in enumerate(self.lines[1:], start=1):
            along, deviation = on_line(points[f], line)
            closing[f] = cubic_pip((1.0 - along) * (line.range_m[1] - line.range_m[0]))
            away = float(np.linalg.norm(points[f] - self._knuckle[f]))
            abduction[f] = np.arctan2(deviation @ self._aside[f], away)
        return replace(closed, closing_rad=closing, abduction_rad=abduction)


def _across(line: FingerLine, normal: Float, towards: Float) -> Float:
    """Unit vector (3,) in the plane across the line, to the side of `towards`."""
    across = np.cross(normal, np.array(line.direction))
    return across * np.sign(across @ towards)
