"""Follow the light of one camera, and warn of colours that leave their range.

    initial_white_balance  the first picture: all colours together prove one light      at the start, or if uncertain
    LightMeter             what stands still: how the light changes, at once            every frame
    ColourDrift            the markers: where the light stands, slowly but for certain  10 times a second

The light is *proven* when two or more markers of one picture agree on it and on no other, until much of the picture
changes at once and no marker vouches for the old light, or the markers fit it badly; then the last known light is
used on, but not where the picture excludes it. `LightMeter` takes the median over a few hundred points of the log
ratio to what each showed before: a hand in front of some of a still desk does not move a median.

`ColourMonitor` warns while a marker is still detected, of what following the light does not mend: light beyond the
bounds, a lamp beyond von Kries' law, a dirty marker. The room of the mean HSV over half a second to each border is
counted in spreads, so a colour that flickers is warned of earlier.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from typing import ParamSpec, TypeVar

import numpy as np
import numpy.typing as npt

from common.arrays import Bool, Float, Image
from common.calibration import HsvRange
from common.geometry.srgb import to_linear, to_srgb
from slave.markers.classify import HUES, ColourTable, hue_distance, hue_span
from slave.markers.illuminant import (
    AHEAD,
    FITS,
    PROOF,
    STRIDE,
    ColourDrift,
    LightEvidence,
    at_bound,
    different,
    evidence,
    gain_difference,
    initial_white_balance,
)

TIME_S = 0.5
LEAST_S = 0.3  # of observations before a verdict
# Smallest spread that is assumed, of hue (of 180), saturation and value (of 255): what noise leaves of one pixel.
FLOOR = np.array([1.5, 8.0, 8.0])


@dataclass(frozen=True, slots=True)
class ColourWarning:
    """Something that will cost a marker, and what to do."""

    marker: str | None  # its name; None: it concerns all
    text: str  # what is seen, and the fix
    ambiguous: str | None = None  # another marker that looks like it
    hues: float = 0.0  # how far the two are apart, of 180


def hsv(light: Float) -> Float:
    """Linear light (..., 3), blue first, to unrounded OpenCV H 0..180, S, V 0..255."""
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
    """Monitor of the margin between every marker's colour and its range."""

    def __init__(self, names: Sequence[str], ranges: Mapping[str, HsvRange]) -> None:
        """Watch `names`, each in its range."""
        self._names = tuple(names)
        self._middle, self._half = np.array([hue_span(ranges[name]) for name in names]).T
        self._low = np.array([ranges[name].hsv_low for name in names], np.float64)
        self._range = ranges
        count = len(self._names)
        self._mean = np.full((count, 3), np.nan)  # hue as the distance from the middle of the range
        self._variance = np.zeros((count, 3))
        self._monitored_s = np.zeros(count)
        self._warned = np.zeros(count, np.bool_)
        self._t_ns: int | None = None

    def push(self, light: Float, clarity: Float, t_ns: int) -> list[ColourWarning]:
        """What is to be warned of after one frame.

        `light`: (M, 3) linear light of each core, undone to the light of calibration, NaN: not seen; `clarity`: 0..1.
        """
        dt_s = 0.0 if self._t_ns is None else min(max(t_ns - self._t_ns, 0) * 1e-9, TIME_S)
        self._t_ns = t_ns
        # clarity of an observation that counts: a half covered marker is mixed with what covers it
        good = np.isfinite(light).all(axis=1) & (np.nan_to_num(clarity) >= 0.4)
        if good.any():
            self._learn(good, hsv(np.maximum(light[good], 1e-5)), dt_s)
        room = self.room()
        with np.errstate(invalid="ignore"):
            # less than 2 spreads is a warning, which ends at 3
            self._warned = np.where(np.isnan(room), self._warned, room < np.where(self._warned, 3.0, 2.0))
        warned = [self._of(int(m), float(room[m])) for m in np.flatnonzero(self._warned)]
        return warned + self._ambiguous()

    def room(self) -> Float:
        """Margin (M,) of each colour in its range, in spreads; NaN: seen too briefly."""
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
        separation = hue_distance(hue[:, None], hue)
        span = np.column_stack([self._middle, self._half])
        other = (span[:, None] != span).any(axis=-1)  # hands painted alike share their ranges
        long = self._monitored_s >= LEAST_S
        with np.errstate(invalid="ignore"):
            # hues: two marker colours nearer than this look the same
            near = (separation < 8.0) & other & long[:, None] & long[None, :]
        return [
            ColourWarning(
                self._names[a],
                f"markers {self._names[a]} and {self._names[b]} look alike, hues {hue[a]:.0f} and {hue[b]:.0f}: "
                f"take brighter light, or repaint one",
                self._names[b],
                float(separation[a, b]),
            )
            for a, b in np.argwhere(np.triu(near, 1)).tolist()
        ]


