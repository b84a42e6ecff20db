"""Normal equations of a mounting.

Unknowns that all epochs share, and the hand of each epoch, which is eliminated.
"""

from dataclasses import dataclass, replace

import numpy as np

from common.arrays import Float
from master.calibrate.extrinsics.hands import HandProblem, Hands, Linear
from master.calibrate.extrinsics.unknown import CAMERA_LATE, UNKNOWN
from master.estimator.parameters import HandParameters


@dataclass(frozen=True, slots=True, eq=False)
class Normal:
    """Normal equations of the shared unknowns and of the hand in each epoch.

    Shared by all epochs: U = UNKNOWN; each hand: L = 6 + n.

    Attributes:
        own: (T, L, L) information of the hands.
        mixed: (T, L, U).
        own_pull: (T, L).
        shared: (U, U).
        shared_pull: (U,).
    """

    own: Float
    mixed: Float
    own_pull: Float
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
        """Eliminate the hands and return the reduced normal equations.

        Information (U, U) and gradient (U,) without the hands, and what gives the hands' steps from the step of the
        rest.
        """
        own = self.own.copy()
        diagonal = np.einsum("tii->ti", own)
        nothing = 1e-9  # information of what nothing constrains
        diagonal[...] = (1.0 + damping) * diagonal + nothing
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
