"""Hands that differ from the published proportions, and what cameras see of them during the guided routine."""

from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise

import numpy as np
from msgspec import structs

from common.arrays import Float, Int
from common.calibration import HandProfile, MarkerMount, RestJoint
from common.geometry.transforms import matrix_to_quaternion, rotation_vector_to_matrix
from common.hand.model import CHAINS, JOINTS, HandModel
from common.hand.profiles import generated_profile
from common.sim.people import PERIOD_S, REST, HandRoutine

TIPS = ("thumb", "index", "middle", "ring", "little")
MARKERS = (*TIPS, "back")


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedRoutine:
    """A hand, and its markers with noise.

    Attributes:
        model: The true hand.
        t_ns: (T,) [ns].
        points_m: (T, M, 3) [m]; NaN: not seen.
        cov_m2: (T, M, 3, 3).
        names: The markers.
    """

    model: HandModel
    t_ns: Int
    points_m: Float
    cov_m2: Float
    names: tuple[str, ...]

    def bones_m(self) -> Float:
        """(5, 3) true lengths."""
        return np.linalg.norm(self.model.bone_m, axis=-1)


def a_hand(rng: np.random.Generator, side: str, back: int = 1) -> HandProfile:
    """Some hand of 165 to 210 mm whose every bone is about 6.5 % off its share, and whose knuckles lie elsewhere."""
    base = generated_profile("true", side, float(rng.uniform(0.165, 0.21)))
    model = HandModel.of(base)
    rest = dict(base.rest_joints)
    for chain in CHAINS:
        at = model.rest_position_m[chain[0]] + rng.normal(0.0, 2.5e-3, 3)
        tilt = rotation_vector_to_matrix(np.radians(rng.normal(0.0, 3.0, 3)))
        places = [at]
        for a, b in pairwise(chain):
            bone = model.rest_position_m[b] - model.rest_position_m[a]
            places.append(places[-1] + tilt @ bone * (1.0 + np.clip(rng.normal(0.0, 0.065), -0.13, 0.13)))
        for joint, place in zip(chain, places, strict=True):
            x, y, z = place.tolist()
            quaternion = matrix_to_quaternion(tilt @ model.rest_rotation[joint]).tolist()
            rest[JOINTS[joint]] = RestJoint(position_m=(x, y, z), orientation_wxyz=tuple(quaternion))
    return structs.replace(base, rest_joints=rest, markers=with_back(base, back).markers)


def with_back(profile: HandProfile, back: int) -> HandProfile:
    """With that many markers on the back."""
    sign = 1.0 if profile.side == "right" else -1.0
    places = {"back2": (0.02 * sign, 0.012, 0.075), "back3": (-0.018 * sign, 0.01, 0.078)}
    more = {name: MarkerMount(joint="palm_frame", offset_m=place) for name, place in places.items()}
    return structs.replace(profile, markers=profile.markers | (more if back == 3 else {}))


@cache
def routine(
    seed: int, side: str, noise_m: float = 1e-3, rest: float = REST, back: int = 1, rate_hz: float = 60.0
) -> SimulatedRoutine:
    """One hand's routine, made once: its arrays are not to be changed; with one marker on the back, it is out of sight.

    Args:
        seed: Of hand, motion and noise.
        side: Left or right.
        noise_m: Of every marker, isotropic, white.
        rest: Share of the drift of a hand in the air that the palm keeps.
        back: Markers on the back.
        rate_hz: Of the poses.
    """
    rng = np.random.default_rng([seed, 99])
    model = HandModel.of(a_hand(rng, side, back))
    moved = replace(model, dip_per_pip=float(rng.uniform(0.58, 0.86)))
    motion = HandRoutine(moved, np.array([0.0, 0.0, 0.47]), seed, rest)
    t_s = np.arange(0.0, PERIOD_S, 1.0 / rate_hz)
    states = [motion.at(t) for t in t_s.tolist()]
    names = MARKERS if back == 1 else (*MARKERS, "back2", "back3")
    joints = model.forward(
        np.stack([state.T_rig_palm for state in states]), np.stack([state.angles_rad for state in states])
    )
    points = model.marker_points(joints, names)
    points = points + rng.normal(0.0, noise_m, points.shape)
    if back == 1:
        points[:, 5] = np.nan
    cov = np.where(np.isfinite(points[..., :1, None]), noise_m**2 * np.eye(3), np.nan)
    return SimulatedRoutine(model, (1e9 * t_s).astype(np.int64), points, cov, names)
