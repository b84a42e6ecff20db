"""Selection of the action that a hand performs.

The hand's shape when the action begins decides, and until it ends there is no other.

    thumb and one finger meet, that finger bent out of the row      pinch
    the thumb meets a finger of four that lie side by side          tap
    all tips about a circle, thumb across                           dial
    index finger stretched, the others bent                         point

So a thumb on the index finger's tip is the key 1 over a row of fingers that are bent alike, and a pinch where the
finger has come to meet the thumb; and a finger that is stretched while a dial turns points at nothing.
"""

from common.arrays import Float
from common.calibration.gesture_settings import GestureSettings
from common.messages import Gesture
from master.gestures.dial import DialMonitor
from master.gestures.features import HandFeatures
from master.gestures.pinch import PinchMonitor
from master.gestures.point import PointMonitor
from master.gestures.taps import ThumbTapMonitor, is_pad
from master.gestures.touch import thumb_touch


class ActionMonitor:
    """Push machine. Holds the four watches, of which one at most is active."""

    def __init__(self, settings: GestureSettings, radius_m: Float) -> None:
        """Of a hand whose joints have the radii (26,) [m]."""
        self._radius_m, self._taps = radius_m, settings.tap
        self.pinch, self.dial = PinchMonitor(settings.pinch), DialMonitor(settings.dial)
        self.tap, self.point = ThumbTapMonitor(settings.tap), PointMonitor(settings.point)

    def push(self, seen: HandFeatures, *, wrist_device_only: bool = False) -> list[Gesture]:
        """Return the messages at the epoch of the features.

        `wrist_device_only`: all that sees the hand is worn on its arm, and the rig frame goes with it.
        """
        pinch, dial, tap, point = self.pinch, self.dial, self.tap, self.point
        touch = thumb_touch(seen, self._radius_m)
        others = dial.active or tap.active or point.active
        gestures = pinch.push(seen, touch, may_begin=not others and not is_pad(seen, self._taps))
        if pinch.active or dial.active or point.active:
            tap.drop()
        else:
            gestures += tap.push(seen, touch, may_begin=True)
        others = pinch.active or tap.active
        dial_may = not others and not point.active
        gestures += dial.push(
            seen, float(touch.gap_m.min()), may_begin=dial_may, wrist_device_only=wrist_device_only
        )
        return gestures + point.push(seen, may_begin=not others and not dial.active)

    def lost(self, t_ns: int) -> list[Gesture]:
        """Return the messages at an epoch at which there is no hand."""
        self.tap.drop()
        return self.pinch.lost(t_ns) + self.dial.lost(t_ns) + self.point.lost(t_ns)
