"""Measurement model of a wrist device for a subject, and its derivatives.

Unknown of the subject (26) are the palm's pose, and of each of the four fingers where its knuckle is, how
thick it is and how long. Unknown in each strobe cycle are three angles per finger; the DIP follows the PIP.
What is seen are the laser point on its plane and the fingertip. Both are made as the master does
(`master.calibrate.laser_intersection`, `common.hand.model`), so that what is fitted is what will be used.
"""

from dataclasses import dataclass
from typing import get_args

import numpy as np
from msgspec.structs import replace

from common.arrays import Float
from common.calibration import Finger, HandProfile
from common.geometry.transforms import rigid, rotation_vector_to_matrix, transform
from common.hand.model import CHAINS, JOINTS, Chains, Fingertips, HandModel
from common.hand.skin import PalmarSurface
from master.calibrate.laser_intersection import LaserIntersection
from master.estimator.priors import DIP, FlexionSynergy
from master.estimator.sensors import PlaneAxes
from master.rig.setup import WristSetup

FINGERS = slice(1, 5)
UNKNOWN, LOCAL = 26, 3
ABDUCTION, MCP, PIP = range(LOCAL)
_ROTATION_STEP = np.radians(0.5)  # of central differences


@dataclass(frozen=True, slots=True, eq=False)
class Unknown:
    """What is unknown of a subject, as changes of a setup."""

    # (6,) rotation [rad] about the wrist joint and shift [m] of the palm, camera axes. A strap holds a device
    # at the wrist and lets it turn: knuckles that lie elsewhere indicate a rotation first
    pose: Float
    knuckle_m: Float  # (4, 3) shift of each knuckle, palm frame
    thick: Float  # this and long: (4,) natural logarithms of the factors of thickness and length
    long: Float

    @classmethod
    def of(cls, x: Float) -> "Unknown":
        """From a vector (26,): pose, knuckles, thickness, length."""
        return cls(x[:6], x[6:18].reshape(4, 3), x[18:22], x[22:26])


