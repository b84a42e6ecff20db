"""A guided motion is segmented, and the most probable subject fitted to it.

**Segments.** The distance of the laser points shows how open the hand is: they are farthest on a flat hand
and come nearer with every joint that bends. So a motion falls into its openings and what lies between them,
and a few strobe cycles of each are all that a fit needs. Which bends are of the knuckles, and which are
fists, is decided by the tips.

**Fit.** Laser point and tip give four numbers of a finger in a strobe cycle, its angles are three unknowns;
the rest comes from joint couplings, each as firm as people keep to it. A flat hand is flat and a finger that
bends at its knuckle is straight, to a few degrees; a fist closes in natural ratios, about. Knuckles,
thickness and length are those of a hand of its size, about. What none of that determines keeps its prior, and
the covariance shows it: above all, a knuckle that lies farther from the camera looks like a thicker finger,
and all knuckles shifted alike like a palm that is shifted.

The angles of a finger in a strobe cycle are its own, 26 unknowns are shared (`master.calibrate.adjust`);
outliers are downweighted (Cauchy). Errors of skin, tips and couplings last as long as a bend does: its strobe
cycles count together as a few.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.errors import FitError
from common.hand.skin import SPREAD
from master.calibrate.adjust import Normal, cauchy, minimise
from master.calibrate.wrist.subject_model import ABDUCTION, LOCAL, MCP, PIP, UNKNOWN, SubjectModel

MOTION = (
    "open the hand flat; bend the straight fingers at their knuckles as far as they go, and back; open it flat;"
    " close it to a fist, and open it again; each bend in three seconds or more"
)
FLAT = -1
_FEWEST = 5  # strobe cycles of a bend


@dataclass(frozen=True, slots=True, eq=False)
class Guided:
    """Strobe cycles that count (T), in order."""

    row: Int  # (T,) their numbers
    bend: Int  # (T,) number of the bend that each is of; FLAT: the hand is open


def guided(along_m: Float) -> Guided:
    """Choose strobe cycles by how far the laser points (T, 4) [m] lie.

    Index ... little; NaN: not seen.

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
        rows = _evenly(rows, open_share, max(32 // len(bends), _FEWEST))
        chosen.append(rows)
        number.append(np.full(len(rows), k))
    return Guided(np.concatenate(chosen), np.concatenate(number))


def openness(along_m: Float) -> Float:
    """Openness (T,) of the hand, 0...1 from its nearest to its farthest laser points.

    Raises:
        FitError: Fewer than three fingers are seen to bend.
    """
    low, high = np.full(4, np.nan), np.full(4, np.nan)
    for f in range(4):
        seen = along_m[np.isfinite(along_m[:, f]), f]
        if len(seen) >= 2 * _FEWEST:
            edge = 0.02  # share of outliers beyond the ends of a way
            low[f], high[f] = np.quantile(seen, [edge, 1.0 - edge])
    moved = high - low > 0.015  # way of the laser point of a finger that bent
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
    """Strobe cycles of each flexion: between openings, at least half of the way."""
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
    """Some of the more open half of the rows: a flat hand stays flat for longer."""
    half = rows[np.argsort(open_share[rows])][len(rows) // 2 :]
    return np.unique(half[np.linspace(0.0, len(half) - 1.0, 6).astype(np.int64)])


def _evenly(rows: Int, open_share: Float, count: int) -> Int:
    """At most `count` of the rows, spread evenly over how open the hand is."""
    known = rows[np.isfinite(open_share[rows])]
    share = open_share[known]
    wanted: Float = np.linspace(float(share.min()), float(share.max()), count)
    return known[np.unique(np.abs(share[:, None] - wanted).argmin(axis=0))]


_LASER_SIGMA_M = 8e-4  # of skin of another shape than the cones
_FLAT_RAD = np.radians(4.0)  # how flat people hold a hand
_STRAIGHT_RAD = np.radians(5.0)  # how straight they keep a finger that bends at its knuckle
_ASIDE_RAD = np.radians(17.0)  # 5 of a finger that keeps to it: its strobe cycles together count as one
_ANY_RAD = np.radians(60.0)  # of an angle that the motion leaves open
_OUTLIER_SIGMAS = 2.5  # standard deviations from which an observation is downweighted
_GUESS_SIGMA = np.array([4e-3, 25.0])  # of a guess: laser point along the plane [m], tip [px]
_GRID_RAD = np.radians(np.arange(0.0, 97.0, 4.0))
_PAST_RAD = np.radians(84.0)  # PIP beyond which the last phalanx may fold into the light
_ROUNDS = (4, 4, 12)  # steps, from one guess of angles to the next
_KNUCKLES, _FIST = 0, 1


@dataclass(frozen=True, slots=True, eq=False)
class ImageObservations:
    """Observations of strobe cycles (T), fingers index ... little; NaN: not seen."""

    laser_m: Float  # (T, 4, 2) on the plane, across and along [m]
    tip_uv: Float  # (T, 4, 2) [px]
    tip_sigma_px: Float  # (T, 4) as the slave reports
    bend: Int  # (T,) as of `Guided`


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """The most probable subject."""

    x: Float  # (26,) as of `subject_model.Unknown`
    covariance: Float  # (26, 26)
    prior_sigma: Float  # (26,) prior standard deviations
    angles_rad: Float  # (T, 4, 3) abduction, MCP, PIP
    fist: Bool  # (T,) whether the strobe cycle is of a fist
    # (T, 4, 4) seen minus fitted, in standard deviations: laser across and along, tip; NaN: not seen, or past
    # the end of the laser's branch
    off: Float
    rms: float  # of `off`, outliers at their limit
    unlike: float  # rms of what fingers did against their joint couplings, in standard deviations
    laser_m: float  # this and tip_px: median residual of laser points and tips
    tip_px: float

    @property
    def prior_rms(self) -> float:
        """Rms change from the prior in standard deviations, per number determined."""
        measured = (1.0 - np.diag(self.covariance) / self.prior_sigma**2).sum()
        return float(np.sqrt(((self.x / self.prior_sigma) ** 2).sum() / measured))


def prior_sigma(pose: Float, length: Float) -> Float:
    """Prior deviations (26,), with the palm's pose (6,) [rad, m], lengths (4,)."""
    knuckle_m = 3e-3  # against a hand of this size, per axis
    return np.r_[pose, np.full(12, knuckle_m), np.full(4, SPREAD), length]


def fit_subject(model: SubjectModel, seen: ImageObservations, sigma: Float) -> Fit:
    """Fit subject and angles; the first guess may be off by `sigma` (26,)."""
    problem = _Problem(model, seen, sigma)
    x, guess, covariance = np.zeros(UNKNOWN), problem.guessed(np.zeros(UNKNOWN)), np.empty(0)
    for rounds in _ROUNDS:  # what a rough pose takes for an outlier may be none
        x, guess, covariance = problem.solved(x, problem.guessed(x), rounds)
    return problem.result(x, guess, covariance)


@dataclass(frozen=True, slots=True, eq=False)
class _Guess:
    """Angles (T, 4, 3), which cycles (T,) are fists, which observations (T, 4) count."""

    angles: Float
    fist: Bool
    used: Bool


class _Problem:
    """Residuals, posture priors and steps of the subject fit."""

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
        """Angles by joint couplings alone; a flexion is a fist if it suits one better."""
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
        found = minimise(self._equations, self._stepped, (x, guess), steps=rounds, gain=0.02)
        return *found.x, found.normal.covariance()

    def _stepped(self, at: tuple[Float, _Guess], step: Float, change: Float) -> tuple[Float, _Guess]:
        x, guess = at
        return x + step, _Guess(guess.angles + change.reshape(guess.angles.shape), guess.fist, guess.used)

    def result(self, x: Float, guess: _Guess, covariance: Float) -> Fit:
        """The fit with its residuals."""
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
        """Seen minus fitted (T, 4, 4) in deviations; NaN: not seen; far: laser misses."""
        shown = self._model(x, angles)
        off = (self._data - shown) / self._sigma
        farthest = 8.0  # of a finger that the laser should meet and does not
        return np.where(np.isnan(shown) & np.isfinite(self._data), farthest, off)

    def _prior_rows(self, guess: _Guess) -> tuple[Float, Float]:
        """Residuals (T, 4, 3) of posture priors, and derivatives by angles (T, 4, 3, 3)."""
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

    def _equations(self, at: tuple[Float, _Guess]) -> Normal:
        """Normal equations at a point; a finger in a strobe cycle is an epoch."""
        x, guess = at
        off = np.where(guess.used[..., None], self._off(x, guess.angles), np.nan)
        by_x, by_angles = self._model.derivatives(x, guess.angles)
        by_x, by_angles = (np.nan_to_num(-by / self._sigma[..., None]) for by in (by_x, by_angles))
        prior_residual, prior_jacobian = self._prior_rows(guess)
        epochs = off.shape[0] * off.shape[1]
        share = np.repeat(self._share, off.shape[1])
        normal = Normal(UNKNOWN, epochs, LOCAL)
        normal.add(
            off.reshape(epochs, -1),
            by_x.reshape(epochs, -1, UNKNOWN),
            by_angles.reshape(epochs, -1, LOCAL),
            loss=cauchy(_OUTLIER_SIGMAS),
            group=2,
            share=share,
        )
        normal.add(
            prior_residual.reshape(epochs, -1),
            np.zeros((epochs, LOCAL, UNKNOWN)),
            prior_jacobian.reshape(epochs, LOCAL, LOCAL),
            share=share,
        )
        normal.add_prior(x, self.prior_sigma)
        return normal


def fists_of(cost: Float) -> Bool:
    """Classify flexions as fists by the cost of either kind (B, 2).

    Tips distinguish the kinds, and some tips are false. A bend that suits both kinds about equally is of the
    one that nothing else is: people are asked for both.
    """
    better: Float = np.log((cost[:, _KNUCKLES] + 1.0) / (cost[:, _FIST] + 1.0))
    clear = np.abs(better) > np.log(2.0)  # ratio of costs
    if clear.any() and (better[clear] > 0.0).all():
        return clear
    if clear.any() and (better[clear] < 0.0).all():
        return ~clear
    return better > 0.0
