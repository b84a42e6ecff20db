"""Several hypotheses about one hand, each with its solution: how likely each is, and what they say together.

The evidence of a hypothesis is the density of the markers under it, by Laplace's approximation

    log p = -cost + log density of the beliefs - log det(normal) / 2

at its solution (MacKay 1992, "Bayesian interpolation", section 4): narrow habits that fit win over wide ones, since
they promised more. Mean and covariance are those of the mixture: the spread between solutions is doubt as well.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.geometry import matrix_to_rotation_vector, rotation_vector_to_matrix
from master.ik.certainty import covariance_alone
from master.ik.hand_problem import HandProblem, Minimum
from master.ik.priors import AnglePrior

_STIFF = 1e-2  # how much less than the markers the mean of the hypotheses holds
_NEGLIGIBLE = 0.01  # a hypothesis of less weight changes next to nothing


@dataclass(frozen=True, slots=True, eq=False)
class Mixture:
    """Mean and covariance of the hypotheses together.

    Attributes:
        T_rig_palm, x: Mean pose (4, 4) and angles (n,), inside the bounds.
        alone: Covariance (6 + n, 6 + n) of the palm's turn [rad] and shift [m] and the angles [rad], by this instant
            alone (`master.ik.certainty`).
        cost: Of the likeliest.
        natural: Probability of the first hypothesis.
    """

    T_rig_palm: Float
    x: Float
    alone: Float
    cost: float
    natural: float

    @classmethod
    def of(cls, problem: HandProblem, habits: AnglePrior, minima: list[Minimum]) -> "Mixture":
        """From what each hypothesis found; one that explains the markers far worse than another is left out."""
        weight = _evidence(problem, minima)
        best = int(np.argmax(weight))
        top, natural = minima[best], float(weight[0])
        if weight[best] > 1.0 - _NEGLIGIBLE:
            alone = covariance_alone(problem.of_hypothesis(best), habits.of_hypothesis(best), top)
            return cls(top.T_rig_palm, top.x, alone, float(top.linear.cost), natural)
        off = np.array([_between(found, top) for found in minima])
        mean: Float = weight @ off
        alone = (off - mean).T * weight @ (off - mean)
        for h, found in enumerate(minima):
            alone += weight[h] * covariance_alone(problem.of_hypothesis(h), habits.of_hypothesis(h), found)
        markers = np.array([problem.place(found.T_rig_palm, found.x) for found in minima])
        between = problem.of_points(np.einsum("h,hmi->mi", weight, markers))
        T, x = _onto(between, *_moved(top.T_rig_palm, top.x, mean), top.linear.normal)
        return cls(T, x, alone, float(top.linear.cost), natural)


def _evidence(problem: HandProblem, minima: list[Minimum]) -> Float:
    """Probability (H,) of each hypothesis."""
    if len(minima) == 1:
        return np.ones(1)
    cost = np.array([found.linear.cost for found in minima])
    known = np.linalg.slogdet(np.array([found.linear.normal for found in minima]))[1]
    log = problem.prior.log_density - cost - 0.5 * known
    weight = np.exp(log - log.max())
    return np.asarray(weight / weight.sum(), np.float64)


def _between(one: Minimum, other: Minimum) -> Float:
    """Turn (3,), shift (3,) and angles (n,) from the other to the one: (6 + n,)."""
    T, T_other = one.T_rig_palm, other.T_rig_palm
    if one is other:
        return np.zeros(6 + len(one.x))
    turn = matrix_to_rotation_vector(T[:3, :3] @ T_other[:3, :3].T)
    return np.concatenate([turn, T[:3, 3] - T_other[:3, 3], one.x - other.x])


def _moved(T_rig_palm: Float, x: Float, step: Float) -> tuple[Float, Float]:
    T = T_rig_palm.copy()
    T[:3, :3] = rotation_vector_to_matrix(step[:3]) @ T[:3, :3]
    T[:3, 3] += step[3:6]
    return T, x + step[6:]


def _onto(problem: HandProblem, T: Float, x: Float, normal: Float) -> tuple[Float, Float]:
    """One step from a mean (4, 4), (n,) of hands to where the mean of their markers is, the shortest by `normal`.

    What is between two hands that explain the markers does so a little worse, since fingers move on arcs.
    """
    there = problem.linearise(T, x)
    step = -np.linalg.solve(there.normal + _STIFF * normal, there.gradient)
    T, x = _moved(T, x, np.asarray(step, np.float64))
    return T, np.minimum(np.maximum(x, problem.parameters.low), problem.parameters.high)
