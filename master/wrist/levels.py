"""Which level a finger is solved at (row D22): from its laser point by habit (FK), or from laser and fingertip (IK).

    fk     laser points only
    ik     only fingers of which both are seen and agree, without habits; of the others nothing is said
    auto   IK where it can be, habits counting as much as they are worth; else FK

**The angles** of ik are those of the least energy (row D16, `master.wrist.inverse`): of exact sights the exact pose.
Those of auto are the median of what is believed along the finger's valley (`master.wrist.valley`): of noisy sights it
errs least, on average. How far light says the tip is away counts too, as soon as its unit is known
(`master.wrist.light_unit`): for ik, between poses that explain laser and tip alike.

**A tip that is none** must not win by itself. Where no pose explains laser and tip together within three standard
deviations it is refused (counted `tip_refused`), and where the pose found would show a line twice as long as was seen.

**Habits** are those of a natural hand, a straight or a free one, and all fingers tell which of them it is: a finger
that defies habit clearly takes from the others the belief in it. Then FK is not believed either: a finger of which only
the laser point is known may have any PIP that explains this point and hides the tip, and all of them are its doubt.

**Ambiguous** is a finger whose belief has two parts, with a PIP between them that is clearly less likely, or one so
wide that it is as good as two. That part is believed which weighs more, or where frames follow each other which is
near to the last angles. The covariance holds all of them.
"""

from dataclasses import dataclass, replace

import numpy as np

from common.arrays import Bool, Float, Int
from common.messages import Level
from master.estimator.settings import DEFAULT, Settings
from master.wrist.belief import FingerAngles
from master.wrist.bent import BentView
from master.wrist.finger_poses import SEEN, UNKNOWNS, FingerPoses
from master.wrist.forward import DIP, PIP
from master.wrist.inverse import InverseModel, Minima
from master.wrist.light_unit import LightUnit
from master.wrist.pose_table import SHAPE
from master.wrist.setup import WristSetup
from master.wrist.sight import HARDLY, SightNoise
from master.wrist.valley import RATIOS, STIFF_RAD, Valley, Valleys

