"""Random hands of known truth, their caps with noise, and errors of found hands.

Joints are independent, each uniform within the limits of preset K; the DIP follows the PIP by 2/3 and up to 8 degrees
off, and an abduction is uniform in what its flexion leaves. Facing the cameras means: the back of the hand looks along
the rig's -z, the fingers point to -y. The palm is turned from there by up to 45 degrees about each axis.
"""

from dataclasses import dataclass

import msgspec
import numpy as np

from common.arrays import Float
from common.calibration import Couplings, HandProfile
from common.geometry.transforms import rotation_vector_to_matrix
from common.hand.model import HandModel
from common.hand.profiles import ABDUCTION, FLEXION, generated_profile, preset_limits, without_tolerance

MARKERS = ("thumb", "index", "middle", "ring", "little", "back")
BACK = 5
FACING_ROTATION = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
EDGE_ON = np.cos(np.radians(75.0))  # a marker on the back that is turned farther aside is not seen
_PLACE_M = np.array([0.03, 0.08, 0.6])
_ROTATION_RAD = np.radians(45.0)
_DIP_PER_PIP = 2.0 / 3.0
_DIP_OFF_RAD = np.radians(8.0)
_MISSED_MM = 1.0


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations of a cap's position (3,) [m], rig axes, and of the palm's orientation [rad] or None."""

    place_m: tuple[float, float, float]
    orientation_rad: float | None = None

    @property
    def cov_m2(self) -> Float:
        """(M, 3, 3) [m^2] of the markers."""
        return np.tile(np.diag(np.square(self.place_m)), (len(MARKERS), 1, 1))


@dataclass(frozen=True, slots=True, eq=False)
class Draw:
    """N hands: palm (N, 4, 4), angles (N, 5, 4), joints (N, 26, 3) and cap centroids (N, M, 3) [m], rig frame."""

    T_rig_palm: Float
    angles_rad: Float
    joints_m: Float
    caps_m: Float

    def every(self, step: int) -> "Draw":
        """Return one hand in `step`."""
        return Draw(
            self.T_rig_palm[::step], self.angles_rad[::step], self.joints_m[::step], self.caps_m[::step]
        )


def bench_model(*, coupled: bool = True) -> HandModel:
    """Return a hand of 19 cm with hard limits of preset K; `coupled`: the DIP is exactly 2/3 of the PIP."""
    limits = without_tolerance(preset_limits("K"))
    profile: HandProfile = msgspec.structs.replace(generated_profile("bench", "right"), limits_rad=limits)
    if not coupled:
        profile = msgspec.structs.replace(profile, couplings=Couplings(dip_per_pip=None))
    return HandModel.of(profile)


def draw(model: HandModel, seed: int, count: int, *, coupling_off_rad: float = _DIP_OFF_RAD) -> Draw:
    """Draw hands in random poses; a DIP is up to `coupling_off_rad` off 2/3 of its PIP, inside its own limits."""
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
    """Return the hands of palms (N, 4, 4) and angles (N, 5, 4) [rad]."""
    joints = model.forward(T_rig_palm, angles_rad)
    return Draw(T_rig_palm, angles_rad, joints.position_m, model.marker_points(joints, MARKERS))


def _rotation(angles_rad: Float) -> Float:
    """Rotations (N, 3, 3) about x, then y, then z by angles (N, 3) [rad]."""
    x, y, z = (rotation_vector_to_matrix(angles_rad[:, [k]] * np.eye(3)[k]) for k in range(3))
    return z @ y @ x


def seen(truth: Draw, noise: Noise, seed: int) -> tuple[Float, Float | None]:
    """Return noisy caps (N, M, 3) [m], and noisy palm orientations (N, 3, 3) or None where none are measured."""
    rng = np.random.default_rng((seed, 1))
    points = truth.caps_m + rng.normal(size=truth.caps_m.shape) * noise.place_m
    if noise.orientation_rad is None:
        return points, None
    off = rng.normal(0.0, noise.orientation_rad, (len(points), 3))
    return points, rotation_vector_to_matrix(off) @ truth.T_rig_palm[:, :3, :3]


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """Errors of N hands, those without a finite answer left out.

    Attributes:
        joints_mm: (N,) mean distance of the 26 joints of a hand.
        pip_deg: (N, 4) index ... little.
        miss_mm: (N, 5) distance of each tip's cap to the measured cap.
        violations: Angles outside their limits; `worst_deg`: by how much the worst is outside.
        not_finite: Hands without a finite answer, of all `hands`.
    """

    joints_mm: Float
    pip_deg: Float
    miss_mm: Float
    violations: int
    worst_deg: float
    not_finite: int
    hands: int

    @property
    def missed_percent(self) -> float:
        """Tips farther than 1 mm from their cap [%]."""
        return 100.0 * float((self.miss_mm > _MISSED_MM).mean())


def score(model: HandModel, truth: Draw, T_rig_palm: Float, angles_rad: Float, asked_m: Float) -> Score:
    """Compare palms (N, 4, 4) and angles (N, 5, 4) [rad], NaN: none found, with truth and caps (N, M, 3) [m]."""
    numbers = np.concatenate([angles_rad.reshape(-1, 20), T_rig_palm.reshape(-1, 16)], axis=1)
    finite = np.isfinite(numbers.sum(axis=1))
    angles = angles_rad[finite]
    joints = model.forward(T_rig_palm[finite], angles)
    off_m = joints.position_m - truth.joints_m[finite]
    return Score(
        joints_mm=1e3 * np.linalg.norm(off_m, axis=-1).mean(axis=-1),
        pip_deg=np.degrees(np.abs(angles[:, 1:, 2] - truth.angles_rad[finite, 1:, 2])),
        miss_mm=1e3 * np.linalg.norm(model.marker_points(joints, MARKERS[:5]) - asked_m[finite, :5], axis=-1),
        violations=int((~model.within_limits(angles)).sum()),
        worst_deg=float(np.degrees(np.abs(angles - model.clamp(angles)).max(initial=0.0))),
        not_finite=int((~finite).sum()),
        hands=len(finite),
    )
