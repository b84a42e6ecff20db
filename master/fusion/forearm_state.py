"""Tilt, heading and the wrist's bend as one Gaussian: how it moves by itself, and what a palm that was seen tells.

With the forearm in the IMU's world the palm lies in the rig

    R_rig_palm = R_rig_world exp(tilt) R_z(heading) R_world_forearm R_forearm_palm(bend)

which has three numbers where the state has five: heading and bend are not told apart where the bend's axes are upright,
except that the heading is slow, and the bend small, in the palm's axes and quick. So all are estimated together, and
the covariance keeps what one has to do with the other. By itself

- tilt (2), what the IMU has the vertical off by, stays for seconds;
- heading walks as far as it is told to;
- bend (2) is a habit, a posture that somebody keeps, and motion about it, with its rate: a Gauss-Markov process of
  second order (Matern 3/2), stepped exactly (Hartikainen, Saerkkae 2010, "Kalman filtering and smoothing solutions to
  temporal Gaussian process regression models"). Wrists at work flex by a median of 1.4...54 deg/s about a median
  posture of -30...3 deg (43 types of work; Hansson et al. 2009, Int. J. Ind. Ergonomics 39, 221; ours: 20 deg/s); most
  of what hands do daily takes 5 deg of flexion, 30 of extension, 10 and 15 of deviation (Palmer et al. 1985, J. Hand
  Surg. 10A, 39);
- error of what is told of turn and bend (5), in units of the covariance that this comes with, palm axes. On rendered
  hands it hardly changes from frame to frame, but within a second or two, as shape and hidden fingers do. More than
  that is taken as new in each frame, so that plain noise does not surprise either.
"""

from dataclasses import dataclass
from math import atan2, exp, pi, radians, remainder, sqrt
from typing import NamedTuple

import numpy as np

from common.arrays import Float
from common.geometry import axis_rotation, matrix_to_rotation_vector, rotation_vector_to_matrix
from common.wrist_bend import forearm_palm
from master.fusion.told_forearm import ToldForearm

ANYWHERE_RAD = pi / sqrt(3.0)  # standard deviation of a uniform circle
HEADING = 2
_SIZE = 14
_TILT, _HABIT, _MOTION, _RATE, _ERROR = slice(2), slice(3, 5), slice(5, 7), slice(7, 9), slice(9, 14)
_ANGLES = slice(7)
_TILT_S = 5.0
_HABIT_RAD, _HABIT_S = np.radians([10.0, 7.0]), 20.0  # flexion, deviation
_MOTION_RAD, _PACE_1_S = np.radians([10.0, 9.0]), 3.0
FRESH, STAYING = 0.4, np.array([0.8, 0.8, 0.8, 2.5, 2.5])  # of what is told: new in each frame, and staying
_STAYS_S = 1.5
_BEYOND = (0.0, 10.83, 13.82, 16.27, 18.47, 20.52)  # chi square of so many degrees, 99.9 %
TELLS_RAD = radians(15.0)  # what is less sure does not teach
_FLICK_RAD_S, _FLICK_RAD = 5.0, radians(20.0)  # faster than usual, but wrists can; and how far that may go
_STEPS, _NEAR_RAD = 4, 0.02
_EYE, _UP = np.eye(3), np.array([0.0, 0.0, 1.0])
_BEND = np.zeros((2, _SIZE))  # habit and motion
_BEND[:, _HABIT] = _BEND[:, _MOTION] = np.eye(2)


