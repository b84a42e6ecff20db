"""Result of the pipeline for one epoch: marker positions, and the hand."""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Code, Float, Int
from common.hand.model import HandJoints
from common.messages import Source


@dataclass(frozen=True, slots=True, eq=False)
class MarkerPositions:
    """Positions of the M markers of a rig at one epoch.

    Attributes:
        points_m: Centroids (M, 3) [m], rig frame; NaN: fewer than two cameras see it,
            or what they see is not one thing.
        cov_m2: (M, 3, 3) [m^2].
        noise_m2: (M, 3, 3) [m^2] the part of it that may differ from one epoch to the next.
        apart: (M,) what two cameras see is not one thing.
        rejected: (C, M) outliers of single cameras, without which the rays of three or more meet.
    """

    points_m: Float
    cov_m2: Float
    noise_m2: Float
    outliers: Bool
    rejected: Bool


@dataclass(frozen=True, slots=True, eq=False)
class SolvedHand:
    """A hand's pose and how well it is known.

    Attributes:
        T_rig_palm: (4, 4).
        angles_rad: (5, 4), inside the limits.
        joints: Forward kinematics of the two.
        cov_m2: (26, 3, 3) [m^2] covariance of the joint positions.
        tilt_cov_rad2: (5, 3, 3) [rad^2] covariance of the directions of the last phalanges, by this epoch alone.
        tilt_process_noise_rad2_s2: (5,) [rad^2/s^2] by how much their trace is expected to grow, by the time squared.
    """

    T_rig_palm: Float
    angles_rad: Float
    joints: HandJoints
    cov_m2: Float
    tilt_cov_rad2: Float
    tilt_process_noise_rad2_s2: Float


@dataclass(frozen=True, slots=True, eq=False)
class HandEstimate:
    """Hand estimate of the pipeline at one epoch.

    Attributes:
        t_ns: The epoch.
        markers: Positions as triangulated.
        smooth_m: (M, 3) [m] after the 1 € filter.
        back_normal: (3,) unit vector from the hand to the cameras that see its back.
        solution: The hand; None: none is known.
        valid, tracked, source: (26,) as of `HandPose`.
        seen: (5,) fingers whose marker was placed now.
        residual_m: (5,) distance at which FABRIK left the marker on a finger's end from its target; NaN: not seen.
        iterations: (5,) of FABRIK.
        reached: (5,) FABRIK brought the marker onto its target.
        solved: Whether the hand is solved from this epoch, not held from an earlier one.
    """

    t_ns: int
    markers: MarkerPositions
    smooth_m: Float
    back_normal: Float
    solution: SolvedHand | None
    valid: Bool
    tracked: Bool
    source: Code
    seen: Bool
    residual_m: Float
    iterations: Int
    reached: Bool
    solved: bool = False

    @classmethod
    def unseen(
        cls, t_ns: int, markers: MarkerPositions, smooth_m: Float, back_normal: Float
    ) -> "HandEstimate":
        """One of which nothing is known yet."""
        return cls(
            t_ns=t_ns,
            markers=markers,
            smooth_m=smooth_m,
            back_normal=back_normal,
            solution=None,
            valid=np.zeros(26, np.bool_),
            tracked=np.zeros(26, np.bool_),
            source=np.full(26, Source.HELD, np.uint8),
            seen=np.zeros(5, np.bool_),
            residual_m=np.full(5, np.nan),
            iterations=np.zeros(5, np.int64),
            reached=np.zeros(5, np.bool_),
        )
