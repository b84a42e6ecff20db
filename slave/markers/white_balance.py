"""Light of one camera at every frame, from three sources.

The sources differ in what they can estimate.

    initial_white_balance   the first picture: all colours together prove one light      at the start, or if uncertain
    light_meter   what stands still: how the light changes, at once             every frame
    drift         the markers: where the light stands, slowly but for certain   10 times a second

The light is *proven* when two or more markers of one picture agree on it and on no other. It is uncertain again when
much of the picture changes at once and no marker vouches for the old light, or when the markers fit it badly. A light
uncertain, the last one known is used on, but not where the picture excludes it.
"""

from concurrent.futures import Future
from functools import partial

import numpy as np

from common.arrays import Float, Image
from slave.markers.classify import ColourTable
from slave.markers.colour_monitor import ColourWarning
from slave.markers.drift import ColourDrift, GainFit, at_bound
from slave.markers.initial_white_balance import (
    AHEAD,
    FITS,
    PROOF,
    STRIDE,
    Evidence,
    different,
    evidence,
    initial_white_balance,
)
from slave.markers.light_meter import Change, LightMeter
from slave.markers.workers import Workers


class WhiteBalance:
    """Light of one camera.

    Holds its estimate, whether it is proven, and the proof under way.
    """

    def __init__(self, table: ColourTable, reference: Float, size: tuple[int, int], workers: Workers) -> None:
        """Begin with the light of calibration, not proven.

        Args:
            table: Colour table of the calibration.
            reference: (M, 3) linear light of each marker's core at calibration, blue first.
            size: Width and height of the picture [px].
            workers: Where a first light is sought: it takes as long as some tens of frames.

        Raises:
            ValueError: A reference is not three positive numbers.
        """
        self._table, self._reference, self._workers = table, reference, workers
        self._drift = ColourDrift(reference)
        self._meter = LightMeter(*size)
        self._provable = len(reference) >= PROOF
        self.proven = not self._provable  # a rig of one marker can only be followed
        self._plausible = False
        self._poor_fits = 0
        self._tried_ns: int | None = None
        self._proof: tuple[Float, Future[Evidence]] | None = None

    @property
    def log_gains(self) -> Float:
        """Log gains (3,) of the light against calibration, blue, green, red."""
        return self._drift.log_gains

    @property
    def trusted(self) -> bool:
        """Return whether markers may be distinguished by their colours."""
        return self.proven or self._plausible

    def look(self, image: Image, t_ns: int) -> None:
        """Take in a picture before its markers are sought.

        Args:
            image: (H, W, 3) BGR, C-contiguous.
            t_ns: Time of the frame [ns], rising; only differences matter.
        """
        change = self._meter.push(image, t_ns)
        if change is not None and change.sure:
            self._change(image, change)
        if self._provable and not self.proven:
            self._prove(image, t_ns)

    def learn(self, colour: Float, clarity: Float, t_ns: int) -> GainFit | None:
        """Update the light from the marker colours of an image.

        Returns None where the last look is too recent.

        Args:
            colour: (M, 3) linear light of each marker's core, blue first; NaN: not seen.
            clarity: (M,) 0..1; NaN: not seen.
            t_ns: Time of the frame [ns].
        """
        fit = self._drift.push(colour, clarity, t_ns)
        if fit is not None:
            seen = fit.residual[np.isfinite(fit.residual)]
            if not seen.size or float(np.median(seen)) <= FITS:
                self._poor_fits = 0
            else:
                self._poor_fits += 1
                # looks in a row, half a second, in which the markers fit badly and make the light uncertain
                poor_fits = 5
                if self._poor_fits >= poor_fits:
                    self._lose_proof()
        return fit

    def warnings(self) -> list[ColourWarning]:
        """What is wrong with the light of all markers."""
        found: list[ColourWarning] = []
        if at_bound(self.log_gains):
            blue, green, red = np.exp(self.log_gains)
            text = (
                f"the light is at the bound of what is followed (red {red / green:.2f} and blue {blue / green:.2f} of "
                f"green, brightness {green:.2f} of calibration): light the scene as at calibration, or calibrate the "
                f"colours under this light"
            )
            found.append(ColourWarning(None, text))
        if not self.proven:
            text = f"the light is not known: show {PROOF} or more markers at once, so it can be measured from them"
            found.append(ColourWarning(None, text))
        return found

    def _change(self, image: Image, change: Change) -> None:
        """Add a change of the light unless an object in front of the camera mimics one."""
        # log gains of red or blue against green between two frames: a lamp was switched, or a hand came near
        sudden = apart(change.log_gains, np.zeros(3)) > 0.2
        # share of still points that must agree on a sudden change that the markers do not vouch for
        clear = 0.75
        if sudden and change.agreeing < clear:
            half = np.ascontiguousarray(image[::STRIDE, ::STRIDE])
            before, after = (
                evidence(half, self._table, self._reference, light).score
                for light in (self.log_gains, self.log_gains + change.log_gains)
            )
            if before + AHEAD > after:
                if before < AHEAD:
                    self._lose_proof()  # no marker shows that the light stayed, either
                return
        self._drift.shift(change.log_gains)
        if self._proof is not None:  # what is being proven is the light of an earlier frame
            self._proof = self._proof[0] + change.log_gains, self._proof[1]

    def _lose_proof(self) -> None:
        if self._provable and self.proven:
            self.proven, self._plausible, self._tried_ns = False, False, None

    def _prove(self, image: Image, t_ns: int) -> None:
        again_ns = 500_000_000  # between two attempts to prove the light
        if self._proof is None and (self._tried_ns is None or t_ns - self._tried_ns >= again_ns):
            self._tried_ns = t_ns
            job = self._workers.submit(
                partial(initial_white_balance, image.copy(), self._table, self._reference, self.log_gains)
            )
            self._proof = np.zeros(3), job
        if self._proof is not None and self._proof[1].done():
            (since, job), self._proof = self._proof, None
            light = job.result()
            self.proven, self._poor_fits = light.proven, 0
            self._plausible = not light.excluded
            if light.proven and different(light.log_gains + since, self.log_gains):
                self._drift.restart(light.log_gains + since)


# what a change of brightness counts against a change of hue: the ranges are wide in brightness
def apart(a: Float, b: Float, dim: float = 0.15) -> float:
    """Return how different two lights (3,) look to the colour table.

    In log gains of red or blue against green.
    """
    blue, green, red = (a - b).tolist()
    return max(abs(blue - green), abs(red - green), dim * abs(green))
