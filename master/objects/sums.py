"""Observations of an object as weighted sums.

Errors that stay from frame to frame are eliminated from them exactly.

An error of a feature in a camera is one that stays (light, shape, cover, lens) plus one that is new in each frame. The
first is an unknown of its own, eliminated by its Schur complement, so four observations of one bead at rest are not
taken for four measurements.

A feature that misses the pose by more than noise and a bad calibration is weighed down as a whole, in its camera, by
Geman and McClure's law (iteratively reweighted least squares); one thing taken for another so costs itself.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from master.fabrik.intersection import RAYS


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Observations of one object around an epoch, n points.

    Attributes:
        camera: (n,) which camera.
        point: (n,) which row of `Features.points`.
        tau_s: (n,) when, from the epoch [s].
        uv: (n, 2) [px], distorted image.
        sigma_px: (n,) standard deviation per axis.
        t_sigma_s: (n,) of the times, the same error for all of a camera.
    """

    camera: Int
    point: Int
    tau_s: Float
    uv: Float
    sigma_px: Float
    t_sigma_s: Float

    def some(self, associated: Bool) -> "Observations":
        """Those of a mask (n,)."""
        return Observations(
            self.camera[associated],
            self.point[associated],
            self.tau_s[associated],
            self.uv[associated],
            self.sigma_px[associated],
            self.t_sigma_s[associated],
        )


class Sums:
    """Weighted sums of observations.

    Determines which observations belong together, and their variances. Holds no state between calls.
    """

    def __init__(self, seen: Observations, feature: Int, floor_2: Float, points: int) -> None:
        """Set up for observations.

        Args:
            seen: The observations.
            feature: (n,) of what each is a part.
            floor_2: (n,) variance per axis [px^2] that light, lens and calibration leave.
            points: How many points the object has.
        """
        variance = seen.sigma_px**2
        independent_share, independent_px = 0.7, 0.1  # as in `master.fabrik.propagate`
        independent = np.minimum(independent_share * variance, independent_px**2)
        correlated = variance - independent + floor_2
        _, first, group = np.unique(seen.camera * points + seen.point, return_index=True, return_inverse=True)
        # What the surest observation keeps is kept by all; others have more that is new.
        self._correlated = np.full(len(first), np.inf)
        np.minimum.at(self._correlated, group, correlated)
        kept = self._correlated[group]
        self._independent = independent + correlated - kept
        self._total = kept + self._independent
        self._of_group = np.zeros((len(first), len(group)))
        self._of_group[group, np.arange(len(group))] = 1.0
        self._group_size = self._of_group.sum(axis=1)
        _, self._whole = np.unique(seen.camera * (int(feature.max()) + 1) + feature, return_inverse=True)
        self._whole_size = np.bincount(self._whole)
        # Of numbers that were measured a bead has two, a tag eight, however often it was.
        self._numbers = 2.0 * np.bincount(self._whole[first])

    def weigh(self, miss: Float, lag_2: Float) -> tuple[Float, Float, float]:
        """Return the chi-square and weight (n,) of each observation, and the cost.

        The chi-square (n,) is per measured number of the feature that the observation belongs to.

        The weight forgives what a bad calibration leaves (`RaySettings.rig_px`), the cost only what this one is
        known to leave.

        Args:
            miss: (n, 2) by which the observations miss the pose [px].
            lag_2: (n,) variance that the uncertainty of their times makes [px^2].
        """
        total = self._total + lag_2
        squared = 0.5 * np.vecdot(miss, miss)
        mean = np.bincount(self._whole, squared / total) / self._whole_size
        forgiven = np.bincount(self._whole, squared / (total + RAYS.rig_px**2)) / self._whole_size
        soft_2 = 9.0  # square of the deviation in sigmas at which a feature counts half ... a quarter
        weight = (1.0 + forgiven / soft_2) ** -2.0
        cost = float((self._numbers * mean / (1.0 + mean / soft_2)).sum())
        return mean[self._whole], weight[self._whole], cost

    def normal(self, rows: Float, weight: Float, lag_2: Float) -> tuple[Float, Float]:
        """Normal matrix (N, N) and gradient (N,), the errors that stay eliminated.

        Args:
            rows: (n, 2, N + 1) derivatives of what is seen by the unknowns; last, by what it is missed [px].
            weight: (n,) of the observations.
            lag_2: As of `weigh`.
        """
        size = rows.shape[2]
        w = weight / (self._independent + lag_2)
        weighted = rows * w[:, None, None]
        both = weighted.reshape(-1, size).T @ rows.reshape(-1, size)
        light = self._of_group @ weight / self._group_size
        down = self._of_group @ w + light / self._correlated
        sums = (self._of_group @ weighted.reshape(len(rows), -1)) / np.sqrt(down)[:, None]
        sums = sums.reshape(-1, size)
        both -= sums.T @ sums
        return both[:-1, :-1], both[:-1, -1]
