"""What other sensors than markers say of a hand: the palm's turn and the fingers' angles, in one covariance.

A device on the forearm tells how fingers are bent (its camera) and how the palm is turned (its IMU), and both through a
wrist that bends: if the bend is other than believed, the palm is turned and all fingers seem bent by it. So their
errors are no five or six of their own. Information adds up over the turn from the believed palm (3), the angles less
the believed ones (20) and the bend less the believed one (2):

    fingers: what sights tell of angles and bend       palm: the inverse of its covariance with the bend

and what is left when the bend is integrated out joins markers and habits in the same normal equations
(`master.estimator.solve`): no sensor is switched on or off, and a bend that all fingers suggest is none of theirs.

A sensor that errs once in a while (a false fingertip) must not win by being narrow. A finger whose angles by the fit
are farther from the believed ones than their information allows counts less, by (N + 4) / (N + chi square), the weight
of Student's t with N = 4 degrees of freedom (Lange, Little, Taylor 1989, "Robust statistical modeling using the t
distribution"). What puts a fingertip where its marker, seen by two cameras, is not, is not taken at all: it is another
thing, such as the edge of what the hand holds.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from common.arrays import Bool, Code, Float, Int
from common.geometry import matrix_to_rotation_vector
from common.hand_model import HandModel
from common.messages import Level
from master.estimator.attached import Attached
from master.estimator.epoch import Sensed
from master.estimator.parameters import HandParameters
from master.fusion.orientation import Orientation, turn_of_vector

_ANGLES, _TURN, _PIP = 4, 3, 2
_FREEDOM = 4.0
_SURPRISED = 9.5  # chi square of four numbers, 1 in 20: below it nothing is weighed down
_BEND = 2
_AXES_AT = np.array([0, 0, 1, 2])  # joint of the chain at which abduction, flexion, PIP, DIP turn
_ALL = _TURN + 5 * _ANGLES
_PALM_AND_BEND = np.array([0, 1, 2, _ALL, _ALL + 1])
_ELSEWHERE = 9.0  # three standard deviations, of all axes together
_MOST_RAD = np.radians(25.0)  # more doubt of one angle than that moves a tip on no straight line
_PALM_M = 8e-3  # about so well a palm is known from one moment to the next


@dataclass(frozen=True, slots=True, eq=False)
class SensedHand:
    """Palm and fingers at one instant as other sensors have them.

    Attributes:
        angles_rad: (5, 4); a finger of which nothing is known has NaN.
        weight: (5, 4, 4) [1/rad^2] what sights tell of the angles, the bend given; all three are 0 where nothing is
            known.
        with_bend: (5, 4, 2) [1/rad^2] of angles and bend together.
        of_bend: (5, 2, 2) [1/rad^2] of the bend, the angles given.
        told: (5,) fingers that are seen now, well enough to say how they are bent.
        level: (5,) `Level` codes: what they are told from.
        bend_cov_rad2: (2, 2) of the bend before these sights.
        palm: How the palm is turned, its covariance with what the bend is in it; None: not known.
        palm_bend_rad2: (3, 2) covariance of that turn, in rig axes, with the bend.
        information: (23, 23) [1/rad^2] of turn and angles.
    """

    angles_rad: Float
    weight: Float
    with_bend: Float
    of_bend: Float
    told: Bool
    level: Code
    bend_cov_rad2: Float
    palm: Orientation | None
    palm_bend_rad2: Float
    information: Float = field(init=False)

    def __post_init__(self) -> None:
        Q = np.zeros((_ALL + _BEND, _ALL + _BEND))
        for f in range(5):
            own = slice(_TURN + _ANGLES * f, _TURN + _ANGLES * (f + 1))
            Q[own, own], Q[own, _ALL:] = self.weight[f], self.with_bend[f]
            Q[_ALL:, own] = self.with_bend[f].T
        Q[_ALL:, _ALL:] = self.of_bend.sum(axis=0)
        if self.palm is None:
            Q[_ALL:, _ALL:] += np.linalg.inv(self.bend_cov_rad2)
        else:
            at = np.ix_(_PALM_AND_BEND, _PALM_AND_BEND)
            cov = np.block(
                [[self.palm.cov_rad2, self.palm_bend_rad2], [self.palm_bend_rad2.T, self.bend_cov_rad2]]
            )
            Q[at] += np.linalg.inv(cov)
        crossed = Q[:_ALL, _ALL:]
        left = Q[:_ALL, :_ALL] - crossed @ np.linalg.solve(Q[_ALL:, _ALL:], crossed.T)
        object.__setattr__(self, "information", np.asarray(left, np.float64))

    @property
    def known(self) -> Bool:
        """(5,) fingers of which something is said."""
        return np.isfinite(self.angles_rad[:, 0])

    @property
    def fingers(self) -> frozenset[int]:
        """Those that are told."""
        return frozenset(np.flatnonzero(self.told).tolist())

    @property
    def alone(self) -> Float:
        """(5, 4, 4) [1/rad^2] what is told of each finger's angles, whatever the bend is."""
        bend = self.of_bend + np.linalg.inv(self.bend_cov_rad2)
        taken = np.linalg.solve(bend, np.swapaxes(self.with_bend, 1, 2))
        return np.asarray(self.weight - self.with_bend @ taken, np.float64)

    def without(self, fingers: Bool) -> "SensedHand":
        """The same, but nothing of those fingers (5,)."""
        angles = np.where(fingers[:, None], np.nan, self.angles_rad)
        return replace(
            self._shared(np.where(fingers, 0.0, 1.0)), angles_rad=angles, told=self.told & ~fingers
        )

    def weighed(self, angles_rad: Float) -> "SensedHand | None":
        """The belief with fingers counting less that a hand of angles (5, 4) contradicts; None: it contradicts none."""
        off = np.where(self.known[:, None], angles_rad - self.angles_rad, 0.0)
        surprise = np.vecdot(off, (self.alone @ off[..., None])[..., 0])
        if not (surprise > _SURPRISED).any():
            return None
        return self._shared(
            np.where(surprise > _SURPRISED, (_FREEDOM + _ANGLES) / (_FREEDOM + surprise), 1.0)
        )

    def _shared(self, share: Float) -> "SensedHand":
        """The same with so much of what each finger tells (5,)."""
        by = share[:, None, None]
        return replace(
            self, weight=by * self.weight, with_bend=by * self.with_bend, of_bend=by * self.of_bend
        )

    def of(self, parameters: HandParameters) -> "SensedFree":
        """The same about a palm and free angles."""
        y = np.where(self.known[:, None], self.angles_rad, 0.0)
        x = parameters.of_angles(y)
        by_free = parameters.by_angles(x)
        # Of an abduction that narrows this is the line that touches there.
        means = y.reshape(-1) + by_free @ x - parameters.angles(x).reshape(-1)
        return SensedFree(self, by_free, means)

    def for_fit(self, parameters: HandParameters, measured: Int) -> Sensed:
        """The same as the estimator takes it.

        Args:
            parameters: The free angles.
            measured: Fingers, any number of times, whose marker is placed.
        """
        free = self.of(parameters)
        lit = self.told & (self.level == Level.FK)
        lit[0] = False  # a thumb has other habits
        lit[measured[measured >= 0]] = False
        columns = np.flatnonzero(lit[parameters.free // _ANGLES] & (parameters.free % _ANGLES == _PIP))

        def weighed(angles_rad: Float) -> Sensed | None:
            less = self.weighed(angles_rad)
            return None if less is None else less.for_fit(parameters, measured)

        return Sensed(
            None if self.palm is None else self.palm.rotation,
            self.palm is not None and self.palm.sure,
            *free.normal_equations(),
            self.told,
            self.level,
            parameters.of_angles(np.nan_to_num(self.angles_rad)),
            columns,
            weighed,
            self,
        )


class MarkerCheck:
    """Finds fingers that another sensor has elsewhere than their markers are; prepared for one hand and its markers."""

    def __init__(self, model: HandModel, markers: tuple[str, ...]) -> None:
        """Prepare.

        Raises:
            CalibrationError: The profile mounts no marker of one of the names.
        """
        self._model, self._attached = model, Attached.markers(model, HandParameters.of(model), markers)
        fingers = [model.mount(name).finger for name in markers]
        self._of_finger = np.array([fingers.index(f) if f in fingers else -1 for f in range(5)])

    def __call__(self, sensed: SensedHand, T_rig_palm: Float, points_m: Float, cov_m2: Float) -> Bool:
        """Fingers (5,) whose angles put their marker where it is not, however their doubt is taken.

        Args:
            sensed: What the sensor says.
            T_rig_palm: (4, 4) where the palm is about now.
            points_m, cov_m2: Markers (M, 3) [m] and their covariances (M, 3, 3); NaN: not seen.
        """
        told = np.where(np.isfinite(sensed.angles_rad), sensed.angles_rad, 0.0)
        chains = self._model.chains(self._model.clamp(told))
        R, at = T_rig_palm[:3, :3], self._of_finger
        tip = self._attached.place(chains)[at] @ R.T + T_rig_palm[:3, 3]
        off = points_m[at] - tip
        arms = tip[:, None] - (chains.position_m[:, _AXES_AT] @ R.T + T_rig_palm[:3, 3])
        cov = np.asarray(np.linalg.inv(sensed.alone + np.eye(_ANGLES) / _MOST_RAD**2), np.float64)
        variance = np.diagonal(cov, axis1=1, axis2=2)
        noise = cov_m2.reshape(-1, 9)[at, ::4].sum(axis=1) / 3.0
        spread = (variance * np.vecdot(arms, arms)).sum(axis=1) + _PALM_M**2 + noise
        wrong = np.vecdot(off, off) > _ELSEWHERE * spread  # NaN is not
        return sensed.known & (at >= 0) & wrong


@dataclass(frozen=True, slots=True, eq=False)
class SensedFree:
    """A belief in the free angles of one hand: angles are `by_free` (20, n) x, believed to be `means` (20,)."""

    belief: SensedHand
    by_free: Float
    means: Float
    _of_fingers: Float = field(init=False)  # (n, n) information of the free angles alone
    _crossed: Float = field(init=False)  # (3, n) and of the turn with them

    def __post_init__(self) -> None:
        by_angles = self.belief.information[:, _TURN:] @ self.by_free
        object.__setattr__(self, "_of_fingers", self.by_free.T @ by_angles[_TURN:])
        object.__setattr__(self, "_crossed", by_angles[:_TURN])

    def normal_equations(self) -> tuple[Float, Float, float]:
        """Information (3 + n, 3 + n), pull (3 + n,) and constant of the turn from the believed palm and the angles."""
        W, n = self.belief.information, self.by_free.shape[1]
        information, pull = np.zeros((_TURN + n, _TURN + n)), np.zeros(_TURN + n)
        information[_TURN:, _TURN:] = self._of_fingers
        weighed = W[:, _TURN:] @ self.means
        pull[_TURN:] = self.by_free.T @ weighed[_TURN:]
        if self.belief.palm is not None:
            information[:_TURN, :_TURN] = W[:_TURN, :_TURN]
            information[:_TURN, _TURN:], information[_TURN:, :_TURN] = self._crossed, self._crossed.T
            pull[:_TURN] = weighed[:_TURN]
        return information, pull, 0.5 * float(self.means @ weighed[_TURN:])

    def add_to(self, R: Float, x: Float, gradient: Float, normal: Float) -> Float:
        """The cost (...) of rotations (..., 3, 3) and free angles (..., n).

        Adds to gradients (..., 6 + n) and normal matrices (..., 6 + n, 6 + n).
        """
        W, by_free, palm = self.belief.information, self.by_free, self.belief.palm
        r = np.zeros((*x.shape[:-1], _ALL))
        r[..., _TURN:] = x @ by_free.T - self.means
        normal[..., 6:, 6:] += self._of_fingers
        if palm is not None:
            off = matrix_to_rotation_vector(R @ palm.rotation.T)
            J = turn_of_vector(off)
            r[..., :_TURN] = off
            turned = J.swapaxes(-1, -2)
            normal[..., :3, :3] += turned @ W[:_TURN, :_TURN] @ J
            crossed = turned @ self._crossed
            normal[..., :3, 6:] += crossed
            normal[..., 6:, :3] += crossed.swapaxes(-1, -2)
            weighed = r @ W
            gradient[..., :3] += (weighed[..., None, :_TURN] @ J)[..., 0, :]
        else:
            weighed = r @ W
        gradient[..., 6:] += weighed[..., _TURN:] @ by_free
        return 0.5 * np.vecdot(r, weighed)