@dataclass(frozen=True, slots=True, eq=False)
class ForearmState:
    """A Gaussian over tilt, heading, habit, motion, its rate and the error of what is told.

    Attributes:
        rig_world: (3, 3) the IMU's world -> rig frame, right up to heading and tilt.
        usual: (14,) variances that doubt grows to; that of the heading, 0, is not one of them.
        mean: (14,) [rad], [rad/s], [1].
        cov: (14, 14).
    """

    rig_world: Float
    usual: Float
    mean: Float
    cov: Float

    @classmethod
    def of(cls, rig_world: Float, tilt_rad: float, heading_rad: float) -> "ForearmState":
        """Before anything was seen: standard deviations of the tilt, per axis, and of the heading."""
        usual = np.zeros(_SIZE)
        usual[_TILT], usual[_ERROR] = tilt_rad**2, 1.0
        usual[_HABIT], usual[_MOTION] = _HABIT_RAD**2, _MOTION_RAD**2
        usual[_RATE] = (_PACE_1_S * _MOTION_RAD) ** 2
        cov = np.diag(usual)
        cov[HEADING, HEADING] = heading_rad**2
        return cls(rig_world, usual, np.zeros(_SIZE), cov)

    @property
    def bend_rad(self) -> Float:
        """(2,) flexion and deviation."""
        return _BEND @ self.mean

    @property
    def bend_cov(self) -> Float:
        """Its covariance (2, 2) [rad^2]."""
        return _BEND @ self.cov @ _BEND.T

    @property
    def with_bend(self) -> Float:
        """Covariance (14, 2) of the state with flexion and deviation."""
        return self.cov @ _BEND.T

    @property
    def heading_sigma_rad(self) -> float:
        """Standard deviation of the heading."""
        return sqrt(self.cov[HEADING, HEADING])

    def palm(self, world_forearm: Float) -> tuple[Float, Float]:
        """The palm (3, 3) in the rig, and the derivative (3, 14) of a small turn of it, in rig axes, by the state."""
        bend = self.bend_rad
        rig_tilted = self.rig_world @ rotation_vector_to_matrix(np.array([*self.mean[_TILT], 0.0]))
        rig_forearm = rig_tilted @ axis_rotation(2, self.mean[HEADING]) @ world_forearm
        slope = rig_forearm @ bend_axes(bend) @ _BEND
        slope[:, _TILT], slope[:, HEADING] = self.rig_world[:, :2], rig_tilted @ _UP
        return rig_forearm @ forearm_palm(bend), slope

    def after(self, step_s: float, walked_rad2: float) -> "ForearmState":
        """What it is `step_s` later, or before if negative, when the heading has walked by so much."""
        moves = _moves(step_s)
        cov = np.diag(self.usual) + moves @ (self.cov - np.diag(self.usual)) @ moves.T
        cov[HEADING, HEADING] += walked_rad2
        return ForearmState(self.rig_world, self.usual, moves @ self.mean, cov)

    def lost(self) -> "ForearmState":
        """The same with a heading that may be anywhere."""
        cov = self.cov.copy()
        cov[HEADING] = cov[:, HEADING] = 0.0
        cov[HEADING, HEADING] = ANYWHERE_RAD**2
        return ForearmState(self.rig_world, self.usual, self.mean, cov)

    def anew(self) -> "ForearmState":
        """As before anything was seen, with a heading that may be anywhere."""
        return ForearmState(self.rig_world, self.usual, np.zeros(_SIZE), np.diag(self.usual)).lost()

    def towards(self, R_rig_palm: Float, world_forearm: Float) -> "ForearmState":
        """The same with the heading that comes nearest to a palm, as little as that may say."""
        tilted = self.rig_world @ rotation_vector_to_matrix(np.array([*self.mean[_TILT], 0.0]))
        turn = tilted.T @ R_rig_palm @ (world_forearm @ forearm_palm(self.bend_rad)).T
        mean = self.mean.copy()
        mean[HEADING] = atan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
        return ForearmState(self.rig_world, self.usual, mean, self.cov)

    def told(self, seen: "SeenForearm", misfit: "Misfit") -> "ForearmState":
        """What an instant, and its misfit to this state, leave of it: an iterated Kalman update (Bell, Cathey 1993)."""
        before = np.zeros(_SIZE)
        off, gain = self._corrected(seen, misfit, before)
        for _ in range(_STEPS):
            if np.abs(off - before)[_ANGLES].max() < _NEAR_RAD:
                break
            before = off
            misfit = seen.against(ForearmState(self.rig_world, self.usual, self.mean + off, self.cov))
            off, gain = self._corrected(seen, misfit, before)
        left = np.eye(_SIZE) - gain @ misfit.slope
        cov = left @ self.cov @ left.T + FRESH * (gain @ gain.T)
        mean = self.mean + off
        mean[HEADING] = remainder(mean[HEADING], 2.0 * pi)
        return ForearmState(self.rig_world, self.usual, mean, 0.5 * (cov + cov.T))

    def _corrected(self, seen: "SeenForearm", misfit: "Misfit", off: Float) -> tuple[Float, Float]:
        """The correction (14,) of the mean and Kalman's gain (14, K), by a misfit that is linear about mean + `off`."""
        crossed = misfit.slope @ self.cov
        gain = np.linalg.solve(crossed @ misfit.slope.T + FRESH * np.eye(len(crossed)), crossed).T.astype(
            np.float64, copy=False
        )
        return gain @ (misfit.off + misfit.slope @ off), gain

    def flicked(self, step_s: float) -> "ForearmState":
        """The same after a motion of the wrist that is quicker than usual."""
        cov = self.cov.copy()
        bent = min(_FLICK_RAD_S * abs(step_s), _FLICK_RAD) ** 2
        cov[_MOTION, _MOTION] += bent * np.eye(2)
        return ForearmState(self.rig_world, self.usual, self.mean, cov)


