"""Hand that best explains a routine, with the uncertainty of each number.

Damped Gauss-Newton over the whole routine.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.errors import FitError
from master.calibrate.hand.problem import HandRoutineProblem
from master.calibrate.hand.shape import Shape

_REFUSED = 12


@dataclass(frozen=True, slots=True, eq=False)
class ShapeFit:
    """A fitted shape.

    Attributes:
        shape: The numbers.
        cov: (size, size) their posterior covariance, residuals' spread included.
        residual_m: (T, 5 + B, 3) observed less predicted; NaN: not seen.
        angles_rad: (T, 5, 4).
        palm: (K, 6) turn [rad] and shift [m] of the palm against its first pose.
        spread: Root of the mean squared whitened residual: 1 where the stated covariances are true.
        alike: By what the standard deviations were raised because errors last longer than a frame.
        steps: SensorMessage.
    """

    shape: Shape
    cov: Float
    residual_m: Float
    angles_rad: Float
    palm: Float
    spread: float
    alike: float
    steps: int


def fit_shape(
    problem: HandRoutineProblem, progress: Callable[[float], None] = lambda share: None
) -> ShapeFit:
    """Minimise from the routine as it was asked for.

    Raises:
        FitError: The search does not settle.
    """
    state, settled = problem.guess(), False
    normal, cost = problem.normal(state)
    damping, taken, refused = 1e-3, 0, 0
    steps = 40
    while taken < steps and refused < _REFUSED:
        coefficients, constants, _ = normal.solve(damping)
        tried = problem.stepped(state, coefficients, constants)
        next_normal, next_cost = problem.normal(tried)
        if next_cost < cost:
            gain, state, normal, cost = cost - next_cost, tried, next_normal, next_cost
            damping, taken, refused = max(damping / 5.0, 1e-9), taken + 1, 0
            progress(min(taken / 15.0, 0.99))
            tolerance = 0.05  # of half chi square, against thousands
            settled = gain < tolerance
            if settled:
                break
        else:
            damping, refused = damping * 8.0, refused + 1
    if not settled and refused < _REFUSED:
        raise FitError(
            f"the fit does not settle in {steps} steps: the palm did not rest, or it is not this routine or hand;"
            " record it again, or begin with --length-mm"
        )
    residual = problem.residuals(state)
    spread, alike = _spread(problem, residual)
    cov = np.asarray(np.linalg.inv(normal.solve(0.0)[2]), np.float64) * (max(spread, 1.0) * alike) ** 2
    moved = state.coefficients[:, :6]
    return ShapeFit(state.shape, cov, residual, problem.angles(state), moved, spread, alike, taken)


def _spread(problem: HandRoutineProblem, residual_m: Float) -> tuple[float, float]:
    """Return the root mean squared whitened residual and its correlation factor.

    The factor is how much more the residual counts because neighbours in time err alike.

    Errors that last, such as a cap's hidden part, do not average out: with a correlation r from frame to frame, n
    frames carry as much information as n (1 - r) / (1 + r) independent ones.
    """
    whitened = (problem.whiten @ np.nan_to_num(residual_m)[..., None])[..., 0]
    seen = np.isfinite(residual_m[..., 0])
    both = seen[1:] & seen[:-1]
    mean_square = float((whitened[seen] ** 2).mean())
    correlation = float((whitened[1:][both] * whitened[:-1][both]).mean()) / mean_square
    r = min(max(correlation, 0.0), 0.95)
    return float(np.sqrt(mean_square)), float(np.sqrt((1.0 + r) / (1.0 - r)))
