"""Which level a finger is solved at (row D22): from its laser point by habit (FK), or from laser and fingertip (IK).

    fk     laser points only
    ik     only fingers of which both are seen and agree; of the others nothing is said
    auto   IK where it can be, else FK

**A tip that is none** must not win by itself. Of the four numbers that are seen three are used up by the unknowns: what
is left, the misfit, is chi-square with one degree of freedom, and more than three standard deviations refuse the tip
(counted `tip_refused`). So does a line of which the pose found would show twice as much.

**Ambiguous** is a finger of which two clearly different poses misfit by amounts that do not differ significantly
(chi-square of one degree of freedom, 95 %). Of these the one nearest to the finger's last angles is taken, if these are
fresh, else the most natural one; a pose that is so unnatural that this outweighs what it explains better is none of
them. The covariance is widened to hold all. Where a fingertip turns back in the image, at the nearest place of its way
to the camera, both sides of that turn explain it: if the misfit between them is no more than noise they are one wide
valley, and its mean is taken.
"""

from dataclasses import dataclass, replace

import numpy as np

from common.arrays import Bool, Float
from common.hand_limits import FLEXION
from common.messages import Level
from master.ik.priors import FreeHand, Priors
from master.wrist.belief import FingerAngles
from master.wrist.finger_poses import SEEN, UNKNOWNS
from master.wrist.forward import DIP, PIP
from master.wrist.inverse import InverseModel, Minima
from master.wrist.setup import WristSetup
from master.wrist.sight import HARDLY, SightNoise

_REFUSED = 9.0
_AS_GOOD = 3.84
_FLAT = 1.0  # two minima with no more than one standard deviation between them are one
_APART_RAD = np.radians(10.0)  # in flexion or PIP: clearly another pose
_RATIOS = 0.5 * (
    0.84 - 2.0 / 3.0
)  # the papers' DIP per PIP lie by this to both sides of their middle (row I12)
_STIFF_RAD = np.radians(1.0)


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """What one message tells of five fingers; NaN: not seen.

    Attributes:
        laser_m: (5, 2) points on the plane (across, along) [m].
        laser_cov_m2: (5, 2, 2) of the sensing.
        distance_m: (5,) of them along the optical axis.
        laser_px: (5,) lengths of the lines.
        tip: (5, 2) tips (x / z, y / z).
        tip_sigma_px: (5,).
    """

    laser_m: Float
    laser_cov_m2: Float
    distance_m: Float
    laser_px: Float
    tip: Float
    tip_sigma_px: Float


