"""The 1 € filter: speed against the reference style; lag and jitter of points and of the solved hand by its settings.

**Points** have the noise that the rig `desk` claims at 0.6 m, three tenths of it new in each frame. **The hand** is
solved from caps with 1 mm of noise, 60 frames a second, and filtered by three settings: `SLIDERS`. Jitter is the
standard deviation over time of the joints of a relaxed hand at rest, all axes together; lag is that of the joints of a
hand that crosses the view at a steady speed, behind the solved one. Both are means of `_SEEDS` runs.
"""

import math
import statistics
import time
from collections.abc import Callable
from itertools import count

import numpy as np

from bench.hand_draws import MARKERS
from bench.real_motion import FACING, SIGMA_M, held_poses, jitter
from bench.row import Row
from bench.solved_hand import PointHand
from common.arrays import Float
from common.calibration import FilterCalibration
from common.geometry.transforms import rigid
from common.hand.model import HandModel
from common.hand.profiles import generated_profile
from master.estimator.epoch import Fitted, FittedHand
from master.estimator.smooth import HandOneEuro
from master.fabrik.one_euro import OneEuro, OneEuroParameters, PointFilter

_ROUNDS = 9
_SAMPLES = 400
_PERIOD_NS = 16_666_667
_SIGMA_M = np.array([2e-4, 2e-4, 1.6e-3])  # claimed at 0.6 m from the rig `desk`
_NEW = 0.3  # of it is new in each frame, as on rendered hands at rest
_SETTINGS = OneEuroParameters.of(FilterCalibration())
SLIDERS = {
    "calm (1 Hz, beta 0)": FilterCalibration(min_cutoff_hz=1.0, beta=0.0),
    "as shipped": FilterCalibration(),
    "quick (30 Hz, beta 4000, 3 mm)": FilterCalibration(min_cutoff_hz=30.0, beta=4000.0, jitter_m=3e-3),
}
_SEEDS, _FRAMES, _SETTLED = 5, 300, 60
_COV = np.tile(SIGMA_M**2 * np.eye(3), (len(MARKERS), 1, 1))


class _LowPass:
    """Checked exponential smoothing that can be asked for its last value."""

    def __init__(self, alpha: float) -> None:
        self._set_alpha(alpha)
        self._raw: float | None = None
        self._smooth: float | None = None

    def _set_alpha(self, alpha: float) -> None:
        if not 0.0 < alpha <= 1.0:
            raise ValueError(f"alpha {alpha} is not in 0 ... 1")
        self._alpha = alpha

    def last_filtered(self) -> float | None:
        return self._smooth

    def filter(self, value: float, alpha: float | None = None) -> float:
        if alpha is not None:
            self._set_alpha(alpha)
        smooth = value if self._smooth is None else self._alpha * value + (1.0 - self._alpha) * self._smooth
        self._raw, self._smooth = value, smooth
        return smooth


class _Signal:
    """The paper's filter in the paper's structure: one object per signal, two checked low passes inside."""

    def __init__(self, frequency: float, min_cutoff: float, beta: float, d_cutoff: float) -> None:
        self._frequency, self._min_cutoff, self._beta, self._d_cutoff = frequency, min_cutoff, beta, d_cutoff
        self._x, self._dx = _LowPass(self._alpha(min_cutoff)), _LowPass(self._alpha(d_cutoff))
        self._time: float | None = None

    def _alpha(self, cutoff: float) -> float:
        period = 1.0 / self._frequency
        tau = 1.0 / (2.0 * math.pi * cutoff)
        return 1.0 / (1.0 + tau / period)

    def filter(self, value: float, t: float) -> float:
        if self._time is not None and t > self._time:
            self._frequency = 1.0 / (t - self._time)
        self._time = t
        last = self._x.last_filtered()
        change = 0.0 if last is None else (value - last) * self._frequency
        speed = self._dx.filter(change, self._alpha(self._d_cutoff))
        cutoff = self._min_cutoff + self._beta * abs(speed)
        return self._x.filter(value, self._alpha(cutoff))


def _median_us(run: Callable[[], None], calls: int) -> float:
    times: list[float] = []
    for _ in range(_ROUNDS):
        start = time.perf_counter()
        run()
        times.append((time.perf_counter() - start) / calls * 1e6)
    return statistics.median(times)


def _push_all(machine: PointFilter, samples: Float, cov: Float) -> None:
    for k, sample in enumerate(samples):
        machine.push(k * 8_333_333, sample, cov)


def _behaviour() -> list[tuple[str, float, str, str]]:
    """Lag and jitter along and across the sight: points filtered by their noise, against the plain filter."""
    noise = np.random.default_rng(3).normal(0.0, _NEW, (3000, 3)) * _SIGMA_M
    out: list[tuple[str, float, str, str]] = []
    still = [x[200:].std(axis=0) * 1e3 for x in (noise, _plain(noise), _limited(noise))]
    for axis, name in ((0, "sideways"), (2, "in depth")):
        raw, plain, ours = (float(sd[axis]) for sd in still)
        out.append(
            (f"at rest, {name}: jitter", ours, "mm", f"plain filter {plain:.3f}, raw {raw:.3f}; goal <= 1")
        )
    for speed in (0.5, 1.0):
        for axis, name in ((0, "sideways"), (2, "in depth")):
            way = noise.copy()
            way[:, axis] += speed * np.arange(len(way)) / 60.0
            lags = [1e3 * float((way - x)[200:, axis].mean()) / speed for x in (_plain(way), _limited(way))]
            out.append((f"{speed} m/s {name}: lag", lags[1], "ms", f"plain filter {lags[0]:.2f}"))
    return out


