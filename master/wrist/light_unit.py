"""The unit of how far LEDs show a fingertip to be, learnt from the poses themselves.

Light from beside the lens falls off with distance, so brightness tells how far away a tip is, up to one factor: power
of the LEDs, gain of the camera, whiteness of the skin (row I15). That factor is the rig's and its wearer's and does not
change with the pose. Near the turn of a tip's way in the image straighter and more bent look alike, but the bent one is
nearer by a tenth or two; so once the factor is known, the doubt is gone.

A finger's density over its poses says which factors explain its brightness. The belief about the factor's logarithm, a
histogram, is multiplied by that: fingers whose pose is sure tell it, those that have two poses tell two. It is a
calibration of the device, kept from pose to pose even where these are unrelated.
"""

import numpy as np

from common.arrays import Float

SIGMA = 0.06  # of a distance told by light: skin inclined by 25 degrees to the light looks 5 % farther
_FALSE = 0.02  # the density left where light tells nothing: a shadow, another finger
_STEP = 0.02
_WIDEST = np.log(1e3)  # the unit is not the metre, but grey levels make it one within three decades
_SHARED = 0.5  # four fingers in one light err together
_KEPT = 0.99  # of what was told before, for every pose: about a hundred of these are remembered


class LightUnit:
    """Push machine: the belief about the factor between relative and true depth."""

    def __init__(self) -> None:
        self._log = np.arange(-_WIDEST, _WIDEST + _STEP, _STEP)
        self._belief = np.zeros(len(self._log))

    def push(self, relative: Float, depth_m: Float, likely: Float, weight: float = 1.0) -> Float:
        """Take one triple; returns the logarithm of how well light fits each pose (5, P), 0 where it tells nothing.

        Args:
            relative: (5,) distances by light; NaN: none.
            depth_m: (5, P) of the tips along the optical axis in each pose; a tip that is not before the camera is lit
                in none of them.
            likely: (5, P) probabilities of the poses without light, summing to 1; NaN: of this finger nothing is known.
            weight: How much this triple is news: 1 for a pose that is not related to the last.
        """
        told = np.flatnonzero((relative > 0.0) & np.isfinite(likely.sum(axis=1)))
        out = np.zeros(depth_m.shape)
        if not len(told):
            return out
        before = depth_m[told] > 0.0
        ratio = np.log(relative[told, None] / np.where(before, depth_m[told], 1.0))
        place = np.clip((ratio + _WIDEST) / _STEP, 0.0, len(self._log) - 1.0).round().astype(np.int64)
        # What each finger says of the factor: its poses' probabilities by the factor they need, blurred by the noise.
        said = np.stack(
            [np.bincount(at, p, len(self._log)) for at, p in zip(place, likely[told] * before, strict=True)]
        )
        blurred = np.stack([np.convolve(one, _BLUR, "same") for one in said])
        news = _SHARED * np.log((1.0 - _FALSE) * blurred + _FALSE * _FLAT)
        now = self._belief + news.sum(axis=0)
        for k, f in enumerate(told):
            # A finger is not a witness of itself.
            others = np.exp(now - news[k] - (now - news[k]).max())
            factor = np.convolve(others / others.sum(), _BLUR, "same")
            out[f] = np.log((1.0 - _FALSE) * np.where(before[k], factor[place[k]], 0.0) + _FALSE * _FLAT)
        self._belief = _KEPT**weight * (self._belief + weight * news.sum(axis=0))
        self._belief -= self._belief.max()
        return out

    @property
    def told(self) -> tuple[float, float]:
        """The factor, and the standard deviation of its logarithm."""
        p = np.exp(self._belief)
        p /= p.sum()
        mean = float(p @ self._log)
        return float(np.exp(mean)), float(np.sqrt(p @ (self._log - mean) ** 2))


def _blur() -> Float:
    at = np.arange(-round(4.0 * SIGMA / _STEP), round(4.0 * SIGMA / _STEP) + 1) * _STEP
    kernel = np.exp(-0.5 * (at / SIGMA) ** 2)
    return kernel / kernel.sum()


_BLUR = _blur()
_FLAT = _STEP / (2.0 * _WIDEST)
