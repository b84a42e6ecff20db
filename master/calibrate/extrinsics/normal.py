"""The hands of all epochs, and the rows that markers and posture priors add about them.

The residuals of a hand are the markers' distances, whitened by their covariances; priors add a quadratic of
the free angles. The Jacobian is closed form: rotation, shift and angles move a marker on the hand as
`master.estimator.kinematics` has it. All is batched over the epochs T.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.geometry.transforms import rotation_vector_to_matrix, skew
from common.hand.model import Chains, HandModel
from master.calibrate.adjust import Normal
from master.estimator.kinematics import BodyPoints
from master.estimator.priors import PosturePrior


@dataclass(frozen=True, slots=True, eq=False)
class Hands:
    """Hand poses of all epochs: T_rig_palm (T, 4, 4), free angles x (T, n) [rad]."""

    T_rig_palm: Float
    x: Float

    def retracted(self, step: Float) -> "Hands":
        """After steps (T, 6 + n): rotation [rad], shift [m], both rig axes; angles [rad]."""
        T = self.T_rig_palm.copy()
        T[:, :3, :3] = rotation_vector_to_matrix(step[:, :3]) @ T[:, :3, :3]
        T[:, :3, 3] += step[:, 3:6]
        return Hands(T, self.x + step[:, 6:])


@dataclass(frozen=True, slots=True, eq=False)
class HandProblem:
    """Constraints on the hands from markers and posture priors."""

    model: HandModel
    markers: BodyPoints  # the M markers on the hand
    posture_prior: PosturePrior  # those of one hypothesis
    points_m: Float  # (T, M, 3) [m] where markers were seen, rig frame
    whiten: Float  # (T, M, 3, 3) inverse square roots of their covariances [1/m]; 0: not seen

    def place(self, hands: Hands) -> Float:
        """Where the markers (T, M, 3) [m] of hands are, rig frame."""
        arm = self._arm(hands, self.markers.place(self._chains(hands)))
        return arm + hands.T_rig_palm[:, None, :3, 3]

    def add_to(self, normal: Normal, hands: Hands, speed_m_s: Float, late: int, share: float = 1.0) -> None:
        """Add the rows of markers and priors, of which a share counts.

        Markers move with the camera's clock, the shared unknown `late`, by their speeds (T, M, 3).
        """
        R, chains = hands.T_rig_palm[:, :3, :3], self._chains(hands)
        local = self.markers.place(chains)
        arm = self._arm(hands, local)
        by_x = (self.whiten @ R[:, None]) @ self.markers.jacobian(chains, local, hands.x)
        own = np.concatenate([self.whiten @ skew(-arm), self.whiten, by_x], axis=-1)
        off = arm + (hands.T_rig_palm[:, None, :3, 3] - self.points_m)
        residual, by_late = ((self.whiten @ v[..., None])[..., 0] for v in (off, -speed_m_s))
        count, size = len(R), own.shape[-1]
        rows = count, -1
        normal.add(
            residual.reshape(rows),
            by_late.reshape(*rows, 1),
            own.reshape(count, -1, size),
            columns=np.array([late]),
            share=share,
        )
        prior = self.posture_prior
        pushed = (hands.x[:, None] @ prior.normal)[:, 0]
        normal.cost += share * float(
            (np.vecdot(pushed - 2.0 * prior.pull, hands.x) + 2.0 * prior.constant).sum()
        )
        normal.own_gradient[:, 6:] += share * (pushed - prior.pull)
        normal.own[:, 0, 6:, 6:] += share * prior.normal

    def _chains(self, hands: Hands) -> Chains:
        return self.model.chains(self.markers.parameters.angles(hands.x))

    def _arm(self, hands: Hands, local: Float) -> Float:
        """From the wrists to markers (T, M, 3) [m], palm axes -> rig axes."""
        return local @ np.swapaxes(hands.T_rig_palm[:, :3, :3], 1, 2)
