"""Poses of the recordings, as the 21 named angles, of a right hand and of a left one alike."""

import numpy as np

from bench.wrist_mesh.hinges import CHAINS, Hinges
from common.arrays import Bool, Float
from common.hand.model import HandModel

DIP_PER_PIP = 0.84
MCP_PER_PIP = 0.54
SPREAD = np.radians((0.2, -3.0, -7.0, -11.8))  # of the recorded hand at rest
MCP, ABDUCTION, PIP, DIP = (np.arange(first, 21, 4) for first in (5, 6, 7, 8))
THUMB_OPEN = np.radians((-6.0, -14.0, 0.0, 0.0, 0.0))
THUMB_CLOSED = np.radians((18.0, -4.0, 8.0, 25.0, 35.0))
CURL_RAD = np.radians(120.0)  # PIP at which the thumb is closed
TRIES = 400
ROOM_SHARE = 0.8  # of the radii: flesh gives way
_PALM_Y_M, _PALM_Z_M = -0.028, 0.088  # the palm's surface and its end at the fingers, palm frame


def natural(pip_rad: Float, thumb: float | None = None) -> Float:
    """Fingers (…, 21) bent as a hand closes, PIP (…, 4); the thumb closed by a share, by default like the index."""
    out = np.zeros((*pip_rad.shape[:-1], 21))
    out[..., PIP], out[..., DIP], out[..., MCP] = pip_rad, DIP_PER_PIP * pip_rad, MCP_PER_PIP * pip_rad
    out[..., ABDUCTION] = SPREAD
    share = pip_rad[..., :1] / CURL_RAD if thumb is None else thumb
    out[..., :5] = THUMB_OPEN + share * (THUMB_CLOSED - THUMB_OPEN)
    return out


def straight(mcp_rad: float) -> Float:
    """Straight fingers (21,), bent at the MCP."""
    out = natural(np.zeros(4))
    out[MCP] = mcp_rad
    return out


def spread(share: float, pip_rad: float, aside_rad: float) -> Float:
    """Half-bent fingers (21,), spread by a share of the recorded hand's resting spread, all moved aside."""
    out = natural(np.full(4, pip_rad), 0.0)
    out[:2] = np.radians((-4.0, -12.0))
    out[ABDUCTION] = SPREAD[1] + share * (SPREAD - SPREAD[1]) + aside_rad
    return out


def independent(rng: np.random.Generator) -> Float:
    """One pose (21,) in which no joint says anything of another, but the DIP of its PIP."""
    out = np.zeros(21)
    out[MCP] = rng.uniform(0.0, np.radians(80.0), 4)
    out[PIP] = rng.uniform(0.0, np.radians(100.0), 4)
    out[DIP] = out[PIP] * rng.uniform(0.5, 0.9, 4)
    out[ABDUCTION] = SPREAD + rng.uniform(-np.radians(10.0), np.radians(10.0), 4)
    low, high = np.radians((-6.0, -14.0, 0.0, 0.0, 0.0)), np.radians((20.0, 20.0, 0.0, 40.0, 50.0))
    out[:5] = rng.uniform(low, high)
    out[2] = max(out[0] - low[0], 0.0) / 3.0  # the twist follows the flexion, as in the recorded poses
    return out


def possible(model: HandModel, angles_rad: Float) -> bool:
    """Whether fingers are beside each other, and none is in the palm."""
    at, _ = Hinges.of(model).pose(angles_rad)
    radius = model.radius_m[1:]
    share = np.linspace(0.0, 1.0, 7)[:, None]
    points: list[Float] = []
    widths: list[Float] = []
    root: list[Bool] = []
    for f, chain in enumerate(CHAINS):
        for k in range(3):
            a, b = chain[k], chain[k + 1]
            if f == 0 and k == 0:
                continue
            points.append(at[a] + share * (at[b] - at[a]))
            widths.append(radius[a] + share[:, 0] * (radius[b] - radius[a]))
            root.append(np.full(len(share), k == 0))
    finger = np.repeat([0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4], len(share))
    xyz, wide, first = np.concatenate(points), np.concatenate(widths), np.concatenate(root)
    apart = np.linalg.norm(xyz[:, None] - xyz, axis=2)
    close = apart < ROOM_SHARE * (wide[:, None] + wide)
    close &= (finger[:, None] != finger) & ~(first[:, None] & first)
    size = np.linalg.norm(at[10] - at[11]) / 0.0664
    sunk = (xyz[:, 2] < _PALM_Z_M * size) & (xyz[:, 1] > _PALM_Y_M * size) & ~first & (finger > 0)
    return not close.any() and not sunk.any()


def random_pose(model: HandModel, rng: np.random.Generator) -> Float:
    """An independent pose (21,) that is possible."""
    for _ in range(TRIES):
        angles = independent(rng)
        if possible(model, angles):
            return angles
    raise RuntimeError(f"no possible pose in {TRIES} tries")


def curling(t_s: Float, phase: Float) -> Float:
    """Fingers (T, 21) that curl and uncurl, each in its own phase (4,); PIP 5 … 105 degrees, at most 250 degrees/s."""
    middle, swing, peak = np.radians((55.0, 50.0, 250.0))
    angle = (peak / swing) * t_s[:, None] + phase
    out = natural(middle + swing * np.sin(angle))
    out[:, MCP] = MCP_PER_PIP * (
        middle + swing * np.sin(angle - 0.35)
    )  # the root leads or lags the middle a little
    return out
