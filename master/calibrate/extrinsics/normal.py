"""The normal equations of a mounting eliminate the hand of every epoch.

The residuals of a hand are the markers' distances, whitened by their covariances; priors add a quadratic of
the free angles. The Jacobian is closed form: rotation, shift and angles move a marker on the hand as
`master.estimator.kinematics` has it. All is batched over the epochs T.
"""

from dataclasses import dataclass, replace

import numpy as np

from common.arrays import Float
from common.geometry.transforms import rotation_vector_to_matrix, skew
from common.hand.model import Chains, HandModel
from master.calibrate.extrinsics.unknown import CAMERA_LATE, UNKNOWN
from master.estimator.kinematics import BodyPoints
from master.estimator.parameters import HandParameters
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
class Linear:
    """The cost at a point: gradient (T, L), Gauss-Newton matrix (T, L, L); L = 6 + n."""

    gradient: Float
    normal: Float


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

    def cost(self, hands: Hands) -> Float:
        """Half the sum of squares (T,) of whitened distances, and of posture priors."""
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
        """The posture priors' information times the free angles (T, n)."""
        return (hands.x[:, None] @ self.posture_prior.normal)[:, 0]


@dataclass(frozen=True, slots=True, eq=False)
class Normal:
    """Normal equations of the U = UNKNOWN shared unknowns and each epoch's L = 6 + n."""

    own: Float  # this, mixed and shared: (T, L, L), (T, L, U) and (U, U) information
    mixed: Float
    own_pull: Float  # this and shared_pull: (T, L) and (U,)
    shared: Float
    shared_pull: Float

    @classmethod
    def of_markers(cls, problem: HandProblem, linear: Linear, hands: Hands, speed: Float) -> "Normal":
        """Of the markers, which move with the camera's clock by `speed` (T, M, 3) [m/s]."""
        count, size = linear.gradient.shape
        mixed, shared, pull = np.zeros((count, size, UNKNOWN)), np.zeros((UNKNOWN,) * 2), np.zeros(UNKNOWN)
        difference_step = 1e-5
        later = replace(problem, points_m=problem.points_m + difference_step * speed)
        after = later.linearise(hands).gradient  # linear in the points
        mixed[..., CAMERA_LATE] = (after - linear.gradient) / difference_step
        off = problem.place(hands) - problem.points_m
        residual, by_late = ((problem.whiten @ v[..., None])[..., 0] for v in (off, -speed))
        shared[CAMERA_LATE, CAMERA_LATE] = (by_late**2).sum()
        pull[CAMERA_LATE] = (by_late * residual).sum()
        return cls(linear.normal, mixed, linear.gradient, shared, pull)

    def and_rows(self, residual: Float, own: Float, shared: Float) -> "Normal":
        """With residuals (T, R) and their derivatives (T, R, L), (T, R, U)."""
        back = np.swapaxes(own, 1, 2)
        return Normal(
            self.own + back @ own,
            self.mixed + back @ shared,
            self.own_pull + (back @ residual[..., None])[..., 0],
            self.shared + np.einsum("tri,trj->ij", shared, shared),
            self.shared_pull + np.einsum("tri,tr->i", shared, residual),
        )

    def shared_out(self, share: float, off: Float, sigma: Float) -> "Normal":
        """Weight the epochs by a share and add the prior of the shared unknowns."""
        return Normal(
            share * self.own,
            share * self.mixed,
            share * self.own_pull,
            share * self.shared + np.diag(sigma**-2.0),
            share * self.shared_pull + off / sigma**2,
        )

    def within(self, x: Float, parameters: HandParameters) -> "Normal":
        """Without the angles (T, n) that stand at their limits and are pushed outwards."""
        down = -self.own_pull[:, 6:]
        stuck = ((x <= parameters.low) & (down < 0.0)) | ((x >= parameters.high) & (down > 0.0))
        moves = np.ones(self.own_pull.shape)
        moves[:, 6:] -= stuck
        own = self.own * moves[:, :, None] * moves[:, None, :]
        np.einsum("tii->ti", own)[...] += 1.0 - moves
        return replace(self, own=own, mixed=self.mixed * moves[..., None], own_pull=self.own_pull * moves)

    def reduced(self, damping: float) -> tuple[Float, Float, Float, Float]:
        """Information (U, U) and gradient (U,) without the hands; and the hands' part."""
        own = self.own.copy()
        diagonal = np.einsum("tii->ti", own)
        diagonal[...] = (1.0 + damping) * diagonal + 1e-9  # information of what nothing constrains
        by_shared = np.asarray(np.linalg.solve(own, self.mixed), np.float64)
        own_step = np.asarray(np.linalg.solve(own, self.own_pull[..., None])[..., 0], np.float64)
        information = self.shared + damping * np.diag(np.diag(self.shared))
        information = information - np.einsum("tli,tlj->ij", self.mixed, by_shared)
        pull = self.shared_pull - np.einsum("tli,tl->i", self.mixed, own_step)
        return information, pull, by_shared, own_step

    def step(self, damping: float) -> tuple[Float, Float]:
        """Of the shared unknowns (U,) and the hands (T, L)."""
        information, pull, by_shared, own_step = self.reduced(damping)
        step = -np.asarray(np.linalg.solve(information, pull), np.float64)
        return step, -own_step - by_shared @ step
