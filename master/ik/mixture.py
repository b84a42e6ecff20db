"""Several hypotheses about one hand, each with its solution: how likely each is, and what they say together.

The evidence of a hypothesis is the density of the markers under it, by Laplace's approximation

    log p = -cost + log density of the beliefs - log det(normal) / 2

at its solution (MacKay 1992, "Bayesian interpolation", section 4): narrow habits that fit win over wide ones, since
they promised more. Mean and covariance are those of the mixture: the spread between solutions is doubt as well.
Of a free hand the mean within its limits is taken, of a natural one the likeliest pose (`master.ik.within`).
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.geometry import matrix_to_rotation_vector
from master.ik.certainty import covariance_alone
from master.ik.hand_problem import HandProblem, Minimum, moved
from master.ik.priors import AnglePrior

_STIFF = 1e-2  # how much less than the markers the mean of the hypotheses holds
_CERTAIN = 12.0  # log odds that count as certain
_NEGLIGIBLE = 0.03  # a hypothesis of less weight changes next to nothing
_NOTICED = 0.15  # one of less weight is taken where it is likeliest: its mean would change next to nothing


@dataclass(frozen=True, slots=True, eq=False)
class Mixture:
    """Mean and covariance of the hypotheses together.

    Attributes:
        T_rig_palm, x: Mean pose (4, 4) and angles (n,), inside the bounds.
        alone: Covariance (6 + n, 6 + n) of the palm's turn [rad] and shift [m] and the angles [rad], by this instant
            alone (`master.ik.certainty`).
        scale: By how much the misfit of the instant has scaled it.
        cost: Of the likeliest.
        natural: Probability of the first hypothesis.
    """

    T_rig_palm: Float
    x: Float
    alone: Float
    scale: float
    cost: float
    natural: float

    @classmethod
    def of(
        cls, problem: HandProblem, habits: AnglePrior, minima: list[Minimum], before: tuple[float, float]
    ) -> "Mixture":
        """From what each hypothesis found; one that explains the markers far worse than another is left out.

        Args:
            problem: The fit.
            habits: What it believes of angles by this instant alone.
            minima: One for each hypothesis, the natural hand first.
            before: How natural the hand was a moment ago, and what that counts, 0 ... 1.
        """
        weight = _weights(problem, minima, *before)
        best = int(np.argmax(weight))
        top, natural = minima[best], float(weight[0])
        sure = weight[best] > 1.0 - _NEGLIGIBLE
        kept = np.array([best]) if sure else np.arange(len(minima))
        share = np.ones(1) if sure else weight
        off = np.array([_between(minima[h], top) for h in kept])
        steps = np.zeros_like(off)
        alone, scale = np.zeros((off.shape[1], off.shape[1])), 0.0
        for k, h in enumerate(kept.tolist()):
            found, believed = minima[h], problem.prior.of_hypothesis(h)
            cov, scaled = covariance_alone(problem, believed, habits.of_hypothesis(h), found)
            alone, scale = alone + share[k] * cov, scale + share[k] * scaled
            if h > 0 and share[k] > _NOTICED:
                steps[k] = problem.mean_step(found)
        off += steps
        mean: Float = share @ off
        alone += (off - mean).T * share @ (off - mean)
        T, x = top.T_rig_palm, top.x
        if mean.any():
            ends = np.array(
                [problem.marker_end(minima[h], step) for h, step in zip(kept, steps, strict=True)]
            )
            between = problem.of_points(np.einsum("h,hmi->mi", share, ends))
            T, x = _onto(between, *moved(T, x, mean), top.linear.normal)
        return cls(T, x, alone, float(scale), float(top.linear.cost), natural)


def _weights(problem: HandProblem, minima: list[Minimum], natural: float, counts: float) -> Float:
    """Probability (H,) of each hypothesis, by the evidence of this instant and what it was before.

    Whether a hand obeys habits does not change from frame to frame, while the evidence of one is noise in part: its
    logarithm is smoothed in time.
    """
    if len(minima) == 1:
        return np.ones(1)
    cost = np.array([found.linear.cost for found in minima])
    known = np.linalg.slogdet(np.array([found.linear.normal for found in minima]))[1]
    log = problem.prior.log_density - cost - 0.5 * known
    now = min(max(float(log[0] - log[1]), -_CERTAIN), _CERTAIN)
    then = np.log(max(natural, 1e-9)) - np.log(max(1.0 - natural, 1e-9))
    odds = (1.0 - counts) * now + counts * min(max(then, -_CERTAIN), _CERTAIN)
    first = 1.0 / (1.0 + np.exp(-odds))
    return np.array([first, 1.0 - first])


def _between(one: Minimum, other: Minimum) -> Float:
    """Turn (3,), shift (3,) and angles (n,) from the other to the one: (6 + n,)."""
    T, T_other = one.T_rig_palm, other.T_rig_palm
    if one is other:
        return np.zeros(6 + len(one.x))
    turn = matrix_to_rotation_vector(T[:3, :3] @ T_other[:3, :3].T)
    return np.concatenate([turn, T[:3, 3] - T_other[:3, 3], one.x - other.x])


def _onto(problem: HandProblem, T: Float, x: Float, normal: Float) -> tuple[Float, Float]:
    """One step from a mean (4, 4), (n,) of hands to where the mean of their markers is, the shortest by `normal`.

    What is between two hands that explain the markers does so a little worse, since fingers move on arcs.
    """
    there = problem.linearise(T, x)
    step = -np.linalg.solve(there.normal + _STIFF * normal, there.gradient)
    T, x = moved(T, x, np.asarray(step, np.float64))
    return T, np.minimum(np.maximum(x, problem.parameters.low), problem.parameters.high)
