"""Hand poses of all epochs: cost and normal equations, batched over epochs.

Given markers and posture priors.

The residuals are the markers' distances, whitened by their covariances; priors add a quadratic of the free angles.
The Jacobian is closed form: turn, shift and angles move a marker on the hand as `master.estimator.body_points` has it.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.geometry.transforms import rotation_vector_to_matrix, skew
from common.hand.model import Chains, HandModel
from master.estimator.body_points import BodyPoints
from master.estimator.priors import PosturePrior


@dataclass(frozen=True, slots=True, eq=False)
class Hands:
    """Hand poses of all epochs.

    Palms (T, 4, 4), palm frame -> rig frame, and free angles (T, n) [rad].
    """

    T_rig_palm: Float
    x: Float

    def retracted(self, step: Float) -> "Hands":
        """Return the hands after the given steps.

        Steps (T, 6 + n): rotation [rad] and shift [m], both in rig axes, and angles [rad].
        """
        T = self.T_rig_palm.copy()
        T[:, :3, :3] = rotation_vector_to_matrix(step[:, :3]) @ T[:, :3, :3]
        T[:, :3, 3] += step[:, 3:6]
        return Hands(T, self.x + step[:, 6:])


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """Linearisation of the cost at a point.

    Gradient (T, L) and Gauss-Newton normal matrix (T, L, L); L = 6 + n.
    """

    gradient: Float
    normal: Float


@dataclass(frozen=True, slots=True, eq=False)
class HandProblem:
    """Constraints on the hands from markers and posture priors.

    Attributes:
        model: The hand.
        markers: The M markers on it.
        posture_prior: Those of one hypothesis.
        points_m: (T, M, 3) [m] where markers were seen, rig frame.
        whiten: (T, M, 3, 3) inverse square roots of their covariances [1/m]; 0: not seen.
    """

    model: HandModel
    markers: BodyPoints
    posture_prior: PosturePrior
    points_m: Float
    whiten: Float

    def place(self, hands: Hands) -> Float:
        """Where the markers (T, M, 3) [m] of hands are, rig frame."""
        arm = self._arm(hands, self.markers.place(self._chains(hands)))
        return arm + hands.T_rig_palm[:, None, :3, 3]

    def cost(self, hands: Hands) -> Float:
        """Return half the sum of squares (T,) of whitened distances and posture priors."""
        arm = self._arm(hands, self.markers.place(self._chains(hands)))
        residual = self._residual(hands, arm)
        pushed = self._pushed(hands)
        prior_cost = np.vecdot(0.5 * pushed - self.posture_prior.pull, hands.x) + self.posture_prior.constant
        return prior_cost + 0.5 * np.vecdot(residual, residual)

    def linearise(self, hands: Hands) -> Linear:
        """Gradient and normal matrix at these hands."""
        R, chains = hands.T_rig_palm[:, :3, :3], self._chains(hands)
        local = self.markers.place(chains)
        arm = self._arm(hands, local)
        by_rotation = self.whiten @ skew(-arm)
        by_x = (self.whiten @ R[:, None]) @ self.markers.jacobian(chains, local, hands.x)
        J = np.concatenate([by_rotation, self.whiten, by_x], axis=-1).reshape(
            len(R), -1, 6 + hands.x.shape[1]
        )
        J_t = np.swapaxes(J, 1, 2)
        gradient, normal = (J_t @ self._residual(hands, arm)[..., None])[..., 0], J_t @ J
        gradient[:, 6:] += self._pushed(hands) - self.posture_prior.pull
        normal[:, 6:, 6:] += self.posture_prior.normal
        return Linear(gradient, normal)

    def _chains(self, hands: Hands) -> Chains:
        return self.model.chains(self.markers.parameters.angles(hands.x))

    def _arm(self, hands: Hands, local: Float) -> Float:
        """From the wrists to markers (T, M, 3) [m], palm axes -> rig axes."""
        return local @ np.swapaxes(hands.T_rig_palm[:, :3, :3], 1, 2)

    def _residual(self, hands: Hands, arm: Float) -> Float:
        """Whitened distances (T, 3 M)."""
        off = arm + (hands.T_rig_palm[:, None, :3, 3] - self.points_m)
        return (self.whiten @ off[..., None]).reshape(len(off), -1)

    def _pushed(self, hands: Hands) -> Float:
        """Return the posture priors' information times the free angles (T, n)."""
        return (hands.x[:, None] @ self.posture_prior.normal)[:, 0]
