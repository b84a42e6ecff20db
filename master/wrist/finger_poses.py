"""What a wrist device would see of a finger in any of its poses: the forward function of the inverse model.

A finger has three unknowns, each in its range: abduction, flexion of the MCP (0 ... 100 degrees in preset D), and PIP
(0 ... 120); the DIP follows the PIP by the coupling (rows D16, D19). With the second angle counted from the first bone
(I16) the chain is that of `common.hand_model`. A thumb has an axis of its own: CMC abduction, CMC flexion, and how far
MCP and IP are closed together, in shares of their ranges as in `NaturalCurve`.

What is seen are four numbers: where the laser meets the finger (2, on its plane), and its tip in the image (2).
"""

from copy import copy
from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.geometry import transform
from common.hand_limits import ABDUCTION, FLEXION
from common.hand_model import Chains
from master.wrist.fingertip import Fingertips
from master.wrist.forward import ASIDE_RAD, BEYOND_RAD, DIP, PIP, NaturalCurve
from master.wrist.laser_cut import LaserCut
from master.wrist.setup import WristSetup
from master.wrist.skin import Skin, first_hits

UNKNOWNS = 3
SEEN = 4
BEHIND_M = 0.003  # of its own finger before a tip: it lies 12 degrees behind the edge of a round tip


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """What is seen of fingers (...).

    Attributes:
        seen: (..., 4) laser point on its plane (across, along) [m], tip (x / z, y / z); NaN where the laser misses.
        length_px: (...) of the laser line in the undistorted image.
    """

    seen: Float
    length_px: Float


