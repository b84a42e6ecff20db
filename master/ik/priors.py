"""What is believed of a hand before a marker is seen: natural postures, unseen fingers, and the last frame.

Every belief is a row of a least-squares problem that is linear in the free angles, divided by its standard
deviation. The constant ones couple angles; those of one frame concern single angles, so they are weights.

Hands mostly obey habits, and now and then defy them altogether: a gun, horns, a pianist. One width of the habits would
be too wide for the former or too narrow for the latter. So there are two hypotheses of every hand, *natural* and
*free*, and the markers tell by their evidence which of the two, or how much of each, to believe (MacKay 1992, "Bayesian
interpolation": the width of the habits is what a free hand gains in fit and pays in volume).
"""

from dataclasses import dataclass, replace

import numpy as np

from common.arrays import Float, Int
from common.hand_model import HandModel
from master.estimator.parameters import HandParameters

_DIP_PER_PIP = 2.0 / 3.0  # where no coupling fixes the DIP, it still tends to this
_NARROWEST_RAD = 1e-3  # limits that leave an angle no room
_SHORTEST_S = 1e-3  # a step in time below this would weld the hand to its last pose


@dataclass(frozen=True, slots=True)
class FreeHand:
    """The habits of a hand that has none [rad]: flexions anywhere within limits, the rest as if drawn evenly from them.

    But a PIP is rather in the lower half of its range.
    """

    pip: float = np.radians(40.0)
    pip_mean: float = np.radians(30.0)


@dataclass(frozen=True, slots=True)
class Priors:
    """Standard deviations of the priors [rad], and where an unseen finger is believed to be; `free` None: all natural.

    `natural_share` is the probability of a natural hand before a marker is seen: a small one, since habits that fit
    win by their narrowness anyhow.

    Round values for hands at work, wide enough that markers overrule them. A handful of alternatives was
    compared on simulated and recorded hands; nothing was fitted. A finger whose tip shows from behind is
    rather straight than bent, and a marker on the back that is seen well faces the cameras.
    """

    abduction: float = np.radians(7.0)
    natural_flexion: float = np.radians(14.0)
    neighbour_flexion: float = np.radians(30.0)
    neighbour_pip: float = np.radians(35.0)
    pip: float = np.radians(45.0)
    pip_mean: float = np.radians(12.0)
    free_dip: float = np.radians(15.0)
    thumb: float = np.radians(20.0)
    thumb_mean: tuple[float, float, float, float] = (
        float(np.radians(8.0)),
        float(np.radians(8.0)),
        float(np.radians(10.0)),
        float(np.radians(15.0)),
    )
    hidden: float = np.radians(15.0)
    curled: tuple[float, float] = (float(np.radians(65.0)), float(np.radians(88.0)))
    thumb_curled: tuple[float, float, float, float] = (
        float(np.radians(20.0)),
        float(np.radians(30.0)),
        float(np.radians(25.0)),
        float(np.radians(30.0)),
    )
    facing: float = np.radians(22.0)
    model_m: float = 1.0e-3
    walk_rad_s: float = 8.0
    palm_walk_rad_s: float = 3.0
    palm_walk_m_s: float = 2.0
    free: FreeHand | None = FreeHand()
    natural_share: float = 1 / 3

    def palm_weight(self, dt_s: float) -> Float:
        """(6,) inverse standard deviations of the palm's turn [rad] and shift [m] in a time."""
        dt = max(dt_s, _SHORTEST_S)
        return np.repeat([1 / (self.palm_walk_rad_s * dt), 1 / (self.palm_walk_m_s * dt)], 3)