class Misfit(NamedTuple):
    """What is told less what a state has, in K directions (K,), each in its sigma; its derivative (K, 14)."""

    off: Float
    slope: Float


@dataclass(frozen=True, slots=True, eq=False)
class SeenForearm:
    """What an instant tells of palm and bend, and the forearm by the IMU then.

    Attributes:
        told: That.
        world_forearm: (3, 3) forearm axes -> the IMU's world.
        directions: (K, 5) those of turn, palm axes, and bend that it tells; orthonormal.
        per_sigma: (K, 5) the same for a turn in rig axes, by their standard deviations [1/rad].
        pull: (K,) how far it tells them to be from where `told` counts, by their standard deviations.
    """

    told: ToldForearm
    world_forearm: Float
    directions: Float
    per_sigma: Float
    pull: Float

    @classmethod
    def of(cls, told: ToldForearm, world_forearm: Float) -> "SeenForearm":
        """Find the directions in which something is told: none may be."""
        to_rig = np.eye(5)
        to_rig[:3, :3] = told.R_rig_palm
        values, axes = np.linalg.eigh(to_rig.T @ told.information @ to_rig)
        told_well = values > TELLS_RAD**-2.0
        directions, sigma = axes.T[told_well], 1.0 / np.sqrt(values[told_well])
        in_rig = directions @ to_rig.T
        return cls(told, world_forearm, directions, in_rig / sigma[:, None], sigma * (in_rig @ told.pull))

    def against(self, state: ForearmState) -> Misfit:
        """What it lacks to be as a state has it."""
        palm, turn = state.palm(self.world_forearm)
        off = np.concatenate(
            [matrix_to_rotation_vector(self.told.R_rig_palm @ palm.T), self.told.bend_rad - state.bend_rad]
        )
        slope = self.per_sigma @ np.concatenate([turn, _BEND])
        slope[:, _ERROR] = self.directions * np.sqrt(STAYING)
        return Misfit(self.pull + self.per_sigma @ off - slope[:, _ERROR] @ state.mean[_ERROR], slope)

    def likely(self, state: ForearmState, misfit: Misfit) -> tuple[bool, float]:
        """Whether a state makes this no outlier, and the logarithm of its density, less a constant."""
        count = len(misfit.off)
        cov = misfit.slope @ state.cov @ misfit.slope.T + FRESH * np.eye(count)
        square = float(misfit.off @ np.linalg.solve(cov, misfit.off))
        return square < _BEYOND[count], -0.5 * (square + float(np.linalg.slogdet(cov)[1]))


def bend_axes(bend_rad: Float) -> Float:
    """The axes (3, 2) of flexion and deviation in the forearm, of a bend (2,) [rad]."""
    deviation = axis_rotation(1, bend_rad[1])
    return np.stack([deviation[:, 0], _EYE[1]], axis=1)


def _moves(step_s: float) -> Float:
    """How the mean (14,) goes on in a step (14, 14); a step back is one of the same process, which has no direction."""
    away = abs(step_s)
    moves = np.eye(_SIZE)
    for part, lasts_s in ((_TILT, _TILT_S), (_HABIT, _HABIT_S), (_ERROR, _STAYS_S)):
        moves[part, part] *= exp(-away / lasts_s)
    paced, decay = _PACE_1_S * away, exp(-_PACE_1_S * away)
    two = np.eye(2)
    moves[_MOTION, _MOTION], moves[_MOTION, _RATE] = (1.0 + paced) * decay * two, step_s * decay * two
    moves[_RATE, _MOTION] = -(_PACE_1_S**2) * step_s * decay * two
    moves[_RATE, _RATE] = (1.0 - paced) * decay * two
    return moves
