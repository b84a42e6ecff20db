"""Random hands of known truth, their caps with noise, errors of found hands, and solvers that are fed the caps.

Joints are independent, each uniform within the limits of preset K; the DIP follows the PIP by 2/3 and up to 8 degrees
off, and an abduction is uniform in what its flexion leaves. Facing the cameras means: the back of the hand looks along
the rig's -z, the fingers point to -y. The palm is turned from there by up to 45 degrees about each axis.

**Papers' way**: the palm's orientation is taken as fixed, the back marker places it; each finger is constrained FABRIK
from its last pose, with DIP = 2/3 PIP, without a closed-form seed and without restarts (Kalbfleisch, with the library
Caliko). Ours has the limits in both passes and aims the root first. The closed form with the same palm shows which
part of an error is FABRIK's and which is the palm's. `PointHand` is the estimator, fed points without cameras.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import inf

import msgspec
import numpy as np
from scipy.optimize import least_squares  # pyright: ignore[reportUnknownVariableType]

from bench.hands.chains import Fabrik
from common.arrays import Float
from common.calibration import Couplings, HandProfile, Limits
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import rigid, rotation_vector_to_matrix
from common.hand.model import HandModel
from common.hand.profiles import ABDUCTION, FLEXION, generated_profile, preset_limits
from master.estimator.epoch import Epoch, Fitted, OrientationMeasurement
from master.estimator.estimator import Estimator
from master.estimator.settings import DEFAULT, Settings
from master.fabrik.linear_algebra import Vector, as_vector
from master.fabrik.solver import Finger

MARKERS = ("thumb", "index", "middle", "ring", "little", "back")
BACK = 5
FACING_ROTATION = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
EDGE_ON = np.cos(np.radians(75.0))  # a marker on the back that is turned farther aside is not seen
_PLACE_M = np.array([0.03, 0.08, 0.6])
_ROTATION_RAD = np.radians(45.0)
_DIP_OFF_RAD = np.radians(8.0)


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


def without_tolerance(limits: Limits) -> Limits:
    """The same limits as walls."""
    walls = {
        name: msgspec.structs.replace(getattr(limits, name), tolerance_rad=(0.0, 0.0, 0.0, 0.0))
        for name in Limits.__struct_fields__
    }
    return Limits(**walls)


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
    angles[:, 1:, 3] = np.clip(2.0 / 3.0 * angles[:, 1:, 2] + off, low[1:, 3], high[1:, 3])
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
    """Errors of N hands, those without a finite answer left out."""

    joints_mm: Float  # (N,) mean distance of the 26 joints of a hand
    pip_deg: Float  # (N, 4) index ... little
    miss_mm: Float  # (N, 5) distance of each tip's cap to the measured cap
    violations: int  # angles outside their limits; `worst_deg`: by how much the worst is outside
    worst_deg: float
    not_finite: int  # hands without a finite answer, of all `hands`
    hands: int

    @property
    def missed_percent(self) -> float:
        """Tips farther than 1 mm from their cap [%]."""
        return 100.0 * float((self.miss_mm > 1.0).mean())


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


Angles = Sequence[Sequence[float]]  # (5, 4) [rad]
Fingers = Callable[[Sequence[Vector]], Angles]  # five tips [m] in the palm frame -> angles
INSIDE_RAD = 1e-6  # scipy refuses a start on a bound, and bounds that leave no room


def finger_solvers(model: HandModel) -> list[Finger]:
    """Return the closed form of the five fingers, each to its cap."""
    return [Finger.of(model, f, model.mount(name).offset_m) for f, name in enumerate(MARKERS[:5])]


def fixed_palm(model: HandModel, points_m: Float, rotation: Float = FACING_ROTATION) -> Float:
    """Return the palm pose (4, 4) of a fixed orientation, placed by the back marker of caps (M, 3) [m]."""
    return rigid(rotation, points_m[BACK] - rotation @ model.mount("back").offset_m)


def tips_in_palm(T_rig_palm: Float, points_m: Float) -> list[Vector]:
    """Return the caps of the five tips [m] in the palm frame, from caps (M, 3) [m]."""
    return [as_vector(p) for p in (points_m[:5] - T_rig_palm[:3, 3]) @ T_rig_palm[:3, :3]]


@dataclass(slots=True)
class PaperFingers:
    """Warm constrained FABRIK. Holds the last pose of each finger, from which the next search starts."""

    closed: list[Finger]
    fabrik: list[Fabrik] = field(init=False)
    last: list[Float | None] = field(init=False)

    def __post_init__(self) -> None:
        self.fabrik = [Fabrik.of(solver.chain, restarts=0) for solver in self.closed]
        self.last = [None] * len(self.closed)

    def push(self, tips_m: Sequence[Vector]) -> Angles:
        """Return angles (5, 4) [rad] for the five tips [m] in the palm frame."""
        out: list[list[float]] = []
        for f, (fabrik, closed) in enumerate(zip(self.fabrik, self.closed, strict=True)):
            found = fabrik.solve(tips_m[f], self.last[f], closed.root)
            self.last[f] = found.angles
            out.append(found.angles.tolist())
        return out


def closed_form(solvers: Sequence[Finger], tips_m: Sequence[Vector]) -> Angles:
    """Return angles (5, 4) [rad] for the five tips [m] in the palm frame, finger by finger."""
    return [solver.closed_form(tip)[:4] for solver, tip in zip(solvers, tips_m, strict=True)]


def scipy_finger(solver: Finger, target: Vector) -> list[float]:
    """Return angles (4,) [rad] of a finger whose cap is to be at `target` [m], from the middle of the limits."""
    low, high = solver.chain.spans.T
    coupled = solver.chain.coupling is not None
    free = [k for k in range(4) if high[k] - low[k] > 2 * INSIDE_RAD and not (coupled and k == 3)]
    angles = np.clip(np.zeros(4), low, high)

    def complete(x: Float) -> tuple[float, float, float, float]:
        angles[free] = x
        if coupled:
            angles[3] = np.clip(solver.ratio * angles[2], low[3], high[3])
        a, f, pip, dip = angles.tolist()
        return a, f, pip, dip

    def residual(x: Float) -> Float:
        return 1e3 * np.subtract(solver.forward(complete(x)), target)  # metres end scipy's search too early

    start = 0.5 * (low + high)[free]
    x = np.asarray(least_squares(residual, start, bounds=(low[free], high[free])).x, np.float64)
    return list(complete(x))


TOWARDS = np.array([0.0, 0.0, -1.0])  # from hands to cameras that look along the rig's +z
_SURE_RAD = np.radians(15.0)  # an orientation that is better known than this about every axis is sure
_NO_RAY = CameraModel(np.eye(3), np.zeros(5), np.eye(4), 640, 480, 0.0)


class PointHand:
    """Push machine. Holds the estimator, to which all positions are given with their covariances."""

    def __init__(
        self,
        model: HandModel,
        markers: tuple[str, ...],
        *,
        continuous: bool = True,
        natural: bool = False,
        faces: bool = True,
        settings: Settings = DEFAULT,
    ) -> None:
        """Prepare for `markers` in the order of the points; `faces`: a back that is seen looks to the cameras."""
        settings = settings if faces else replace(settings, back_normal_rad=inf)
        self.estimator = Estimator(
            [_NO_RAY], model, markers, markers, continuous=continuous, natural=natural, settings=settings
        )

    def push(
        self,
        t_ns: int,
        points_m: Float,
        cov_m2: Float,
        facing: Float = TOWARDS,
        rotation: tuple[Float, Float] | None = None,
    ) -> Fitted:
        """Fit one epoch of marker positions in the rig frame; NaN: not seen.

        Args:
            points_m, cov_m2: (M, 3) [m] and (M, 3, 3) [m^2].
            facing: (3,) unit vector from the hand to the cameras.
            rotation: The palm's rotation (3, 3) by a sensor, its covariance (3, 3) [rad^2], rig axes; None: unknown.
        """
        measured = None
        if rotation is not None:
            matrix, cov_rad2 = rotation
            sure = bool(np.linalg.eigvalsh(cov_rad2)[-1] < _SURE_RAD**2)
            measured = OrientationMeasurement(matrix, np.asarray(np.linalg.inv(cov_rad2), np.float64), sure)
        return self.estimator.push(Epoch(t_ns, points_m, facing, cov_m2=cov_m2, orientation=measured))