@dataclass(frozen=True, slots=True, eq=False)
class AnglePrior:
    """Beliefs about the free angles x, summed up: x normal x / 2 - pull x + constant, half a sum of squares.

    Attributes:
        normal: (..., n, n); leading axes: one or several hypotheses.
        pull: (..., n).
        constant: (...) so that the cost is that of the squares.
        log_density: (...) logarithm of the density of the habits at cost 0, but for what hypotheses have in common.
        known_least: `least` where it is asked for in every frame; None: not reckoned yet.
    """

    normal: Float
    pull: Float
    constant: Float
    log_density: Float
    known_least: Float | None = None

    @classmethod
    def of(
        cls,
        model: HandModel,
        parameters: HandParameters,
        priors: Priors,
        unlike: frozenset[int] = frozenset(),
    ) -> "AnglePrior":
        """What holds of every hand in every frame: (1 or 2, ...), a natural hand and a free one.

        Args:
            model, parameters, priors: The hand.
            unlike: Fingers of which it is known that they are not bent as the others: those are no neighbours.
        """
        tables = [_natural_rows(model, parameters, priors, unlike)]
        if priors.free is not None:
            tables.append(_free_rows(model, parameters, priors, priors.free))
        habits = cls(
            np.array([rows.T @ rows for rows, _ in tables]),
            np.array([means @ rows for rows, means in tables]),
            np.array([0.5 * float(means @ means) for _, means in tables]),
            np.zeros(len(tables)),
        )
        volume = habits.normal.copy()
        flexion = np.flatnonzero((parameters.free >= 4) & (parameters.free % 4 == 1))
        span = np.maximum(parameters.high - parameters.low, _NARROWEST_RAD)[flexion]
        # The highest density of a normal distribution of this width is that of any angle within the span.
        volume[1:, flexion, flexion] += 2.0 * np.pi / span**2
        share = np.log([priors.natural_share, 1.0 - priors.natural_share][: len(tables)])
        least = habits.least()
        log_density = share + least + 0.5 * np.linalg.slogdet(volume)[1]
        return replace(habits, log_density=log_density, known_least=least)

    def and_single(self, weight: Float, mean: Float) -> "AnglePrior":
        """With a belief about single angles added: inverse standard deviations and means (n,)."""
        normal, squared = self.normal.copy(), weight * weight
        size = len(weight)
        normal.reshape(*normal.shape[:-2], size * size)[..., :: size + 1] += squared  # a view
        pull = squared * mean
        constant = self.constant + 0.5 * float(pull @ mean)
        return AnglePrior(normal, self.pull + pull, constant, self.log_density)

    def without_single(self, columns: Int, mean: float, sigma: float) -> "AnglePrior":
        """The same, but the first hypothesis without the belief about each of these angles by itself that it holds."""
        normal, pull, constant = self.normal.copy(), self.pull.copy(), self.constant.copy()
        normal[0, columns, columns] -= 1.0 / sigma**2
        pull[0, columns] -= mean / sigma**2
        constant[0] -= 0.5 * len(columns) * (mean / sigma) ** 2
        return AnglePrior(normal, pull, constant, self.log_density)

    def of_hypothesis(self, which: Int | int) -> "AnglePrior":
        """That of one hypothesis, or of several (S,), one for each search."""
        least = None if self.known_least is None else self.known_least[which]
        return AnglePrior(
            self.normal[which], self.pull[which], self.constant[which], self.log_density[which], least
        )

    def cost_and_gradient(self, x: Float) -> tuple[Float, Float]:
        """Half the sum of squares (...) at x (..., n), and its derivative (..., n)."""
        pushed = (x[..., None, :] @ self.normal)[..., 0, :]
        return np.vecdot(0.5 * pushed - self.pull, x) + self.constant, pushed - self.pull

    def least(self) -> Float:
        """The cost (...) where it is least: beliefs that contradict each other."""
        if self.known_least is not None:
            return self.known_least
        natural = np.linalg.solve(self.normal, self.pull[..., None])[..., 0]
        return self.constant - 0.5 * np.vecdot(self.pull, natural)


def hidden_belief(
    parameters: HandParameters, priors: Priors, seen: frozenset[int], known: tuple[Float, Float] | None
) -> tuple[Float, Float]:
    """Weight and mean (n,) of the angles of fingers without a marker.

    Args:
        parameters: Which angles are free.
        priors: Where an unseen finger is believed to be.
        seen: Fingers that have a marker; nothing is believed of them here.
        known: Angles (5, 4) [rad] and standard deviation (5,) [rad] where there is a better belief; None:
            curled out of sight, because a stretched finger would show.
    """
    angles, sigma = np.zeros((5, 4)), np.full((5, 4), np.inf)
    if known is None:
        angles[0], sigma[0] = priors.thumb_curled, priors.hidden
        angles[1:, 1:3], sigma[1:, 1:3] = priors.curled, priors.hidden
    else:
        angles[:], sigma[:] = known[0], known[1][:, None]
    sigma[list(seen)] = np.inf
    return 1.0 / parameters.free_of(sigma), parameters.of_angles(angles)


