"""How sure a hand is of what its markers do not tell, such as where a finger points: judged by one instant alone.

To the fit the last pose is a prior, as wide as a hand moves meanwhile. That holds it steady, but it is no second
witness: the same habits led to it from the same markers, so a wrong direction of a finger is as wrong in every frame
of a held pose. Counted as a witness, a hundred times a second, it would make the pose look surer than it ever was.
So it is left out here, and an angle that nothing else tells is somewhere within its limits.

What is left are the markers and habits. Habits hold better of some postures than of others: a pointing hand defies
them. By how much is told by the misfit of the instant itself, which scales the covariance (Birge 1932), with the
claimed widths as one observation more (a prior of unit information: Kass, Wasserman 1995):

    covariance = s^2 (J' J + normal)^-1,   s^2 = max(1, (1 + chi^2) / (1 + f)),   f = 3 N - 6 + (2 if the back is seen)

and 3 for each finger that another sensor tells.

A good fit makes nothing surer than it was claimed. The misfit tells of what markers contradict, and most of what is
unsure, such as the palm's turn about the one marker on its back or a finger that is hidden, leaves none.

N markers are 3 N numbers, and the palm takes six; each angle is as much a number as a belief. Beliefs that contradict
each other, whatever the markers, tell nothing of the instant: their least cost is no part of chi^2.
"""

import numpy as np

from common.arrays import Float
from master.ik.hand_problem import HandProblem, Minimum
from master.ik.priors import AnglePrior

_CLAIMED = 1.0  # observations that the claimed widths of habits count as


def covariance_alone(
    problem: HandProblem, believed: AnglePrior, habits: AnglePrior, found: Minimum
) -> tuple[Float, float]:
    """Covariance (6 + n, 6 + n) of the palm's turn [rad] and shift [m] and of the free angles [rad], of one instant.

    And by how much the misfit has scaled it.

    Args:
        problem: The fit, which may believe in the last pose as well.
        believed: What it believes of angles under the hypothesis of the solution.
        habits: The same without the last pose.
        found: Its solution.
    """
    normal = found.linear.normal.copy()
    normal[6:, 6:] += habits.normal - believed.normal
    diagonal = normal.reshape(-1)[:: len(normal) + 1]  # a view
    diagonal += problem.parameters.anywhere
    if problem.palm is not None:
        diagonal[:6] -= problem.palm.weight * problem.palm.weight
    told = 0 if problem.others is None else len(problem.others.belief.fingers)
    free = max(3 * (len(problem.points_m) + told) - 6 + (0 if problem.facing is None else 2), 0)
    scale = max((_CLAIMED + chi_square_alone(problem, believed, habits, found)) / (_CLAIMED + free), 1.0)
    return np.asarray(scale * np.linalg.inv(normal), np.float64), scale


def chi_square_alone(problem: HandProblem, believed: AnglePrior, habits: AnglePrior, found: Minimum) -> float:
    """Squared misfit of markers and habits, without the last pose and what habits cost anyway."""
    past = problem.palm_cost(found.T_rig_palm) + float(believed.cost_and_gradient(found.x)[0])
    habit = float(habits.cost_and_gradient(found.x)[0]) - float(habits.least())
    return max(2.0 * (float(found.linear.cost) - past + habit), 0.0)
