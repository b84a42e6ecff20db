"""Compiled steps of an epoch.

They work on the tables, the state and the scratch arrays of one hand.
"""

from collections.abc import Sequence

import numpy as np

from common.arrays import Bool, Float
from common.geometry.camera_model import CameraModel
from common.hand.model import HandJoints, HandModel
from common.kernels import bound
from common.messages.records import boxed, fields
from master.estimator.cameras import CameraArrays
from master.estimator.epoch import Epoch
from master.estimator.extras import stationary_of
from master.estimator.hand_tables import HandTables, Mounts
from master.estimator.hypotheses import Blank
from master.estimator.kinematics import Scratch, pose
from master.estimator.observation_sources import count_rows
from master.estimator.parameters import HandParameters
from master.estimator.priors import PosturePrior
from master.estimator.problem import Rig
from master.estimator.residuals import Observations, observe_points, observe_rays
from master.estimator.settings import Settings
from master.estimator.state import HandState
from master.estimator.update import Estimate, fit_epoch, predict_epoch, take_over_epoch
from master.estimator.workspace import Model, Workspace
from master.estimator.wrist_device import EXTRAS, HEADING, NO_EXTRAS, Device, observe_wrist
from master.estimator.wrist_model import WristModel
from master.estimator.wrist_update import prepare_epoch

_STIFF_RAD = np.radians(1.0)  # of fingers that are taken to bend as their PIP does
_EYE, _AT_ORIGIN = np.eye(3), np.eye(4)


