"""An epoch has inputs, compiled steps, and a hand as output.

`CycleReader` makes rows of a wrist camera's strobe cycles, for the level asked for:

    fk     laser points only, of fingers that bend naturally
    ik     only fingers of which laser point and tip are both seen; the others are not reported
    auto   a finger whose tip is not seen is solved from its laser point, as far as that goes
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import nan

import numpy as np

from common.arrays import Bool, Code, Float, Int
from common.geometry.camera_model import CameraModel
from common.hand.model import FINGERS, HandJoints, HandModel
from common.kernels import bound
from common.messages import Source, WristDetections
from common.records import boxed, fields, record
from master.estimator.kinematics import Scratch, pose
from master.estimator.parameters import HandParameters, HandTables, Mounts
from master.estimator.posterior import Model, Workspace, count_rows
from master.estimator.priors import CubicLaw, PosturePrior, WristModel
from master.estimator.problem import Observations, observe_points, observe_rays
from master.estimator.sensors import (
    EXTRAS,
    HEADING,
    NO_EXTRAS,
    CameraArrays,
    Device,
    WristRows,
    in_image,
    observe_wrist,
)
from master.estimator.settings import KERNEL, Settings
from master.estimator.solve import Blank
from master.estimator.state import stationary_of, unknown_hand
from master.estimator.update import Estimate, fit_epoch, predict_epoch, take_over_epoch
from master.estimator.wrist_update import prepare_epoch
from master.rig.setup import WristSetup


@dataclass(frozen=True, slots=True, eq=False)
class MarkerPositions:
    """Positions of the M markers of a rig at one epoch."""

    points_m: Float  # centroids (M, 3) [m], rig frame; NaN: fewer than two cameras see it, or not one thing
    cov_m2: Float  # (M, 3, 3) [m^2]
    noise_m2: Float  # (M, 3, 3) [m^2] the part of it that may differ from one epoch to the next
    outliers: Bool  # (M,) what two cameras see is not one thing
    rejected: Bool  # (C, M) outliers of single cameras, without which the rays of three or more meet


@dataclass(frozen=True, slots=True, eq=False)
class SolvedHand:
    """A hand's pose and how well it is known."""

    T_rig_palm: Float  # (4, 4)
    angles_rad: Float  # (5, 4), inside the limits
    joints: HandJoints
    cov_m2: Float  # (26, 3, 3) [m^2] covariance of the joint positions
    tilt_cov_rad2: Float  # (5, 3, 3) [rad^2] of the last phalanges' directions, by this epoch alone
    tilt_process_noise_rad2_s2: Float  # (5,) [rad^2/s^2] growth of its trace, by time squared


@dataclass(frozen=True, slots=True, eq=False)
class HandEstimate:
    """Hand estimate of the marker line at one epoch."""

    t_ns: int
    markers: MarkerPositions
    smooth_m: Float  # (M, 3) [m] after the 1 € filter
    back_normal: Float  # (3,) unit vector from the hand to the cameras that see its back
    solution: SolvedHand | None  # None: none is known
    valid: Bool  # (26,), as `tracked` and `source`: as of `HandPose`
    tracked: Bool
    source: Code
    seen: Bool  # (5,) fingers whose marker was placed now
    residual_m: Float  # (5,) where FABRIK left the marker on a finger's end from its target; NaN: not seen
    iterations: Int  # (5,) of FABRIK
    reached: Bool  # (5,) FABRIK brought the marker onto its target
    solved: bool = False  # whether the hand is solved from this epoch, not held from an earlier one

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


