"""The inverse model: poses of a finger that explain where the laser meets it and where its tip is (rows D16, D17, D19).

A finger has three unknowns and four numbers are seen (`master.wrist.finger_poses`). The energy is

    (y - f(x))' R^-1 (y - f(x))       within the range of x

with R the covariance of what was seen; habits have no part in it. It can have several minima: a finger straight and
low, or bent and high, may show its tip at the same place. All are looked for, the global one is among them:

1. **table**: for every PIP of a grid the node that explains best what was seen (`PoseTable.candidates`), brought by
   Gauss-Newton steps on the interpolated table to the least energy at that PIP;
2. **dips** of this energy over the PIP: from there the PIP moves too, and those that meet are one;
3. **exactly**: where the corners of the table's cell differ by much of the noise in what they say of the laser point,
   the few that are left are refined with the laser's cut itself, until a step is short against what the noise of the
   sensing makes of angles. Derivatives are those of the table, mended after every step by what the step did (Broyden
   1965). Elsewhere the table is as good as the cut;
4. where the sensing has **no noise** to speak of, all are followed down to what rounding leaves of the energy, and who
   has none is sought on (`master.wrist.exact_search`).

An unknown at the end of its range stays there while the energy falls towards the outside (projected Newton, Bertsekas
1982).
"""

from copy import copy
from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from master.wrist.candidates import MINIMA, Found, apart
from master.wrist.exact_search import ExactSearch
from master.wrist.finger_poses import SEEN, FingerPoses
from master.wrist.forward import PIP
from master.wrist.pose_table import Forward, PoseTable
from master.wrist.setup import WristSetup

_PROFILE_STEPS, _TABLE_STEPS, _EXACT_STEPS = 2, 2, 3
_FARTHEST_RAD = np.radians(12.0)  # of one step
_ARRIVED_RAD = np.radians(0.05)  # what is left after so short a step is a part of it
_IN_DOUBT = (
    0.5  # standard deviations by which a table's corners may differ, which is twice what it is wrong by
)
_EXACT_RAD = np.radians(0.02)  # sensing that turns a finger by no more is none
_BEATEN = 15.0  # nor is it refined further if it is exactly known to be worse by this


@dataclass(frozen=True, slots=True, eq=False)
class Minima:
    """Poses of the five fingers that explain what was seen, the best first; inf and NaN where there are not so many.

    Attributes:
        x_rad: (5, K, 3) abduction, flexion, PIP.
        misfit: (5, K) the energy, a chi-square of SEEN - UNKNOWNS degrees of freedom where nothing is at its limit.
    """

    x_rad: Float
    misfit: Float


class InverseModel:
    """Finds them for one device and hand. What it holds was prepared by the constructor, in about a second."""

    def __init__(self, setup: WristSetup) -> None:
        self.poses = FingerPoses(setup)
        self.table: Forward = PoseTable(setup, self.poses)
        self._search = ExactSearch(self.poses, self.table)
        self._loose = 12.0 / (self.poses.high - self.poses.low) ** 2  # (5, 3): anywhere within the range

    def bent(self, poses: FingerPoses, table: Forward) -> "InverseModel":
        """The same hand before another palm pose."""
        other = copy(self)
        other.poses, other.table, other._search = poses, table, ExactSearch(poses, table)
        return other

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
        misfit = np.zeros(len(x))
        for _ in range(_TABLE_STEPS):
            y, J, _ = self.table.views(x, finger)
            misfit, to = self._step(x, finger, white[finger], seen[finger] - y, J)
            x = x + to
        keep = apart(x, finger, misfit)
        coarse = np.zeros(5) if coarse_rad is None else np.nan_to_num(coarse_rad)
        exact = told & (coarse < _EXACT_RAD)
        found = self._refined(x[keep], finger[keep], seen, white, np.fmax(0.5 * coarse, _ARRIVED_RAD), exact)
        if exact.any():
            found = self._search(found, exact, seen, white)
        return _minima(found)

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

    def _refined(
        self, x: Float, finger: Int, seen: Float, white: Float, arrived_rad: Float, exact: Bool
    ) -> Found:
        """What candidates (N, 3) of fingers (N,) lead to; by the cut where the table is in doubt.

        Those of `exact` (5,) fingers are left as they are.
        """
        white, seen = white[finger], seen[finger]
        y, J, length = self.table.views(x, finger)
        doubt = self.table.doubt(x, finger)
        doubt = (white[:, :2, :2] @ doubt[..., None])[..., 0]
        moving = ~exact[finger] & (np.abs(doubt).max(axis=1) > _IN_DOUBT)
        best, _ = self._step(x, finger, white, seen - y, J)
        best[moving], length[moving] = np.inf, np.nan
        best_x, best_J = x.copy(), J.copy()
        y_before, x_before = np.full((len(x), SEEN), np.nan), x
        for _ in range(_EXACT_STEPS):
            if not moving.any():
                break
            y, long = np.full((len(x), SEEN), np.nan), np.full(len(x), np.nan)
            y[moving], long[moving] = self.poses.of_fingers(x[moving], finger[moving])
            J = _mended(J, x - x_before, y - y_before)
            misfit, to = self._step(x, finger, white, seen - y, J)
            won = misfit < best
            best_x[won], best[won], length[won], best_J[won] = x[won], misfit[won], long[won], J[won]
            # Where the laser misses, or a step led uphill: half the way back to the best.
            to = np.where(won[:, None], to, 0.5 * (best_x - x))
            x_before, y_before, x = x, y, x + to
            short = (np.abs(to) <= arrived_rad[finger, None]).all(axis=1)
            arrived = moving & won & short
            best_x[arrived] = x[arrived]
            least = np.full(5, np.inf)
            np.minimum.at(least, finger, best)
            moving &= ~short & (best < least[finger] + _BEATEN)
        return Found(best_x, finger, best, length, best_J)

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


def _minima(found: Found) -> Minima:
    """Those of each finger in their order, as many of each."""
    found = found.of(np.lexsort((found.misfit, found.finger)))
    finger = found.finger
    slot = np.arange(len(finger)) - np.searchsorted(finger, finger)
    x, misfit = np.full((5, MINIMA, found.x_rad.shape[1]), np.nan), np.full((5, MINIMA), np.inf)
    x[finger, slot], misfit[finger, slot] = found.x_rad, found.misfit
    return Minima(x, misfit)


def _mended(J: Float, by: Float, did: Float) -> Float:
    """Derivatives (N, 4, 3) that give what a step (N, 3) did (N, 4), else as they were."""
    moved = np.vecdot(by, by)
    known = np.isfinite(did).all(axis=1) & (moved > 1e-10)
    short = did - (J @ by[..., None])[..., 0]
    change = short[..., None] * by[:, None] / np.where(known, moved, 1.0)[:, None, None]
    return J + np.where(known[:, None, None], change, 0.0)
