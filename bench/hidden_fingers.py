"""How far a finger without a marker is from where it is solved to be, on exact motions: with its neighbours, and alone.

Each of the four fingers is hidden again and again, while the other markers and the palm's turn are measured almost
exactly, and its solved angles are held against the truth. *Alone* is the same without any belief that fingers move
together. Beside them stands the same finger while its marker is seen. Scenes and random poses are of seeds that
decided nothing.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.hand_draws import FACING_ROTATION, MARKERS
from bench.joint_covariance import leap_recordings, motions
from bench.row import Row
from bench.solved_hand import PointHand
from common.arrays import Float
from common.calibration import HandProfile, load
from common.geometry.transforms import rigid
from common.hand.model import HandModel
from common.sim.leap import load_leap
from common.sim.motion import HandMotion
from master.estimator.settings import DEFAULT

_HAND = Path(__file__).parent.parent / "calib_json/hands/default-right.json"
_SEEDS = (11, 12, 13)
HIDDEN_S = (0.0, 0.1, 0.3, 0.6)  # 0: the marker is still seen
_SECONDS, _RATE_HZ, _SEEN = 12.0, 60.0, 30  # frames before each time that it is hidden
_STEPS = tuple(round(after_s * _RATE_HZ) for after_s in HIDDEN_S)
_CYCLE = _SEEN + _STEPS[-1]
_SIGMA_M, _SIGMA_RAD = 1e-4, 1e-3
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
        together, alone = (
            np.concatenate([growth_deg(model, a, alike=alike) for model, a in angles], axis=1)
            for alike in (True, False)
        )
        for k, after_s in enumerate(HIDDEN_S[1:], 1):
            seen, own = rms_deg(together[0]), rms_deg(alone[k])
            note = f"by its own motion alone {own:.1f}, while its marker is seen {seen:.1f}"
            yield Row(f"{name}, after {after_s:g} s", rms_deg(together[k]), "deg", note)


def angles_of(motion: HandMotion) -> Float:
    """(T, 5, 4) [rad] once through a motion, or its first seconds."""
    times = np.arange(0.0, min(motion.period_s, _SECONDS), 1.0 / _RATE_HZ)
    return np.array([motion.at(t).angles_rad for t in times.tolist()])


def growth_deg(model: HandModel, angles_rad: Float, *, alike: bool) -> Float:
    """Errors (K, N, 2) [deg] of flexion and PIP, at each of the times `HIDDEN_S` after the last marker of a finger.

    Args:
        model: The hand.
        angles_rad: (T, 5, 4) the truth, frame by frame.
        alike: Whether fingers are believed to move together.
    """
    settings = DEFAULT
    if not alike:
        settings, model = DEFAULT.changed("alike", 0.0), replace(model, neighbours=False)
    palm = rigid(FACING_ROTATION, np.array([0.0, 0.08, 0.5]))
    places = model.marker_points(model.forward(np.tile(palm, (len(angles_rad), 1, 1)), angles_rad), MARKERS)
    cov = np.tile(_SIGMA_M**2 * np.eye(3), (len(MARKERS), 1, 1))
    orientation = palm[:3, :3], _SIGMA_RAD**2 * np.eye(3)
    off: list[list[Float]] = [[] for _ in HIDDEN_S]
    for finger in range(1, 5):
        solver = PointHand(model, MARKERS, settings=settings)
        for k in range(len(places) // _CYCLE * _CYCLE):
            points, hidden = places[k].copy(), k % _CYCLE - _SEEN + 1
            if hidden > 0:
                points[finger] = np.nan
            hand = solver.push(round(k * 1e9 / _RATE_HZ), points, cov, orientation=orientation).solution
            if hidden in _STEPS:
                assert hand is not None
                error = (hand.angles_rad - angles_rad[k])[finger, 1:3]
                off[_STEPS.index(hidden)].append(error)
    return np.degrees(np.array(off))


def rms_deg(errors: Float) -> float:
    """RMS of errors (N, 2)."""
    return float(np.sqrt(np.mean(np.square(errors))))
