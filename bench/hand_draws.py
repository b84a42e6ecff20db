"""Random hands of known truth, and what a solver is told of them: caps with noise, and perhaps the palm's orientation.

The joints are independent, each uniform within the limits of preset K; no habit of hands is in them. Only the DIP
follows the PIP, by 2/3 and up to 8 degrees off, and an abduction is uniform in what its flexion leaves. Facing the
cameras means: the back of the hand looks along the rig's -z, the fingers point to -y. The palm is turned from there
by up to 45 degrees about each axis.
"""

from dataclasses import dataclass

import msgspec
import numpy as np

from common.arrays import Float
from common.calibration import Couplings, HandProfile
from common.calibration.hand_presets import preset_limits, without_tolerance
from common.geometry.transforms import rotation_vector_to_matrix
from common.hand.limits import ABDUCTION, FLEXION
from common.hand.model import HandModel
from common.hand.profiles import generated_profile

MARKERS = ("thumb", "index", "middle", "ring", "little", "back")
BACK = 5
FACING_ROTATION = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
_PLACE_M = np.array([0.03, 0.08, 0.6])
_ROTATION_RAD = np.radians(45.0)
_DIP_PER_PIP = 2.0 / 3.0
_DIP_OFF_RAD = np.radians(8.0)


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations: of a cap's place (3,) [m] along the rig's axes, of the palm's orientation [rad] or None."""

    place_m: tuple[float, float, float]
    orientation_rad: float | None = None

    @property
    def cov_m2(self) -> Float:
        """(M, 3, 3) [m^2] of the markers."""
        return np.tile(np.diag(np.square(self.place_m)), (len(MARKERS), 1, 1))


@dataclass(frozen=True, slots=True, eq=False)
class Draw:
    """N hands.

    Attributes:
        T_rig_palm: (N, 4, 4).
        angles_rad: (N, 5, 4).
        joints_m: (N, 26, 3) [m], rig frame.
        caps_m: (N, M, 3) [m] cap centroids as they are, in the order of `MARKERS`.
    """

    T_rig_palm: Float
    angles_rad: Float
    joints_m: Float
    caps_m: Float

    def every(self, step: int) -> "Draw":
        """One hand in `step`."""
        return Draw(
            self.T_rig_palm[::step], self.angles_rad[::step], self.joints_m[::step], self.caps_m[::step]
        )


def bench_model(*, coupled: bool = True) -> HandModel:
    """The quick-start hand of 19 cm with preset K; `coupled`: the DIP follows the PIP by 2/3 exactly.

    Its limits are walls, as all solvers that are compared have them.
    """
    profile: HandProfile = msgspec.structs.replace(
        generated_profile("bench", "right"), limits_rad=without_tolerance(preset_limits("K"))
    )
    if not coupled:
        profile = msgspec.structs.replace(profile, couplings=Couplings(dip_per_pip=None))
    return HandModel.of(profile)


def draw(model: HandModel, seed: int, count: int, *, coupling_off_rad: float = _DIP_OFF_RAD) -> Draw:
    """Hands in random poses, the same for the same seed.

    Args:
        model: Bones, limits and markers.
        seed: Of the random numbers.
        count: How many.
        coupling_off_rad: How far a DIP may be off 2/3 of its PIP; it stays inside its own limits.
    """
    rng = np.random.default_rng(seed)
    low, high = model.limits_rad[..., 0], model.limits_rad[..., 1]
    angles = rng.uniform(low, high, (count, 5, 4))
    legal_low, legal_high = model.abduction_limits_rad(angles[..., FLEXION])
    angles[..., ABDUCTION] = rng.uniform(legal_low, legal_high)
    off = rng.uniform(-coupling_off_rad, coupling_off_rad, (count, 4))
    angles[:, 1:, 3] = np.clip(_DIP_PER_PIP * angles[:, 1:, 2] + off, low[1:, 3], high[1:, 3])
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = _rotation(rng.uniform(-_ROTATION_RAD, _ROTATION_RAD, (count, 3))) @ FACING_ROTATION
    T[:, :3, 3] = _PLACE_M
    return posed(model, T, angles)


def posed(model: HandModel, T_rig_palm: Float, angles_rad: Float) -> Draw:
    """The hands of given palms (N, 4, 4) and angles (N, 5, 4) [rad]."""
    joints = model.forward(T_rig_palm, angles_rad)
    return Draw(T_rig_palm, angles_rad, joints.position_m, model.marker_points(joints, MARKERS))


def _rotation(angles_rad: Float) -> Float:
    """Turns (N, 3, 3) about x, then y, then z by angles (N, 3) [rad]."""
    x, y, z = (rotation_vector_to_matrix(angles_rad[:, [k]] * np.eye(3)[k]) for k in range(3))
    return z @ y @ x


def seen(truth: Draw, noise: Noise, seed: int) -> tuple[Float, Float | None]:
    """Caps with noise (N, M, 3) [m], and the palms' orientations (N, 3, 3) with theirs, or None where not told."""
    rng = np.random.default_rng((seed, 1))
    points = truth.caps_m + rng.normal(size=truth.caps_m.shape) * noise.place_m
    if noise.orientation_rad is None:
        return points, None
    off = rng.normal(0.0, noise.orientation_rad, (len(points), 3))
    return points, rotation_vector_to_matrix(off) @ truth.T_rig_palm[:, :3, :3]
