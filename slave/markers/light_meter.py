"""Immediate detection of light changes on static parts of the image.

The same few hundred pixels of every frame are compared.

A camera of a rig does not move, so most of its picture is the same desk in every frame. The median over all
points of the log ratio to what each point showed before is the change of the light; a hand in front of some of them
does not move a median, and where a hand or a card covers too many, there is no answer. It measures only how the
light *changes*; where it stands against calibration only the marker colours determine (`drift`).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.arrays import Float, Image
from common.geometry.srgb import to_linear

GRID = 16  # points along each side
AGREE = 0.55  # share of the points that must agree
EVERY_NS = 50_000_000  # a slow change is measured so often,
LOG_LIGHT = np.log(np.maximum(to_linear(np.arange(256) / 255.0), 1e-4))


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """How the light changed since it was last measured.

    Attributes:
        log_gains: (3,) natural logarithms, blue, green, red; 0 where nothing can be estimated.
        sure: Enough points agree.
        agreeing: Share of all points that agree, 0..1.
    """

    log_gains: Float
    sure: bool
    agreeing: float


class LightMeter:
    """Measures changes of the light on the still points of one camera.

    Holds what each point shows under the light of the first frame, the light since then, the last time it was
    measured, and the last bytes.
    """

    def __init__(self, width: int, height: int) -> None:
        """Place the points on a grid over a picture of this size [px]."""
        u = ((np.arange(GRID) + 0.5) * width / GRID).astype(np.intp)
        v = ((np.arange(GRID) + 0.5) * height / GRID).astype(np.intp)
        self._pixel = (v[:, None] * width + u).reshape(-1)
        self._still: Float | None = None
        self._bytes: npt.NDArray[np.int16] | None = None
        self._light = np.zeros(3)
        self._t_ns = 0

    def push(self, image: Image, t_ns: int) -> Change | None:
        """The change since it was last measured; None where it need not be measured now.

        Args:
            image: (H, W, 3) BGR, C-contiguous.
            t_ns: Time of the frame [ns], rising.
        """
        bytes_ = image.reshape(-1, 3).take(self._pixel, axis=0)
        last, self._bytes = self._bytes, bytes_.astype(np.int16)
        if self._still is None or last is None:
            self._still, self._t_ns = LOG_LIGHT.take(bytes_), t_ns
            return None
        if 0 <= t_ns - self._t_ns < EVERY_NS:
            # and at once when this share of the bytes leapt by so much (noise is 2) since the last frame
            leap, leaping = 8, 0.2
            leaps = np.count_nonzero(np.abs(self._bytes - last) > leap)
            if leaps < leaping * bytes_.size:
                return None
        return self._measure(bytes_, self._still, t_ns)

    def _measure(self, bytes_: Image, still: Float, t_ns: int) -> Change:
        seen = LOG_LIGHT.take(bytes_)
        dt_s, self._t_ns = max(t_ns - self._t_ns, 0) * 1e-9, t_ns
        dark, bright = 12, 250  # bytes beyond which a point measures nothing: noise, or clipped
        usable = ((bytes_ >= dark) & (bytes_ <= bright)).all(axis=1)
        ratio = seen - still
        count = int(np.count_nonzero(usable))
        least = 48  # points that measure something
        if count < least:
            return Change(np.zeros(3), sure=False, agreeing=0.0)
        middle = np.partition(ratio[usable], count // 2, axis=0)[count // 2]
        # a point agrees when its log ratios are this near the median: three standard deviations of a dark desk
        alike = 0.25
        near = usable & (np.abs(ratio - middle) <= alike).all(axis=1)
        agreeing = float(np.count_nonzero(near)) / count
        sure = agreeing >= AGREE
        change = np.zeros(3)
        if sure:
            change, self._light = middle - self._light, middle
        # a point that agrees is learnt quickly, one that shows something else slowly
        quick_s, slow_s = 2.0, 10.0
        # Ratios are learnt relative to the light, so that the light itself is never learnt away.
        rate = np.full(GRID * GRID, -np.expm1(-dt_s / slow_s))
        rate[near] = -np.expm1(-dt_s / quick_s)
        rate[~usable] = 0.0
        still += rate[:, None] * (ratio - self._light)
        return Change(change, sure=sure, agreeing=agreeing)
