"""The inverse model: poses of a finger that explain where the laser meets it and where its tip is (rows D16, D17, D19).

A finger has three unknowns and four numbers are seen (`master.wrist.finger_poses`). The energy is

    (y - f(x))' R^-1 (y - f(x))       within the range of x

with R the covariance of what was seen; habits have no part in it. It can have several minima: a finger straight and
low, or bent and high, may show its tip at the same place. All are looked for, the global one is among them:

1. **table**: for every PIP of a grid the node that explains best what was seen (`PoseTable.candidates`), brought by
   Gauss-Newton steps on the interpolated table to the least energy at that PIP;
2. **dips** of this energy over the PIP: from there the PIP moves too, and those that meet are one;
3. **exactly**: the few that are left are refined with the laser's cut itself, until a step is short against what the
   noise of the sensing makes of angles. Its derivatives are those of the table for one step, differences for two, and
   then mended after every step by what the step did (Broyden 1965).

An unknown at the end of its range stays there while the energy falls towards the outside (projected Newton, Bertsekas
1982).
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from master.wrist.finger_poses import SEEN, UNKNOWNS, FingerPoses
from master.wrist.forward import PIP
from master.wrist.pose_table import PoseTable
from master.wrist.setup import WristSetup

MINIMA = 3  # of one finger that are refined
_PROFILE_STEPS, _TABLE_STEPS, _EXACT_STEPS = 2, 2, 8
_NUDGED = 2  # of the exact steps: those whose derivatives are differences of what is seen
_NUDGE_RAD = np.radians(0.2)
_FARTHEST_RAD = np.radians(12.0)  # of one step
_ARRIVED_RAD = np.radians(0.05)  # what is left after so short a step is a part of it
_SAME_RAD = np.radians(4.0)  # nearer to each other than this, two candidates are on their way to one minimum
_BEATEN = 15.0  # nor is it refined further if it is exactly known to be worse by this
_HOPELESS = 40.0  # worse than the best by this on the table, a candidate is none; a table is wrong by less


@dataclass(frozen=True, slots=True, eq=False)
class Minima:
    """Poses of the five fingers that explain what was seen, the best first; inf and NaN where there are not so many.

    Attributes:
        x_rad: (5, K, 3) abduction, flexion, PIP.
        cov_rad2: (5, K, 3, 3).
        misfit: (5, K) the energy, a chi-square of SEEN - UNKNOWNS degrees of freedom where nothing is at its limit.
        length_px: (5, K) of the laser line there.
        midway: (5, K) misfit half way from the best to each: little more than of these, and there is one wide valley.
    """

    x_rad: Float
    cov_rad2: Float
    misfit: Float
    length_px: Float
    midway: Float


class InverseModel:
    """Finds them for one device and hand. What it holds was prepared by the constructor, in about a second."""

    def __init__(self, setup: WristSetup) -> None:
        self.poses = FingerPoses(setup)
        self.table = PoseTable(setup, self.poses)
        self._loose = 12.0 / (self.poses.high - self.poses.low) ** 2  # (5, 3): anywhere within the range

    def __call__(self, seen: Float, cov: Float, coarse_rad: Float | None = None) -> Minima:
        """The minima.

        Args:
            seen: (5, 4) laser point on its plane (across, along) [m] and tip (x / z, y / z); NaN: a finger of which
                not both are known, and which is left out.
            cov: (5, 4, 4) its covariance, finite.
            coarse_rad: (5,) what the noise of the sensing makes of angles: a step shorter than half of it is the last.
        """
        told: Bool = np.isfinite(seen.sum(axis=1)) & self.table.met
        white = np.asarray(np.linalg.inv(np.linalg.cholesky(cov)), np.float64)
        x, finger = self._dips(np.where(told[:, None], seen, 0.0), told, white)
        misfit, seen = np.zeros(len(x)), seen[finger]
        for _ in range(_TABLE_STEPS):
            y, J, _ = self.table.views(x, finger)
            misfit, to = self._step(x, finger, white[finger], seen - y, J)
            x = x + to
        arrived = np.full(5, _ARRIVED_RAD)
        if coarse_rad is not None:
            arrived = np.fmax(arrived, 0.5 * coarse_rad)
        return self._exact(*self._left(x, finger, misfit, seen), white, arrived)

    def _dips(self, seen: Float, told: Bool, white: Float) -> tuple[Float, Int]:
        """Where the least energy for each PIP has its minima over the PIP: poses (N, 3) and their fingers (N,)."""
        places, energy = self.table.candidates(seen)
        finger, _ = rows = np.nonzero(np.isfinite(energy) & told[:, None])
        x, profile = places[rows], np.full(energy.shape, np.inf)
        for _ in range(_PROFILE_STEPS):
            y, J, _ = self.table.views(x, finger)
            profile[rows], to = self._step(x, finger, white[finger], seen[finger] - y, J, bend=False)
            x = x + to
        places[rows] = x
        dip = np.isfinite(profile)
        dip[:, 1:] &= profile[:, 1:] <= profile[:, :-1]
        dip[:, :-1] &= profile[:, :-1] <= profile[:, 1:]
        return places[dip], np.nonzero(dip)[0]

    def _left(self, x: Float, finger: Int, misfit: Float, seen: Float) -> tuple[Float, Int, Float]:
        """Of candidates (N) those that are worth refining, sorted by finger and misfit, with what was seen of each."""
        order = np.lexsort((misfit, finger))
        x, finger, misfit, seen = x[order], finger[order], misfit[order], seen[order]
        rank = np.arange(len(x))
        better = (finger[:, None] == finger) & (rank < rank[:, None])
        close = (np.abs(x[:, None] - x)[..., 1:] < _SAME_RAD).all(axis=-1)
        first = np.searchsorted(finger, finger)
        keep = ~(better & close).any(axis=1) & (misfit < misfit[first] + _HOPELESS)
        keep &= (better & keep).sum(axis=1) < MINIMA
        return x[keep], finger[keep], seen[keep]

    def _exact(self, x: Float, finger: Int, seen: Float, white: Float, arrived_rad: Float) -> Minima:
        """The minima that poses (N, 3) of fingers (N,), sorted, are near to; `seen` (N, 4) of each."""
        count, white = len(x), white[finger]
        slot = np.arange(count) - np.searchsorted(finger, finger)
        best_x, best, length = x.copy(), np.full(count, np.inf), np.full(count, np.nan)
        _, J, _ = self.table.views(x, finger)
        first, rank = np.unique(finger, return_index=True, return_inverse=True)[1:]
        best_J, moving = J.copy(), np.ones(count, np.bool_)
        y_before, x_before = np.full((count, SEEN), np.nan), x
        for k in range(_EXACT_STEPS if count else 0):
            if 0 < k <= _NUDGED:
                y, long, nudged = self._nudged(x, finger, slot, moving)
                J = np.where(np.isfinite(nudged).all(axis=(1, 2), keepdims=True), nudged, J)
            else:
                y, long = self._views(x, finger, slot, moving)
                J = _mended(J, x - x_before, y - y_before)
            misfit, to = self._step(x, finger, white, seen - y, J)
            won = misfit < best
            best_x[won], best[won], length[won], best_J[won] = x[won], misfit[won], long[won], J[won]
            # Where the laser misses, or a step led uphill: half the way back to the best.
            to = np.where(won[:, None], to, 0.5 * (best_x - x))
            x_before, y_before, x = x, y, x + to
            moving &= (np.abs(to) > arrived_rad[finger, None]).any(axis=1)
            arrived = won & ~moving
            best_x[arrived] = x[arrived]
            moving &= best < np.minimum.reduceat(best, first)[rank] + _BEATEN
            if not moving.any():
                break
        order = np.lexsort((best, finger))
        best_x, best = best_x[order], best[order]
        middle = 0.5 * (best_x + best_x[np.searchsorted(finger, finger)])
        y, J, _ = self.table.views(middle, finger)
        midway, _ = self._step(middle, finger, white, seen - y, J)
        cov = self._cov(best_J[order], white, finger)
        return _minima(
            finger, slot, x_rad=best_x, cov_rad2=cov, misfit=best, length_px=length[order], midway=midway
        )

    def _nudged(self, x: Float, finger: Int, slot: Int, wanted: Bool) -> tuple[Float, Float, Float]:
        """As `_views`, and how it changes with each unknown (N, 4, 3) [1/rad]."""
        count = len(x)
        many = np.repeat(x[None], 1 + UNKNOWNS, axis=0)
        inwards = _NUDGE_RAD * (1.0 - 2.0 * (x + _NUDGE_RAD > self.poses.high[finger]))
        for k in range(UNKNOWNS):
            many[1 + k, :, k] += inwards[:, k]
        slots = slot + MINIMA * np.arange(1 + UNKNOWNS)[:, None]
        of_all = np.tile(finger, 1 + UNKNOWNS), slots.ravel(), np.tile(wanted, 1 + UNKNOWNS)
        y, length = self._views(many.reshape(-1, UNKNOWNS), *of_all)
        by = np.empty((count, SEEN, UNKNOWNS))
        for k in range(UNKNOWNS):
            by[..., k] = (y[(1 + k) * count : (2 + k) * count] - y[:count]) / inwards[:, k, None]
        return y[:count], length[:count], by

    def _views(self, x: Float, finger: Int, slot: Int, wanted: Bool) -> tuple[Float, Float]:
        """What is seen (N, 4) of poses (N, 3), exactly, and how long the line is (N,); NaN where not wanted."""
        slots = int(slot.max()) + 1
        grid, which = np.zeros((slots, 5, UNKNOWNS)), np.zeros((slots, 5), np.bool_)
        grid[slot, finger], which[slot, finger] = x, wanted
        views = self.poses.views(grid, which)
        return views.seen[slot, finger], views.length_px[slot, finger]

    def _step(
        self, x: Float, finger: Int, white: Float, off: Float, J: Float, bend: bool = True
    ) -> tuple[Float, Float]:
        """Energy (N,) of poses (N, 3) with residuals `off` (N, 4), inf where that is NaN, and a step towards less.

        Without `bend` the PIP is left as it is.
        """
        low, high = self.poses.low[finger], self.poses.high[finger]
        off = (white @ off[..., None])[..., 0]
        energy = np.nan_to_num(np.vecdot(off, off), nan=np.inf)
        slope = white @ J
        down = (np.swapaxes(slope, 1, 2) @ np.nan_to_num(off)[..., None])[..., 0]
        H = np.swapaxes(slope, 1, 2) @ slope
        stuck = ((x <= low) & (down < 0.0)) | ((x >= high) & (down > 0.0))
        stuck[:, PIP] |= not bend
        H = np.where(stuck[:, None] | stuck[..., None], 0.0, H)
        np.einsum("nii->ni", H)[...] += np.where(stuck, 1.0, 1e-3 * self._loose[finger])
        to = np.linalg.solve(H, np.where(stuck, 0.0, down)[..., None])[..., 0]
        return energy, np.clip(x + np.clip(to, -_FARTHEST_RAD, _FARTHEST_RAD), low, high) - x

    def _cov(self, J: Float, white: Float, finger: Int) -> Float:
        """Covariances (N, 3, 3) of unknowns at derivatives (N, 4, 3)."""
        slope = white @ J
        information = np.swapaxes(slope, 1, 2) @ slope
        np.einsum("nii->ni", information)[...] += self._loose[finger]
        return np.asarray(np.linalg.inv(information), np.float64)


def _minima(finger: Int, slot: Int, **values: Float) -> Minima:
    """Values (N, ...) of minima, as many of each finger."""
    empty = {"misfit": np.inf, "midway": np.inf}
    table: dict[str, Float] = {}
    for name, value in values.items():
        table[name] = np.full((5, MINIMA, *value.shape[1:]), empty.get(name, np.nan))
        table[name][finger, slot] = value
    return Minima(**table)


def _mended(J: Float, by: Float, did: Float) -> Float:
    """Derivatives (N, 4, 3) that give what a step (N, 3) did (N, 4), else as they were."""
    moved = np.vecdot(by, by)
    known = np.isfinite(did).all(axis=1) & (moved > 1e-10)
    short = did - (J @ by[..., None])[..., 0]
    change = short[..., None] * by[:, None] / np.where(known, moved, 1.0)[:, None, None]
    return J + np.where(known[:, None, None], change, 0.0)
