"""Records of a fit: a hand under each hypothesis, and both together."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from common.arrays import Float
from common.kernels import inlined
from common.messages.records import boxed, record
from master.estimator.priors import PosturePrior
from master.estimator.problem import EpochPrior, Search
from master.estimator.residuals import Observations
from master.estimator.truncated import Cut


class Posterior:
    """A hand by one epoch.

    Attributes:
        palm, x, z: (4, 4) palm, (n,) free angles, (K,) extras.
        cov: (N, N) of turn [rad], shift [m], rig axes, free angles [rad] and extras, by this epoch alone.
        marker_chi2: (M,) chi square of each marker.
        steps: (1,) of the search.
        natural_weight: (1,) probability that the hand follows the posture prior.
        scale: (1,) by how much the residual has scaled the covariance.
        contrary: (1,) chi square of the palm against how other sensors have it turned, and of what the extras gave in.
    """

    palm: Float
    x: Float
    z: Float
    cov: Float
    marker_chi2: Float
    steps: Float
    natural_weight: Float
    scale: Float
    contrary: Float

    @classmethod
    def empty(cls, n: int, extras: int, markers: int) -> "Posterior":
        """Scratch for one."""
        N = 6 + n + extras
        return record(
            cls,
            palm=(4, 4),
            x=n,
            z=extras,
            cov=(N, N),
            marker_chi2=markers,
            steps=1,
            natural_weight=1,
            scale=1,
            contrary=1,
        )


class Blank(NamedTuple):
    """Empty prior, used by `_onto` for a fit to points alone.

    `epoch_prior`: the array that a `EpochPrior` lies in (`common.messages.records.boxed`).
    """

    posture_prior: PosturePrior
    epoch_prior: Any
    between: Observations

    @classmethod
    def of(cls, n: int, extras: int, cameras: int, markers: int) -> "Blank":
        """For a hand with n free angles."""
        nothing = PosturePrior(np.zeros((1, n, n)), np.zeros((1, n)), np.zeros(1), np.zeros(1))
        return cls(nothing, boxed(EpochPrior.none(n, extras)), Observations.empty(cameras, markers))


class Hypothesis:
    """A hand of N = 6 + n + K unknowns and M markers under one hypothesis.

    Attributes:
        palm, x, z: (4, 4), (n,), (K,) where its search ended.
        gradient, normal: (N,), (N, N) there.
        marker_chi2, information: (M,) chi square and (M, 3, 3) what is known of the place of each marker.
        cost, apart: (1,) half the sum of squares, and the half of what rays that do not meet have between them.
        share: (1,) its probability.
        step: (N,) from there to the mean within the limits, and `off` (N,) the same from the likelier hand.
    """

    palm: Float
    x: Float
    z: Float
    gradient: Float
    normal: Float
    marker_chi2: Float
    information: Float
    cost: Float
    outliers: Float
    share: Float
    step: Float
    off: Float

    @classmethod
    def empty(cls, n: int, extras: int, markers: int) -> "Hypothesis":
        """Scratch for one."""
        N = 6 + n + extras
        return record(
            cls,
            palm=(4, 4),
            x=n,
            z=extras,
            gradient=N,
            normal=(N, N),
            marker_chi2=markers,
            information=(markers, 3, 3),
            cost=1,
            outliers=1,
            share=1,
            step=N,
            off=N,
        )


class Scratch:
    """Scratch for both hypotheses of N = 6 + n + K unknowns and M markers."""

    each: Sequence[Hypothesis]  # (2,) natural and free
    start_T: Float  # (4, 4)
    start_x: Float  # (n,)
    start_z: Float  # (K,)
    middle: Float  # (N,)
    A: Float  # (N, N)
    L: Float  # (N, N)
    work: Float  # (N, N)
    cov: Float  # (N, N)
    here: Float  # (M, 3)
    there: Float  # (M, 3)
    cut: Cut
    search: Search

    @classmethod
    def empty(cls, n: int, extras: int, markers: int) -> "Scratch":
        """Allocate it."""
        N, M = 6 + n + extras, markers
        return record(
            cls,
            each=(Hypothesis.empty(n, extras, markers), 2),
            start_T=(4, 4),
            start_x=n,
            start_z=extras,
            middle=N,
            A=(N, N),
            L=(N, N),
            work=(N, N),
            cov=(N, N),
            here=(M, 3),
            there=(M, 3),
            cut=Cut.empty(n, N),
            search=Search.empty(n, extras, markers),
        )


@inlined
def likelier(scratch: Scratch) -> int:
    """The hypothesis with the larger probability."""
    return 0 if scratch.each[0].share[0] >= scratch.each[1].share[0] else 1
