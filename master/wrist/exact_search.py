"""The inverse model where what was seen is exact: then the true pose has no energy, and what has some is not the truth.

Rounding alone is left of the energy at the truth. So a minimum with more than that is a place where the refinement
stopped too early, or it is the bottom of another valley, and the search goes on: first from the minima themselves, then
from more nodes of the table, by Levenberg and Marquardt's steps with differences of the laser's cut. A device's noise
never asks for this, and no message of a real one pays for it.
"""

import numpy as np

from common.arrays import Bool, Float, Int
from master.wrist.candidates import Found, apart, joined
from master.wrist.finger_poses import SEEN, UNKNOWNS, FingerPoses
from master.wrist.pose_table import Forward

NOTHING = 1e-9  # of energy: what rounding leaves of it, and 1e-4 degrees or less
_STEPS = 24
# Differences are taken over a share of the last step, for what is seen has small jumps.
_NUDGED, _NUDGES_RAD = 0.2, np.radians([0.01, 0.3])
_FARTHEST_RAD = np.radians(10.0)
_EASIER, _HARDER = 0.2, 5.0  # damping after a step downhill, and after one that was none
_LEADS = 100.0  # of energy by the table: with more, a minimum leads to no truth
_SETTLED = 0.999  # of energy that is left by a step: the next will not do more
# With so much energy, three standard deviations, after so many steps it is no way to the truth.
_TRIED, _NO_LEAD = 6, 9.0
_STARTS = 24
_SIDES = np.array([side for side in np.ndindex(3, 3, 3) if side != (1, 1, 1)]) - 1.0  # (26, 3)
_AROUND_RAD = np.radians([0.1, 0.3, 1.0, 3.0])
_STALLED = 1e3  # of damping: steps are then of no length


class ExactSearch:
    """Follows poses of one hand before one device down to where they explain what was seen best. Holds no state."""

    def __init__(self, poses: FingerPoses, table: Forward) -> None:
        self._poses, self._table = poses, table

    def __call__(self, found: Found, wanted: Bool, seen: Float, white: Float) -> Found:
        """Minima of fingers, those of the `wanted` (5,) searched for.

        Args:
            found: What the table and a few steps have led to.
            wanted: (5,) whose sight is exact.
            seen: (5, 4), white: (5, 4, 4) what turns its residual into standard deviations.
        """
        own = wanted[found.finger] & (found.misfit < _LEADS)
        out = joined(
            found.of(np.flatnonzero(~own)),
            self._descended(found.x_rad[own], found.finger[own], seen, white, first=False),
        )
        for starts in (self._elsewhere, self._around):
            least = np.full(5, np.inf)
            np.minimum.at(least, out.finger, out.misfit)
            lost = [int(f) for f in np.flatnonzero(wanted & (least > NOTHING))]
            if not lost:
                break
            some = [starts(f, out, seen[f]) for f in lost]
            x, finger = np.concatenate(some), np.repeat(lost, [len(of_one) for of_one in some])
            out = joined(out, self._descended(x, finger, seen, white, first=True))
        return out.of(apart(out.x_rad, out.finger, out.misfit))

    def _elsewhere(self, finger: int, found: Found, seen: Float) -> Float:
        return self._table.starts(seen, finger, _STARTS)

    def _around(self, finger: int, found: Found, seen: Float) -> Float:
        own = np.flatnonzero(found.finger == finger)
        best = found.x_rad[own[found.misfit[own].argmin()]]
        x = best + (_AROUND_RAD[:, None, None] * _SIDES).reshape(-1, UNKNOWNS)
        return np.clip(x, self._poses.low[finger], self._poses.high[finger])

    def _descended(self, x: Float, finger: Int, seen: Float, white: Float, first: bool) -> Found:
        """Local minima that poses (N, 3) of fingers (N,) lead to, or of each finger the `first` without energy."""
        seen, white = seen[finger], white[finger]
        count = len(x)
        best, energy, length = x.copy(), np.full(count, np.inf), np.full(count, np.nan)
        off, J = np.zeros((count, SEEN)), np.zeros((count, SEEN, UNKNOWNS))
        damping, moving, trial = np.full(count, 1e-3), np.ones(count, np.bool_), x.copy()
        nudge = np.full(count, _NUDGES_RAD[1])
        for k in range(_STEPS):
            at = np.flatnonzero(moving)
            y, long, by = self._nudged(trial[at], finger[at], nudge[at])
            left = (white[at] @ (seen[at] - y)[..., None])[..., 0]
            now = np.nan_to_num(np.vecdot(left, left), nan=np.inf)
            won = now < energy[at]
            settled = won & (now > _SETTLED * energy[at])
            damping[at] *= np.where(won, _EASIER, _HARDER)
            took = at[won]
            best[took], energy[took], length[took] = trial[took], now[won], long[won]
            off[took], J[took] = left[won], np.nan_to_num(by[won])
            moving[at] = (
                (energy[at] > NOTHING) & (damping[at] < _STALLED) & ~settled & np.isfinite(energy[at])
            )
            moving &= (k < _TRIED) | (energy < _NO_LEAD)
            if first:  # who has found his way to nothing is the truth of his finger
                moving &= ~np.isin(finger, finger[energy <= NOTHING])
            at = np.flatnonzero(moving)
            if not len(at):
                break
            trial[at] = self._stepped(best[at], finger[at], off[at], white[at] @ J[at], damping[at])
            nudge[at] = np.clip(_NUDGED * np.abs(trial[at] - best[at]).max(axis=1), *_NUDGES_RAD)
        return Found(best, finger, energy, length, J)

    def _nudged(self, x: Float, finger: Int, nudge_rad: Float) -> tuple[Float, Float, Float]:
        """What is seen (N, 4), the length of the line (N,), and derivatives (N, 4, 3) [1/rad], of poses (N, 3)."""
        count = len(x)
        nudge = nudge_rad[:, None]
        inwards = nudge * (1.0 - 2.0 * (x + nudge > self._poses.high[finger]))
        many = np.tile(x, (1 + UNKNOWNS, 1)).reshape(1 + UNKNOWNS, count, UNKNOWNS)
        for k in range(UNKNOWNS):
            many[1 + k, :, k] += inwards[:, k]
        y, length = self._poses.of_fingers(many.reshape(-1, UNKNOWNS), np.tile(finger, 1 + UNKNOWNS))
        y = y.reshape(1 + UNKNOWNS, count, SEEN)
        by = np.moveaxis(y[1:] - y[0], 0, -1) / inwards[:, None]
        return y[0], length[:count], by

    def _stepped(self, x: Float, finger: Int, off: Float, slope: Float, damping: Float) -> Float:
        """Poses (N, 3) a damped step farther, within the ranges, by residuals (N, 4) and their slopes (N, 4, 3)."""
        low, high = self._poses.low[finger], self._poses.high[finger]
        turned = np.swapaxes(slope, 1, 2)
        down, H = (turned @ off[..., None])[..., 0], turned @ slope
        stuck = ((x <= low) & (down < 0.0)) | ((x >= high) & (down > 0.0))
        H = np.where(stuck[:, None] | stuck[..., None], 0.0, H)
        size = np.einsum("nii->ni", H)
        size += np.where(stuck, 1.0, damping[:, None] * size + 1e-9 * size.max(axis=1, keepdims=True) + 1e-12)
        to = np.linalg.solve(H, np.where(stuck, 0.0, down)[..., None])[..., 0]
        return np.clip(x + np.clip(to, -_FARTHEST_RAD, _FARTHEST_RAD), low, high)