def _plain(points: Float) -> Float:
    machine = OneEuro(_SETTINGS)
    return np.array([machine.push(k * _PERIOD_NS, p) for k, p in enumerate(points)])


def _limited(points: Float) -> Float:
    machine = PointFilter(_SETTINGS, np.eye(3))
    cov = np.diag(_SIGMA_M**2)[None]
    return np.array([machine.push(k * _PERIOD_NS, p[None], cov)[0] for k, p in enumerate(points)])


def _solved(model: HandModel, speed_m_s: float, seed: int) -> list[Fitted]:
    """A relaxed hand that crosses the view, solved from caps with noise."""
    angles = held_poses(model)["relaxed"]
    at = np.tile([0.0, 0.08, 0.5], (_FRAMES, 1))
    at[:, 0] = speed_m_s * 1e-9 * _PERIOD_NS * (np.arange(_FRAMES) - _FRAMES / 2)
    noise = np.random.default_rng(seed).normal(0.0, SIGMA_M, (_FRAMES, len(MARKERS), 3))
    solver = PointHand(model, MARKERS)
    return [
        solver.push(
            k * _PERIOD_NS,
            model.marker_points(model.forward(rigid(FACING, place), angles), MARKERS) + noise[k],
            _COV,
        )
        for k, place in enumerate(at)
    ]


def _settled(hands: list[Fitted]) -> list[FittedHand]:
    return [hand.solution for hand in hands[_SETTLED:] if hand.solution is not None]


def _hand_rows() -> list[Row]:
    """Jitter and lag of the solved hand at three places of the console's sliders."""
    model = HandModel.of(generated_profile("held", "right"))
    speeds = (0.0, 0.3, 1.0)
    runs = {speed: [_solved(model, speed, seed) for seed in range(_SEEDS)] for speed in speeds}
    raw = statistics.mean(jitter(_settled(run))[0] for run in runs[0.0])
    out: list[Row] = []
    for name, settings in SLIDERS.items():
        for speed, solved in runs.items():
            values: list[float] = []
            for run in solved:
                smooth = HandOneEuro(model, MARKERS, OneEuroParameters.of(settings))
                shown = _settled([smooth.push(k * _PERIOD_NS, hand, _COV) for k, hand in enumerate(run)])
                if speed == 0.0:
                    values.append(jitter(shown)[0])
                else:
                    pairs = zip(_settled(run), shown, strict=True)
                    behind = [a.joints.position_m[:, 0] - b.joints.position_m[:, 0] for a, b in pairs]
                    values.append(1e3 * float(np.mean(behind)) / speed)
            mean = statistics.mean(values)
            if speed == 0.0:
                out.append(Row(f"hand, {name}: jitter", mean, "mm", f"before the filter {raw:.2f}"))
            else:
                out.append(Row(f"hand, {name}: lag at {speed} m/s", mean, "ms", ""))
    return out


def rows() -> list[tuple[str, float, str, str]]:
    """(name, value, unit, goal) of each measurement."""
    samples = np.cumsum(np.random.default_rng(1).normal(0.0, 1e-3, (_SAMPLES, 6, 3)), axis=0)
    period = 8_333_333
    theirs: list[Float] = []
    ours: list[Float] = []

    def reference() -> None:
        signals = [_Signal(120.0, 1.0, 0.1, 1.0) for _ in range(18)]
        theirs.clear()
        for k, sample in enumerate(samples):
            values: list[float] = sample.ravel().tolist()
            t = k * period * 1e-9
            out = [s.filter(v, t) for s, v in zip(signals, values, strict=True)]
            theirs.append(np.array(out).reshape(6, 3))

    def machine() -> None:
        one_euro = OneEuro(OneEuroParameters(1.0, 0.1, 1.0))
        ours[:] = [one_euro.push(k * period, sample) for k, sample in enumerate(samples)]

    slow, fast = _median_us(reference, _SAMPLES), _median_us(machine, _SAMPLES)
    difference = float(np.abs(np.stack(ours) - np.stack(theirs)).max())
    limited = PointFilter(_SETTINGS, np.eye(3))
    cov = np.tile(np.diag(_SIGMA_M**2), (6, 1, 1))
    points = _median_us(lambda: _push_all(limited, samples, cov), _SAMPLES)
    hand = OneEuro(_SETTINGS, (6, 4, 4, 4, 4, 4))
    values, variance = np.resize(samples, (_SAMPLES, 26)), np.full(26, SIGMA_M**2)
    clock = count(1)

    def grouped() -> None:
        for sample in values:
            hand.push(next(clock) * period, sample, variance)

    signals = _median_us(grouped, _SAMPLES)
    return [
        *_behaviour(),
        *_hand_rows(),
        ("26 signals of a hand in groups, by their noise", signals, "µs", "goal <= 10"),
        ("6 points by their noise, along the axes of the view", points, "µs", ""),
        ("1 €, 18 signals, one object per signal (baseline)", slow, "µs", ""),
        ("1 €, 18 signals, Phalanx", fast, "µs", ""),
        ("1 €, ratio", slow / fast, "x", ">= 5"),
        ("1 €, largest difference to the reference", difference, "m", "<= 1e-9"),
    ]
