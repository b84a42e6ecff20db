"""The last step of a hand: given the palm, a finger that the whole-hand fit leaves off its cap is brought onto it.

The fit balances all markers and priors. A finger whose cap is explained within its noise stays as fitted: to pull
it onto the last millimetre of noise costs 1.4 degrees of PIP a millimetre. Where the balance leaves a finger off by
more than the noise allows, the palm is kept and the finger solved alone within its limits: closed form for the
seed, FABRIK to the end. The thumb, and a finger whose DIP may stray, have four angles for three numbers, so their
seed is the fit itself. A cap out of reach changes nothing: the fit is already the best compromise, and a search for
a better one would cost a frame.
"""

from dataclasses import replace

import numpy as np

from common.arrays import Float
from common.geometry import invert, transform
from common.hand_model import HandModel
from master.ik.attached import Attached
from master.ik.fabrik import Fabrik
from master.ik.finger import FingerSolver
from master.ik.hand import EXPLAINED, HandSolution
from master.ik.joints import Vector
from master.ik.parameters import HandParameters

MODEL_M = 1e-3  # bones and caps are known to about this
_MODEL_M2 = MODEL_M**2 * np.eye(3)
_ON_CAP_M = 1e-4  # residual below which a finger is on its cap
_ITERATIONS = 10  # the seed is the answer; what it cannot reach, iterations improve little


class FingerRefiner:
    """Closed form and FABRIK for the fingers of one hand that carry a marker. Holds no state between calls."""

    def __init__(self, model: HandModel, markers: tuple[str, ...]) -> None:
        """Prepare tables and chains.

        Raises:
            CalibrationError: The profile mounts no marker of one of the names.
        """
        self._model, self._attached = model, Attached.markers(model, HandParameters.of(model), markers)
        self._fingers: dict[int, tuple[int, FingerSolver, Fabrik]] = {}
        for index, name in enumerate(markers):
            mount = model.mount(name)
            finger = mount.finger
            if finger is not None and mount.joint is not None and finger not in self._fingers:
                closed_form = FingerSolver.of(model, finger, mount.offset_m)
                fabrik = Fabrik.of(
                    closed_form.chain, tolerance_m=_ON_CAP_M, max_iterations=_ITERATIONS, restarts=0
                )
                self._fingers[finger] = (index, closed_form, fabrik)

    def __call__(
        self, hand: HandSolution, points_m: Float, cov_m2: Float, told: frozenset[int] = frozenset()
    ) -> HandSolution:
        """The same palm with every seen finger on its cap, as far as noise asks and limits allow.

        Args:
            hand: Solution of the whole-hand fit.
            points_m: Cap centroids (M, 3) [m], rig frame; NaN: not seen.
            cov_m2: (M, 3, 3) [m^2].
            told: Fingers whose angles another sensor tells: the search begins from these, not from the closed form.
        """
        surprised = surprise_of(points_m - self._attached.on(hand.joints), cov_m2) >= EXPLAINED
        if not surprised.any():  # NaN is not: not seen
            return hand
        T_palm_rig, angles = invert(hand.T_rig_palm), hand.angles_rad.copy()
        for finger, (marker, closed_form, fabrik) in self._fingers.items():
            if not surprised[marker]:
                continue
            x, y, z = (float(value) for value in transform(T_palm_rig, points_m[marker]))
            determined = closed_form.chain.coupling is not None and finger not in told
            found = _solve(closed_form, fabrik, (x, y, z), None if determined else angles[finger])
            if found is not None:
                angles[finger] = found
        if np.array_equal(angles, hand.angles_rad):
            return hand
        angles = self._model.clamp(angles)
        joints = self._model.forward(hand.T_rig_palm, angles)
        residual = np.linalg.norm(self._attached.on(joints) - points_m, axis=1)
        return replace(hand, angles_rad=angles, joints=joints, residual_m=residual)


def surprise_of(off_m: Float, cov_m2: Float) -> Float:
    """Chi square (M,) of markers that are off their places by (M, 3) [m], of covariances (M, 3, 3); NaN: not seen."""
    solved = np.linalg.solve(cov_m2 + _MODEL_M2, off_m[..., None])
    return np.asarray(np.vecdot(off_m, solved[..., 0]), np.float64)


def _solve(
    closed_form: FingerSolver, fabrik: Fabrik, target: Vector, fitted: Float | None
) -> tuple[float, ...] | None:
    """Angles (4,) [rad] that bring the finger onto the target; None where it cannot be reached.

    Args:
        closed_form, fabrik: The finger.
        target: Cap [m], palm frame.
        fitted: (4,) [rad] to start from instead of the closed form.
    """
    if fitted is not None:
        a, f, pip, dip = (float(value) for value in fitted)
    else:
        found = closed_form.reachable(target)
        if found is None:
            return None
        a, f, pip, dip = found[:4]
    result = fabrik.solve(target, ((a, f), (pip,), (dip,)), closed_form.root)
    return tuple(angle for joint in result.angles for angle in joint) if result.reached else None
