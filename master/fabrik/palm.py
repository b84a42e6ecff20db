"""Fit the palm of an instant: from the last one, or from several starts.

From the last one where that explains the markers.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float
from common.geometry import fit_rigid
from common.hand_model import HandJoints, HandModel
from master.estimator.attached import Attached
from master.estimator.parameters import HandParameters
from master.estimator.small_matrices import inverse
from master.fabrik.hand_tables import HandTables, Mounts
from master.fabrik.kinematics import covariances, pose
from master.fabrik.palm_kernel import PalmPrior, fit, informations
from master.ik.hand import EXPLAINED, determined
from master.ik.hidden import HiddenFingers
from master.ik.priors import AnglePrior, Priors, hidden_belief

_ENOUGH = 1e-3  # of half chi square that a further step may gain
_BENDS_RAD = (0.1, 0.7, 1.3)  # of the PIP, from which a search afresh begins: open to closed
_ABOVE_M = 0.05  # a point above the wrist stands for "the back of the hand faces the cameras"
_ABOVE_WEIGHT, _PALM_WEIGHT = 0.3, 3.0
_LEAST_AGE_S = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Palm:
    """The palm, with the angles of the fingers that go best with it.

    Attributes:
        T: (4, 4) [m], rig frame.
        x: (n,) [rad] free angles.
        cov: (6 + n, 6 + n) covariance of turn [rad], shift [m] and x by this instant alone.
        cost: Half chi square, priors included.
        surprise: (M,) chi square of each marker; 0: not seen.
    """

    T: Float
    x: Float
    cov: Float
    cost: float
    surprise: Float


class PalmFitter:
    """Fits the palm of one hand. Holds no state between calls."""

    def __init__(self, model: HandModel, markers: tuple[str, ...], priors: Priors | None = None) -> None:
        """Prepare what is the same in every frame.

        Raises:
            CalibrationError: The profile mounts no marker of one of the names.
        """
        self.model, self.priors = model, priors or Priors()
        self.parameters = HandParameters.of(model)
        self.tables = HandTables.of(model, self.parameters)
        self.attached = Attached.markers(model, self.parameters, markers)
        self.mounts = Mounts.of(self.attached)
        self._on_finger = self.attached.on_finger[:, 0]
        self._habits: dict[frozenset[int], tuple[Float, Float]] = {}
        bent = np.zeros((len(_BENDS_RAD), 5, 4))
        bent[:, 1:, 1:3] = np.multiply.outer(_BENDS_RAD, (0.6, 1.0))[:, None]
        self._postures = np.array([self.parameters.of_angles(angles) for angles in bent])
        self._shapes_m = self.attached.place(model.chains(self.parameters.angles(self._postures)))
        self._model_m2 = self.priors.model_m**2
        self._finger_of_free = self.parameters.free // 4

    def __call__(
        self,
        points_m: Float,
        cov_m2: Float,
        facing: Float | None,
        last: Palm | None = None,
        age_s: float = 0.0,
        hidden: HiddenFingers | None = None,
    ) -> Palm | None:
        """Fit the palm of one instant.

        Args:
            points_m: Cap centroids (M, 3) [m], rig frame; NaN: not seen.
            cov_m2: (M, 3, 3) [m^2].
            facing: (3,) unit vector along which the back looks; None: nothing known.
            last: The palm a moment ago; None: nothing is known of it.
            age_s: How long ago that was [s].
            hidden: Where fingers that are not seen are believed to be; None: curled out of sight.

        Returns:
            The palm; None where there is no last one and too few markers, or none at all.
        """
        seen, information = np.empty(len(points_m), np.bool_), np.empty((len(points_m), 3, 3))
        if not informations(points_m, cov_m2, self._model_m2, seen, information):
            return None
        best = None
        if last is not None:
            prior = self._expected(last, age_s, seen, facing, hidden)
            best = self._fit(points_m, information, seen, prior, last.T, last.x)
            if not (best.surprise > EXPLAINED).any():
                return best
        if not determined(points_m[seen], facing, None):
            return best
        prior = self._unexpected(seen, facing, hidden)
        for T, x in zip(*self._starts(points_m, seen, facing), strict=True):
            found = self._fit(points_m, information, seen, prior, T, x)
            if best is None or found.cost < best.cost:
                best = found
        return best

    def _fit(
        self, points: Float, information: Float, seen: Bool, prior: PalmPrior, T: Float, x: Float
    ) -> Palm:
        T, x = np.array(T, np.float64, order="C"), x.copy()
        size = 6 + len(x)
        normal, surprise = np.empty((size, size)), np.zeros(len(points))
        cost, _ = fit(
            self.tables, self.mounts, prior, points, information, seen, T, x, normal, surprise, _ENOUGH
        )
        alone = normal.reshape(-1)[:: size + 1]
        alone[:6] -= prior.palm_weight**2
        walked = self._shown(seen)[self._finger_of_free]
        alone[6:][walked] -= prior.weight[walked] ** 2
        alone += self.parameters.anywhere
        scale = max(1.0, float(surprise.sum()) / (3.0 * int(seen.sum())))
        cov = np.empty((size, size))
        if not inverse(normal, scale, cov):  # by rounding: nothing is known but limits
            cov[:] = np.diag(1.0 / self.parameters.anywhere)
        return Palm(T, x, cov, cost, surprise)

    def _shown(self, seen: Bool) -> Bool:
        """(5,) which fingers have a marker that is seen."""
        shown = np.zeros(5, np.bool_)
        shown[self.attached.finger[seen & self._on_finger]] = True
        return shown

    def _expected(
        self, last: Palm, age_s: float, seen: Bool, facing: Float | None, hidden: HiddenFingers | None
    ) -> PalmPrior:
        """The prior where the last palm is known: what is seen moves on from there."""
        x, shown = last.x, self._shown(seen)
        weight = np.full(len(x), 1.0 / (self.priors.walk_rad_s * max(age_s, _LEAST_AGE_S)))
        if hidden is not None and not shown.all():
            unseen = ~shown[self._finger_of_free]
            weight = np.where(unseen, 1.0 / hidden.sigma_rad[self._finger_of_free], weight)
            x = np.where(unseen, self.parameters.of_angles(hidden.angles_rad), x)
        return self._prior(x, weight, last.T, self.priors.palm_weight(age_s), facing)

    def _unexpected(self, seen: Bool, facing: Float | None, hidden: HiddenFingers | None) -> PalmPrior:
        """The prior where no last palm is known: a hidden finger is curled.

        But not one between two that show.
        """
        shown = frozenset(self.attached.finger[seen & self._on_finger].tolist())
        like = frozenset(f for f in (2, 3) if hidden is None and {f - 1, f + 1} <= shown) - shown
        known = None if hidden is None else (hidden.angles_rad, hidden.sigma_rad)
        weight, mean = hidden_belief(self.parameters, self.priors, shown | like, known)
        unlike = frozenset(range(5)) - shown - like if hidden is None else frozenset[int]()
        return self._prior(mean, weight, np.eye(4), np.zeros(6), facing, unlike)

    def _prior(
        self,
        x: Float,
        weight: Float,
        T: Float,
        palm_weight: Float,
        facing: Float | None,
        unlike: frozenset[int] = frozenset(),
    ) -> PalmPrior:
        if unlike not in self._habits:  # each of the 32 sets is worked out once
            habits = AnglePrior.of(self.model, self.parameters, self.priors, unlike)
            self._habits[unlike] = (
                np.ascontiguousarray(habits.normal[0]),
                np.ascontiguousarray(habits.pull[0]),
            )
        known = facing is not None
        return PalmPrior(
            *self._habits[unlike],
            x,
            weight,
            T,
            palm_weight,
            facing if known else np.zeros(3),
            1.0 / self.priors.facing if known else 0.0,
        )

    def _starts(self, points: Float, seen: Bool, facing: Float | None) -> tuple[Float, Float]:
        """Lay three hands, open to closed, on the markers: (3, 4, 4), (3, n)."""
        weight = np.where(self._on_finger[seen], 1.0, _PALM_WEIGHT)
        observed, expected = points[seen], self._shapes_m[:, seen]
        if facing is not None:
            above = expected.mean(axis=1, keepdims=True) + np.array([0.0, _ABOVE_M, 0.0])
            observed = np.vstack([observed, observed.mean(axis=0) + _ABOVE_M * facing])
            expected = np.concatenate([expected, above], axis=1)
            weight = np.append(weight, _ABOVE_WEIGHT)
        return fit_rigid(observed, expected, weight), self._postures

    def covariances(self, palm: Palm) -> tuple[Float, Float]:
        """Return covariances of the joints and of the last phalanges' directions.

        (26, 3, 3) [m^2] and (5, 3, 3) [rad^2].
        """
        cov, tilt = np.empty((26, 3, 3)), np.empty((5, 3, 3))
        covariances(self.tables, palm.T, palm.x, palm.cov, cov, tilt)
        return cov, tilt

    def pose(self, T: Float, angles_rad: Float) -> tuple[HandJoints, Float]:
        """Return the joints, and the markers (M, 3) [m] in the palm frame.

        Of a palm (4, 4) and angles (5, 4) [rad].
        """
        position, rotation = np.empty((26, 3)), np.empty((26, 3, 3))
        places = np.empty((len(self.attached.offset_m), 3))
        pose(self.tables, self.mounts, T, angles_rad.ravel(), position, rotation, places)
        return HandJoints(position, rotation, T), places
