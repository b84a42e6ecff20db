"""Solution for a hand from one epoch alone.

A search begins there when it has no state to go on from.

From another hand of the epoch, if there is one that explains the markers; else from several, open to closed, each laid
on the markers as a rigid body, of which the best goes on.
"""

import numpy as np

from common.arrays import Float
from common.geometry.transforms import fit_rigid
from common.hand.model import HandModel
from common.hand.wrist_joint import forearm_palm
from master.estimator.epoch import Epoch
from master.estimator.epoch_steps import EpochSteps
from master.estimator.parameters import HandParameters
from master.estimator.priors import PosturePrior, curled, posture_prior_of
from master.estimator.settings import Settings
from master.estimator.solve import MAX_ITERATIONS
from master.estimator.wrist_device import WRIST_ANGLES

_BENDS_RAD = (0.1, 0.7, 1.3)  # of the PIP, from which a reinitialising search begins: open to closed
_AT_ORIGIN = np.eye(4)
NONE = frozenset[int]()


class PosturePriorTables:
    """Posture priors of one hand while some fingers are flexed unlike the others.

    Each is computed once.
    """

    def __init__(
        self, model: HandModel, parameters: HandParameters, settings: Settings, *, natural: bool
    ) -> None:
        """Of a hand; `natural`: it is taken to obey them."""
        self._model, self._parameters, self._settings, self._natural = model, parameters, settings, natural
        self._tables: dict[frozenset[int], PosturePrior] = {}

    def unlike(self, fingers: frozenset[int]) -> PosturePrior:
        """Those while these fingers are bent unlike the others."""
        if fingers not in self._tables:
            posture_prior = posture_prior_of(self._model, self._parameters, self._settings, fingers)
            self._tables[fingers] = posture_prior.natural_component() if self._natural else posture_prior
        return self._tables[fingers]


