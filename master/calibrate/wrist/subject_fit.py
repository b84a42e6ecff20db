"""A guided motion is segmented, and the most probable subject fitted to it.

Segmentation of a subject's guided motion.

Flat hand, knuckles flexed with straight fingers, flat hand, fist.

How far the laser points lie shows how open the hand is, whatever else is still unknown: they are farthest on a flat
hand and come nearer with every joint that bends. So a motion falls into its openings and what lies between them, and
a few strobe cycles of each are all that a fit needs. Which bends are of the knuckles, and which are fists, is decided
later, by the tips.

Most probable subject of a device as one least-squares problem.

Given what was seen of a guided motion.

Laser point and tip give four numbers of a finger in a strobe cycle, its angles are three unknowns; what is known of a
subject comes from joint couplings as well, each as firm as people keep to it. A flat hand is flat and a finger that
bends at its knuckle is straight, to a few degrees; a fist closes in natural ratios, about. Knuckles, thickness and
length are those of a hand of its size, about. What none of that determines keeps its prior, and the
covariance shows it: above all, a knuckle that lies farther from the camera looks like a thicker finger, and all
knuckles shifted alike look like a palm that is shifted.

The angles of each finger in each strobe cycle are eliminated (Schur complement), which leaves 26 unknowns. Steps are
Levenberg-Marquardt; outliers are downweighted (Cauchy). Errors of skin, tips and couplings last as long as a bend
does: its strobe cycles count together as a few.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.errors import FitError
from common.hand.skin import SPREAD
from master.calibrate.wrist.subject_model import ABDUCTION, LOCAL, MCP, PIP, UNKNOWN, SubjectModel

MOTION = (
    "open the hand flat; bend the straight fingers at their knuckles as far as they go, and back; open it flat;"
    " close it to a fist, and open it again; each bend in three seconds or more"
)
FLAT = -1
_FEWEST = 5  # strobe cycles of a bend


@dataclass(frozen=True, slots=True, eq=False)
class Guided:
    """Strobe cycles that count (T), in order.

    Attributes:
        row: (T,) their numbers.
        bend: (T,) number of the bend that each is of; FLAT: the hand is open.
    """

    row: Int
    bend: Int


def guided(along_m: Float) -> Guided:
    """Choose strobe cycles by how far the laser points lie [m].

    Laser points (T, 4) of index ... little; NaN: not seen.

    Raises:
        FitError: Fewer than three fingers bent, or the hand bent fewer than two times between openings.
    """
    open_share = openness(along_m)
    # shares of a finger's way: 4 degrees of a straight finger are a tenth of it
    flat = open_share > 0.85
    bends = _bends(open_share, flat)
    if len(bends) < 2 or not flat.any():
        raise FitError(
            f"the hand bent {len(bends)} times between being flat, at least twice is needed: {MOTION}"
        )
    chosen = [_flattest(np.flatnonzero(flat), open_share)]
    number = [np.full(len(chosen[0]), FLAT)]
    for k, rows in enumerate(bends):
        per_bend = 16
        rows = _evenly(rows, open_share, max(per_bend * 2 // len(bends), _FEWEST))
        chosen.append(rows)
        number.append(np.full(len(rows), k))
    return Guided(np.concatenate(chosen), np.concatenate(number))


def openness(along_m: Float) -> Float:
    """Return the openness (T,) of the hand as a share of the laser points' ways.

    The share that the points have gone from the nearest to the farthest.

    Raises:
        FitError: Fewer than three fingers are seen to bend.
    """
    low, high = np.full(4, np.nan), np.full(4, np.nan)
    for f in range(4):
        seen = along_m[np.isfinite(along_m[:, f]), f]
        if len(seen) >= 2 * _FEWEST:
            edge = 0.02  # share of outliers beyond the ends of a way
            low[f], high[f] = np.quantile(seen, [edge, 1.0 - edge])
    moved_m = 0.015  # of the laser point of a finger that bent
    moved = high - low > moved_m
    fingers = 3  # that must be seen
    if moved.sum() < fingers:
        raise FitError(
            f"{moved.sum()} fingers bend before the laser, at least {fingers} are needed: {MOTION}"
        )
    share = (along_m[:, moved] - low[moved]) / (high - low)[moved]
    share[np.isfinite(share).sum(axis=1) < fingers - 1] = np.nan
    out = np.full(len(share), np.nan)
    seen = np.isfinite(share).any(axis=1)
    out[seen] = np.nanmedian(share[seen], axis=1)
    return out


def _bends(open_share: Float, flat: Bool) -> list[Int]:
    """Return the strobe cycles of each flexion.

    What lies between openings and goes at least half of the way.
    """
    bends: list[Int] = []
    known = np.flatnonzero(np.isfinite(open_share))
    edges = np.flatnonzero(np.diff(np.r_[True, flat[known], True]))
    for first, stop in edges.reshape(-1, 2):
        rows = known[first:stop]
        bent = 0.5  # shares of a finger's way: 4 degrees of a straight finger are a tenth of it
        if len(rows) >= _FEWEST and open_share[rows].min() < bent:
            bends.append(rows)
    return bends


def _flattest(rows: Int, open_share: Float) -> Int:
    """Pick some of the more open half of the rows.

    A hand stays flat for longer than it passes by.
    """
    half = rows[np.argsort(open_share[rows])][len(rows) // 2 :]
    per_flat = 6
    return np.unique(half[np.linspace(0.0, len(half) - 1.0, per_flat).astype(np.int64)])


def _evenly(rows: Int, open_share: Float, count: int) -> Int:
    """At most `count` of the rows, spread evenly over how open the hand is."""
    known = rows[np.isfinite(open_share[rows])]
    share = open_share[known]
    wanted: Float = np.linspace(float(share.min()), float(share.max()), count)
    return known[np.unique(np.abs(share[:, None] - wanted).argmin(axis=0))]


_LASER_SIGMA_M = 8e-4  # of skin of another shape than the cones
_FLAT_RAD = np.radians(4.0)  # how flat people hold a hand
_STRAIGHT_RAD = np.radians(5.0)  # how straight they keep a finger that bends at its knuckle
_ASIDE_RAD = np.radians(
    17.0
)  # 5 of a finger, who keeps to it all the time: its strobe cycles together count as one
_ANY_RAD = np.radians(60.0)  # of an angle that the motion leaves open
_OUTLIER_SIGMAS = 2.5  # standard deviations from which an observation is downweighted
_GUESS_SIGMA = np.array([4e-3, 25.0])  # of a guess: laser point along the plane [m], tip [px]
_GRID_RAD = np.radians(np.arange(0.0, 97.0, 4.0))
_PAST_RAD = np.radians(84.0)  # PIP beyond which the last phalanx may fold into the light
_ROUNDS = (4, 4, 12)  # steps, from one guess of angles to the next
_KNUCKLES, _FIST = 0, 1


@dataclass(frozen=True, slots=True, eq=False)
class ImageObservations:
    """Image observations of strobe cycles (T), fingers index ... little.

    NaN: not seen.

    Attributes:
        laser_m: (T, 4, 2) on the plane, across and along [m].
        tip_uv: (T, 4, 2) [px].
        tip_sigma_px: (T, 4) as the slave reports.
        bend: (T,) as of `guided.Guided`.
    """

    laser_m: Float
    tip_uv: Float
    tip_sigma_px: Float
    bend: Int


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """The most probable subject.

    Attributes:
        x: (26,) as of `subject_model.Unknown`.
        covariance: (26, 26).
        prior_sigma: (26,) prior standard deviations.
        angles_rad: (T, 4, 3) abduction, MCP, PIP.
        fist: (T,) whether the strobe cycle is of a fist.
        off: (T, 4, 4) seen minus fitted, in standard deviations: laser across and along, tip; NaN: not seen, or past
            the end of the laser's branch.
        rms: Of `off`, outliers at their limit.
        unlike: Rms of what fingers did against their joint couplings, in standard deviations.
        laser_m, tip_px: What is left at laser points and tips, median.
    """

    x: Float
    covariance: Float
    prior_sigma: Float
    angles_rad: Float
    fist: Bool
    off: Float
    rms: float
    unlike: float
    laser_m: float
    tip_px: float

    @property
    def prior_rms(self) -> float:
        """Return the rms change from the prior in standard deviations.

        Over as many numbers as the motion determined.
        """
        measured = (1.0 - np.diag(self.covariance) / self.prior_sigma**2).sum()
        return float(np.sqrt(((self.x / self.prior_sigma) ** 2).sum() / measured))


def prior_sigma(pose: Float, length: Float) -> Float:
    """Return the prior standard deviations of a subject (26,).

    With the palm's pose (6,) [rad, m] and the lengths of fingers (4,).
    """
    knuckle_m = 3e-3  # against a hand of this size, per axis
    return np.r_[pose, np.full(12, knuckle_m), np.full(4, SPREAD), length]


def fit_subject(model: SubjectModel, seen: ImageObservations, sigma: Float) -> Fit:
    """Fit subject and angles.

    Args:
        model: Forward function about the first guess.
        seen: What was seen.
        sigma: (26,) how far the first guess may be off, as of `prior_sigma`.
    """
    problem = _Problem(model, seen, sigma)
    x, guess, covariance = np.zeros(UNKNOWN), problem.guessed(np.zeros(UNKNOWN)), np.empty(0)
    for rounds in _ROUNDS:  # what a rough pose takes for an outlier may be none
        x, guess, covariance = problem.solved(x, problem.guessed(x), rounds)
    return problem.result(x, guess, covariance)


@dataclass(frozen=True, slots=True, eq=False)
class _Guess:
    """Initial guess of angles, fists and inliers.

    Angles (T, 4, 3), which strobe cycles (T,) are of a fist, and which observations (T, 4) count.
    """

    angles: Float
    fist: Bool
    used: Bool


class _Problem:
    """Residuals, posture priors and steps of the subject fit.

    Its state was prepared by the constructor.
    """

    def __init__(self, model: SubjectModel, seen: ImageObservations, sigma: Float) -> None:
        self._model, self._bend, self.prior_sigma = model, seen.bend, sigma
        self._data = np.concatenate([seen.laser_m, seen.tip_uv], axis=-1)
        tip_sigma_m = 2e-3  # what is seen as the tip of a finger is anywhere on its pulp
        tip_px = np.hypot(np.nan_to_num(seen.tip_sigma_px), tip_sigma_m * model.px_per_m)
        laser = np.full_like(tip_px, _LASER_SIGMA_M)
        self._sigma = np.stack([laser, laser, tip_px, tip_px], axis=-1)
        count = np.array([(seen.bend == bend).sum() for bend in seen.bend])
        independent = 4.0  # strobe cycles of a bend
        self._share = np.minimum(independent / count, 1.0)  # (T,) what a strobe cycle counts

    def guessed(self, x: Float) -> "_Guess":
        """Guess the angles from joint couplings alone.

        A flexion is that of a fist if it suits a fist better.
        """
        grid = np.zeros((2, len(_GRID_RAD), 4, LOCAL))
        grid[_KNUCKLES, ..., MCP] = grid[_FIST, ..., PIP] = _GRID_RAD[:, None]
        grid[_FIST, ..., MCP] = self._model.mcp_per_pip * _GRID_RAD[:, None]
        shown = np.stack([self._model(x, poses) for poses in grid])  # (2, G, 4, 4)
        # Abductions, of which nothing is known yet, move points and tips across.
        along = (self._data[:, None, None, :, 1::2] - shown[..., 1::2]) / _GUESS_SIGMA
        unseen = np.isnan(self._data[:, None, None, :, 1::2])
        roughest = 3.0
        far = np.where(unseen, 0.0, np.nan_to_num(np.abs(along), nan=roughest))
        cost: Float = (np.minimum(far, roughest) ** 2).sum(axis=-1)  # (T, 2, G, 4)
        least = cost.min(axis=2).sum(axis=2)
        bends = np.unique(self._bend[self._bend != FLAT])
        fists = bends[fists_of(np.array([least[self._bend == bend].sum(axis=0) for bend in bends]))]
        fist = np.isin(self._bend, fists)
        own_cost = cost[np.arange(len(fist)), fist.astype(np.int64)]  # (T, G, 4); a fist is number _FIST
        node: Int = own_cost.argmin(axis=1)
        angles = grid[fist.astype(np.int64)[:, None], node, np.arange(4)]
        used: Bool = (own_cost.min(axis=1) < roughest**2) & ~(angles[..., PIP] > _PAST_RAD)
        flat = self._bend == FLAT
        angles[flat], used[flat] = 0.0, True
        return _Guess(angles, fist, used)

    def solved(self, x: Float, guess: _Guess, rounds: int) -> tuple[Float, _Guess, Float]:
        """Unknowns (26,), angles and covariance (26, 26), from a guess."""
        damping, covariance = 1e-2, np.diag(self.prior_sigma**2)
        cost = self._cost(x, guess)
        for _ in range(rounds):
            normal = self._normal(x, guess)
            covariance = np.asarray(np.linalg.inv(normal.reduced(0.0)[0]), np.float64)
            trials, settled = 6, 0.02  # of a step; the gain that is none
            for _ in range(trials):
                step, change = normal.step(damping)
                stepped = _Guess(guess.angles + change, guess.fist, guess.used)
                trial = self._cost(x + step, stepped)
                if trial < cost:
                    break
                damping *= 6.0
            else:
                break
            x, guess, gain, cost, damping = x + step, stepped, cost - trial, trial, 0.2 * damping
            if gain < settled:
                break
        return x, guess, covariance

    def result(self, x: Float, guess: _Guess, covariance: Float) -> Fit:
        """The result with what is left."""
        off = np.where(guess.used[..., None], self._off(x, guess.angles), np.nan)
        known = np.isfinite(off)
        rms = float(np.sqrt(np.mean(np.minimum(np.abs(off[known]), 2.0 * _OUTLIER_SIGMAS) ** 2)))
        laser, tip = (
            np.sqrt((part**2).sum(axis=-1)) for part in (off[..., :2], (off * self._sigma)[..., 2:])
        )
        unlike = float(np.sqrt(np.mean(self._prior_rows(guess)[0][guess.used] ** 2)))
        return Fit(
            x, covariance, self.prior_sigma, guess.angles, guess.fist, off, rms, unlike,
            _LASER_SIGMA_M * float(np.sqrt(np.nanmedian(laser**2))), float(np.sqrt(np.nanmedian(tip**2))),
        )  # fmt: skip

    def _off(self, x: Float, angles: Float) -> Float:
        """Return seen minus fitted (T, 4, 4) in standard deviations.

        NaN: not seen. A finger that the laser misses is far.
        """
        shown = self._model(x, angles)
        off = (self._data - shown) / self._sigma
        farthest = 8.0  # of a finger that the laser should meet and does not
        return np.where(np.isnan(shown) & np.isfinite(self._data), farthest, off)

    def _prior_rows(self, guess: _Guess) -> tuple[Float, Float]:
        """Return the residuals (T, 4, 3) of the posture priors and their derivatives.

        By the angles (T, 4, 3, 3).
        """
        angles, fist, flat = guess.angles, guess.fist, self._bend == FLAT
        ratio = np.broadcast_to(self._model.mcp_per_pip, angles.shape[:2])
        by = np.zeros((*angles.shape[:2], LOCAL, LOCAL))
        by[..., ABDUCTION, ABDUCTION] = 1.0 / _ASIDE_RAD
        ratio_spread = 0.15  # MCP of a fist against the natural ratio
        mcp = np.hypot(_FLAT_RAD, ratio_spread * ratio * np.maximum(angles[..., PIP], 0.0))
        by[fist, :, MCP, MCP], by[fist, :, MCP, PIP] = 1.0 / mcp[fist], -ratio[fist] / mcp[fist]
        by[fist, :, PIP, PIP] = 1.0 / _ANY_RAD
        by[~fist, :, MCP, MCP] = np.where(flat[~fist], 1.0 / _FLAT_RAD, 1.0 / _ANY_RAD)[:, None]
        by[~fist, :, PIP, PIP] = 1.0 / _STRAIGHT_RAD
        return (by @ angles[..., None])[..., 0], by

    def _cost(self, x: Float, guess: _Guess) -> float:
        off = np.nan_to_num(self._off(x, guess.angles)) * guess.used[..., None]
        pairs = np.stack([(off[..., :2] ** 2).sum(axis=-1), (off[..., 2:] ** 2).sum(axis=-1)])
        data = (_OUTLIER_SIGMAS**2 * np.log1p(pairs / _OUTLIER_SIGMAS**2)).sum(axis=(0, 2))
        grid = (self._prior_rows(guess)[0] ** 2).sum(axis=(1, 2))
        return float((self._share * (data + grid)).sum() + ((x / self.prior_sigma) ** 2).sum())

    def _normal(self, x: Float, guess: _Guess) -> "_Normal":
        """Build the normal equations at a point, with outliers down-weighted."""
        off = np.nan_to_num(self._off(x, guess.angles))
        pairs = np.stack([(off[..., :2] ** 2).sum(axis=-1), (off[..., 2:] ** 2).sum(axis=-1)], axis=-1)
        root = np.repeat((1.0 + pairs / _OUTLIER_SIGMAS**2) ** -0.5, 2, axis=-1) * guess.used[..., None]
        root = np.where(np.isfinite(self._data), root, 0.0)
        by_x, by_angles = self._model.derivatives(x, guess.angles)
        prior_residual, prior_jacobian = self._prior_rows(guess)
        share = np.sqrt(self._share)[:, None, None]
        scale = (share * root / self._sigma)[..., None]
        residual = np.concatenate([share * root * off, share * prior_residual], axis=-1)
        local = np.concatenate([-scale * by_angles, share[..., None] * prior_jacobian], axis=-2)
        shared = np.concatenate([-scale * by_x, np.zeros((*prior_residual.shape, UNKNOWN))], axis=-2)
        back = np.swapaxes(local, -1, -2)
        return _Normal(
            back @ local,
            back @ shared,
            (back @ residual[..., None])[..., 0],
            np.einsum("tfij,tfik->jk", shared, shared) + np.diag(self.prior_sigma**-2.0),
            np.einsum("tfij,tfi->j", shared, residual) + x / self.prior_sigma**2,
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Normal equations of shared unknowns and of each finger's angles.

    Unknowns that all strobe cycles share (26), and angles that belong to one finger in one strobe cycle (T, 4, 3).

    Attributes:
        own: (T, 4, 3, 3) information of the angles.
        mixed: (T, 4, 3, 26).
        own_pull: (T, 4, 3).
        shared: (26, 26).
        shared_pull: (26,).
    """

    own: Float
    mixed: Float
    own_pull: Float
    shared: Float
    shared_pull: Float

    def reduced(self, damping: float) -> tuple[Float, Float, Float, Float]:
        """Eliminate the angles and return the reduced normal equations.

        Information (26, 26) and gradient (26,) without the angles, and what gives the angles' steps from the step of
        the rest.
        """
        eye = damping * np.eye(LOCAL)
        own = self.own * (1.0 + eye) + 1e-9 * np.eye(LOCAL)
        by_shared = _solve(own, self.mixed)
        own_step = _solve(own, self.own_pull[..., None])[..., 0]
        information = self.shared * (1.0 + damping * np.eye(UNKNOWN))
        information = information - np.einsum("tfij,tfik->jk", self.mixed, by_shared)
        pull = self.shared_pull - np.einsum("tfij,tfi->j", self.mixed, own_step)
        return information, pull, by_shared, own_step

    def step(self, damping: float) -> tuple[Float, Float]:
        """Of the shared unknowns (26,) and the angles (T, 4, 3)."""
        information, pull, by_shared, own_step = self.reduced(damping)
        step = -_solve(information, pull[:, None])[:, 0]
        return step, -own_step - by_shared @ step


def fists_of(cost: Float) -> Bool:
    """Classify flexions as fists by the cost of either kind (B, 2).

    Tips distinguish the kinds, and some tips are false.

    A bend that suits both kinds about equally is of the one that nothing else is: people are asked for both.
    """
    better: Float = np.log((cost[:, _KNUCKLES] + 1.0) / (cost[:, _FIST] + 1.0))
    clearly = 2.0  # ratio of costs
    clear = np.abs(better) > np.log(clearly)
    if clear.any() and (better[clear] > 0.0).all():
        return clear
    if clear.any() and (better[clear] < 0.0).all():
        return ~clear
    return better > 0.0


def _solve(a: Float, b: Float) -> Float:
    return np.asarray(np.linalg.solve(a, b), np.float64)
