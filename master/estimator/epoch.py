"""Inputs and outputs of the estimator at an epoch."""

from dataclasses import dataclass, field

import numpy as np

from common.arrays import Bool, Code, Float, Int
from master.fabrik.estimate import SolvedHand


@dataclass(frozen=True, slots=True, eq=False)
class Epoch:
    """What is measured at one time.

    Attributes:
        t_ns: When.
        points_m: (A, 3) where rays place the markers; NaN: they do not.
        cov_m2: (A, 3, 3) covariances of these, where they are what is measured; None: the centroids are.
        uv: (C, A, 2) [px] centroids of all markers of the rig; NaN: not seen, or gated out.
        variance_px2: (C, A) of each camera's own errors; NaN: not to be used.
        own_m2: (A, 3, 3) covariance of what is wrong with each marker itself, beside bones.
        back_normal: (3,) unit vector from the hand to the cameras that see its back.
        orientation: Rotation of the palm by other sensors; None: not measured.
        wrist: What a wrist device sees of the fingers; None: nothing.
        place: (3,) [m] where the palm is, of a wrist device alone; None: not known.
        start: Another hand of this epoch; None: there is none.
        second_order: Whether the joints' covariance is wanted to second order, as a hand that is published has it.
    """

    t_ns: int
    points_m: Float
    back_normal: Float
    cov_m2: Float | None = None
    uv: Float | None = None
    variance_px2: Float | None = None
    own_m2: Float | None = None
    orientation: "OrientationMeasurement | None" = None
    wrist: "WristRows | None" = None
    place: Float | None = None
    start: SolvedHand | None = None
    second_order: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class OrientationMeasurement:
    """How other sensors have the palm turned.

    Attributes:
        rotation: (3, 3) palm -> rig frame; where `axes` is given that of a straight wrist.
        information: (3, 3) [1/rad^2] about its turn, rig axes.
        sure: Whether it is known about every axis how the palm lies.
        axes: (3, 3) as rows, rig axes: about which tilt 2 and heading turn the forearm; None: the IMU is on the palm.
        process_noise_rad2: Variance of what the heading has drifted since the epoch before.
    """

    rotation: Float
    information: Float
    sure: bool
    axes: Float | None = None
    process_noise_rad2: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class WristRows:
    """Measurements of five fingers from one strobe cycle of a wrist device.

    x, y are those of undistorted rays (x, y, 1).

    Attributes:
        laser, tip: (5, 2) laser points and fingertips x, y; NaN: not seen.
        laser_sigma_px, tip_sigma_px: (5,) their standard deviations per axis.
        laser_px: (5,) lengths of the lines.
        tip_depth: (5,) distances of the tips by light, in a unit of its own.
        laser_s, tip_s: How much later than the epoch laser points and fingertips were seen.
        law: (5,) PIPs [rad] by another law of the laser point; NaN: none.
    """

    laser: Float
    laser_sigma_px: Float
    laser_px: Float
    tip: Float
    tip_sigma_px: Float
    tip_depth: Float
    laser_s: float
    tip_s: float
    law: Float


@dataclass(frozen=True, slots=True, eq=False)
class FittedHand(SolvedHand):
    """A hand fitted by the estimator.

    Attributes:
        alone: (6 + n, 6 + n) covariance of the palm's turn [rad] and shift [m] and of the free angles [rad], by this
            epoch alone.
        x: (n,) free angles.
        scale: By how much the residual of the epoch has scaled `measurement_cov`.
        natural_weight: Probability that the hand follows the posture prior.
        marker_chi2: (M,) chi square of each marker.
        steps: Of the search.
        twist: (5,) [rad] by which the hinges of each finger are rolled about its first bone.
    """

    measurement_cov: Float
    x: Float
    scale: float
    natural_weight: float
    marker_chi2: Float
    steps: int
    twist: Float = field(default_factory=lambda: np.zeros(5))


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """Result of the estimator at an epoch.

    Attributes:
        solution: The hand; None: nothing is known of it.
        valid, tracked, source: (26,) as of `HandPose`.
        rests: (6,) what thumb ... little and the palm rest on now; 0: on nothing. Equal numbers are equal grounds: for
            a finger the sum of `ON_MARKERS`, `BY_MARKERS` where its own is placed, and `ON_OTHERS` by its level; for
            the palm one of the former and which markers are seen.
        anew: The hand of a moment ago was wrong: nothing of it is in this one.
        solver_mode: (5,) `SolverMode` codes of what the fingers are solved from by a wrist device, now.
        ambiguous: (5,) whether another pose of the finger explains that as well.
        rotation_rejected: Whether the palm by markers contradicts the measured orientation, which was rejected.
        refused, off: (5,) fingertips and laser points that no pose explains.
    """

    solution: FittedHand | None
    valid: Bool
    tracked: Bool
    source: Code
    sources: Int
    reinitialised: bool = False
    solver_mode: Code = field(default_factory=lambda: np.zeros(5, np.uint8))
    ambiguous: Bool = field(default_factory=lambda: np.zeros(5, np.bool_))
    rotation_rejected: bool = False
    refused: Bool = field(default_factory=lambda: np.zeros(5, np.bool_))
    off: Bool = field(default_factory=lambda: np.zeros(5, np.bool_))
