"""Joint couplings of a person's fingers, from a motion capture.

How the joints flex together: the couplings of the hand file.

    DIP = ratio . PIP,  MCP = ratio . PIP        index ... little, least squares through zero, with the weights of Huber

Zero is the straight finger in the palm's plane, which is where profiles from joints have it. Noise of the joints, which
shows in bones that change their length, turns short bones; it is taken out of the spread. A DIP that keeps its ratio
to half a degree was not measured: trackers make it from the PIP (the Leap does so). An MCP that is off by more than 25
degrees has no coupling: people bend it alone as well, and what was done in the recording constrains too little.
"""

from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from common.arrays import Float, Int
from common.calibration import Couplings
from common.calibration.hand_presets import preset_couplings

_MOVES_RAD_S = np.radians(10.0)
_BENT_RAD = np.radians(15.0)  # the PIP, where it determines a ratio
_RANGE_RAD = np.radians(20.0)  # of the PIP from the 5th to the 95th hundredth, at least
_MADE_RAD = np.radians(0.5)
_NO_COUPLING_RAD = np.radians(25.0)
_ROUNDS = 20


@dataclass(frozen=True, slots=True)
class Ratio:
    """One angle against the PIP.

    Attributes:
        per_pip: The ratio.
        spread_rad: Standard deviation about it, that of noise taken out; 0: no more than noise.
        noise_rad: What noise of the joints makes of it.
    """

    per_pip: float
    spread_rad: float
    noise_rad: float


@dataclass(frozen=True, slots=True)
class MotionCouplings:
    """Couplings measured from a motion.

    Attributes:
        moved_s: How long any PIP moved.
        dip, mcp: The ratios; None: fingers bend too little.
        couplings: Those of the default with what was measured; None: nothing was.
        remarks: What was not taken, and why.
    """

    moved_s: float
    dip: Ratio | None
    mcp: Ratio | None
    couplings: Couplings | None
    remarks: tuple[str, ...]


def motion_couplings(angles_rad: Float, chains_m: Float, t_ns: Int) -> MotionCouplings:
    """Couplings from a motion.

    Args:
        angles_rad: (T, 5, 4) [rad] of `common.hand.posture.joint_angles`.
        chains_m: (T, 5, 4, 3) [m] the joints that these are of: their noise is estimated from bones that change.
        t_ns: (T,) [ns] times.
    """
    angles = angles_rad[:, 1:, 1:]
    step_s = 1e-9 * np.diff(t_ns)
    rate = np.abs(np.diff(angles[:, :, 1], axis=0)).max(axis=1) / step_s
    # longer, two frames are no step
    moved_s = float(step_s[(rate > _MOVES_RAD_S) & (step_s < 0.1)].sum())
    low, high = np.percentile(angles[:, :, 1], [5.0, 95.0])
    # of movement, at least
    if moved_s < 20.0 or high - low < _RANGE_RAD:
        why = f"fingers move for {moved_s:.0f} s, and {np.degrees(high - low):.0f}° at the PIP"
        return MotionCouplings(
            moved_s, None, None, None, (f"couplings are the default: {why}; 20 s and 20° are needed",)
        )
    first, middle, last = _joint_noise(chains_m)
    dip = _ratio(angles[..., 2], angles[..., 1], (last, middle))
    mcp = _ratio(angles[..., 0], angles[..., 1], (first, middle))
    couplings, remarks, taken = preset_couplings("K"), list[str](), False
    if np.hypot(dip.spread_rad, dip.noise_rad) < _MADE_RAD:
        remarks.append(
            f"DIP is {dip.per_pip:.2f} PIP to {np.degrees(dip.spread_rad):.1f}°: its tracker made it so; the default"
            " stays"
        )
    else:
        couplings, taken = replace(couplings, dip_per_pip=dip.per_pip, dip_spread_rad=dip.spread_rad), True
    if mcp.spread_rad > _NO_COUPLING_RAD or mcp.per_pip <= 0.0:
        remarks.append(
            f"MCP deviates by {np.degrees(mcp.spread_rad):.0f}° from {mcp.per_pip:.2f} PIP: no coupling; the default"
            " stays"
        )
    else:
        couplings, taken = replace(couplings, mcp_per_pip=mcp.per_pip), True
    return MotionCouplings(moved_s, dip, mcp, couplings if taken else None, tuple(remarks))


def _joint_noise(chains_m: Float) -> tuple[float, float, float]:
    """Return the standard deviations [rad] of MCP, PIP and DIP by joint noise.

    Mean square over index ... little.

    A bone from a to b of length L turns by the noise across it; b moves both bones at an angle. The noise is that along
    the bones, whose length does not change in truth, alike in all directions.
    """
    length = np.linalg.norm(np.diff(chains_m[:, 1:], axis=2), axis=3)
    variance = 0.5 * length.var(axis=0).mean(axis=1, keepdims=True)  # of a joint, per axis; (4, 1)
    inverse = 1.0 / length.mean(axis=0)
    joined = inverse[:, :-1] ** 2 + (inverse[:, :-1] + inverse[:, 1:]) ** 2 + inverse[:, 1:] ** 2
    first = np.sqrt((variance * 2.0 * inverse[:, :1] ** 2).mean())
    middle, last = np.sqrt((variance * joined).mean(axis=0))
    return float(first), float(middle), float(last)


def _ratio(angle: Float, pip: Float, noise_rad: tuple[float, float]) -> Ratio:
    """Of angles (T, 4) [rad] to PIPs, where these are bent, and the noise of both."""
    bent = pip > _BENT_RAD
    x, y = pip[bent], angle[bent]
    weight, slope = np.ones(len(x)), 0.0
    off, spread = np.zeros(len(x)), 0.0
    for _ in range(_ROUNDS):
        slope = float((weight * x * y).sum() / (weight * x * x).sum())
        off = np.asarray(np.abs(y - slope * x), np.float64)
        spread = max(1.4826 * float(np.median(off)), 1e-6)
        huber = 1.345
        weight = np.minimum(1.0, huber * spread / np.maximum(off, 1e-12))
    outlier = 4.0
    typical = off < outlier * spread
    spread = float(np.sqrt((off[typical] ** 2).mean()))
    noise = float(np.hypot(noise_rad[0], slope * noise_rad[1]))
    left = spread * spread - noise * noise
    least_share = 0.25  # of a variance: less is noise
    return Ratio(slope, float(np.sqrt(left)) if left > least_share * spread * spread else 0.0, noise)