@dataclass(frozen=True, slots=True, eq=False)
class Epoch:
    """What is measured at one time."""

    t_ns: int
    points_m: Float  # (A, 3) [m] where rays place the markers; NaN: they do not
    back_normal: Float  # (3,) unit vector from the hand to the cameras that see its back
    cov_m2: Float | None = None  # (A, 3, 3) where points are measured; None: the centroids are
    uv: Float | None = None  # (C, A, 2) [px] centroids of all markers of the rig; NaN: not seen, or gated out
    variance_px2: Float | None = None  # (C, A) of each camera's own errors; NaN: not to be used
    own_m2: Float | None = None  # (A, 3, 3) [m^2] of what is wrong with each marker itself, beside bones
    orientation: "OrientationMeasurement | None" = None  # of the palm by other sensors; None: not measured
    wrist: WristRows | None = None  # what a wrist device sees of the fingers; None: nothing
    place: Float | None = None  # (3,) [m] where the palm is, of a wrist device alone; None: not known
    start: SolvedHand | None = None  # another hand of this epoch; None: there is none
    second_order: bool = True  # whether the joints' covariance is wanted to second order


@dataclass(frozen=True, slots=True, eq=False)
class OrientationMeasurement:
    """How other sensors have the palm turned."""

    rotation: Float  # (3, 3) palm -> rig frame; where `axes` is given that of a straight wrist
    information: Float  # (3, 3) [1/rad^2] about its turn, rig axes
    sure: bool  # whether it is known about every axis how the palm lies
    axes: Float | None = None  # (3, 3) rows, rig axes: of tilt 2 and heading; None: IMU on the palm
    process_noise_rad2: float = 0.0  # variance of what the heading has drifted since the epoch before


@dataclass(frozen=True, slots=True, eq=False)
class FittedHand(SolvedHand):
    """A hand fitted by the estimator."""

    measurement_cov: Float  # (6 + n, 6 + n) turn [rad], shift [m], free angles [rad], by this epoch alone
    x: Float  # (n,) free angles
    scale: float  # by how much the residual of the epoch has scaled `measurement_cov`
    natural_weight: float  # probability that the hand follows the posture prior
    marker_chi2: Float  # (M,)
    steps: int  # of the search
    twist: Float = field(default_factory=lambda: np.zeros(5))  # (5,) [rad]


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """Result of the estimator at an epoch.

    `sources` (6,): what thumb ... little and the palm rest on now; 0: on nothing. Equal numbers are equal
    grounds: for a finger the sum of `ON_MARKERS`, `BY_MARKERS` where its own is placed, and `ON_OTHERS` by
    its level; for the palm one of the former and which markers are seen. `ambiguous` (5,): another pose
    explains the finger as well.
    """

    solution: FittedHand | None  # None: nothing is known of the hand
    valid: Bool  # (26,), as `tracked` and `source`: as of `HandPose`
    tracked: Bool
    source: Code
    sources: Int
    reinitialised: bool = False  # the hand of a moment ago was wrong: nothing of it is in this one
    solver_mode: Code = field(default_factory=lambda: np.zeros(5, np.uint8))
    ambiguous: Bool = field(default_factory=lambda: np.zeros(5, np.bool_))  # (5,)
    rotation_rejected: bool = False  # whether the palm by markers contradicts the measured orientation
    refused: Bool = field(default_factory=lambda: np.zeros(5, np.bool_))
    off: Bool = field(default_factory=lambda: np.zeros(5, np.bool_))


_EYE, _AT_ORIGIN = np.eye(3), np.eye(4)


