"""The most probable mounting is the solution of one least-squares problem.

Unknown in each epoch is the hand, palm and fingers, as markers and the widest priors have it
(`normal.Hands`); all epochs share the mounting (`unknown.Unknown`). Four kinds of residuals:

- **markers**, where they were at that epoch of the rig's clock;
- **laser points and tips**, of the palm as it lies before the camera. Camera and IMU are one body, so that is

      R_camera_palm = R_camera_imu (R_rig_world R_world_imu)' R_rig_palm

  however the wrist is bent, and its joint stays where it is;
- **the wrist**, which bends and does not twist: R_forearm_palm = R_forearm_imu (R_rig_world R_world_imu)'
  R_rig_palm has two angles and no third (`common.hand.wrist`);
- **its zero**, which no sensor knows: a wrist that bends as far one way as the other is straight in the mean.

The hand is an epoch's own, the 34 unknowns of the mounting are shared (`master.calibrate.adjust`); outliers
are weighed down (Cauchy). Errors of skin and tips last as long as a bend does, so all epochs of a second
together count as a few. A part of the motion is fitted from several guesses, then all of it from the best.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from common.arrays import Float
from common.geometry.transforms import rotation_vector_to_matrix, skew
from common.hand.model import Chains, HandModel
from common.hand.wrist import wrist_angles_of
from master.calibrate.adjust import Normal, cauchy, minimise, stepped_poses
from master.calibrate.extrinsics.tracks import (
    FINGERS,
    SEEN,
    HandTrack,
    ImuOrientations,
    ImuTrack,
    LinesOfSight,
    Markers,
)
from master.calibrate.extrinsics.unknown import (
    CAMERA_IMU,
    CAMERA_LATE,
    FOREARM_IMU,
    GAIN,
    IMU_LATE,
    OUTLIER_SIGMAS,
    REACH,
    RIG_WORLD,
    SHIFT,
    THICK,
    UNKNOWN,
    ZERO,
    Fit,
    StrobeCycles,
    Unknown,
    prior_sigma,
)
from master.calibrate.observations import thinned
from master.estimator.kinematics import BodyPoints
from master.estimator.parameters import HandParameters
from master.estimator.priors import PosturePrior, posture_prior_of


@dataclass(frozen=True, slots=True, eq=False)
class Hands:
    """Hand poses of all epochs: T_rig_palm (T, 4, 4), free angles x (T, n) [rad]."""

    T_rig_palm: Float
    x: Float

    def retracted(self, step: Float) -> "Hands":
        """After steps (T, 6 + n): rotation [rad], shift [m], both rig axes; angles [rad]."""
        return Hands(stepped_poses(self.T_rig_palm, step[:, :6]), self.x + step[:, 6:])


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
        normal.own[0, :, 6:, 6:] += share * prior.normal

    def _chains(self, hands: Hands) -> Chains:
        return self.model.chains(self.markers.parameters.angles(hands.x))

    def _arm(self, hands: Hands, local: Float) -> Float:
        """From the wrists to markers (T, M, 3) [m], palm axes -> rig axes."""
        return local @ np.swapaxes(hands.T_rig_palm[:, :3, :3], 1, 2)


def wrist_rotation_angles(R_forearm_palm: Float) -> Float:
    """Flexion, deviation and twist (..., 3) [rad] of rotations (..., 3, 3)."""
    return np.concatenate([wrist_angles_of(R_forearm_palm), R_forearm_palm[..., 1, :1]], axis=-1)


def bends_by_rotation(R_forearm_palm: Float) -> Float:
    """Derivatives (T, 3, 3) of `wrist_rotation_angles` by a rotation, forearm axes."""
    here, out = wrist_rotation_angles(R_forearm_palm), np.empty((len(R_forearm_palm), 3, 3))
    for k in range(3):
        difference_step = 1e-5
        rotated = rotation_vector_to_matrix(difference_step * np.eye(3)[k]) @ R_forearm_palm
        out[..., k] = (wrist_rotation_angles(rotated) - here) / difference_step
    return out


_TWIST_RAD = np.radians(1.0)
_WRIST_RAD = np.radians(15.0)
_EYE = np.eye(3)


@dataclass(frozen=True, slots=True, eq=False)
class _Output:
    """Output of the tracks for clock errors near `about`: markers and rotations."""

    about: Unknown
    markers: Markers
    orientations: ImuOrientations
    tip_px: Float


class Problem:
    """Residuals and steps of the mounting problem.

    State: the markers and orientations of the tracks at the last estimate of the clocks.
    """

    def __init__(
        self,
        lines_of_sight: LinesOfSight,
        model: HandModel,
        names: tuple[str, ...],
        hand: HandTrack,
        imu: ImuTrack,
        cycles: StrobeCycles,
        px_per_m: float,
        first: Unknown,
    ) -> None:
        self._lines_of_sight, self._hand, self._imu = lines_of_sight, hand, imu
        self._cycles, self._first = cycles, first
        model = replace(model, tolerance_rad=np.zeros((5, 4)))  # nothing here weighs what is beyond limits
        self._model, self._parameters = model, HandParameters.of(model)
        count = len(cycles.t_s)
        self._hands = HandProblem(
            model,
            BodyPoints.markers(model, self._parameters, names),
            _loosest(posture_prior_of(model, self._parameters)),
            np.zeros((count, len(names), 3)),
            np.zeros((count, len(names), 3, 3)),
        )
        # skin of another shape than the cones; a tip is seen anywhere on its pulp
        surface_m, tip_m = 8e-4, 1e-3
        tip_px = np.hypot(np.nan_to_num(cycles.tip_sigma_px), tip_m * px_per_m)
        laser_m = np.hypot(np.nan_to_num(cycles.laser_sigma_m), surface_m)
        self.sigma = np.concatenate([laser_m, np.repeat(tip_px[..., None], 2, axis=-1)], axis=-1)
        last_s, first_s = cycles.t_s[-1], cycles.t_s[0]
        self._share = min(4.0 * (last_s - first_s) / count, 1.0)  # independent epochs
        self._wrist_sigma = np.array([_WRIST_RAD, _WRIST_RAD, _TWIST_RAD])
        self._prior_sigma = prior_sigma()

    def followed(self, unknown: Unknown, rounds: Sequence[int]) -> tuple[Unknown, Hands, int]:
        """Minimise from a guess, round by round; also the number of steps."""
        hands, steps = self.guessed(unknown), 0
        for most in rounds:
            self.update_observations(unknown, hands)
            unknown, hands, taken = self.solved(unknown, hands, most)
            steps += taken
        return unknown, hands, steps

    def guessed(self, unknown: Unknown) -> Hands:
        """The hands as the markers alone have them."""
        near = self._hand.nearest(self._cycles.t_s + unknown.camera_late_s)
        x = np.array([self._parameters.of_angles(angles) for angles in self._hand.angles_rad[near]])
        return Hands(self._hand.T_rig_palm[near], x)

    def update_observations(self, unknown: Unknown, hands: Hands) -> None:
        """Sample the tracks at the estimated clock offsets and gyroscope errors."""
        self._mended, self._mended_of = self._imu.mended(unknown.gyro), unknown.gyro
        at = self._cycles.t_s + unknown.camera_late_s
        markers = self._hand.markers(at)
        orientations = self._mended.at(at - unknown.imu_late_s)
        self._known = orientations.known & (markers.seen.sum(axis=1) > 0)
        seen = markers.seen & self._known[:, None]
        cap_m = 5e-4  # where caps sit, beyond the noise of the cameras
        cov = np.where(seen[..., None, None], markers.cov_m2, 0.0) + cap_m**2 * _EYE
        whiten = np.linalg.inv(np.linalg.cholesky(cov)) * seen[..., None, None]
        place = self._hands.place(hands)
        far = (whiten @ (place - np.nan_to_num(markers.points_m))[..., None])[..., 0]
        whiten = whiten * ((1.0 + np.vecdot(far, far) / OUTLIER_SIGMAS**2) ** -0.5)[..., None, None]
        observed = [
            np.nan_to_num(part) for part in (markers.points_m, markers.speed_m_s, markers.acceleration_m_s2)
        ]
        self._observed = _Output(
            unknown,
            Markers(observed[0], observed[1], observed[2], markers.cov_m2),
            replace(
                orientations, R_world_imu=np.where(self._known[:, None, None], orientations.R_world_imu, _EYE)
            ),
            self._tips_with_the_laser(unknown, hands),
        )
        self._hands = replace(self._hands, whiten=whiten)
        data = np.concatenate([self._cycles.laser_m, self._observed.tip_px], axis=-1)
        self._data = np.where(self._known[:, None, None], data, np.nan)

    def _tips_with_the_laser(self, unknown: Unknown, hands: Hands) -> Float:
        """Tips (T, 4, 2) [px] at the laser's time, moved back by the hand's own motion."""
        late_s, t_s = self._cycles.tip_late_s, self._cycles.t_s
        at = t_s + unknown.camera_late_s
        orientations = self._mended.at(at - unknown.imu_late_s)
        known = replace(orientations, R_world_imu=np.nan_to_num(orientations.R_world_imu))
        R = self._camera_rig(unknown, known)
        angles = self._parameters.angles(hands.x)
        seen = self._lines_of_sight(
            R @ hands.T_rig_palm[:, :3, :3], unknown.shift_m, angles, unknown.thick, unknown.reach_m
        )
        speed = np.gradient(seen[..., 2:], t_s, axis=0)
        jump = np.diff(t_s, prepend=t_s[0]) > 0.2
        speed[jump | np.r_[jump[1:], False] | ~orientations.known] = 0.0
        return self._cycles.tip_uv - late_s * np.nan_to_num(speed)

    def solved(self, unknown: Unknown, hands: Hands, rounds: int) -> tuple[Unknown, Hands, int]:
        """The least cost from a guess, and the number of steps."""
        found = minimise(self.equations, self._stepped, (unknown, hands), steps=rounds, gain=0.03)
        return *found.x, found.steps

    def result(self, unknown: Unknown, hands: Hands, steps: int) -> Fit:
        """The fit with its covariance and residuals."""
        covariance = self.equations((unknown, hands)).covariance()
        shown, wrist_angles = self._shown(unknown, hands)
        off = (self._data - shown) / self.sigma
        far = self._hands.place(hands) - self._here(unknown).points_m
        seen = self._hands.whiten[..., 0, 0] > 0.0
        marker_m = float(np.sqrt((far[seen] ** 2).sum(axis=-1).mean()))
        bends, twist = wrist_angles[:, :2], wrist_angles[:, 2]
        return Fit(unknown, covariance, bends, twist, off, self.sigma, shown, marker_m, steps)

    def _stepped(self, x: tuple[Unknown, Hands], step: Float, own: Float) -> tuple[Unknown, Hands]:
        unknown, hands = x
        after = hands.retracted(own)
        angles = np.minimum(np.maximum(after.x, self._parameters.low), self._parameters.high)
        return unknown.retracted(step), replace(after, x=angles)

    def _here(self, unknown: Unknown) -> Markers:
        """The markers when the frames were taken."""
        late_s, observed = unknown.camera_late_s - self._observed.about.camera_late_s, self._observed.markers
        speed = observed.speed_m_s + late_s * observed.acceleration_m_s2
        points = observed.points_m + late_s * (observed.speed_m_s + 0.5 * late_s * observed.acceleration_m_s2)
        return Markers(points, speed, observed.acceleration_m_s2, observed.cov_m2)

    def _orientations(self, unknown: Unknown) -> ImuOrientations:
        """The IMU when the frames were taken."""
        about, observed = self._observed.about, self._observed.orientations
        late_s = unknown.camera_late_s - unknown.imu_late_s - about.camera_late_s + about.imu_late_s
        return replace(
            observed,
            R_world_imu=observed.R_world_imu @ rotation_vector_to_matrix(late_s * observed.rate_rad_s),
        )

    def _rig_imu(self, unknown: Unknown, orientations: ImuOrientations) -> Float:
        """(T, 3, 3) IMU axes -> rig axes."""
        drift = rotation_vector_to_matrix(-(orientations.drift @ (unknown.gyro - self._mended_of)))
        return unknown.R_rig_world @ drift @ orientations.R_world_imu

    def _camera_rig(self, unknown: Unknown, orientations: ImuOrientations) -> Float:
        """(T, 3, 3) rig axes -> camera axes."""
        return unknown.R_camera_imu @ np.swapaxes(self._rig_imu(unknown, orientations), 1, 2)

    def _wrists(self, unknown: Unknown, hands: Hands, orientations: ImuOrientations) -> Float:
        """R_forearm_palm (T, 3, 3)."""
        palm = np.swapaxes(self._rig_imu(unknown, orientations), 1, 2) @ hands.T_rig_palm[:, :3, :3]
        return unknown.R_forearm_imu @ palm

    def _shown(self, unknown: Unknown, hands: Hands) -> tuple[Float, Float]:
        """Predicted observations (T, 4, SEEN), and angles of the wrist (T, 3) [rad]."""
        orientations = self._orientations(unknown)
        R = self._camera_rig(unknown, orientations) @ hands.T_rig_palm[:, :3, :3]
        angles = self._parameters.angles(hands.x)
        seen = self._lines_of_sight(R, unknown.shift_m, angles, unknown.thick, unknown.reach_m)
        return seen, wrist_rotation_angles(self._wrists(unknown, hands, orientations))

    def _off(self, shown: Float) -> Float:
        """Fitted minus seen (T, 4, SEEN) in standard deviations; 0: not seen.

        A finger that the laser misses is far.
        """
        off = (shown - self._data) / self.sigma
        missed = np.isnan(shown) & np.isfinite(self._data)
        farthest = 8.0  # of a finger that the laser should meet and does not
        return np.where(missed, farthest, np.nan_to_num(off))

    def equations(self, x: tuple[Unknown, Hands]) -> Normal:
        """Normal equations at a point."""
        unknown, hands = x
        orientations, here = self._orientations(unknown), self._here(unknown)
        normal = Normal(UNKNOWN, len(hands.x), 6 + hands.x.shape[1])
        markers = replace(self._hands, points_m=here.points_m)
        markers.add_to(normal, hands, here.speed_m_s, CAMERA_LATE, self._share)
        loss, share = cauchy(OUTLIER_SIGMAS), self._share
        sight, by_hand, by_shared = self._line_of_sight_rows(unknown, hands, orientations)
        normal.add(sight, by_shared, by_hand, loss=loss, group=2, share=share)
        wrist, by_hand, by_shared = self._wrist_rows(unknown, hands, orientations)
        normal.add(wrist, by_shared, by_hand, loss=loss, group=3, share=share)
        normal.add_prior(unknown.off(self._first), self._prior_sigma)
        low, high = self._parameters.low, self._parameters.high
        held = np.zeros(normal.own_gradient.shape, np.bool_)
        held[:, 6:] = np.where(normal.own_gradient[:, 6:] > 0.0, hands.x <= low, hands.x >= high)
        normal.hold(held)
        return normal

    def _line_of_sight_rows(
        self, unknown: Unknown, hands: Hands, orientations: ImuOrientations
    ) -> tuple[Float, Float, Float]:
        """Line-of-sight residuals (T, 16) and their derivatives.

        By own unknowns (T, 16, 6 + n) and by shared unknowns (T, 16, UNKNOWN).
        """
        camera_rig = self._camera_rig(unknown, orientations)
        R = camera_rig @ hands.T_rig_palm[:, :3, :3]
        angles = self._parameters.angles(hands.x)
        shown, by = self._lines_of_sight.derivatives(
            R, unknown.shift_m, angles, unknown.thick, unknown.reach_m
        )
        off = self._off(shown)
        observed = np.isfinite(self._data) & np.isfinite(shown)
        by = by * (observed / self.sigma)[..., None]
        count, n = len(hands.x), hands.x.shape[1]
        by_rotation = by[..., :3].reshape(count, -1, 3)
        own = np.zeros((count, 4 * SEEN, 6 + n))
        own[..., :3] = by_rotation @ camera_rig
        complete = self._parameters.complete.reshape(5, 4, n)[FINGERS]
        by_x = np.einsum("tfya,fan->tfyn", by[..., 6:10], complete)
        own[..., 6:] = self._parameters.by_parameters(by_x, hands.x).reshape(count, -1, n)
        shared = np.zeros((count, 4, SEEN, UNKNOWN))
        for f in range(4):
            shared[:, f, :, THICK.start + f] = by[:, f, :, 10]
            shared[:, f, :, REACH.start + f] = by[:, f, :, 11]
        shared = shared.reshape(count, -1, UNKNOWN)
        shared[..., CAMERA_IMU] = by_rotation
        shared[..., SHIFT] = by[..., 3:6].reshape(count, -1, 3)
        self._world_columns(shared, -by_rotation @ camera_rig, unknown, orientations)
        return off.reshape(count, -1), own, shared

    def _wrist_rows(
        self, unknown: Unknown, hands: Hands, orientations: ImuOrientations
    ) -> tuple[Float, Float, Float]:
        """As `_line_of_sight_rows`, of flexion, deviation and twist."""
        wrist = self._wrists(unknown, hands, orientations)
        weight = self._known[:, None] / self._wrist_sigma
        by_rotation = weight[..., None] * bends_by_rotation(wrist)
        forearm_rig = unknown.R_forearm_imu @ np.swapaxes(self._rig_imu(unknown, orientations), 1, 2)
        own = np.zeros((len(wrist), 3, 6 + hands.x.shape[1]))
        own[..., :3] = by_rotation @ forearm_rig
        shared = np.zeros((len(wrist), 3, UNKNOWN))
        shared[..., FOREARM_IMU] = by_rotation
        self._world_columns(shared, -by_rotation @ forearm_rig, unknown, orientations)
        return wrist_rotation_angles(wrist) * weight, own, shared

    def _world_columns(
        self, shared: Float, by_imu: Float, unknown: Unknown, orientations: ImuOrientations
    ) -> None:
        """Fill in derivatives by the IMU's world, its gyroscope's errors, and clocks.

        Into `shared` (T, R, UNKNOWN), from `by_imu` (T, R, 3) by a rotation of the IMU, rig axes.
        """
        shared[..., RIG_WORLD] = by_imu
        by_gyro = -by_imu @ (unknown.R_rig_world @ orientations.drift)
        shared[..., ZERO], shared[..., GAIN] = by_gyro[..., :3], by_gyro[..., 3:]
        rate = (self._rig_imu(unknown, orientations) @ orientations.rate_rad_s[..., None])[..., 0]
        later = (by_imu @ rate[..., None])[..., 0]
        shared[..., CAMERA_LATE], shared[..., IMU_LATE] = later, -later


def _loosest(posture_prior: PosturePrior) -> PosturePrior:
    """Priors of the free hand, the last hypothesis, with a part of the information."""
    prior_share = 1e-2  # of their information: what sensors measure is to count
    normal, pull, constant = (
        prior_share * part[-1:] for part in (posture_prior.normal, posture_prior.pull, posture_prior.constant)
    )
    return PosturePrior(normal, pull, constant, posture_prior.log_density[-1:])


_COARSE_ROUNDS = (4, 4, 4)  # steps of a first look
_ROUNDS = (5, 5, 8)  # steps from one linearisation of the tracks to the next


def fit_extrinsics(
    lines_of_sight: LinesOfSight,
    model: HandModel,
    names: tuple[str, ...],
    hand: HandTrack,
    imu: ImuTrack,
    cycles: StrobeCycles,
    px_per_m: float,
    firsts: Sequence[Unknown],
) -> Fit:
    """Fit the mounting to tracks of hand and IMU and to strobe cycles.

    `names` are the track's markers, in order; `px_per_m` is what a metre at the tips is in the image. Of the
    first guesses `firsts` one is right to some 15 degrees, 15 mm and 20 ms.
    """
    coarse = cycles.of(thinned(np.arange(len(cycles.t_s)), 40))
    best: tuple[float, Unknown] | None = None
    for first in firsts:
        problem = Problem(lines_of_sight, model, names, hand, imu, coarse, px_per_m, first)
        unknown, hands, _ = problem.followed(first, _COARSE_ROUNDS)
        cost = problem.equations((unknown, hands)).cost
        if best is None or cost < best[0]:
            best = cost, unknown
    first = firsts[0] if best is None else best[1]
    problem = Problem(lines_of_sight, model, names, hand, imu, cycles, px_per_m, first)
    return problem.result(*problem.followed(first, _ROUNDS))
