"""Defaults for what a hand profile may omit.

Joint limits and couplings as given in the two papers, and radii.

How far abduction narrows in a fist is in neither paper. Fingers pushed aside by a known force give way by 24
degrees at a straight MCP and by 15 at 90 degrees of flexion, the mean of all fingers of 100 people (Lutsky, Matzon,
Walinchus, Ross & Beredjiklian, J. Hand Surg. Am. 39, 2014). Their ratio is taken: a limit is where the ligaments
stop a finger. Of their own force people spread a fist even less.

Nor do the papers state how people differ from their limits. Active ranges of young adults have standard deviations
of 5 to 12 degrees, and knuckles reach 20 degrees beyond the straight finger (Mallon, Brown & Nunley, "Digital ranges
of motion: normal values in young adults", J. Hand Surg. Am. 16, 1991). So a preset is a prior with a width.
"""

from math import radians

import numpy as np
from msgspec.structs import replace

from common.calibration import Couplings, FingerLimits, Limits, Preset

# Radii by place in the finger [share of the middle finger's proximal bone], for profiles without radius_m.
_RADIUS_SHARE = {
    "palm": 0.3,
    "wrist": 0.5,
    "metacarpal": 0.3,
    "proximal": 0.2,
    "intermediate": 0.175,
    "distal": 0.16,
    "tip": 0.145,
}

_TOLERANCE_RAD = (radians(5.0), radians(6.0), radians(4.0), radians(4.0))


def preset_limits(preset: Preset) -> Limits:
    """Joint limits of Kalbfleisch (K) or Digits (D), relative to the rest pose."""
    k = preset == "K"
    abduction = 15.0 if k else 20.0
    thumb = _degrees((-20.0, 50.0), (-15.0, 50.0), (-10.0, 60.0), (-15.0, 85.0))

    def finger(spread: float) -> FingerLimits:
        flexion, pip, dip = (90.0, 110.0, 90.0) if k else (100.0, 120.0, 101.0)
        spread_at_full_flexion = 15.0 / 24.0
        return _degrees((-spread, spread), (0.0, flexion), (0.0, pip), (0.0, dip), spread_at_full_flexion)

    side = finger(abduction)
    return Limits(thumb=thumb, index=side, middle=finger(0.0 if k else abduction), ring=side, little=side)


def without_tolerance(limits: Limits) -> Limits:
    """The same limits as walls."""
    walls = {
        name: replace(getattr(limits, name), tolerance_rad=(0.0, 0.0, 0.0, 0.0))
        for name in Limits.__struct_fields__
    }
    return Limits(**walls)


def preset_couplings(preset: Preset) -> Couplings:
    """Return the couplings of a preset.

    DIP per PIP: 2/3 in K, 0.84 in D (Kamper's ratio); MCP = 0.54 PIP is D's natural flexion.
    """
    return Couplings(dip_per_pip=2.0 / 3.0 if preset == "K" else 0.84, mcp_per_pip=0.54)


def _degrees(
    abduction: tuple[float, float],
    flexion: tuple[float, float],
    pip: tuple[float, float],
    dip: tuple[float, float],
    spread_at_full_flexion: float = 1.0,
) -> FingerLimits:
    def span(value: tuple[float, float]) -> tuple[float, float]:
        return float(np.radians(value[0])), float(np.radians(value[1]))

    return FingerLimits(
        abduction_rad=span(abduction),
        flexion_rad=span(flexion),
        pip_rad=span(pip),
        dip_rad=span(dip),
        spread_at_full_flexion=spread_at_full_flexion,
        tolerance_rad=_TOLERANCE_RAD,
    )


def radius_share(joint: str) -> float:
    """Radius of an OpenXR joint, as a share of the middle finger's proximal bone."""
    return _RADIUS_SHARE[joint.rsplit("-", 1)[-1]]