def last_belief(
    parameters: HandParameters, priors: Priors, angles_rad: Float, age_s: Float
) -> tuple[Float, Float]:
    """Weight and mean (n,) of the angles (5, 4) of a hand whose fingers were last told `age_s` (5,) ago."""
    walk = 1.0 / (priors.walk_rad_s * np.maximum(age_s, _SHORTEST_S))
    return walk[parameters.free // 4], parameters.of_angles(angles_rad)


def _natural_rows(
    model: HandModel, parameters: HandParameters, priors: Priors, unlike: frozenset[int]
) -> tuple[Float, Float]:
    """Rows (P, n) and means (P,): natural flexion, small abduction, neighbours alike, a loose thumb."""
    rows = _Rows(parameters)
    for k, mean in enumerate(priors.thumb_mean):
        rows.add({k: 1.0}, mean, priors.thumb)
    rows.add({2: -1.0, 3: 1.0}, 0.0, priors.thumb)
    for f in range(1, 5):
        a = 4 * f
        rows.add({a: 1.0}, 0.0, priors.abduction)
        if model.mcp_per_pip is None:
            rows.add({a + 1: 1.0}, priors.pip_mean, priors.pip)  # as little as is known of the PIP
        else:
            rows.add({a + 1: 1.0, a + 2: -model.mcp_per_pip}, 0.0, priors.natural_flexion)
        rows.add({a + 2: 1.0}, priors.pip_mean, priors.pip)
        rows.add_loose_dip(model, a, priors.free_dip)
        if model.neighbours and f < 4 and (f in unlike) == (f + 1 in unlike):
            rows.add({a + 1: 1.0, a + 5: -1.0}, 0.0, priors.neighbour_flexion)
            rows.add({a + 2: 1.0, a + 6: -1.0}, 0.0, priors.neighbour_pip)
    return rows.table()


def _free_rows(
    model: HandModel, parameters: HandParameters, priors: Priors, free: FreeHand
) -> tuple[Float, Float]:
    """Rows (P, n) and means (P,) of a hand whose joints know nothing of each other."""
    rows = _Rows(parameters)
    low, high = model.limits_rad[..., 0], model.limits_rad[..., 1]
    middle, span = (0.5 * (low + high)).tolist(), high - low
    even = (span / np.sqrt(12.0)).tolist()  # standard deviation of an even distribution
    for k in range(4):
        rows.add({k: 1.0}, middle[0][k], even[0][k] or priors.thumb)
    for f in range(1, 5):
        a = 4 * f
        rows.add(
            {a: 1.0}, middle[f][0], even[f][0] or priors.abduction
        )  # none that cannot move tells them apart
        rows.add({a + 1: 1.0}, middle[f][1], 2.0 * span[f, 1] or priors.pip)  # next to nothing
        rows.add({a + 2: 1.0}, free.pip_mean, free.pip)
        rows.add_loose_dip(model, a, priors.free_dip)
    return rows.table()


class _Rows:
    """Collects beliefs about sums of angles, numbered as in the flat (20,) table."""

    def __init__(self, parameters: HandParameters) -> None:
        self._column = {int(angle): c for c, angle in enumerate(parameters.free)}
        self._rows: list[Float] = []
        self._means: list[float] = []

    def add(self, terms: dict[int, float], mean: float, sigma: float) -> None:
        row = np.zeros(len(self._column))
        for angle, factor in terms.items():
            row[self._column[angle]] = factor / sigma
        self._rows.append(row)
        self._means.append(mean / sigma)

    def add_loose_dip(self, model: HandModel, a: int, free_dip: float) -> None:
        """That the DIP of the finger whose angles begin at `a` follows its PIP, if it does so at all loosely."""
        if model.dip_per_pip is None:
            self.add({a + 3: 1.0, a + 2: -_DIP_PER_PIP}, 0.0, free_dip)
        elif model.dip_spread_rad > 0.0:
            self.add({a + 3: 1.0, a + 2: -model.dip_per_pip}, 0.0, model.dip_spread_rad)

    def table(self) -> tuple[Float, Float]:
        return np.array(self._rows), np.array(self._means)