_REFUSED = 9.0
_AS_GOOD = 3.84  # chi-square of one degree of freedom, 95 %: poses whose misfits differ by less explain alike
_APART_RAD = np.radians(10.0)  # in PIP: clearly another pose
_PASS = 0.4  # of the lower top that a density falls below between two parts
_OTHER = 0.05  # of all belief: less than this is no other part
_GOES_ON_RAD = np.radians(20.0)  # by which a PIP may have moved since the finger was last seen
_CONTRADICTED = 0.01  # less probable than this, a natural hand is none
_FLESH_RAD = np.radians(2.5)  # 2 mm of a tip that is not quite where the hand file has it, over two bones
_CLEARLY_RAD, _INSIDE_PX = np.radians(10.0), 20.0  # by which a tip is in sight that is hardly ever missed
_SHOWN = np.log(10.0)  # of ten tips that the model says are seen nine are found
NOTHING = np.zeros(5, np.bool_)
NOTHING.flags.writeable = False


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
        tip_depth: (5,) of them by light, relative.
    """

    laser_m: Float
    laser_cov_m2: Float
    distance_m: Float
    laser_px: Float
    tip: Float
    tip_sigma_px: Float
    tip_depth: Float


class Levels:
    """Solves fingers at the level that the rig asks for. What it holds was prepared by the constructor."""

    def __init__(self, setup: WristSetup, model: InverseModel, settings: Settings = DEFAULT) -> None:
        self._model, self._hand = model, setup.model
        self._sight, self._valleys = SightNoise(setup), Valleys(model.poses, settings)
        self._alone, self._optics = setup.level == "ik", setup.optics
        share = settings.natural_share
        self._share = np.log([share, *2 * [0.5 * (1.0 - share)]])

    def __call__(
        self,
        natural: FingerAngles,
        sight: Sighting,
        last_rad: Float,
        unit: LightUnit,
        news: float = 1.0,
        view: BentView | None = None,
        expected: Bool = NOTHING,
    ) -> tuple[FingerAngles, Bool]:
        """Angles of fingers, and whose tip was refused (5,).

        Args:
            natural: What the laser points say by habit.
            sight: What was seen.
            last_rad: (5, 4) the fingers' last angles; NaN where those are too old.
            unit: What is known of the unit of `sight.tip_depth`; it is told more.
            news: How far this pose is from the last one: 1 where they are unrelated.
            view: What is seen at the bend of the wrist; None: it is straight.
            expected: (5,) fingers of which somebody else says how they are bent.
        """
        model = self._model if view is None else self._model.bent(view.poses, view)
        seen = np.concatenate([sight.laser_m, sight.tip], axis=1)
        both: Bool = np.isfinite(seen.sum(axis=1))
        nodes, energy = model.table.candidates(np.where(both[:, None], seen, 0.0))
        nodes[~(np.isfinite(energy) & both[:, None])] = np.nan
        noise = self._noise(sight, both)
        valley = self._valleys(model.poses, model.table, nodes, np.where(both[:, None], seen, np.nan), noise)
        believed = both & (valley.misfit.min(axis=1) < _REFUSED)
        mixed, habit = self._mixed(valley, believed)
        x = np.swapaxes(np.nan_to_num(valley.x_rad), 0, 1)
        depth_m = model.poses.tips(model.poses.angles(x))[..., 2].T
        log = mixed + unit.push(
            np.where(believed, sight.tip_depth, np.nan), depth_m, _probable(mixed, believed), news
        )
        least = None
        if self._alone:
            coarse_rad = self._sight.turn_rad(sight.tip_sigma_px, sight.distance_m)
            minima = model(np.where(believed[:, None], seen, np.nan), noise, coarse_rad)
            least = _least(minima, valley, log, last_rad)
        found, at = self._angles(valley, log, believed, last_rad, least)
        shown = self._sight.shown(valley.length_px[np.arange(5), at], sight.laser_px)
        solved = believed & (shown >= HARDLY)
        kept = natural if habit > _CONTRADICTED else self._free(model, natural, sight, solved)
        if not self._alone:
            hidden = self._should_show(model.poses, kept, np.isnan(sight.tip[:, 0]), expected)
            kept = replace(kept, told=kept.told & ~hidden, off=kept.off | hidden)
        kept = replace(kept, angles_rad=kept.angles_rad.copy(), cov_rad2=kept.cov_rad2.copy())
        kept.angles_rad[solved], kept.cov_rad2[solved] = found.angles_rad[solved], found.cov_rad2[solved]
        no = ~solved
        if self._alone:
            kept.angles_rad[no], kept.cov_rad2[no] = np.nan, np.nan
        level = kept.level if not self._alone else np.full(5, np.uint8(Level.NONE))
        return replace(
            kept,
            told=solved | (kept.told & (not self._alone)),
            past=kept.past & no,
            off=kept.off & no,
            level=np.where(solved, np.uint8(Level.IK), level),
            ambiguous=found.ambiguous & solved,
        ), both & no

    def _noise(self, sight: Sighting, both: Bool) -> Float:
        """Covariance (5, 4, 4) of what was seen, finite."""
        out = np.zeros((5, SEEN, SEEN))
        whole = np.ones(5)
        out[:, :2, :2] = self._sight.laser_m2(sight.laser_cov_m2, sight.distance_m, whole, whole)
        tip = self._sight.tip(sight.tip_sigma_px, sight.distance_m)
        out[:, 2:, 2:] = np.where(both[:, None, None], tip, np.eye(2))
        return out

    def _mixed(self, valley: Valley, believed: Bool) -> tuple[Float, float]:
        """Logarithms of what is believed of each pose (5, P), and how probable it is that the hand is natural."""
        if self._alone:
            return valley.likely, 1.0
        of_all = np.where(believed, valley.evidence, 0.0).sum(axis=1) + self._share
        hands = of_all - np.logaddexp.reduce(of_all)
        return np.logaddexp.reduce(hands[:, None, None] + valley.log), float(np.exp(hands[0]))

    def _should_show(self, poses: FingerPoses, natural: FingerAngles, unseen: Bool, expected: Bool) -> Bool:
        """Fingers (5,) of which habit is not believed: it has their tip in sight, and that is not seen.

        They are bent otherwise. Where tips of neighbours are missing alike the hand may as well hold something that
        hides them. From a triple alone nobody can tell; where fingers are expected somewhere it is this that their
        laser point follows, not habit, and it counts.
        """
        asked = natural.told & unseen
        asked[0] = False  # the tip of a thumb is hardly ever found
        if unseen.all() or not asked.any():
            return np.zeros(5, np.bool_)
        x = np.nan_to_num(natural.angles_rad[:, :UNKNOWNS]) + np.array([-1.0, 0.0, 1.0])[
            :, None, None
        ] * np.array([0.0, 0.0, _CLEARLY_RAD])
        tips = poses.tips(poses.angles(x))
        uv = self._optics.project(tips)
        size = np.array([self._optics.width_px, self._optics.height_px])
        inside = ((uv > _INSIDE_PX) & (uv < size - _INSIDE_PX)).all(axis=-1)
        missing = asked & (inside & poses.tips_shown(x)).all(axis=0)
        beside = np.zeros(5, np.bool_)
        beside[2:] |= missing[1:-1]
        beside[1:-1] |= missing[2:]
        return missing & ~(beside & expected)

    def _free(
        self, model: InverseModel, natural: FingerAngles, sight: Sighting, solved: Bool
    ) -> FingerAngles:
        """Fingers of a hand that is not natural, of which the laser point alone is known: what is possible."""
        point = np.isfinite(sight.laser_m[:, 0]) & np.isfinite(natural.angles_rad[:, 0]) & ~solved
        if not point.any():
            return natural
        start = np.repeat(natural.angles_rad[:, None, :UNKNOWNS], SHAPE[PIP], axis=1)
        start[..., PIP] = model.table.first[:, None, PIP] + model.table.step[:, None, PIP] * np.arange(
            SHAPE[PIP]
        )
        start[~point] = np.nan
        nobody = np.zeros(5, np.bool_)
        valley = self._valleys(
            model.poses, model.table, start, sight.laser_m, self._noise(sight, nobody)[:, :2, :2]
        )
        log = np.logaddexp(valley.log[1], valley.log[2])
        log[model.poses.tips_shown(np.swapaxes(np.nan_to_num(valley.x_rad), 0, 1)).T] -= _SHOWN
        found, _ = self._angles(valley, log, point, np.full((5, 4), np.nan))
        point &= valley.misfit.min(axis=1) < _REFUSED
        angles, cov = natural.angles_rad.copy(), natural.cov_rad2.copy()
        angles[point], cov[point] = found.angles_rad[point], found.cov_rad2[point]
        return replace(
            natural, angles_rad=angles, cov_rad2=cov, told=natural.told & ~point, off=natural.off | point
        )

    def _angles(
        self,
        valley: Valley,
        log: Float,
        known: Bool,
        last_rad: Float,
        least: tuple[Float, Bool] | None = None,
    ) -> tuple[FingerAngles, Int]:
        """The angles that are believed, or those of `least` energy, and at which of the poses (5,) they lie."""
        x, p = np.nan_to_num(valley.x_rad), np.nan_to_num(_probable(log, known))
        pip = x[..., PIP]
        going = np.exp(-0.5 * ((pip - last_rad[:, PIP, None]) / _GOES_ON_RAD) ** 2)
        part, parted = _part(p, p * np.nan_to_num(going, nan=1.0))
        inside = np.where(part, p, 0.0)
        at, chosen = _median(x, inside)
        twice = np.zeros(5, np.bool_)
        if least is not None:
            at, chosen, twice = np.abs(pip - least[0][:, None, PIP]).argmin(axis=1), *least
        away = x - chosen[:, None]
        cov = np.swapaxes(away, 1, 2) @ (p[..., None] * away)
        cov[:, :2, :2] += (p[..., None, None] * np.nan_to_num(valley.side_rad2)).sum(axis=1)
        cov[:, range(UNKNOWNS), range(UNKNOWNS)] += STIFF_RAD**2
        cov[:, PIP, PIP] += _FLESH_RAD**2
        other = (p * (np.abs(away[..., PIP]) > _APART_RAD)).sum(axis=1) > _OTHER
        ambiguous = known & ((parted & other) | twice)
        return self._whole(chosen, cov, known, ambiguous), at

    def _whole(self, x: Float, cov: Float, solved: Bool, ambiguous: Bool) -> FingerAngles:
        """Four angles of three unknowns (5, 3)."""
        by = np.zeros((5, 4, UNKNOWNS))
        by[:, range(UNKNOWNS), range(UNKNOWNS)] = 1.0
        by[:, DIP, PIP] = self._model.poses.dip_per_pip
        whole = by @ cov @ np.swapaxes(by, 1, 2)
        loose = max(self._hand.dip_spread_rad, STIFF_RAD)
        whole[:, DIP, DIP] += loose**2 + (RATIOS * x[:, PIP]) ** 2
        angles = self._hand.clamp(self._model.poses.angles(x))
        level = np.where(solved, np.uint8(Level.IK), np.uint8(Level.NONE))
        no = np.zeros(5, np.bool_)
        return FingerAngles(angles, whole, solved, no, no, level, ambiguous)


def _least(minima: Minima, valley: Valley, log: Float, last_rad: Float) -> tuple[Float, Bool]:
    """Poses (5, 3) of least energy, and whether another, clearly apart, explains as much (5,).

    Of those that explain alike it is the one that is near to the last angles, or else that light and valley favour.
    """
    rows, x = np.arange(5), np.nan_to_num(minima.x_rad)
    as_good = minima.misfit <= minima.misfit[:, :1] + _AS_GOOD
    node = np.abs(np.nan_to_num(valley.x_rad)[:, None, :, PIP] - x[..., PIP, None]).argmin(axis=2)
    walked = -np.abs(x[..., PIP] - last_rad[:, None, PIP])
    rank = np.where(np.isfinite(walked), walked, np.take_along_axis(log, node, axis=1))
    best = np.where(as_good, np.nan_to_num(rank, neginf=-1e9), -np.inf).argmax(axis=1)
    near = np.abs(x[rows, best] - x[:, 0])[:, PIP] <= _APART_RAD
    chosen = x[rows, np.where(near, 0, best)]
    return chosen, (as_good & (np.abs(x[..., PIP] - chosen[:, None, PIP]) > _APART_RAD)).any(axis=1)


def _probable(log: Float, known: Bool) -> Float:
    """Probabilities (5, P) of logarithms; NaN of fingers of which nothing is known."""
    top = log.max(axis=1, keepdims=True)
    p = np.exp(log - np.where(np.isfinite(top), top, 0.0))
    total = p.sum(axis=1, keepdims=True)
    return np.where(known[:, None] & (total > 0.0), p / np.where(total > 0.0, total, 1.0), np.nan)


def _median(x: Float, p: Float) -> tuple[Int, Float]:
    """Where along poses (5, P, 3) half of the weights (5, P) lies, and the pose there (5, 3)."""
    rows, last = np.arange(len(p)), p.shape[1] - 1
    half = np.cumsum(p, axis=1) - 0.5 * p - 0.5 * p.sum(axis=1, keepdims=True)
    at = np.clip((half < 0.0).sum(axis=1) - 1, 0, last)
    after = np.minimum(at + 1, last)
    way = half[rows, after] - half[rows, at]
    share = np.where(
        (way > 0.0) & (p[rows, after] > 0.0), -half[rows, at] / np.where(way > 0.0, way, 1.0), 0.0
    )
    share = np.clip(share, 0.0, 1.0)[:, None]
    return at, (1.0 - share) * x[rows, at] + share * x[rows, after]


def _part(p: Float, preferred: Float) -> tuple[Bool, Bool]:
    """Which poses (5, P) make up the part of a density (5, P) that is preferred, and whether there are others (5,).

    Two tops are of one part where the density does not fall clearly between them.
    """
    part, parted = np.ones(p.shape, np.bool_), np.zeros(len(p), np.bool_)
    for f, row in enumerate(p):
        ends = _ends(row)
        parted[f] = len(ends) > 2
        if parted[f]:
            weight = np.add.reduceat(preferred[f], ends[:-1])
            best = int(weight.argmax())
            part[f] = False
            part[f, ends[best] : ends[best + 1]] = True
    return part, parted


def _ends(row: Float) -> Int:
    """Where the parts of a density (P,) begin, and its length."""
    rising = np.diff(row, prepend=0.0, append=0.0)
    tops = np.flatnonzero((rising[:-1] > 0.0) & (rising[1:] <= 0.0))
    ends = [0]
    top = tops[0] if len(tops) else 0
    for other in tops[1:]:
        low = top + int(row[top : other + 1].argmin())
        if row[low] < _PASS * min(row[top], row[other]):
            ends.append(low)
            top = other
        elif row[other] > row[top]:
            top = other
    return np.array([*ends, len(row)])
