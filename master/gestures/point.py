"""Pointing: index finger extended, the three after it flexed, and the ray.

The ray goes on where the index finger points.

The ray goes from the knuckle through the tip and begins at the tip. Both ends are what a hand is fitted to best, the
tip by its own marker and the knuckle by the palm, and they are as far apart as anything that points: the same
millimetre turns the line knuckle - tip by a third of what it turns the last bone, whose direction is prior more than
measurement (the DIP follows the PIP). It begins at the tip because there is no hand beyond it.

How sure the ray is follows from what is known of both ends across it. One that may be off by more than a few degrees
is withheld: before one pair of cameras, a palm that faces them is known by its fingertips alone, and knuckles stand
anywhere within some centimetres. It must be sure twice in a row when the pointing begins; one that is not for a
moment later stays as it was last.

Nothing is smoothed here: the markers are already, by the 1 EUR filter with a cut-off that rises with speed, and a
hand at rest is held still by the hand's own filter. A second filter would only add its lag.
"""

from math import sqrt

import numpy as np

from common.arrays import Float
from common.calibration.gesture_actions import PointSettings
from common.hand.model import CHAINS
from common.kernels import kernel
from common.messages import Gesture, Phase
from master.estimator.matrices import spread
from master.gestures.features import HandFeatures
from master.gestures.held_gesture import HeldGesture

_KNUCKLE, _TIP = int(CHAINS[1, 0]), int(CHAINS[1, 3])


class PointMonitor:
    """Detector of pointing.

    Push machine. Holds the pointing that has begun, since when its shape is there or was lost, and if the ray was
    sure.
    """

    def __init__(self, settings: PointSettings) -> None:
        self._settings = settings
        self._point: HeldGesture | None = None
        self._since_ns: int | None = None  # of the shape before it begins; of its loss after
        self._sure = False  # whether the ray was
        self._last: Gesture | None = None

    @property
    def active(self) -> bool:
        """Whether the finger points."""
        return self._point is not None

    def push(self, seen: HandFeatures, *, may_begin: bool) -> list[Gesture]:
        """Return the messages at the epoch of the features.

        Pointing begins only where it may.
        """
        own, point = self._settings, self._point
        shape, before = self._shape(seen), self._sure
        held = 1.5  # the standard deviation of a ray that is reported already may be larger by this
        most_rad = own.ray_sigma_rad * (1.0 if point is None else held)
        self._sure = _ray_sigma_rad(seen.joints_m, seen.joints_cov_m2) <= most_rad
        if point is None:
            if not (shape and may_begin):
                self._since_ns = None
                return []
            if self._since_ns is None:
                self._since_ns = seen.t_ns
            if (seen.t_ns - self._since_ns) * 1e-9 < own.hold_s or not (self._sure and before):
                return []
            self._point, self._since_ns = HeldGesture(seen.hand, "point", "point", self._since_ns), None
            return [self._message(self._point, "begin", seen)]
        if shape and self._sure:
            self._since_ns = None
        elif self._over(seen.t_ns):
            return self._end(self._message(point, "end", seen))
        return [self._message(point, "update", seen)]

    def lost(self, t_ns: int) -> list[Gesture]:
        """Return the messages at an epoch at which there is no hand."""
        last = self._last
        if self._point is None or last is None or not self._over(t_ns):
            return []
        return self._end(
            self._point.message("end", t_ns, 0.0, origin_m=last.origin_m, direction=last.direction)
        )

    def _over(self, t_ns: int) -> bool:
        """Check whether the shape has been lost for long.

        The time counts from the first call.
        """
        if self._since_ns is None:
            self._since_ns = t_ns
        return (t_ns - self._since_ns) * 1e-9 >= self._settings.hold_s

    def _end(self, message: Gesture) -> list[Gesture]:
        self._point, self._since_ns, self._last = None, None, None
        return [message]

    def _shape(self, seen: HandFeatures) -> bool:
        """Check whether the index finger is extended and the others are flexed.

        It is checked as far as these are known.
        """
        own, going = self._settings, self.active
        slack = own.slack_rad if going else 0.0
        sigma: list[float] = seen.sigma_m.tolist()
        known = [one <= own.sigma_most_m for one in sigma]
        _, index, *others = _bends(seen)
        if not known[1] and not going:
            return False
        bent = all(
            bend >= own.bent_rad - slack or (going and not sure)
            for bend, sure in zip(others, known[2:], strict=True)
        )
        return bent and (index <= own.stretched_rad + slack or not known[1])

    def _message(self, point: HeldGesture, phase: Phase, seen: HandFeatures) -> Gesture:
        tip = seen.joints_m[_TIP]
        way = tip - seen.joints_m[_KNUCKLE]
        if not self._sure and self._last is not None:
            way = self._last.direction
        middle = 0.5 * (self._settings.stretched_rad + self._settings.bent_rad)
        clear = [min(max((bend - middle) / middle, 0.0), 1.0) for bend in _bends(seen)[2:]]
        known = 1.0 if seen.sigma_m[1] <= self._settings.sigma_most_m else 0.5
        self._last = point.message(
            phase, seen.t_ns, known * sum(clear) / len(clear), origin_m=tip, direction=way / sqrt(way @ way)
        )
        return self._last


def _bends(seen: HandFeatures) -> list[float]:
    """How far each finger is bent beyond its knuckle (5,) [rad]."""
    bends: list[list[float]] = seen.bend_rad.tolist()
    return [pip + dip for _, pip, dip in bends]


@kernel
def _ray_sigma_rad(joints: Float, cov: Float) -> float:
    """Return the standard deviation [rad] of the ray, about its worst axis.

    Arguments as of `HandFeatures`. What is across the ray of both ends' covariance counts: P C P with P = I - w w'.
    """
    x, y, z = (
        joints[_TIP, 0] - joints[_KNUCKLE, 0],
        joints[_TIP, 1] - joints[_KNUCKLE, 1],
        joints[_TIP, 2] - joints[_KNUCKLE, 2],
    )
    length = sqrt(x * x + y * y + z * z)
    w = x / length, y / length, z / length
    both, along, total = np.empty((3, 3)), np.zeros(3), 0.0
    for i in range(3):
        for k in range(3):
            both[i, k] = cov[_TIP, i, k] + cov[_KNUCKLE, i, k]
            along[i] += both[i, k] * w[k]
        total += w[i] * along[i]
    for i in range(3):
        for k in range(3):
            both[i, k] += w[i] * w[k] * total - w[i] * along[k] - along[i] * w[k]
    return spread(both)[1] / length