class Levels:
    """Solves fingers at the level that the rig asks for. What it holds was prepared by the constructor."""

    def __init__(self, setup: WristSetup, model: InverseModel, priors: Priors | None = None) -> None:
        self._model, self._hand, self._sight = model, setup.model, SightNoise(setup)
        self._alone = setup.level == "ik"
        habits = priors or Priors()
        natural = habits.natural_share
        self._hands = (natural, habits.natural_flexion), (1.0 - natural, (habits.free or FreeHand()).pip)

    def __call__(self, natural: FingerAngles, sight: Sighting, last_rad: Float) -> tuple[FingerAngles, Bool]:
        """Angles of fingers, and whose tip was refused (5,).

        Args:
            natural: What the laser points say by habit.
            sight: What was seen.
            last_rad: (5, 4) the fingers' last angles; NaN where those are too old.
        """
        seen = np.concatenate([sight.laser_m, sight.tip], axis=1)
        both: Bool = np.isfinite(seen.sum(axis=1))
        coarse_rad = self._sight.turn_rad(sight.tip_sigma_px, sight.distance_m)
        minima = self._model(seen, self._noise(sight, both), coarse_rad)
        shown = self._sight.shown(np.nan_to_num(minima.length_px[:, 0]), sight.laser_px)
        solved = both & (minima.misfit[:, 0] < _REFUSED) & (shown >= HARDLY)
        found = self._angles(minima, solved, last_rad)
        no = ~solved
        kept = replace(natural, angles_rad=natural.angles_rad.copy(), cov_rad2=natural.cov_rad2.copy())
        kept.angles_rad[solved], kept.cov_rad2[solved] = found.angles_rad[solved], found.cov_rad2[solved]
        if self._alone:
            kept.angles_rad[no], kept.cov_rad2[no] = np.nan, np.nan
        level = natural.level if not self._alone else np.full(5, np.uint8(Level.NONE))
        return replace(
            kept,
            told=solved | (natural.told & (not self._alone)),
            past=natural.past & no,
            off=natural.off & no,
            level=np.where(solved, np.uint8(Level.IK), level),
            ambiguous=found.ambiguous,
        ), both & no

    def _noise(self, sight: Sighting, both: Bool) -> Float:
        """Covariance (5, 4, 4) of what was seen, finite."""
        out = np.zeros((5, SEEN, SEEN))
        whole = np.ones(5)
        out[:, :2, :2] = self._sight.laser_m2(sight.laser_cov_m2, sight.distance_m, whole, whole)
        tip = self._sight.tip(sight.tip_sigma_px, sight.distance_m)
        out[:, 2:, 2:] = np.where(both[:, None, None], tip, np.eye(2))
        return out

    def _angles(self, minima: Minima, solved: Bool, last_rad: Float) -> FingerAngles:
        """Of the minima of each finger the one that is believed."""
        rows, x = np.arange(5), minima.x_rad
        unnatural = self._unnatural(x)
        cost = minima.misfit + unnatural
        walked = (np.abs(x - last_rad[:, None, :UNKNOWNS]) ** 2).sum(axis=-1)
        rank = np.where(np.isfinite(last_rad[:, :1]), walked, unnatural)
        likely = cost <= cost.min(axis=1, keepdims=True) + _AS_GOOD
        best = np.where(likely, np.nan_to_num(rank, nan=np.inf), np.inf).argmin(axis=1)
        near = (np.abs(x[rows, best] - x[:, 0])[:, 1:] <= _APART_RAD).all(axis=1)
        best = np.where(near, 0, best)
        chosen = x[rows, best]
        as_good = solved[:, None] & (minima.misfit <= minima.misfit[rows, best][:, None] + _AS_GOOD)
        away = np.where(as_good[..., None], x - chosen[:, None], 0.0)
        ambiguous = (np.abs(away[..., 1:]) > _APART_RAD).any(axis=(1, 2))
        weight = as_good / np.maximum(as_good.sum(axis=1, keepdims=True), 1)
        cov = minima.cov_rad2[rows, best] + np.swapaxes(away, 1, 2) @ (weight[..., None] * away)
        # Of one wide valley the mean is believed.
        valley = as_good & (minima.midway < minima.misfit[:, :1] + _FLAT)
        worse = np.nan_to_num(cost, posinf=1e9) - np.nan_to_num(cost[rows, best], posinf=1e9)[:, None]
        part = np.where(valley, np.exp(-0.5 * np.clip(worse, -50.0, 50.0)), 0.0)
        part[rows, best] = np.maximum(part[rows, best], 1e-9)
        wide = (valley.sum(axis=1) > 1) & valley[rows, best] & ambiguous
        mean = chosen + (part[..., None] * away).sum(axis=1) / part.sum(axis=1)[:, None]
        return self._whole(np.where(wide[:, None], mean, chosen), cov, solved, ambiguous)

    def _unnatural(self, x: Float) -> Float:
        """What poses (5, K, 3) cost by being unnatural, as chi-square: -2 ln of how rare that is; inf where NaN.

        Some hands bend by habit and some are free (`master.ik.priors`), so it is no more than some units.
        """
        slope, base = self._model.poses.habit
        strayed = x[..., FLEXION] - base[:, None] - slope[:, None] * x[..., PIP]
        share, rare = 0.0, 0.0
        for part, sigma in self._hands:
            share = share + part / sigma * np.exp(-0.5 * (strayed / sigma) ** 2)
            rare += part / sigma
        return -2.0 * np.log(np.nan_to_num(share / rare, nan=0.0) + 1e-300)

    def _whole(self, x: Float, cov: Float, solved: Bool, ambiguous: Bool) -> FingerAngles:
        """Four angles of three unknowns (5, 3)."""
        by = np.zeros((5, 4, UNKNOWNS))
        by[:, range(UNKNOWNS), range(UNKNOWNS)] = 1.0
        by[:, DIP, PIP] = self._model.poses.dip_per_pip
        whole = by @ cov @ np.swapaxes(by, 1, 2)
        loose = max(self._hand.dip_spread_rad, _STIFF_RAD)
        whole[:, DIP, DIP] += loose**2 + (_RATIOS * x[:, PIP]) ** 2
        angles = self._hand.clamp(self._model.poses.angles(x))
        level = np.where(solved, np.uint8(Level.IK), np.uint8(Level.NONE))
        no = np.zeros(5, np.bool_)
        return FingerAngles(angles, whole, solved, no, no, level, ambiguous)
