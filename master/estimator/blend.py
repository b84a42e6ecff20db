"""Blending of a hand over jumps that are no motion.

The hand is watched by several kinds of sensors. It is blended part by part: the palm and each finger.

Such a hand is solved elsewhere from one epoch to the next whenever another marker is seen or one less, when another
sensor measures a finger, and when what is measured without markers jumps. What is shown goes on as the hand moves,
and all that leads elsewhere is led in, no faster than a given speed.

How the hand moves meanwhile is estimated without solving it: the palm goes as those markers on its back go that are in
both epochs, and everything else at half the speed at which it was shown.
"""

from math import exp

import numpy as np

from common.arrays import Bool, Float, Int
from master.estimator.observation_sources import BY_MARKERS

PLACE, ROTATION, ANGLES = slice(0, 3), slice(3, 6), slice(6, 26)
PARTS: Int = np.repeat([5, 0, 1, 2, 3, 4], [6, 4, 4, 4, 4, 4])  # signal -> finger, or 5: the palm


class Blend:
    """Push machine that holds the offsets that remain of jumps.

    It also holds the sources the hand was based on, its markers and its speed.
    """

    def __init__(self, blend_m_s: float, on_palm: Bool) -> None:
        """Blend each part no faster than a speed [m/s].

        `on_palm` (M,) marks which markers sit on the back.
        """
        self._blend_m_s, self._on_palm = blend_m_s, on_palm
        self._offset, self._speed = np.zeros(26), np.zeros(26)
        self._sources = np.zeros(6, np.int64)
        self._points_m = np.full((len(on_palm), 3), np.nan)

    def push(self, gap_s: float, sources: Int, shown: Float, solved: Float, points_m: Float) -> Float:
        """Return the offset to be added to the solved signals (26,) [m].

        The signals are those of `master.estimator.smooth`.

        Args:
            gap_s: Time since the last; 0: there is none.
            rests: (6,) as of `Fitted`.
            shown, solved: (26,) what was shown last, what is solved now.
            points_m: (M, 3) the markers; NaN: not seen.
        """
        if gap_s > 0.0:
            # of it: a motion that is not seen any more rather ends than goes on
            stale_s = 0.1  # after such a gap nothing of a speed is left
            goes_on = shown + 0.5 * min(gap_s, stale_s) * self._speed
            went = (points_m - self._points_m)[self._on_palm]
            went = went[np.isfinite(went[:, 0])]
            if len(went) and gap_s <= stale_s:
                goes_on[PLACE] = shown[PLACE] + went.mean(axis=0)
            off = np.sqrt(np.bincount(PARTS, np.square(goes_on - solved - self._offset)))
            triangulated = (sources & self._sources & BY_MARKERS) > 0
            blended_m, nothing_m = 1e-3, 1e-5  # a part that is led by more is not yet where its markers are
            led = np.bincount(PARTS, np.abs(self._offset)) > blended_m
            sudden_m = 3e-3  # from one epoch to the next, beside motion
            leaps = ((sources != self._sources) | ~triangulated | led) & (off > sudden_m)
            self._offset = np.where(leaps[PARTS], goes_on - solved, self._offset)
            size_m = np.maximum(np.bincount(PARTS, np.abs(self._offset)), nothing_m)
            step_m = 5e-3  # is the most that is led between two poses
            left = 1.0 - min(self._blend_m_s * gap_s, step_m) / size_m
            ease_s = 0.04  # in which the last of what is led fades
            self._offset = self._offset * np.maximum(left, exp(-gap_s / ease_s))[PARTS]
        self._sources, self._points_m = sources, points_m
        return self._offset

    def moved(self, gap_s: float, step: Float) -> None:
        """Learn from the step (26,) [m] of what was shown."""
        if gap_s > 0.0:
            speed_s = 0.03  # of the shown hand, which is smooth
            self._speed = self._speed + (1.0 - exp(-gap_s / speed_s)) * (step / gap_s - self._speed)