class EpochSteps:
    """Holds the state of one hand (`now`), and what is worked on at an epoch (`at`).

    `triangulated` (M,): of which of the hand's markers the places are known at the epoch; `on_hand` (M,): the
    hand's markers among those of the rig; `finger` (M,): the finger that carries each; -1: the palm.
    """

    def __init__(
        self,
        cameras: Sequence[CameraModel],
        model: HandModel,
        parameters: HandParameters,
        markers: tuple[str, ...],
        hand_markers: tuple[str, ...],
        posture_prior: PosturePrior,
        settings: Settings,
        wrist: WristModel | None,
    ) -> None:
        """Lay out the tables, and compile; arguments as of `Estimator`."""
        self._settings, mounts, count = settings, Mounts.of(model, hand_markers), len(hand_markers)
        self.on_hand = np.array([markers.index(name) for name in hand_markers], np.int64)
        self.finger = mounts.finger
        extras, device = (NO_EXTRAS, record(Device)) if wrist is None else (EXTRAS, wrist.device)
        self._cameras, n = CameraArrays.of(cameras), len(parameters.free)
        self.observed = observed = Observations.empty(len(cameras), count)
        self.triangulated: Bool = np.zeros(count, np.bool_)
        self._blank = Blank.of(n, extras, len(cameras), count)
        # Records are used by their fields here, and handed to kernels in the arrays that they lie in.
        sizes = {"n": n, "K": extras, "N": 6 + n + extras}
        self.state = unknown_hand(**sizes)
        space = record(Workspace, **sizes, M=_capacity(count))
        self.now, self.at = fields(self.state), fields(space)
        self._state, self._space, self._work = boxed(self.state), boxed(space), boxed(record(Scratch))
        self._ground = self._space["ground"]
        self._cycle_rows = self._space["epoch_prior"]["cycle_rows"]
        hand, device = boxed(HandTables.of(model, parameters)), boxed(device)
        self._model = Model(hand, boxed(settings.record()), mounts, self._cameras, device)
        self.at.epoch_prior.z_info[0, 0] = 1.0  # of a rig without wrist device: one extra that means nothing
        if wrist is not None:
            self._lay_out(wrist)
        nothing, own = np.full((len(cameras), len(markers), 2), np.nan), np.zeros((len(markers), 3, 3))
        scratch = np.empty((26, 3)), np.empty((26, 3, 3)), np.empty((count, 3))
        none, each = np.full((5, 2), np.nan), np.full(5, np.nan)
        rows = WristRows(none, each, each, none, each, each, 0.0, 0.0, each)
        self._rays = bound(observe_rays, nothing, nothing[..., 0].copy(), own, self.on_hand, observed)
        self._points = bound(observe_points, scratch[2], own[self.on_hand], 0.0, observed)
        self._count = bound(count_rows, mounts, observed, self._ground)
        self._cycle = bound(observe_wrist, device, rows, 0.0, self._cycle_rows)
        self._pose = bound(pose, hand, mounts, _AT_ORIGIN, np.zeros(20), self._work, *scratch)
        rig, state, space = self._model, self._state, self._space
        self._prepare = bound(prepare_epoch, rig, state, space)
        self._predict = bound(predict_epoch, rig, state, observed, space)
        self._fit = bound(fit_epoch, rig, posture_prior, observed, self._blank, space)
        self._take_over = bound(take_over_epoch, rig, state, True, observed, space, Estimate.empty())

    def pose(self, T: Float, angles_rad: Float) -> tuple[HandJoints, Float]:
        """Place joints and markers (M, 3) [m], rig frame, as `Estimator.pose`."""
        position, rotation = np.empty((26, 3)), np.empty((26, 3, 3))
        places, angles = np.empty((len(self.on_hand), 3)), angles_rad.reshape(20)
        model, at = self._model, np.ascontiguousarray(T)
        self._pose(model.hand, model.mounts, at, angles, self._work, position, rotation, places)
        return HandJoints(position, rotation, T), places

    def observe(self, at: Epoch, *, continuous: bool) -> None:
        """Write the rows of an epoch, and count them."""
        task, cycle_rows = self.at.task, self.at.epoch_prior.cycle_rows
        task.t_ns[0], task.second_order[0], task.continuous[0] = at.t_ns, at.second_order, continuous
        task.process_noise_rad2[0] = 0.0 if at.orientation is None else at.orientation.process_noise_rad2
        if at.wrist is None:
            cycle_rows.rows[0] = 0.0
            cycle_rows.lit[:] = cycle_rows.shown[:] = 0.0
        else:
            self.at.prior.law[:] = at.wrist.law
            self._cycle(self._model.device, at.wrist, self._settings.light_rad, self._cycle_rows)
        bones_m2 = self._settings.bones_m**2
        if at.cov_m2 is not None:
            points, cov = at.points_m[self.on_hand], at.cov_m2[self.on_hand]
            self._points(points, cov, bones_m2, self.observed)
            self.triangulated = self.observed.triangulated
        else:
            self.triangulated = np.isfinite(at.points_m[self.on_hand].sum(axis=1))
            self.observed.seen[:] = False
            if at.uv is not None:
                assert at.variance_px2 is not None
                assert at.own_m2 is not None
                uv, variance = np.ascontiguousarray(at.uv), np.ascontiguousarray(at.variance_px2)
                self._rays(uv, variance, at.own_m2 + bones_m2 * _EYE, self.on_hand, self.observed)
        self._count(self._model.mounts, self.observed, self._ground)

    def prepare(self) -> None:
        """Predict the extras; search the minima of fingers that a wrist device sees."""
        self._prepare(self._model, self._state, self._space)

    def set_priors(self, at: Epoch, *, known: bool) -> None:
        """Write the priors but past and posture; `known`: the past is informative."""
        epoch_prior, ground, orientation = self.at.epoch_prior, self.at.ground, at.orientation
        epoch_prior.back_normal[:] = at.back_normal
        epoch_prior.back_normal_w2[0] = self._settings.back_normal_rad**-2.0 if ground.back[0] else 0.0
        epoch_prior.depth_w2[0] = 0.0
        if known and ground.most[0] == 1:
            camera_centre = self._cameras.centre[(self.observed.weight > 0.0).sum(axis=1).argmax()]
            line_of_sight = self.now.palm[:3, 3] - camera_centre
            epoch_prior.line_of_sight[:] = line_of_sight / np.sqrt(line_of_sight @ line_of_sight)
            epoch_prior.depth_w2[0] = self._settings.held_depth_m**-2.0
        epoch_prior.oriented[0] = orientation is not None
        if orientation is not None:
            epoch_prior.forearm[:3, :3] = orientation.rotation
            epoch_prior.orientation_info[:] = orientation.information
            epoch_prior.on_forearm[0] = orientation.axes is not None
            epoch_prior.axes[:] = 0.0 if orientation.axes is None else orientation.axes
        epoch_prior.place_w2[0] = 0.0
        if at.place is not None:
            epoch_prior.place[:], epoch_prior.place_w2[0] = at.place, self._settings.stands_m**-2.0

    def predict(self) -> float:
        """Write where the state has the hand; as `predict_epoch`."""
        return self._predict(self._model, self._state, self.observed, self._space)

    def fit(self, posture_prior: PosturePrior, *, coarse: bool = False) -> float:
        """Fit what is measured; return chi square, or the cost of a rough search."""
        self.at.task.coarse[0] = coarse
        return self._fit(self._model, posture_prior, self.observed, self._blank, self._space)

    def take_over(self, *, goes_on: bool) -> Estimate:
        """Write the solution into the state; `goes_on`: it is the hand before."""
        out = Estimate.empty()
        self._take_over(self._model, self._state, goes_on, self.observed, self._space, out)
        return out

    def kept(self) -> Float:
        """A copy of the state, for `put_back`."""
        return self._state.copy()

    def put_back(self, state: Float) -> None:
        """Let the state be what it was."""
        self._state[:] = state

    def determines_hand(self, at: Epoch) -> bool:
        """Return whether the markers determine a hand.

        They must not lie in one line, unless it runs across `back_normal`: what faces the cameras turns the
        hand about a line of markers, but not about one that points at them. With an orientation that is known
        any marker is enough.
        """
        if at.place is not None:
            return True
        points = at.points_m[self.on_hand][self.triangulated]
        if at.orientation is not None and at.orientation.sure:
            return len(points) > 0
        if len(points) < 2:
            return False
        off = points - points.mean(axis=0)
        s = self._settings
        if len(points) > 2:  # plainly not in one line, without what a decomposition takes
            length2 = np.vecdot(off, off)
            along, longest2 = off @ off[length2.argmax()], float(length2.max())
            if (
                longest2 > 0.0
                and float((length2 - along * along / longest2).max()) > (4.0 * s.line_width_m) ** 2
            ):
                return True
        _, extent, axes = np.linalg.svd(off)
        if len(points) > 2 and extent[1] > s.line_width_m:
            return True
        back = self.at.ground.back[0]
        has_direction = extent[0] > s.line_length_m and abs(axes[0] @ at.back_normal) < s.line_across
        return bool(back and has_direction)

    def has_outlier(self) -> bool:
        """Return whether a marker is too far from what was found."""
        marker_chi2 = self.at.found.marker_chi2[: len(self.on_hand)]
        return bool((marker_chi2 > self._settings.marker_gate).any())

    def _lay_out(self, wrist: WristModel) -> None:
        """Write finger priors before a wrist device, and those of its extras."""
        prior, state, s = self.at.prior, self.now, self._settings
        prior.base_rad[:], prior.per_pip[:], prior.frame[:] = wrist.base_rad, wrist.per_pip, wrist.frame
        prior.abduction[:], prior.flexion[:] = s.abduction_rad, s.coupled_rad
        prior.abduction[0] = prior.flexion[0] = 0.5 * s.thumb_rad
        if wrist.natural_only:
            prior.natural_only[0], prior.flexion[:] = 1.0, s.stiff_rad
        state.stationary[:] = stationary_of(s, loose=wrist.loose, tilt_rad=wrist.tilt_rad)
        state.z_cov[:] = np.diag(state.stationary)
        if wrist.heading_rad is not None:
            state.z_cov[HEADING, HEADING] = wrist.heading_rad**2


