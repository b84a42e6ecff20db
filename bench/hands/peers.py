"""Peers of our solvers on the same caps: the hand as the papers solve it, and scipy's general least squares.

**Papers' way**: the palm's orientation is taken as fixed, the back marker places it; each finger is constrained FABRIK
from its last pose, with DIP = 2/3 PIP, without a closed-form seed and without restarts (Kalbfleisch, with the library
Caliko). Ours has the limits in both passes and aims the root first. The closed form with the same palm shows which
part of an error is FABRIK's and which is the palm's.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import least_squares  # pyright: ignore[reportUnknownVariableType]

from bench.hands.draws import BACK, FACING_ROTATION, MARKERS, Noise
from common.arrays import Float
from common.geometry.transforms import rigid, rotation_vector_to_matrix
from common.hand.model import HandModel
from master.estimator.parameters import HandParameters
from master.estimator.priors import posture_prior_of
from master.estimator.settings import DEFAULT
from master.fabrik.fabrik import Fabrik, Pose
from master.fabrik.linear_algebra import Vector, as_vector
from master.fabrik.solver import FingerSolver

Angles = Sequence[Sequence[float]]  # (5, 4) [rad]
Fingers = Callable[[Sequence[Vector]], Angles]  # five tips [m] in the palm frame -> angles
_INSIDE_RAD = 1e-6  # scipy refuses a start on a bound, and bounds that leave no room
_IN_MM = 1e3  # metres make scipy's gradient tolerance end too early


def finger_solvers(model: HandModel) -> list[FingerSolver]:
    """Return the closed form of the five fingers, each to its cap."""
    return [FingerSolver.of(model, f, model.mount(name).offset_m) for f, name in enumerate(MARKERS[:5])]


def fixed_palm(model: HandModel, points_m: Float, rotation: Float = FACING_ROTATION) -> Float:
    """Return the palm pose (4, 4) of a fixed orientation, placed by the back marker of caps (M, 3) [m]."""
    return rigid(rotation, points_m[BACK] - rotation @ model.mount("back").offset_m)


def tips_in_palm(T_rig_palm: Float, points_m: Float) -> list[Vector]:
    """Return the caps of the five tips [m] in the palm frame, from caps (M, 3) [m]."""
    return [as_vector(p) for p in (points_m[:5] - T_rig_palm[:3, 3]) @ T_rig_palm[:3, :3]]


@dataclass(slots=True)
class PaperFingers:
    """Warm constrained FABRIK. Holds the last pose of each finger, from which the next search starts."""

    closed: list[FingerSolver]
    fabrik: list[Fabrik] = field(init=False)
    last: list[Pose | None] = field(init=False)

    def __post_init__(self) -> None:
        self.fabrik = [Fabrik.of(solver.chain, restarts=0) for solver in self.closed]
        self.last = [None] * len(self.closed)

    def push(self, tips_m: Sequence[Vector]) -> Angles:
        """Return angles (5, 4) [rad] for the five tips [m] in the palm frame."""
        out: list[list[float]] = []
        for f, (fabrik, closed) in enumerate(zip(self.fabrik, self.closed, strict=True)):
            found = fabrik.solve(tips_m[f], self.last[f], closed.root)
            self.last[f] = found.angles
            out.append([q for joint in found.angles for q in joint])
        return out


def closed_form(solvers: Sequence[FingerSolver], tips_m: Sequence[Vector]) -> Angles:
    """Return angles (5, 4) [rad] for the five tips [m] in the palm frame, finger by finger."""
    return [solver.solve(tip)[:4] for solver, tip in zip(solvers, tips_m, strict=True)]


def scipy_finger(solver: FingerSolver, target: Vector) -> list[float]:
    """Return angles (4,) [rad] of a finger whose cap is to be at `target` [m], from the middle of the limits."""
    low, high = (np.array(v) for v in zip(*solver.limits, strict=True))
    coupled = solver.chain.coupling is not None
    free = [k for k in range(4) if high[k] - low[k] > 2 * _INSIDE_RAD and not (coupled and k == 3)]
    angles = np.clip(np.zeros(4), low, high)

    def complete(x: Float) -> tuple[float, float, float, float]:
        angles[free] = x
        if coupled:
            angles[3] = np.clip(solver.ratio * angles[2], low[3], high[3])
        a, f, pip, dip = angles.tolist()
        return a, f, pip, dip

    def residual(x: Float) -> Float:
        return _IN_MM * np.subtract(solver.forward(complete(x)), target)

    start = 0.5 * (low + high)[free]
    x = np.asarray(least_squares(residual, start, bounds=(low[free], high[free])).x, np.float64)
    return list(complete(x))


@dataclass(frozen=True, slots=True, eq=False)
class ScipyHand:
    """The residuals of the whole-hand fit of a natural hand: whitened caps, priors, limits. Numerical Jacobian.

    Attributes:
        model: The hand.
        parameters: Its free angles and their bounds.
        whiten: (M, 3, 3) inverse square roots of the caps' covariances [1/m].
        rows, mean: (n, n) and (n,): priors are the residuals rows @ (x - mean).
    """

    model: HandModel
    parameters: HandParameters
    whiten: Float
    rows: Float
    mean: Float

    @classmethod
    def of(cls, model: HandModel, noise: Noise) -> "ScipyHand":
        """Prepare for caps with this noise, and the default priors."""
        parameters = HandParameters.of(model)
        posture_prior = posture_prior_of(model, parameters).natural_component()
        normal, pull = posture_prior.normal[0], posture_prior.pull[0]
        cov = noise.cov_m2 + DEFAULT.bones_m**2 * np.eye(3)
        return cls(
            model,
            parameters,
            np.asarray(np.linalg.inv(np.linalg.cholesky(cov)), np.float64),
            np.asarray(np.linalg.cholesky(normal).T, np.float64),
            np.asarray(np.linalg.solve(normal, pull), np.float64),
        )

    def residuals(self, T_rig_palm: Float, x: Float, points_m: Float) -> Float:
        """Residuals [sigma] of a palm (4, 4) and free angles (n,) [rad]: caps (M, 3) [m], then priors."""
        joints = self.model.forward(T_rig_palm, self.parameters.angles(x))
        off = self.model.marker_points(joints, MARKERS) - points_m
        return np.concatenate([(self.whiten @ off[..., None]).ravel(), self.rows @ (x - self.mean)])

    def solve(self, points_m: Float, T_rig_palm: Float, angles_rad: Float) -> tuple[Float, Float]:
        """Return palm (4, 4) and angles (5, 4) [rad] for caps (M, 3) [m], from a palm and angles to start with."""
        R, low, high = T_rig_palm[:3, :3], self.parameters.low, self.parameters.high
        room = high - low > 2 * _INSIDE_RAD
        angles = np.clip(np.zeros(len(low)), low, high)

        def hand(v: Float) -> tuple[Float, Float]:
            angles[room] = v[6:]
            return rigid(rotation_vector_to_matrix(v[:3]) @ R, v[3:6]), angles

        def residual(v: Float) -> Float:
            return self.residuals(*hand(v), points_m)

        inside = np.clip(self.parameters.of_angles(angles_rad), low + _INSIDE_RAD, high - _INSIDE_RAD)[room]
        start = np.concatenate([np.zeros(3), T_rig_palm[:3, 3], inside])
        anywhere = np.full(6, np.inf)
        bounds = np.concatenate([-anywhere, low[room]]), np.concatenate([anywhere, high[room]])
        end = np.asarray(least_squares(residual, start, bounds=bounds, x_scale="jac").x, np.float64)
        T, x = hand(end)
        return T, self.model.clamp(self.parameters.angles(x))
