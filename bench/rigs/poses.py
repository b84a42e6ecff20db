"""Poses of a hand on the bus against the truth of the scene, moment by moment; are they steady?"""

import threading
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bench.rigs.rooms import standard_scene
from bench.rigs.sender import WAY_S, scene_s
from common.arrays import Float
from common.messages import HandPose

_GRID_HZ = 200.0
_STEADY_S, _STEADY_SHARE, _GAP_S = 0.5, 0.8, 0.2
_SANE_MM = 20.0  # of a TRACKED joint; the scene's hand is 180 mm long
_FALSE_SIGMAS = 6.0  # of a valid joint, in its own standard deviations
_FALSE_MM, _LIKELY_SIGMAS = (
    60.0,
    3.5,
)  # of a TRACKED joint: so far off only where its covariance makes that likely


@dataclass(frozen=True, slots=True)
class Judged:
    """One pose.

    Attributes:
        came_s: When, `time.monotonic`.
        age_s: How old it was then, by its own time.
        worst_mm: Error of the worst TRACKED joint; NaN: none is tracked.
        beyond: Worst error of a valid joint, in its own standard deviations.
    """

    came_s: float
    age_s: float
    worst_mm: float
    beyond: float

    @property
    def false(self) -> bool:
        """Whether it is sure of a joint and wrong about it."""
        return self.beyond > _FALSE_SIGMAS or (self.worst_mm > _FALSE_MM and self.beyond > _LIKELY_SIGMAS)


@dataclass(frozen=True, slots=True)
class Pace:
    """How poses come: so many a second, with gaps no longer than this [s]."""

    rate_hz: float
    gap_s: float = _GAP_S


class Poses:
    """All poses of one hand, judged by the scene of `bench.rigs.sender --way`. Holds them, and a table of the scene."""

    def __init__(self, epoch_ns: int) -> None:
        """Of the scene that began then."""
        self._epoch_ns, self._lock, self._judged = epoch_ns, threading.Lock(), list[Judged]()
        scene, count = standard_scene(), round(WAY_S * _GRID_HZ) + 2
        self._table: Float = np.stack([scene.truth(k / _GRID_HZ).joints.position_m for k in range(count)])

    def take(self, message: object, came_ns: int) -> None:
        """Judge a pose that came at `came_ns`; other messages are ignored."""
        if isinstance(message, HandPose):
            judged = self.judged(message, came_ns)
            with self._lock:
                self._judged.append(judged)

    def since(self, moment_s: float, until_s: float = float("inf")) -> list[Judged]:
        """Return those that came in between, `time.monotonic`."""
        with self._lock:
            return [one for one in self._judged if moment_s <= one.came_s < until_s]

    def judged(self, pose: HandPose, came_ns: int) -> Judged:
        """Compare a pose with the truth."""
        at = scene_s((pose.t_ns - self._epoch_ns) * 1e-9) * _GRID_HZ
        k = int(at)
        truth = self._table[k] + (at - k) * (self._table[k + 1] - self._table[k])
        error = np.linalg.norm(pose.position_m - truth, axis=1)
        sigma = np.sqrt(np.trace(pose.cov_m2, axis1=1, axis2=2))
        beyond = float(np.max(error / sigma, where=pose.valid, initial=0.0))
        worst_mm = 1e3 * float(error[pose.tracked].max(initial=-np.inf))
        return Judged(
            came_ns * 1e-9,
            (came_ns - pose.t_ns) * 1e-9,
            worst_mm if np.isfinite(worst_mm) else np.nan,
            beyond,
        )


def pace_of(judged: list[Judged], began_s: float, ended_s: float, rate_hz: float) -> Pace:
    """Return the pace from `began_s` to `ended_s`: at most `rate_hz`; gaps half as long again as the longest."""
    came = [began_s, *(one.came_s for one in judged), ended_s]
    longest_s = max(b - a for a, b in pairwise(came))
    return Pace(min(rate_hz, len(judged) / (ended_s - began_s)), max(_GAP_S, 1.5 * longest_s))


def steady_from(judged: list[Judged], moment_s: float, pace: Pace) -> float | None:
    """Return when, after `moment_s`, poses came steadily and were right for half a second; None: not yet.

    Steady: four fifths of the number of the pace, no gap above its own, no TRACKED joint off by more than 20 mm.
    """
    came = [one for one in judged if one.came_s >= moment_s]
    for k, first in enumerate(came):
        window = [one for one in came[k:] if one.came_s < first.came_s + _STEADY_S]
        if came[-1].came_s < first.came_s + _STEADY_S:
            return None
        gaps = [b.came_s - a.came_s for a, b in pairwise(window)]
        enough = (
            len(window) >= _STEADY_SHARE * _STEADY_S * pace.rate_hz and max(gaps, default=9.0) < pace.gap_s
        )
        if enough and all(one.worst_mm < _SANE_MM for one in window):
            return first.came_s
    return None
