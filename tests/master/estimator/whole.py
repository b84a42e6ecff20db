"""A hand whose priors and measurements tests set, and its normal equations against finite differences."""

from dataclasses import replace

import msgspec
import numpy as np

from common.arrays import Float
from common.calibration import Couplings
from common.geometry.transforms import rigid, rotation_vector_to_matrix
from common.hand.model import HandModel
from common.hand.profiles import generated_profile, preset_couplings
from common.kernels import constant
from common.records import boxed, filled, record
from master.estimator.parameters import HandParameters, HandTables, Mounts
from master.estimator.posterior import Model
from master.estimator.priors import posture_prior_of
from master.estimator.problem import EpochPrior, Iterate, Observations, Search
from master.estimator.sensors import EXTRAS, NO_EXTRAS, CameraArrays, Device
from master.estimator.settings import DEFAULT
from tests.hand_helpers import MARKERS, natural_angles, palm, walls
from tests.master.estimator.fitted import FREE, PAIR
from tests.master.estimator.kernels import linearise_at

LENS = np.array([-0.3, 0.12, 1e-3, -2e-3, -0.02])
CAMERAS = (PAIR[0], replace(PAIR[1], distortion=LENS))
H = 1e-6


def made(side: str, preset: str, coupled: bool) -> HandModel:
    profile = generated_profile("made", side)
    limits = walls("K" if preset == "K" else "D")
    couplings = preset_couplings("D") if coupled else Couplings(dip_per_pip=None)
    return HandModel.of(msgspec.structs.replace(profile, limits_rad=limits, couplings=couplings))


MODELS = {
    "right K": made("right", "K", True),
    "left D": made("left", "D", True),
    "free": made("right", "K", False),
}


class Whole:
    """A hand somewhere, without priors and measurements until they are set.

    One with free DIPs has a wrist device, too: kernels of its size are compiled for those alone.
    """

    def __init__(self, model: HandModel, seed: int, device: Device | None = None) -> None:
        self.model, self.rng, self.h = model, np.random.default_rng(seed), constant(seed % 2)
        self.parameters = HandParameters.of(model)
        n = self.n = len(self.parameters.free)
        if n > FREE and device is None:
            device = record(Device)
        K = NO_EXTRAS if device is None else EXTRAS
        self.T, angles = palm(self.rng.uniform(-30.0, 30.0, 3)), natural_angles(self.rng)
        low, high = self.parameters.low, self.parameters.high
        self.x = np.clip(self.parameters.of_angles(angles), low + 0.02, high - 0.02)
        self.z = np.zeros(K)
        self.points = model.marker_points(model.forward(self.T, self.parameters.angles(self.x)), MARKERS)
        self.posture_prior = posture_prior_of(model, self.parameters)
        self.epoch_prior, self.search = (
            record(EpochPrior, n=n, K=K),
            record(Search, n=n, K=K, N=6 + n + K, M=16),
        )
        self.observed = Observations.empty(2, 6)
        self.rig = Model(
            boxed(HandTables.of(model, self.parameters)),
            boxed(DEFAULT.changed("wrist_share", 1.0).record()),  # with less, the gradient is not the cost's
            Mounts.of(model, MARKERS),
            CameraArrays.of(CAMERAS),
            boxed(record(Device) if device is None else device),
        )

    def cost(self, step: Float | None = None) -> tuple[float, Float, Float]:
        """Cost, gradient and normal matrix at a step (N,) from the hand."""
        N = 6 + self.n + len(self.z)
        by = np.zeros(N) if step is None else step
        T = rigid(rotation_vector_to_matrix(by[:3]) @ self.T[:3, :3], self.T[:3, 3] + by[3:6])
        at = filled(
            record(Iterate, n=self.n, K=len(self.z), N=N),
            palm=T,
            x=self.x + by[6 : 6 + self.n],
            z=self.z + by[6 + self.n :],
        )
        boxes = boxed(at), boxed(self.search)
        cost = linearise_at(
            self.rig, self.posture_prior, boxed(self.epoch_prior), self.observed, self.h, *boxes
        )
        return float(cost), at.gradient.copy(), at.normal.copy()

    def numeric_gradient(self, step_size: float = H) -> Float:
        """The gradient (N,) by central differences."""
        N = 6 + self.n + len(self.z)
        steps = step_size * np.eye(N)
        return np.array([(self.cost(e)[0] - self.cost(-e)[0]) / (2.0 * step_size) for e in steps])

    def hessian_of_cost(self, step_size: float = H) -> Float:
        """The second derivatives (N, N) of the cost, as central differences of its gradient."""
        N = 6 + self.n + len(self.z)
        steps = step_size * np.eye(N)
        return np.array([(self.cost(e)[1] - self.cost(-e)[1]) / (2.0 * step_size) for e in steps])

    def check(self, share: float) -> None:
        """The gradient against finite differences, to a share of its largest component."""
        _, gradient, normal = self.cost()
        numeric = self.numeric_gradient()
        if (
            self.n > FREE and self.observed.seen.any()
        ):  # markers move with the twists, which the device alone teaches
            numeric[6 + self.n : 6 + self.n + 5] = 0.0
        size = np.array([3, 3, self.n, len(self.z)])  # turn, shift, angles and extras have units of their own
        largest = np.repeat([max(float(np.abs(part).max()), 1e-3) for part in
                             np.split(numeric, np.cumsum(size)[:-1])], size)  # fmt: skip
        np.testing.assert_array_less(np.abs(gradient - numeric), share * largest)
        np.testing.assert_allclose(normal, normal.T, atol=1e-9 * np.abs(normal).max())
        assert np.linalg.eigvalsh(normal).min() > -1e-9 * np.abs(normal).max()


def silent(whole: Whole) -> None:
    """Switch the posture prior off."""
    for table in whole.posture_prior:
        table[:] = 0.0
