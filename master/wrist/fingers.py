"""What a wrist device's triples say of the fingers' angles: laser points on their plane, and fingertips (D5 to D22).

`WristFingers` is a push machine without clock, socket or thread. `master.wrist.pipeline` makes poses of what it says,
and whoever knows the hand from elsewhere, too, may join it to that. What it says of a finger:

- **seen**: laser point and tip tell its angles, or its laser point how far it is closed by habit (`level`); `told`.
- **ambiguous**: so, but another pose explains as much; told, and its doubt holds both.
- **past the branch**: bent so far that the point no longer moves with it: not told, the angles are the middle of what
  is left, with its whole width as doubt.
- **off**: the point fits no natural finger: angles as found, not told.
- **not seen**: NaN.
"""

from collections import Counter
from contextlib import nullcontext
from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float
from common.hand_model import FINGERS
from common.messages import Level, WristDetections
from common.wrist_bend import STRAIGHT
from master.estimator.pipeline import Stage
from master.fabrik.one_euro import OneEuroParameters, PointFilter
from master.wrist.belief import AngleBelief, FingerAngles
from master.wrist.bend_slope import BendSlope, SightWorth, near
from master.wrist.bent import BentView, BentWrist
from master.wrist.bent_closing import closings
from master.wrist.cubic import CubicLaw
from master.wrist.finger_poses import FingerPoses
from master.wrist.forward import ForwardTable
from master.wrist.inverse import InverseModel
from master.wrist.invert import Inverse
from master.wrist.laser_plane import LaserPoints, PlaneAxes, in_image, laser_points
from master.wrist.levels import NOTHING, Levels, Sighting
from master.wrist.light_unit import LightUnit
from master.wrist.setup import WristSetup
from master.wrist.sight import SightNoise

FORGET_S = 0.5
_FINGERS = np.arange(5)
_LINGERS_S = 0.5  # a hand at work has another pose after that: sooner, poses tell the same of the light
NEVER_NS = -(2**62)
_NO_TIPS = np.full((5, 2), np.nan), np.full(5, np.nan)
_AWAY_M = 0.1  # of fingertips from the camera, where a filter must know millimetres


@dataclass(frozen=True, slots=True, eq=False)
class SeenFingers:
    """What one triple says of the fingers.

    Attributes:
        t_ns: Its instant [ns], on the master's clock.
        found: The angles, at the bend that was told.
        laser_m: (5, 3) where the laser meets the fingers [m], camera frame; NaN: not seen.
        by_bend: (5, 4, 2) how the angles would change with the wrist's flexion and deviation [rad/rad].
        worth: What is seen says of angles and bend by itself, without habits.
    """

    t_ns: int
    found: FingerAngles
    laser_m: Float
    by_bend: Float
    worth: SightWorth


