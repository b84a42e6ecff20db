"""Workspace of the kernels of an epoch.

It has what is the same at every epoch, the task, and scratch room.
"""

from typing import Any, NamedTuple

from common.arrays import Bool, Code, Float, Int
from common.messages.records import record
from master.estimator.cameras import CameraArrays
from master.estimator.extras import ExtrasScratch
from master.estimator.finger_scan import Prior, Scan
from master.estimator.hand_tables import Mounts
from master.estimator.hypotheses import Posterior, Scratch
from master.estimator.joint_covariance import CovarianceScratch
from master.estimator.observation_sources import Ground
from master.estimator.problem import EpochPrior
from master.estimator.state import Hidden


class Task:
    """What is to be done at an epoch.

    Attributes:
        t_ns: (1,) the epoch.
        palm_shown: (1,) whether something measures where the palm is.
        palm, angles: (4, 4), (20,) another hand of the epoch [rad].
        x: (n,) its free angles, inside the limits; or, with the palm, where a search begins.
        may_leave: (1,) whether there is another, and it may take the place of the state.
        rough: (1,) whether a search is to end early, in place, under the widest hypothesis alone.
        natural: (1,) probability of a natural hand a moment ago, and `counts` (1,) what that counts, 0 ... 1.
        second_order: (1,) whether covariance is wanted to second order.
        process_noise_rad2: (1,) variance of what the heading has drifted since the last epoch.
        continuous: (1,) whether epochs follow each other.
        scanned: (20,) angles of fingers whose cost map was searched, where it is likeliest.
        refused: (5,) fingertips, and `off` (5,) laser points, that no pose explains.
        solver_mode: (5,) `SolverMode` codes of what fingers are solved from.
        ambiguous: (5,) whether another pose explains as much.
    """

    t_ns: Int
    palm_shown: Bool
    palm: Float
    angles: Float
    x: Float
    may_leave: Bool
    coarse: Bool
    natural_weight: Float
    counts: Float
    second_order: Bool
    process_noise_rad2: Float
    continuous: Bool
    scanned: Float
    refused: Bool
    off: Bool
    solver_mode: Code
    ambiguous: Bool

    @classmethod
    def empty(cls, n: int) -> "Task":
        """Scratch for one."""
        return record(
            cls,
            t_ns=("i8", 1),
            palm_shown=("u1", 1),
            palm=(4, 4),
            angles=20,
            x=n,
            may_leave=("u1", 1),
            coarse=("u1", 1),
            natural_weight=1,
            counts=1,
            second_order=("u1", 1),
            process_noise_rad2=1,
            continuous=("u1", 1),
            scanned=20,
            refused=("u1", 5),
            off=("u1", 5),
            solver_mode=("u1", 5),
            ambiguous=("u1", 5),
        )


class Workspace:
    """Scratch for all kernels of one hand, with the task and the prior of the epoch."""

    task: Task
    ground: Ground
    epoch_prior: EpochPrior
    hidden: Hidden
    found: Posterior
    scratch: Scratch
    cov_scratch: CovarianceScratch
    prior: Prior
    scan: Scan
    extras: ExtrasScratch

    @classmethod
    def empty(cls, n: int, extras: int, markers: int) -> "Workspace":
        """Allocate it."""
        return record(
            cls,
            task=Task.empty(n),
            ground=Ground.empty(),
            epoch_prior=EpochPrior.none(n, extras),
            hidden=Hidden.none(n),
            found=Posterior.empty(n, extras, markers),
            scratch=Scratch.empty(n, extras, markers),
            cov_scratch=CovarianceScratch.empty(6 + n + extras, markers),
            prior=Prior.empty(),
            scan=Scan.empty(),
            extras=ExtrasScratch.empty(extras),
        )


class Model(NamedTuple):
    """Everything that is the same at every epoch.

    Hand, settings and device are in their arrays (`common.messages.records.boxed`).
    """

    hand: Any
    settings: Any
    mounts: Mounts
    cameras: CameraArrays
    device: Any
