"""What is believed of a hand before a marker is seen: natural postures, unseen fingers, and the last frame.

Every belief is a row of a least-squares problem that is linear in the free angles, divided by its standard
deviation. The constant ones couple angles; those of one frame concern single angles, so they are weights.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.hand_model import HandModel
from master.ik.parameters import HandParameters

_DIP_PER_PIP = 2.0 / 3.0  # where no coupling fixes the DIP, it still tends to this
_SHORTEST_S = 1e-3  # a step in time below this would weld the hand to its last pose


@dataclass(frozen=True, slots=True)
class Priors:
    """Standard deviations of the priors [rad], and where an unseen finger is believed to be.

    Round values for hands at work, wide enough that markers overrule them. A handful of alternatives was
    compared on simulated and recorded hands; nothing was fitted. A finger whose tip shows from behind is
    rather straight than bent, and a marker on the back that is seen well faces the cameras.
    """

    abduction: float = np.radians(7.0)
    natural_flexion: float = np.radians(14.0)
    neighbour_flexion: float = np.radians(30.0)
    neighbour_pip: float = np.radians(35.0)
    pip: float = np.radians(45.0)
    pip_mean: float = np.radians(18.0)
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

    def palm_weight(self, dt_s: float) -> Float:
        """(6,) inverse standard deviations of the palm's turn [rad] and shift [m] in a time."""
        dt = max(dt_s, _SHORTEST_S)
        return np.repeat([1 / (self.palm_walk_rad_s * dt), 1 / (self.palm_walk_m_s * dt)], 3)


@dataclass(frozen=True, slots=True, eq=False)
class AnglePrior:
    """Beliefs about the free angles x, summed up: x normal x / 2 - pull x + constant, half a sum of squares.

    Attributes:
        normal: (n, n).
        pull: (n,).
        constant: So that the cost is that of the squares.
    """

    normal: Float
    pull: Float
    constant: float

    @classmethod
    def of(cls, model: HandModel, parameters: HandParameters, priors: Priors) -> "AnglePrior":
        """What holds of every hand in every frame."""
        rows, means = _natural_rows(model, parameters, priors)
        return cls(rows.T @ rows, means @ rows, 0.5 * float(means @ means))

    def and_single(self, weight: Float, mean: Float) -> "AnglePrior":
        """With a belief about single angles added: inverse standard deviations and means (n,)."""
        normal, squared = self.normal.copy(), weight * weight
        normal.flat[:: len(normal) + 1] += squared
        pull = squared * mean
        return AnglePrior(normal, self.pull + pull, self.constant + 0.5 * float(pull @ mean))

    def cost_and_gradient(self, x: Float) -> tuple[Float, Float]:
        """Half the sum of squares (...) at x (..., n), and its derivative (..., n)."""
        pushed = x @ self.normal
        return np.vecdot(0.5 * pushed - self.pull, x) + self.constant, pushed - self.pull

    def least(self) -> float:
        """The cost where it is least: beliefs that contradict each other."""
        return self.constant - 0.5 * float(self.pull @ np.linalg.solve(self.normal, self.pull))


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
    return 1.0 / parameters.free_of(sigma), parameters.free_of(angles)


def last_belief(
    parameters: HandParameters, priors: Priors, angles_rad: Float, dt_s: float
) -> tuple[Float, Float]:
    """Weight and mean (n,) of the angles (5, 4) a hand had `dt_s` ago."""
    walk = 1.0 / (priors.walk_rad_s * max(dt_s, _SHORTEST_S))
    return np.full(len(parameters.free), walk), parameters.free_of(angles_rad)


def _natural_rows(model: HandModel, parameters: HandParameters, priors: Priors) -> tuple[Float, Float]:
    """Rows (P, n) and means (P,): natural flexion, small abduction, neighbours alike, a loose thumb."""
    column = {int(angle): c for c, angle in enumerate(parameters.free)}
    rows: list[Float] = []
    means: list[float] = []

    def add(terms: dict[int, float], mean: float, sigma: float) -> None:
        row = np.zeros(len(column))
        for angle, factor in terms.items():
            row[column[angle]] = factor / sigma
        rows.append(row)
        means.append(mean / sigma)

    for k, mean in enumerate(priors.thumb_mean):
        add({k: 1.0}, mean, priors.thumb)
    add({2: -1.0, 3: 1.0}, 0.0, priors.thumb)
    for f in range(1, 5):
        a = 4 * f
        add({a: 1.0}, 0.0, priors.abduction)
        if model.mcp_per_pip is None:
            add({a + 1: 1.0}, priors.pip_mean, priors.pip)  # as little as is known of the PIP
        else:
            add({a + 1: 1.0, a + 2: -model.mcp_per_pip}, 0.0, priors.natural_flexion)
        add({a + 2: 1.0}, priors.pip_mean, priors.pip)
        if model.dip_per_pip is None:
            add({a + 3: 1.0, a + 2: -_DIP_PER_PIP}, 0.0, priors.free_dip)
        if model.neighbours and f < 4:
            add({a + 1: 1.0, a + 5: -1.0}, 0.0, priors.neighbour_flexion)
            add({a + 2: 1.0, a + 6: -1.0}, 0.0, priors.neighbour_pip)
    return np.array(rows), np.array(means)
