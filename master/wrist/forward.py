"""Where the laser meets a finger that bends naturally: a table of one hand, simulated (Digits, UIST 2012).

A natural finger bends all its joints together: MCP = 0.54 PIP, DIP = 0.84 PIP, PIP 0 ... 120 degrees (Kamper's ratios),
where the hand file does not say otherwise. The joints of a thumb go through the same share of their ranges. So a finger
has two unknowns, how far it is *closed* (its PIP; a thumb's MCP) and its abduction, and its laser point has two
coordinates on the plane. The table holds that point over both unknowns; `master.wrist.invert` turns it round.

For each pose of the grid the bones go where forward kinematics puts them, and the laser is made to meet the skin
around them (`master.wrist.laser_cut`).

**The branch.** A bending finger moves its point towards the device, by 15 mm for 5 degrees when straight and by 1 mm
when bent by 80. At about 95 the last phalanx folds into the light: the line jumps to it and then hardly moves. The
table is turned round up to that jump only.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.errors import CalibrationError
from common.hand_limits import ABDUCTION, FLEXION
from common.hand_model import HandModel
from common.hand_presets import preset_couplings
from master.wrist.laser_cut import LaserCut
from master.wrist.setup import WristSetup

PIP, DIP = 2, 3
CLOSED_RAD = np.radians(120.0)
_CLOSINGS, _ABDUCTIONS = 61, 9
_NUDGED_ROWS = 4
ASIDE_RAD = np.radians(20.0)  # abduction of preset D
BEYOND_RAD = np.radians(5.0)  # the grid goes beyond the limits of abduction, for noise and skin
_JUMP = 0.3  # spheres by which the line's mean place on the finger may rise while it bends
_WHOLE = 0.7  # share of the line as it was a few rows before; less is partly hidden by the last phalanx
_FADE = 0.97  # by which a line may shorten from row to row
_NUDGE_RAD = np.radians(3.0)


@dataclass(frozen=True, slots=True, eq=False)
class NaturalCurve:
    """Angles by closing: base + closing * slope.

    Attributes:
        base_rad, slope: (5, 4); the slope of the PIP (thumb MCP) is 1.
        range_rad: (5, 2) of the closing.
    """

    base_rad: Float
    slope: Float
    range_rad: Float

    @classmethod
    def of(cls, model: HandModel) -> "NaturalCurve":
        """That of a hand: its own couplings where its file states them, else those of Digits."""
        stated = model.profile.couplings is not None
        digits = preset_couplings("D")
        mcp, dip = (model.mcp_per_pip, model.dip_per_pip) if stated else (None, None)
        base, slope, reach = np.zeros((5, 4)), np.zeros((5, 4)), np.empty((5, 2))
        slope[1:, FLEXION] = digits.mcp_per_pip if mcp is None else mcp
        slope[1:, DIP] = digits.dip_per_pip if dip is None else dip
        slope[:, PIP] = 1.0
        reach[1:] = 0.0, CLOSED_RAD
        low, high = model.limits_rad[0, 1:].T
        span = np.maximum(high - low, 1e-3)
        slope[0, 1:] = span / span[1]
        base[0, 1:] = low - low[1] * slope[0, 1:]
        reach[0] = low[1], low[1] + span[1]
        return cls(base, slope, reach)

    def angles(self, closing_rad: Float, abduction_rad: Float) -> Float:
        """Angles (..., 5, 4) [rad] of closings and abductions (..., 5) [rad]."""
        angles = self.base_rad + closing_rad[..., None] * self.slope
        angles[..., ABDUCTION] = abduction_rad
        return angles


@dataclass(frozen=True, slots=True, eq=False)
class ForwardTable:
    """Laser points over closing (C) and abduction (A) of the five fingers.

    Attributes:
        curve: What is natural.
        closing_rad: (5, C), even steps.
        abduction_rad: (5, A), even steps.
        point_m: (5, C, A, 2) coordinates on the plane (across, along) [m], continued where the laser misses the finger.
        by_mcp, by_dip: (5, C, A, 2) how the point moves with the MCP or the DIP alone [m/rad].
        length_px: (5, C, A) of the lit and seen line in the undistorted image; 0: the laser misses.
        last: (5, A) rows at which the branch ends.
    """

    curve: NaturalCurve
    closing_rad: Float
    abduction_rad: Float
    point_m: Float
    by_mcp: Float
    by_dip: Float
    length_px: Float
    last: Int

    @classmethod
    def of(cls, setup: WristSetup) -> "ForwardTable":
        """Simulate it; takes one or two seconds.

        Raises:
            CalibrationError: The laser meets none of index ... little, however they are bent.
        """
        model = setup.model
        curve = NaturalCurve.of(model)
        closing = _evenly(curve.range_rad, _CLOSINGS)
        # A limit of 0, as preset K has for the middle finger, keeps no real finger from moving aside.
        most = np.maximum(np.abs(model.limits_rad[:, ABDUCTION]), ASIDE_RAD) + BEYOND_RAD
        abduction = _evenly(np.array([-1.0, 1.0]) * most, _ABDUCTIONS)
        angles = curve.angles(*np.broadcast_arrays(closing.T[:, None], abduction.T[None]))  # (C, A, 5, 4)
        cut = LaserCut(setup)
        point, length, place = cut(angles)
        if not (length[1:] > 0.0).any():
            raise CalibrationError(
                "laser_plane, T_camera_palm: the laser meets no finger of this hand however it is bent: calibrate plane"
                " and palm"
            )
        return cls(
            curve,
            closing,
            abduction,
            continued(point),
            _nudged(cut, angles, FLEXION),
            _nudged(cut, angles, DIP),
            length,
            _branch(length, place),
        )

    @property
    def met(self) -> Bool:
        """(5,) whether the laser meets the finger in so many poses that its point can be followed."""
        return ((self.length_px > 0.0).sum(axis=1) > 1).any(axis=1)


def _evenly(ends: Float, count: int) -> Float:
    """Even steps (5, count) between ends (5, 2)."""
    return ends[:, :1] + np.linspace(0.0, 1.0, count) * (ends[:, 1:] - ends[:, :1])


def _nudged(cut: LaserCut, angles_rad: Float, joint: int) -> Float:
    """How the point moves with one joint [m/rad], (5, C, A, 2): found on some rows, between them interpolated."""
    rows = np.arange(0, _CLOSINGS, _NUDGED_ROWS)
    ends: list[Float] = []
    for sign in (-1.0, 1.0):
        nudged = angles_rad[rows]
        nudged[..., joint] += sign * _NUDGE_RAD
        ends.append(cut(nudged)[0])
    some = continued((ends[1] - ends[0]) / (2.0 * _NUDGE_RAD))
    at = np.arange(_CLOSINGS) / _NUDGED_ROWS
    before = np.minimum(at.astype(np.int64), len(rows) - 2)
    share = (at - before)[:, None, None]
    return (1.0 - share) * some[:, before] + share * some[:, before + 1]


def continued(values: Float) -> Float:
    """Values (5, C, A, N) with straight lines along C in place of NaN; 0 where a column holds no two numbers."""
    out = values.copy()
    rows = np.arange(values.shape[1], dtype=np.float64)
    for f, a, n in np.ndindex(values.shape[0], *values.shape[2:]):
        column = values[f, :, a, n]
        known = np.flatnonzero(np.isfinite(column))
        if len(known) == len(column):
            continue
        if len(known) < 2:
            out[f, :, a, n] = 0.0
            continue
        filled = np.interp(rows, rows[known], column[known])
        for end, inner in ((known[0], known[1]), (known[-1], known[-2])):
            slope = (column[end] - column[inner]) / (end - inner)
            outside = (rows - end) * np.sign(end - inner) > 0.0
            filled[outside] = column[end] + slope * (rows[outside] - end)
        out[f, :, a, n] = filled
    return out


def _branch(length_px: Float, place: Float) -> Int:
    """Last rows (5, A) to which the lit line is whole and wanders towards the palm while the finger closes.

    A thumb's has no such end: it never reaches its own tip.
    """
    last = np.full((5, length_px.shape[2]), length_px.shape[1] - 1)
    for f, a in np.ndindex(last.shape):
        lowest, longest = np.inf, 0.0
        for row in np.flatnonzero(length_px[f, :, a] > 0.0) if f else ():
            length = length_px[f, row, a]
            if place[f, row, a] > lowest + _JUMP or length < _WHOLE * longest:
                last[f, a] = row - 1
                break
            lowest, longest = min(lowest, place[f, row, a]), max(_FADE * longest, length)
    return last