def _capacity(markers: int) -> int:
    """Round a count of markers up, so that kernels are compiled once for most rigs."""
    return max(-(-markers // KERNEL.markers), 1) * KERNEL.markers


def count_fingers(counts: Counter[str], event: str, fingers: Bool) -> None:
    """Count an event of some fingers (5,)."""
    counts.update(f"{event}.{FINGERS[f]}" for f in np.flatnonzero(fingers))


class CycleReader:
    """Converts cycles to rows; counts by finger `outside`, `tip_outside`, `no_plane`."""

    def __init__(self, setup: WristSetup, counts: Counter[str]) -> None:
        self._setup, self._counts = setup, counts
        self._cubic = CubicLaw(setup) if setup.cubic else None

    def read(self, message: WristDetections, t_ns: int) -> tuple[WristRows, Float]:
        """Return a strobe cycle's rows, laser points (5, 3) [m], camera frame; NaN: none."""
        setup, solver_mode = self._setup, self._setup.solver_mode
        uv = np.concatenate([message.laser_uv, message.tip_uv])
        self._reject("outside", uv[:5], message.laser_sigma_px)
        self._reject("tip_outside", uv[5:], message.tip_sigma_px)
        xy1 = np.ones((10, 3))
        xy1[:, :2] = setup.optics.undistort(uv)
        away = setup.offset_m / (xy1[:5] @ setup.normal)
        no_plane = np.isfinite(uv[:5, 0]) & ~(away > 0.0)
        away[no_plane] = nan
        count_fingers(self._counts, "no_plane", no_plane)
        points_m = xy1[:5] * away[:, None]
        laser, tip = xy1[:5, :2].copy(), xy1[5:, :2].copy()
        if solver_mode == "fk":
            tip[:] = nan
        elif solver_mode == "ik":
            alone = ~(np.isfinite(laser[:, 0]) & np.isfinite(tip[:, 0]))
            laser[alone], tip[alone] = nan, nan
        law = np.full(5, nan)
        if self._cubic is not None:
            law = np.where(np.isnan(tip[:, 0]), self._cubic(points_m), nan)
        late_s = 1e-9 * (message.t_ns + setup.late_ns - t_ns)
        tips = tip, message.tip_sigma_px, message.tip_depth
        times = late_s, late_s + setup.frame_s
        return WristRows(laser, message.laser_sigma_px, message.laser_px, *tips, *times, law), points_m

    def _reject(self, event: str, uv: Float, sigma_px: Float) -> None:
        """Write NaN to points (5, 2) outside the picture or anywhere in it; count."""
        outside = np.isfinite(uv[:, 0]) & ~in_image(self._setup, uv, sigma_px)
        uv[outside] = nan
        count_fingers(self._counts, event, outside)