class WristFingers:
    """Push machine. Holds filters of laser points and tips, of each finger the last angles, and the unit of light."""

    def __init__(
        self,
        setup: WristSetup,
        counts: Counter[str],
        *,
        continuous: bool = True,
        stage: Stage = lambda name: nullcontext(),
        inverse: Inverse | None = None,
        model: InverseModel | None = None,
    ) -> None:
        """Join the parts.

        Args:
            setup: Device and hand.
            counts: Counted into, by event and finger: `late`, `outside`, `no_plane`, `tip_outside`, `tip_refused`,
                `ik`, `past`, `off`, `ambiguous`.
            continuous: False: every message is an unrelated pose; no filter, no memory.
            stage: Opens a timer by stage name.
            inverse: The table of this device and hand; None: a new one, which takes a second or two.
            model: The inverse model of the same, for levels above "fk"; None: a new one, which takes a second.
        """
        self.counts = counts
        self._setup, self._stage, self._continuous = setup, stage, continuous
        self._axes = PlaneAxes.of(setup)
        poses = FingerPoses(setup) if model is None else model.poses
        self._bent = BentWrist(setup, poses)
        self.inverse = Inverse(ForwardTable.of(setup)) if inverse is None else inverse
        table = self.inverse.table
        self._believe = AngleBelief(setup, table)
        self._cubic = CubicLaw(setup, table) if setup.cubic else None
        self._slope = BendSlope(SightNoise(setup), table.curve)
        self._levels = None if setup.level == "fk" else Levels(setup, model or InverseModel(setup))
        self._smooth, self._smooth_tips = (
            _point_filter(setup, self._axes) if continuous else None for _ in range(2)
        )
        self._light, self._told_ns = LightUnit(), NEVER_NS
        self._last_ns = NEVER_NS
        self._angles, self._seen_ns = np.full((5, 4), np.nan), np.full(5, NEVER_NS)

    def push(
        self, message: WristDetections, bend_rad: Float = STRAIGHT, expected_rad: Float | None = None
    ) -> SeenFingers | None:
        """Take what one triple showed.

        Args:
            message: A triple.
            bend_rad: (2,) flexion and deviation of the wrist at its instant (`common.wrist_bend`).
            expected_rad: (5, 4) angles, where they are expected; NaN or None: habit tells. What a laser point alone
                leaves open of a finger follows them.

        Returns:
            What it says, or None: it is not later than the last, and was counted and dropped.
        """
        t_ns = message.t_ns + self._setup.late_ns
        if t_ns <= self._last_ns:
            self.counts["late"] += 1
            return None
        self._last_ns = t_ns
        with self._stage("laser"):
            told = np.isfinite(message.laser_uv).all(axis=1)
            shown = in_image(self._setup, message.laser_uv, message.laser_sigma_px)
            self._count("outside", told & ~shown)
            points = laser_points(
                self._setup, np.where(shown[:, None], message.laser_uv, np.nan), message.laser_sigma_px
            )
            self._count("no_plane", shown & np.isnan(points.point_m[:, 0]))
        with self._stage("angles"):
            found, by_bend, worth = self._angles_of(t_ns, message, points, bend_rad, expected_rad)
        seen = np.isfinite(found.angles_rad[:, 0])
        self._angles[seen], self._seen_ns[seen] = found.angles_rad[seen], t_ns
        self._count("past", found.past)
        self._count("off", found.off)
        self._count("ambiguous", found.ambiguous)
        return SeenFingers(t_ns, found, points.point_m, by_bend, worth)

    def _angles_of(
        self,
        t_ns: int,
        message: WristDetections,
        points: LaserPoints,
        bend_rad: Float,
        expected_rad: Float | None,
    ) -> tuple[FingerAngles, Float, SightWorth]:
        """What laser and tips say of the fingers, how it changes with the bend (5, 4, 2), and what sights are worth."""
        point = points.point_m
        if self._smooth is not None:
            point = self._smooth.push(t_ns, point, points.cov_m2)
        flat, cov = self._axes.flat(point), self._axes.flat_cov(points.cov_m2)
        view = self._bent.at(bend_rad) if bend_rad.any() else None
        closed = self.inverse(flat) if view is None else closings(view, self.inverse.table, flat)
        if self._cubic is not None:
            closed = self._cubic(flat, closed)
        found = self._believe(closed, cov, point[:, 2], message.laser_px)
        tip, sigma_px = _NO_TIPS if self._levels is None else self._tips(t_ns, message)
        sight = Sighting(flat, cov, point[:, 2], message.laser_px, tip, sigma_px, message.tip_depth)
        if self._levels is not None:
            expected = NOTHING if expected_rad is None else np.isfinite(expected_rad[:, 0])
            found = self._by_level(self._levels, t_ns, found, sight, view, expected)
        seen = view or self._bent.at(bend_rad)
        if expected_rad is not None:
            limits = np.moveaxis(self._setup.model.limits_rad, -1, 0)
            found = near(lambda a: seen.crossings(a, _FINGERS), found, expected_rad, (limits[0], limits[1]))
        at = seen.crossings(np.nan_to_num(found.angles_rad), _FINGERS)
        return found, *self._slope(at, found, sight)

    def _by_level(
        self,
        levels: Levels,
        t_ns: int,
        natural: FingerAngles,
        sight: Sighting,
        view: BentView | None,
        expected: Bool,
    ) -> FingerAngles:
        """What laser and tips say together."""
        fresh = self._continuous & (1e-9 * (t_ns - self._seen_ns) <= FORGET_S)
        last = np.where(fresh[:, None], self._angles, np.nan)
        gone_s = 1e-9 * (t_ns - self._told_ns)
        news = -np.expm1(-gone_s / _LINGERS_S) if self._continuous else 1.0
        self._told_ns = t_ns
        found, refused = levels(natural, sight, last, self._light, float(news), view, expected)
        self._count("tip_refused", refused)
        self._count("ik", found.level == Level.IK)
        return found

    def _tips(self, t_ns: int, message: WristDetections) -> tuple[Float, Float]:
        """Fingertips (5, 2) as x / z, y / z, and their standard deviations (5,) [px]; NaN: not seen.

        They are filtered like the laser points, as if all were as far away as a hand usually is: in step with these.
        """
        told = np.isfinite(message.tip_uv).all(axis=1)
        shown = in_image(self._setup, message.tip_uv, message.tip_sigma_px)
        self._count("tip_outside", told & ~shown)
        tip = self._setup.optics.undistort(np.where(shown[:, None], message.tip_uv, np.nan))
        sigma_px = np.where(shown, message.tip_sigma_px, np.nan)
        if self._smooth_tips is not None:
            point = _AWAY_M * np.concatenate([tip, np.ones((5, 1))], axis=1)
            noise_m = _AWAY_M * sigma_px / self._setup.optics.matrix[0, 0]
            cov = (noise_m**2)[:, None, None] * np.eye(3)
            tip = self._smooth_tips.push(t_ns, point, cov)[:, :2] / _AWAY_M
        return tip, sigma_px

    def _count(self, event: str, fingers: Bool) -> None:
        count(self.counts, event, fingers)


def count(counts: Counter[str], event: str, fingers: Bool) -> None:
    """Count an event of each of the fingers (5,) by name."""
    for f in np.flatnonzero(fingers):
        counts[f"{event}.{FINGERS[f]}"] += 1


def _point_filter(setup: WristSetup, axes: PlaneAxes) -> PointFilter:
    """The rig's 1 € filter, across, out of and along the plane."""
    return PointFilter(
        OneEuroParameters.of(setup.filter),
        np.stack([axes.axes[0], setup.normal, axes.axes[1]]),
    )