class Reinitialiser:
    """Fits without the state. What it holds was prepared by the constructor."""

    def __init__(
        self,
        steps: EpochSteps,
        parameters: HandParameters,
        posture_prior: PosturePriorTables,
        settings: Settings,
    ) -> None:
        self._steps, self._parameters, self._posture_prior, self._settings = (
            steps,
            parameters,
            posture_prior,
            settings,
        )
        postures = np.zeros((len(_BENDS_RAD), 5, 4))
        mcp_per_pip = 0.6
        postures[:, 1:, 1:3] = np.multiply.outer(_BENDS_RAD, (mcp_per_pip, 1.0))[:, None]
        self._postures = np.array([parameters.of_angles(angles) for angles in postures])
        self._finger_of_free = parameters.free // 4
        any_finger = posture_prior.unlike(NONE)
        likeliest = np.asarray(np.linalg.solve(any_finger.normal[0], any_finger.pull[0]), np.float64)
        self._natural = np.minimum(np.maximum(likeliest, parameters.low), parameters.high)

    def begin(self, at: Epoch) -> float:
        """Fit without the state; return chi square of the markers.

        From the other hand, or from several starts. A finger between two that show is rather bent as they are: no hand
        curls it alone. But straight it would show.
        """
        shown = frozenset(np.flatnonzero(self._steps.at.ground.shown).tolist())
        like = frozenset(f for f in (2, 3) if f not in shown and {f - 1, f + 1} <= shown)
        chi2 = self._begin_with(at, shown, like)
        angles = self._parameters.angles(self._steps.at.found.x)
        straight = frozenset(f for f in like if angles[f, 1:].sum() < self._settings.shows_rad)
        return self._begin_with(at, shown, like - straight) if straight else chi2

    def _begin_with(self, at: Epoch, shown: frozenset[int], like: frozenset[int]) -> float:
        """As `begin`, while the hidden fingers of `like` are bent as their neighbours."""
        steps, outliers, start = self._steps, frozenset(range(5)) - shown - like, at.start
        task, epoch_prior, scratch = steps.at.task, steps.at.epoch_prior, steps.at.scratch
        epoch_prior.past_w2[:], epoch_prior.past[:], epoch_prior.palm_w2[:], epoch_prior.depth_w2[:] = (
            0.0,
            0.0,
            0.0,
            0.0,
        )
        fingers = np.isin(np.arange(5), list(outliers))
        epoch_prior.own_w2[:], epoch_prior.own[:] = curled(self._parameters, self._settings, fingers)
        even = 0.5  # probability
        task.natural_weight[0], task.counts[0] = even, 0.0
        posture_prior = self._posture_prior.unlike(outliers)
        try:
            if start is not None:
                shows = steps.at.ground.shown[self._finger_of_free] > 0
                x = np.where(shows, self._parameters.of_angles(start.angles_rad), self._natural)
                scratch.start_T[:], scratch.start_x[:] = start.T_rig_palm, self._with_scanned(x)
                chi2 = steps.fit(posture_prior)
                if steps.at.found.steps[0] < MAX_ITERATIONS and not steps.has_outlier():
                    return chi2
            ends = list[tuple[float, Float, Float]]()
            starts = self._starts(at)
            if len(starts) == 1:
                scratch.start_T[:], scratch.start_x[:] = starts[0]
                return steps.fit(posture_prior)
            for T, x in starts:
                task.palm[:], task.x[:] = T, x
                ends.append((steps.fit(posture_prior, coarse=True), task.palm.copy(), task.x.copy()))
            _, scratch.start_T[:], scratch.start_x[:] = min(ends, key=lambda end: end[0])
            return steps.fit(posture_prior)
        finally:
            epoch_prior.own_w2[:] = 0.0

    def _starts(self, epoch: Epoch) -> list[tuple[Float, Float]]:
        """Return three hands, open to closed, as starts of the search.

        Each is laid on the markers as a rigid body; only one where the palm is known.
        """
        steps, measured = self._steps, self._measured_rotation(epoch)
        if epoch.place is not None and measured is not None:
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = measured, epoch.place
            return [(T, self._with_scanned(self._natural.copy()))]
        triangulated = steps.triangulated
        above_m, above_weight, palm_weight = 0.05, 0.3, 3.0
        weight = np.where(steps.finger[triangulated] >= 0, 1.0, palm_weight)
        observed = epoch.points_m[steps.on_hand][triangulated]
        starts: list[tuple[Float, Float]] = []
        for posture in self._postures:
            x = self._with_scanned(posture.copy())
            expected = steps.pose(_AT_ORIGIN, self._parameters.angles(x))[1][triangulated]
            if measured is not None and epoch.orientation is not None and epoch.orientation.sure:
                T = np.eye(4)
                T[:3, :3] = measured
                T[:3, 3] = np.average(observed - expected @ measured.T, axis=0, weights=weight)
            elif steps.at.epoch_prior.back_normal_w2[0] > 0.0:
                # A point above the wrist stands for "the back of the hand faces the cameras".
                above = expected.mean(axis=0) + np.array([0.0, above_m, 0.0])
                towards = observed.mean(axis=0) + above_m * epoch.back_normal
                T = fit_rigid(
                    np.vstack([observed, towards]),
                    np.vstack([expected, above]),
                    np.append(weight, above_weight),
                )
            else:
                T = fit_rigid(observed, expected, weight)
            starts.append((np.ascontiguousarray(T), x))
        return starts

    def _measured_rotation(self, at: Epoch) -> Float | None:
        """Return the palm rotation measured by other sensors (3, 3).

        It includes the estimated wrist flexion; None: they do not report it.
        """
        if at.orientation is None or at.orientation.axes is None:
            return None if at.orientation is None else at.orientation.rotation
        return at.orientation.rotation @ forearm_palm(self._steps.now.z[WRIST_ANGLES : WRIST_ANGLES + 2])

    def _with_scanned(self, x: Float) -> Float:
        """Return free angles (n,) with those of the scanned fingers filled in.

        These are fingers whose minimum was searched.
        """
        known = self._steps.at.scan.known > 0.0
        if not known.any():
            return x
        scanned = self._parameters.of_angles(self._steps.at.task.scanned.reshape(5, 4))
        return np.where(known[self._finger_of_free], scanned, x)
