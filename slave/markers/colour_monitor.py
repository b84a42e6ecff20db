"""Early warning that a marker's colour is about to leave its range.

It warns while the marker is still detected, by the distance of its colour from the border of its range.

Colours are undone to the light of calibration first, so what is left is what following the light does not mend: light
beyond the bounds, a lamp whose colour von Kries' law does not describe, a marker that is dirty or worn. Each
marker's hue, saturation and value are averaged over half a second; the room to each border of its range is counted
in the spread of that average, so a colour that flickers is warned of earlier.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float
from common.calibration import HsvRange
from common.geometry.srgb import to_srgb
from slave.markers.classify import HUES

TIME_S = 0.5
LEAST_S = 0.3  # of observations before a verdict
# Smallest spread that is assumed, of hue (of 180), saturation and value (of 255): what noise leaves of one pixel.
FLOOR = np.array([1.5, 8.0, 8.0])


@dataclass(frozen=True, slots=True)
class ColourWarning:
    """Something that will cost a marker, and what to do.

    Attributes:
        marker: Its name; None: it concerns all.
        text: What is seen, and the fix.
        ambiguous: Another marker that looks like it; None: it is about this one alone.
        hues: How far the two are apart, of 180.
    """

    marker: str | None
    text: str
    ambiguous: str | None = None
    hues: float = 0.0


def hsv(light: Float) -> Float:
    """Convert linear light (..., 3), blue first, to OpenCV's HSV.

    H (0..180), S and V (0..255), unrounded.
    """
    code = 255.0 * to_srgb(light)
    blue, green, red = code[..., 0], code[..., 1], code[..., 2]
    value, span = code.max(axis=-1), np.ptp(code, axis=-1)
    safe = np.maximum(span, 1e-9)
    sector = np.select(
        [value == red, value == green],
        [(green - blue) / safe, 2.0 + (blue - red) / safe],
        4.0 + (red - green) / safe,
    )
    hue = np.where(span > 0.0, 30.0 * sector % HUES, 0.0)
    return np.stack([hue, 255.0 * span / np.maximum(value, 1e-9), value], axis=-1)


class ColourMonitor:
    """Monitor of the margin between every marker's colour and its range.

    Holds the mean, spread and observed time of each marker, and for which markers a warning was given.
    """

    def __init__(self, names: Sequence[str], ranges: Mapping[str, HsvRange]) -> None:
        """Watch `names`, each in its range."""
        self._names = tuple(names)
        low = np.array([ranges[name].hsv_low for name in names], np.float64)
        high = np.array([ranges[name].hsv_high for name in names], np.float64)
        self._half = (
            np.where(high[:, 0] >= low[:, 0], high[:, 0] - low[:, 0], high[:, 0] + HUES - low[:, 0]) / 2.0
        )
        self._middle = (low[:, 0] + self._half) % HUES
        self._low, self._range = low, ranges
        count = len(self._names)
        self._mean = np.full((count, 3), np.nan)  # hue as the distance from the middle of the range
        self._variance = np.zeros((count, 3))
        self._monitored_s = np.zeros(count)
        self._warned = np.zeros(count, np.bool_)
        self._t_ns: int | None = None

    def push(self, light: Float, clarity: Float, t_ns: int) -> list[ColourWarning]:
        """Take in one frame; what is to be warned of now.

        Args:
            light: (M, 3) linear light of each marker's core, undone to the light of calibration; NaN: not seen.
            clarity: (M,) 0..1; NaN: not seen.
            t_ns: Time of the frame [ns], rising.
        """
        dt_s = 0.0 if self._t_ns is None else min(max(t_ns - self._t_ns, 0) * 1e-9, TIME_S)
        self._t_ns = t_ns
        # clarity of an observation that counts: a half covered marker is mixed with what covers it
        good = np.isfinite(light).all(axis=1) & (np.nan_to_num(clarity) >= 0.4)
        if good.any():
            self._learn(good, hsv(np.maximum(light[good], 1e-5)), dt_s)
        room = self.room()
        with np.errstate(invalid="ignore"):
            # spreads: less is a warning; a marker that is warned of is well again with
            well = 3.0
            self._warned = np.where(np.isnan(room), self._warned, room < np.where(self._warned, well, 2.0))
        warned = [self._of(int(m), float(room[m])) for m in np.flatnonzero(self._warned)]
        return warned + self._ambiguous()

    def room(self) -> Float:
        """Return the margin (M,) of each colour to the nearest border of its range.

        In spreads; NaN: not observed for long enough.
        """
        spread = np.maximum(np.sqrt(self._variance), FLOOR)
        hue = (self._half - np.abs(self._mean[:, 0])) / spread[:, 0]
        rest = (self._mean[:, 1:] - self._low[:, 1:]) / spread[:, 1:]
        room = np.minimum(hue, rest.min(axis=1))
        return np.where(self._monitored_s >= LEAST_S, room, np.nan)

    def _learn(self, good: Bool, seen: Float, dt_s: float) -> None:
        seen[:, 0] = (seen[:, 0] - self._middle[good] + HUES / 2.0) % HUES - HUES / 2.0
        fresh = np.isnan(self._mean[good, 0])
        mean = np.where(fresh[:, None], seen, self._mean[good])
        share = 1.0 - np.exp(-dt_s / TIME_S)
        away = seen - mean
        self._mean[good] = mean + share * away
        self._variance[good] = (1.0 - share) * (self._variance[good] + share * away**2)
        self._monitored_s[good] += dt_s

    def _of(self, m: int, room: float) -> ColourWarning:
        name, colour = self._names[m], self._range[self._names[m]]
        h, s, v = self._mean[m, 0] + self._middle[m], self._mean[m, 1], self._mean[m, 2]
        return ColourWarning(
            name,
            f"marker {name}: its colour H {h % HUES:.0f} S {s:.0f} V {v:.0f} is {max(room, 0.0):.1f} spreads from the "
            f"border of its range {colour.hsv_low}-{colour.hsv_high}: clean or repaint it, or calibrate the colours "
            f"under this light",
        )

    def _ambiguous(self) -> list[ColourWarning]:
        hue = (self._mean[:, 0] + self._middle) % HUES
        apart = np.abs(hue[:, None] - hue[None, :])
        apart = np.minimum(apart, HUES - apart)
        long = self._monitored_s >= LEAST_S
        with np.errstate(invalid="ignore"):
            # hues: two marker colours nearer than this look the same
            near = (apart < 8.0) & long[:, None] & long[None, :]
        return [
            ColourWarning(
                self._names[a],
                f"markers {self._names[a]} and {self._names[b]} look alike, hues {hue[a]:.0f} and {hue[b]:.0f}: "
                f"take brighter light, or repaint one",
                self._names[b],
                float(apart[a, b]),
            )
            for a, b in np.argwhere(np.triu(near, 1)).tolist()
        ]