class SubjectModel:
    """Laser points and tips of one device and hand as a function of the unknowns."""

    def __init__(self, setup: WristSetup) -> None:
        self._setup, self._surface, self.axes = setup, PalmarSurface.of(setup.model), PlaneAxes.of(setup)
        self._intersection, self._tips = LaserIntersection(setup, rays=32), Fingertips.of(setup.model)
        self._root = setup.model.rest_position_m[CHAINS[:, 0]]
        synergy = FlexionSynergy.of(setup.model)
        distance = np.linalg.norm(transform(setup.T_camera_palm, self._root[FINGERS].mean(axis=0)))
        self.px_per_m = float(setup.optics.matrix[0, 0] / distance)  # at the knuckles
        self.mcp_per_pip, self.dip_per_pip = synergy.per_pip[FINGERS, 1], synergy.per_pip[FINGERS, DIP]

    @property
    def none(self) -> Unknown:
        """No change."""
        return Unknown.of(np.zeros(UNKNOWN))

    def palm(self, unknown: Unknown) -> Float:
        """T_camera_palm (4, 4)."""
        guess = self._setup.T_camera_palm
        change = rotation_vector_to_matrix(unknown.pose[:3])
        return rigid(change @ guess[:3, :3], guess[:3, 3] + unknown.pose[3:])

    def knuckles(self, unknown: Unknown) -> Float:
        """(4, 3) of index ... little, camera frame [m]."""
        return transform(self.palm(unknown), self._root[FINGERS] + unknown.knuckle_m)

    def __call__(self, x: Float, angles: Float) -> Float:
        """Laser point (across, along) [m] and tip [px] (T, 4, 4); NaN: the laser misses.

        Unknowns x (26,) as of `Unknown`, angles (T, 4, 3) abduction, MCP, PIP [rad].
        """
        return self._seen([self._surface_of(Unknown.of(x), angles)])[0]

    def derivatives(self, x: Float, angles: Float) -> tuple[Float, Float]:
        """Derivatives (T, 4, 4, 26) by unknowns, (T, 4, 4, 3) by angles; 0: not known."""
        shift_step, share_step = 5e-4, 0.02  # of central differences
        steps = np.r_[np.full(3, _ROTATION_STEP), np.full(3, shift_step), np.full(2, share_step)]
        ways = np.zeros((8, UNKNOWN))
        ways[:6, :6] = np.eye(6)
        ways[6, 18:22] = ways[7, 22:26] = 1.0
        surfaces: list[tuple[Float, Float, Float]] = []
        for way, step in zip(ways, steps, strict=True):
            surfaces += [self._surface_of(Unknown.of(x + sign * step * way), angles) for sign in (1.0, -1.0)]
        for k in range(LOCAL):
            change = _ROTATION_STEP * np.eye(LOCAL)[k]
            surfaces += [self._surface_of(Unknown.of(x), angles + sign * change) for sign in (1.0, -1.0)]
        seen = self._seen(surfaces)
        half = np.r_[steps, np.full(LOCAL, _ROTATION_STEP)]
        per_pip = np.nan_to_num((seen[0::2] - seen[1::2]) / (2.0 * half[:, None, None, None]))
        out = np.zeros((*angles.shape[:2], 4, UNKNOWN))
        out[..., :6] = np.moveaxis(per_pip[:6], 0, -1)
        # A knuckle that moves in the palm moves its finger as a palm does that moves: only turned.
        by_knuckle = np.moveaxis(per_pip[3:6], 0, -1) @ self.palm(Unknown.of(x))[:3, :3]
        for f in range(4):
            out[:, f, :, 6 + 3 * f : 9 + 3 * f] = by_knuckle[:, f]
            out[:, f, :, 18 + f], out[:, f, :, 22 + f] = per_pip[6, :, f], per_pip[7, :, f]
        return out, np.moveaxis(per_pip[8:], 0, -1)

    def _surface_of(self, unknown: Unknown, angles: Float) -> tuple[Float, Float, Float]:
        """Spheres (T, 4, K, 3), radii (4, K) and tips (T, 4, 3) [m] in the camera frame."""
        whole = np.zeros((len(angles), 5, 4))
        whole[:, FINGERS, :3] = angles
        whole[:, FINGERS, DIP] = self.dip_per_pip * angles[..., 2]
        chains = self._setup.model.chains(whole)
        long, shift, thick = np.ones((5, 1, 1)), np.zeros((5, 1, 3)), np.ones((5, 1))
        long[FINGERS, 0, 0], thick[FINGERS, 0] = np.exp(unknown.long), np.exp(unknown.thick)
        shift[FINGERS, 0] = unknown.knuckle_m
        root = self._root[:, None]
        chains = Chains(root + shift + long * (chains.position_m - root), chains.rotation)
        surface = PalmarSurface(thick * self._surface.palmar_m, thick * self._surface.radius_m)
        spheres = surface.spheres(chains)
        tips, palm = self._tips.points(chains), self.palm(unknown)
        tips_m = transform(palm, tips[:, FINGERS])
        return transform(palm, spheres[:, FINGERS]), surface.radius_m[FINGERS], tips_m

    def _seen(self, surfaces: list[tuple[Float, Float, Float]]) -> Float:
        """(P, T, 4, 4) laser points and tips of P hands."""
        spheres = np.stack([one[0] for one in surfaces])
        radius = np.stack([one[1] for one in surfaces])[:, None]
        line = self._intersection.line(spheres, radius, np.bool_(False))
        tips = self._setup.optics.project(np.stack([one[2] for one in surfaces]))
        return np.concatenate([line.point_m, tips], axis=-1)


def fitted_profile(model: HandModel, unknown: Unknown) -> HandProfile:
    """The hand file with the knuckles, lengths and thickness of its subject."""
    place = model.rest_position_m.copy()
    thick = PalmarSurface.of(model).palmar_m[FINGERS] * np.exp(unknown.thick)[:, None]
    for f, chain in enumerate(CHAINS[FINGERS]):
        root = place[chain[0]].copy()
        place[chain] = root + unknown.knuckle_m[f] + np.exp(unknown.long[f]) * (place[chain] - root)
    joints = dict(model.profile.rest_joints)
    for index in CHAINS[FINGERS].ravel():
        x, y, z = (round(float(v), 9) for v in place[index])
        joints[JOINTS[index]] = replace(joints[JOINTS[index]], position_m=(x, y, z))
    plain = replace(model.profile, rest_joints=joints)
    names: tuple[Finger, ...] = get_args(Finger)[FINGERS]
    # Without radii the breadth of the knuckles constrains the thickness, and they have moved.
    without = {name: scale for name, scale in plain.palmar_scale.items() if name not in names}
    typical = PalmarSurface.of(HandModel.of(replace(plain, palmar_scale=without))).palmar_m[FINGERS]
    scale = (thick / typical).mean(axis=1)
    scales = {name: round(float(value), 4) for name, value in zip(names, scale, strict=True)}
    return replace(plain, palmar_scale=without | scales)