class EpochSteps:
    """Holds the state of one hand, and what is worked on at an epoch.

    Attributes:
        state: All that is remembered of the hand; `now`: its fields.
        at: Task, epoch prior, what is found, and scratch: fields of `Workspace`.
        observed: Rows of the markers.
        placed: (M,) of which of the hand's markers the places are known at the epoch.
        on_hand: (M,) the hand's markers among those of the rig.
        finger: (M,) the finger that carries each; -1: the palm.
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
        """Lay out the tables, and compile.

        Arguments as of `Estimator`; `posture_prior`: any of those used.
        """
        self._settings, mounts, count = settings, Mounts.of(model, hand_markers), len(hand_markers)
        self.on_hand = np.array([markers.index(name) for name in hand_markers], np.int64)
        self.finger = mounts.finger
        extras, device = (NO_EXTRAS, Device.none()) if wrist is None else (EXTRAS, wrist.device)
        self._rig = Rig(HandTables.of(model, parameters), mounts, CameraArrays.of(cameras), device)
        n = len(parameters.free)
        self.observed = observed = Observations.empty(len(cameras), count)
        self.triangulated: Bool = np.zeros(count, np.bool_)
        self._blank = Blank.of(n, extras, len(cameras), count)
        # Records are used by their fields here, and handed to kernels in the arrays that they lie in.
        self.state = state = HandState.unknown(n, extras)
        space = Workspace.empty(n, extras, _capacity(count))
        self.now, self.at = fields(state), fields(space)
        self._state, self._space, self._work = boxed(state), boxed(space), boxed(Scratch.empty())
        self._ground, self._lines_of_sight = (
            self._space["ground"],
            self._space["epoch_prior"]["lines_of_sight"],
        )
        hand, device = boxed(self._rig.hand), boxed(device)
        self._model = Model(hand, boxed(settings.record()), mounts, self._rig.cameras, device)
        self.at.scratch.search.wrist_share[0] = settings.wrist_share
        self.at.epoch_prior.z_info[0, 0] = 1.0  # of a rig without wrist device: one extra that means nothing
        if wrist is not None:
            self._lay_out(wrist)
        nothing, own = np.full((len(cameras), len(markers), 2), np.nan), np.zeros((len(markers), 3, 3))
        scratch, none = (
            (np.empty((26, 3)), np.empty((26, 3, 3)), np.empty((count, 3))),
            np.full((5, 2), np.nan),
        )
        each = none[:, 0].copy()
        self._rays = bound(observe_rays, nothing, nothing[..., 0].copy(), own, self.on_hand, observed)
        self._points = bound(observe_points, scratch[2], own[self.on_hand], 0.0, observed)
        self._count = bound(count_rows, mounts, observed, self._ground)
        self._cycle = bound(
            observe_wrist, device, none, each, each, none, each, each, 0.0, 0.0, 0.0, self._lines_of_sight
        )
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
        T_whole = np.ascontiguousarray(T)
        self._pose(
            self._model.hand, self._model.mounts, T_whole, angles, self._work, position, rotation, places
        )
        return HandJoints(position, rotation, T), places

    def observe(self, at: Epoch, *, continuous: bool) -> None:
        """Write the rows of an epoch, and count them."""
        task, lines_of_sight = self.at.task, self.at.epoch_prior.lines_of_sight
        task.t_ns[0], task.second_order[0], task.continuous[0] = at.t_ns, at.second_order, continuous
        task.process_noise_rad2[0] = 0.0 if at.orientation is None else at.orientation.process_noise_rad2
        if at.wrist is None:
            lines_of_sight.rows[0] = 0.0
            lines_of_sight.lit[:] = lines_of_sight.shown[:] = 0.0
        else:
            self.at.prior.law[:] = at.wrist.law
            self._cycle(
                self._model.device,
                at.wrist.laser,
                at.wrist.laser_sigma_px,
                at.wrist.laser_px,
                at.wrist.tip,
                at.wrist.tip_sigma_px,
                at.wrist.tip_depth,
                self._settings.light_rad,
                at.wrist.laser_s,
                at.wrist.tip_s,
                self._lines_of_sight,
            )
        if at.uv is None and at.cov_m2 is None:
            self.observed.seen[:] = False
        elif at.cov_m2 is not None:
            bones_m2 = self._settings.bones_m**2
            points, cov = at.points_m[self.on_hand], at.cov_m2[self.on_hand]
            self._points(points, cov, bones_m2, self.observed)
        else:
            assert at.uv is not None
            assert at.variance_px2 is not None
            assert at.own_m2 is not None
            own = at.own_m2 + self._settings.bones_m**2 * _EYE
            uv, variance = np.ascontiguousarray(at.uv), np.ascontiguousarray(at.variance_px2)
            self._rays(uv, variance, own, self.on_hand, self.observed)
        measured = at.cov_m2 is not None
        self.triangulated = (
            self.observed.triangulated if measured else np.isfinite(at.points_m[self.on_hand].sum(axis=1))
        )
        self._count(self._model.mounts, self.observed, self._ground)

    def prepare(self) -> None:
        """Predict the extra unknowns and search the finger minima.

        The search is along the angles of the fingers that a wrist device sees.
        """
        self._prepare(self._model, self._state, self._space)

    def set_priors(self, at: Epoch, *, known: bool) -> None:
        """Write the priors other than the past and the posture prior.

        `known`: whether the past is still informative.
        """
        epoch_prior, ground, orientation = self.at.epoch_prior, self.at.ground, at.orientation
        epoch_prior.back_normal[:] = at.back_normal
        epoch_prior.back_normal_w2[0] = self._settings.back_normal_rad**-2.0 if ground.back[0] else 0.0
        epoch_prior.depth_w2[0] = 0.0
        if known and ground.most[0] == 1:
            camera_centre = self._rig.cameras.centre[(self.observed.weight > 0.0).sum(axis=1).argmax()]
            line_of_sight = self.now.palm[:3, 3] - camera_centre
            epoch_prior.line_of_sight[:] = line_of_sight / np.sqrt(line_of_sight @ line_of_sight)
            epoch_prior.depth_w2[0] = self._settings.held_depth_m**-2.0
        epoch_prior.oriented[0] = orientation is not None
        if orientation is not None:
            epoch_prior.forearm[:3, :3], epoch_prior.orientation_info[:] = (
                orientation.rotation,
                orientation.information,
            )
            epoch_prior.on_forearm[0] = orientation.axes is not None
            epoch_prior.axes[:] = 0.0 if orientation.axes is None else orientation.axes
        epoch_prior.place_w2[0] = 0.0
        if at.place is not None:
            stands_m = 1e-4  # of a palm before the wrist device alone, whose frame is the rig's
            epoch_prior.place[:], epoch_prior.place_w2[0] = at.place, stands_m**-2.0

    def predict(self) -> float:
        """Write where the state has the hand; as `predict_epoch`."""
        return self._predict(self._model, self._state, self.observed, self._space)

    def fit(self, posture_prior: PosturePrior, *, coarse: bool = False) -> float:
        """Fit what is measured; return chi square, or the cost of a rough search."""
        self.at.task.coarse[0] = coarse
        return self._fit(self._model, posture_prior, self.observed, self._blank, self._space)

    def take_over(self, *, goes_on: bool) -> Estimate:
        """Write the solution into the state and return the estimate.

        `goes_on`: the hand is that of the epoch before.
        """
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

        They must not lie in one line, unless that line runs across `back_normal`.

        What faces the cameras turns the hand about a line of markers, but not about one that points at them. With an
        orientation that is known any one marker is enough.
        """
        if at.place is not None:
            return True
        points = at.points_m[self.on_hand][self.triangulated]
        if at.orientation is not None and at.orientation.sure:
            return len(points) > 0
        if len(points) < 2:
            return False
        off = points - points.mean(axis=0)
        spread_m = 5e-3  # markers nearer than this to one line do not turn a hand about it
        if len(points) > 2:  # plainly not in one line, without what a decomposition takes
            length2 = np.vecdot(off, off)
            along, longest2 = off @ off[length2.argmax()], float(length2.max())
            if longest2 > 0.0 and float((length2 - along * along / longest2).max()) > (4.0 * spread_m) ** 2:
                return True
        _, extent, axes = np.linalg.svd(off)
        if len(points) > 2 and extent[1] > spread_m:
            return True
        back = self.at.ground.back[0]
        length_m = 20e-3  # a line shorter than this has no direction
        across = 0.9  # cosine to the sight, at most
        return bool(back and extent[0] > length_m and abs(axes[0] @ at.back_normal) < across)

    def has_outlier(self) -> bool:
        """Return whether a marker is too far from what was found."""
        marker_chi2 = self.at.found.marker_chi2[: len(self.on_hand)]
        return bool((marker_chi2 > self._settings.marker_gate).any())

    def _lay_out(self, wrist: WristModel) -> None:
        """Write the finger priors before a wrist device, and those of the extras.

        The extras are what the device leaves open.
        """
        prior, state, s = self.at.prior, self.now, self._settings
        prior.base_rad[:], prior.per_pip[:], prior.frame[:] = wrist.base_rad, wrist.per_pip, wrist.frame
        prior.abduction[:], prior.flexion[:] = s.abduction_rad, s.coupled_rad
        prior.abduction[0] = prior.flexion[0] = 0.5 * s.thumb_rad
        if wrist.natural_only:
            prior.natural_only[0], prior.flexion[:] = 1.0, _STIFF_RAD
        state.stationary[:] = stationary_of(s, loose=wrist.loose, tilt_rad=wrist.tilt_rad)
        state.z_cov[:] = np.diag(state.stationary)
        if wrist.heading_rad is not None:
            state.z_cov[HEADING, HEADING] = wrist.heading_rad**2


def _capacity(markers: int) -> int:
    """Round a count of markers up, so that kernels are compiled once for most rigs."""
    step = 16
    return max(-(-markers // step), 1) * step
