"""How far a finger without a marker is from where it is believed, on exact motions: with its neighbours, and alone.

Each of the four fingers is hidden in turn, every tenth of a second, while the others are seen exactly; what is believed
of it (`master.ik.hidden`) is held against the truth. Scenes and random poses are of seeds that decided nothing.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bench.joint_certainty import leap_recordings, motions
from bench.row import Row
from common.arrays import Float
from common.calibration import HandProfile, load
from common.hand_model import HandModel
from common.sim.leap import load_leap
from common.sim.motion import HandMotion
from master.ik.hidden import FingerMemory

_HAND = Path(__file__).parent.parent / "calib_json/hands/default-right.json"
_SEEDS = (11, 12, 13)
_HIDDEN_S = (0.1, 0.3, 0.6)
_SECONDS, _RATE_HZ, _EVERY, _LEARN = 30.0, 60.0, 6, 6
_GROUPS = {"standard scene": "simulated scenes", "study poses": "simulated scenes"}


def rows() -> Iterator[Row]:
    """RMS of flexion and PIP [deg] by motion and time, believed to move with the neighbours."""
    profile = load(_HAND, HandProfile)
    played: dict[str, list[tuple[HandModel, HandMotion]]] = {}
    for seed in _SEEDS:
        for name, model, motion in motions(profile, seed):
            played.setdefault(_GROUPS.get(name, name), []).append((model, motion))
    if recordings := leap_recordings():
        leap, _ = played["recorded motion"][0]
        played["recorded motion"] = [(leap, load_leap(path, leap, np.zeros(3))) for path in recordings]
    for name, group in played.items():
        angles = [(model, angles_of(motion)) for model, motion in group]
        for hidden_s in _HIDDEN_S:
            together, alone = (
                rms_deg([strayed_deg(model, a, hidden_s, natural) for model, a in angles])
                for natural in (1.0, 0.0)
            )
            yield Row(
                f"{name}, after {hidden_s:g} s", together, "deg", f"by its own motion alone {alone:.1f}"
            )


def angles_of(motion: HandMotion) -> Float:
    """(T, 5, 4) [rad] once through a motion, or its first half minute."""
    times = np.arange(0.0, min(motion.period_s, _SECONDS), 1.0 / _RATE_HZ)
    return np.array([motion.at(t).angles_rad for t in times.tolist()])


def strayed_deg(model: HandModel, angles_rad: Float, hidden_s: float, natural: float) -> Float:
    """Errors (N, 2) [deg] of flexion and PIP of angles (T, 5, 4) after a time without a marker.

    Args:
        model: Whose limits hold.
        angles_rad: The truth.
        hidden_s: How long the marker has been gone.
        natural: Probability to obey habits when it went: 1, the neighbours tell what they can; 0, nothing.
    """
    count = round(hidden_s * _RATE_HZ)
    off: list[Float] = []
    for k in range(_LEARN, len(angles_rad) - count, _EVERY):
        for finger in range(1, 5):
            seen, memory = frozenset(range(5)) - {finger}, FingerMemory(model)
            for before, after in zip(angles_rad[k - _LEARN : k], angles_rad[k - _LEARN + 1 :], strict=False):
                memory.moved(before, after, 1.0 / _RATE_HZ)
            memory.belief(0, 0, angles_rad[k], natural, seen)  # the marker goes
            now = round(hidden_s * 1e9)
            believed = memory.belief(now, now, angles_rad[k + count], natural, seen).angles_rad
            off.append((believed - angles_rad[k + count])[finger, 1:3])
    return np.degrees(np.array(off))


def rms_deg(errors: list[Float]) -> float:
    """RMS of errors (N, 2) of several motions."""
    return float(np.sqrt(np.mean(np.square(np.concatenate(errors)))))