class FingerPoses:
    """Poses of the five fingers of one hand before one device. What it holds was prepared by the constructor.

    Attributes:
        low, high: (5, 3) range of the unknowns [rad]; that of the abduction goes beyond the limits of the hand, for
            noise and skin.
    """

    def __init__(self, setup: WristSetup) -> None:
        self._setup, self._curve = setup, NaturalCurve.of(setup.model)
        self._cut, self._skin, self._tips = (
            LaserCut(setup),
            Skin.of(setup.model),
            Fingertips.of(setup.model),
        )
        limits = setup.model.limits_rad
        self.low, self.high = limits[:, :UNKNOWNS, 0].copy(), limits[:, :UNKNOWNS, 1].copy()
        aside = np.maximum(np.abs(limits[:, ABDUCTION]).max(axis=1), ASIDE_RAD) + BEYOND_RAD
        self.low[:, ABDUCTION], self.high[:, ABDUCTION] = -aside, aside
        self._dip = self._curve.slope[:, DIP], self._curve.base_rad[:, DIP], limits[:, DIP].T

    def bent(self, setup: WristSetup) -> "FingerPoses":
        """The same hand before another palm pose."""
        other = copy(self)
        other._setup, other._cut = setup, self._cut.bent(setup)
        return other

    @property
    def curve(self) -> NaturalCurve:
        """How fingers bend naturally."""
        return self._curve

    @property
    def dip_per_pip(self) -> Float:
        """(5,) how far the last joint bends with the one before."""
        return self._dip[0]

    @property
    def habit(self) -> tuple[Float, Float]:
        """Slope and base (5,) of natural flexion: flexion = base + slope * PIP."""
        return self._curve.slope[:, FLEXION], self._curve.base_rad[:, FLEXION]

    def angles(self, x: Float) -> Float:
        """Angles (..., 5, 4) [rad] of unknowns (..., 5, 3)."""
        slope, base, (low, high) = self._dip
        out = np.empty((*x.shape[:-1], 4))
        out[..., :UNKNOWNS] = x
        out[..., DIP] = np.clip(base + slope * x[..., PIP], low, high)
        return out

    def angles_of(self, x: Float, finger: Int) -> tuple[Float, Float]:
        """Angles (N, 4) [rad] of unknowns (N, 3) of fingers (N,), and how the last joint follows the PIP there (N,)."""
        slope, base, limits = self._dip
        dip = base[finger] + slope[finger] * x[:, PIP]
        low, high = limits[:, finger]
        free = (dip > low) & (dip < high)
        return np.concatenate([x, np.clip(dip, low, high)[:, None]], axis=1), np.where(
            free, slope[finger], 0.0
        )

    def tips(self, angles_rad: Float) -> Float:
        """Tips (..., 5, 3) [m], camera frame, of angles (..., 5, 4)."""
        return transform(self._setup.T_camera_palm, self.tips_in_palm(angles_rad))

    def tips_in_palm(self, angles_rad: Float) -> Float:
        """Tips (..., 5, 3) [m], palm frame, of angles (..., 5, 4)."""
        return self._tips.points(self._setup.model.chains(angles_rad))

    def tips_of(self, angles_rad: Float, finger: Int) -> Float:
        """Tips (N, 3) [m], camera frame, of angles (N, 4) of fingers (N,), each its own."""
        chains = self.chains(angles_rad, finger)
        return transform(self._setup.T_camera_palm, Fingertips(self._tips.beyond_m[finger]).points(chains))

    def views(self, x: Float, wanted: Bool, cut: LaserCut | None = None) -> Views:
        """What is seen of some of the fingers with unknowns (N, 5, 3): the `wanted` (N, 5); NaN of the others."""
        cut = cut or self._cut
        chains = self._setup.model.chains(self.angles(x))
        T = self._setup.T_camera_palm
        tips = transform(T, self._tips.points(chains))
        finger = np.nonzero(wanted)[1]
        spheres = transform(T, self._skin.spheres(chains)[wanted])
        line = cut.line(spheres, self._skin.radius_m[finger], finger == 0)
        seen, length = np.full((*wanted.shape, SEEN), np.nan), np.full(wanted.shape, np.nan)
        seen[wanted, :2], length[wanted] = line.point_m, line.length_px
        seen[..., 2:] = tips[..., :2] / tips[..., 2:]
        return Views(seen, length)

    def of_fingers(self, x: Float, finger: Int, cut: LaserCut | None = None) -> tuple[Float, Float]:
        """What is seen (N, 4) of poses (N, 3) of fingers (N,), each its own, and the lengths of the lines (N,) [px]."""
        rank = _ranks(finger)
        rows = int(rank.max(initial=-1)) + 1
        grid, wanted = np.zeros((rows, 5, UNKNOWNS)), np.zeros((rows, 5), np.bool_)
        grid[rank, finger], wanted[rank, finger] = x, True
        views = self.views(grid, wanted, cut)
        return views.seen[rank, finger], views.length_px[rank, finger]

    def chains(self, angles_rad: Float, finger: Int) -> Chains:
        """The joints (N, 4, ...), palm frame, of angles (N, 4) of fingers (N,), each its own."""
        rank = _ranks(finger)
        grid = np.zeros((int(rank.max(initial=-1)) + 1, 5, 4))
        grid[rank, finger] = angles_rad
        chains = self._setup.model.chains(grid)
        return Chains(chains.position_m[rank, finger], chains.rotation[rank, finger])

    def tips_shown(self, x: Float) -> Bool:
        """Whether the camera sees the tips (N, 5) of unknowns (N, 5, 3), or these lie just behind a finger's edge."""
        chains, T = self._setup.model.chains(self.angles(x)), self._setup.T_camera_palm
        tips = transform(T, self._tips.points(chains))
        spheres = transform(T, self._skin.spheres(chains))
        away = np.linalg.norm(tips, axis=-1)
        out = np.empty(away.shape, np.bool_)
        for f in range(5):
            rays = (tips[:, f] / away[:, f, None])[:, None]
            first = first_hits(np.zeros(3), rays, spheres[:, f], self._skin.radius_m[f])
            out[:, f] = first.min(axis=(1, 2)) > away[:, f] - BEHIND_M
        return out


def _ranks(finger: Int) -> Int:
    """Of rows of fingers (N,) the how manieth of its finger each is (N,)."""
    rank = np.empty(len(finger), np.int64)
    for f in range(5):
        of = finger == f
        rank[of] = np.arange(np.count_nonzero(of))
    return rank