GRID = 16  # points along each side
AGREE = 0.55  # share of the points that must agree
EVERY_NS = 50_000_000  # a slow change is measured so often
LOG_LIGHT = np.log(np.maximum(to_linear(np.arange(256) / 255.0), 1e-4))


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """How the light changed since it was last measured."""

    log_gains: Float  # (3,) natural logarithms, blue, green, red; 0 where nothing can be estimated
    sure: bool  # enough points agree
    agreeing: float  # share of all points that agree, 0..1


class LightMeter:
    """Measures changes of the light on the still points of one camera."""

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
        """Change since it was last measured in a C-contiguous image; None: not due."""
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
        dt_s, self._t_ns = max(t_ns - self._t_ns, 0) * 1e-9, t_ns
        dark, bright = 12, 250  # bytes beyond which a point measures nothing: noise, or clipped
        usable = ((bytes_ >= dark) & (bytes_ <= bright)).all(axis=1)
        ratio = LOG_LIGHT.take(bytes_) - still
        count = int(np.count_nonzero(usable))
        least = 48  # points that measure something
        if count < least:
            return Change(np.zeros(3), sure=False, agreeing=0.0)
        middle = np.partition(ratio[usable], count // 2, axis=0)[count // 2]
        # a point agrees when its log ratios are this near the median: three standard deviations of a dark desk
        alike = 0.25
        near = usable & (np.abs(ratio - middle) <= alike).all(axis=1)
        agreeing = float(np.count_nonzero(near)) / count
        sure, change = agreeing >= AGREE, np.zeros(3)
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


P = ParamSpec("P")
T = TypeVar("T")


class Inline(Executor):
    """Worker in the caller's thread: the same input gives the same output."""

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Do it; the future is done."""
        done: Future[T] = Future()
        done.set_result(fn(*args, **kwargs))
        return done


class WhiteBalance:
    """Light of one camera: estimate, whether it is proven, the proof under way."""

    def __init__(
        self, table: ColourTable, reference: Float, size: tuple[int, int], workers: Executor
    ) -> None:
        """Begin with the light of calibration, not proven.

        `reference`: (M, 3) linear light of each marker's core at calibration, blue first, positive or ValueError;
        `size`: width and height of the picture [px]; `workers` seek a first light, which takes as long as some tens
        of frames.
        """
        self._table, self._reference, self._workers = table, reference, workers
        self._drift = ColourDrift(reference)
        self._meter = LightMeter(*size)
        self._provable = len(reference) >= PROOF
        self.proven = not self._provable  # a rig of one marker can only be followed
        self._plausible = False
        self._poor_fits = 0
        self._tried_ns: int | None = None
        self._proof: tuple[Float, Future[LightEvidence]] | None = None

    @property
    def log_gains(self) -> Float:
        """Log gains (3,) of the light against calibration, blue, green, red."""
        return self._drift.log_gains

    @property
    def trusted(self) -> bool:
        """Return whether markers may be distinguished by their colours."""
        return self.proven or self._plausible

    def look(self, image: Image, t_ns: int) -> None:
        """Take in a picture (H, W, 3) BGR, C-contiguous, before its markers are sought."""
        change = self._meter.push(image, t_ns)
        if change is not None and change.sure:
            self._change(image, change)
        if self._provable and not self.proven:
            self._prove(image, t_ns)

    def learn(self, colour: Float, clarity: Float, t_ns: int) -> bool:
        """Update the light as `ColourDrift.push`; False: the last look is too recent."""
        fit = self._drift.push(colour, clarity, t_ns)
        if fit is None:
            return False
        seen = fit.residual[np.isfinite(fit.residual)]
        poor = seen.size and float(np.median(seen)) > FITS
        self._poor_fits = self._poor_fits + 1 if poor else 0
        # looks in a row, half a second, in which the markers fit badly and make the light uncertain
        poor_fits = 5
        if self._poor_fits >= poor_fits:
            self._lose_proof()
        return True

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
        sudden = gain_difference(change.log_gains, np.zeros(3)) > 0.2
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
                initial_white_balance, image.copy(), self._table, self._reference, self.log_gains
            )
            self._proof = np.zeros(3), job
        if self._proof is not None and self._proof[1].done():
            (since, job), self._proof = self._proof, None
            light = job.result()
            self.proven, self._poor_fits = light.proven, 0
            self._plausible = not light.excluded
            if light.proven and different(light.log_gains + since, self.log_gains):
                self._drift.restart(light.log_gains + since)
