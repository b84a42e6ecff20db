"""How fast real hands change their motion: speed, acceleration and jerk of recorded finger tips and palms.

Where the constants of `master.fabrik.propagate` come from. Recordings: `leapjs/*.npz` of the data folder;
their samples jitter, so derivatives are those of polynomials of fourth degree over 0.1 s (speed, acceleration) and
0.14 s (jerk): slower than tremor, faster than a grasp.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.signal import savgol_filter  # pyright: ignore[reportUnknownVariableType]

from bench.row import Row
from common.arrays import Float
from common.recording.npz import read_npz

_ROOT = Path(__file__).resolve().parents[1]
_GRID_S = 0.01
_WINDOW = {1: 11, 2: 11, 3: 15}
_TIPS = (4, 8, 12, 16, 20)


def derivatives(t_s: Float, places: Float) -> Float:
    """RMS per axis of speed, acceleration, jerk (3,) [m/s, m/s^2, m/s^3] of places (T, K, 3) [m] at times (T,) [s]."""
    even = np.arange(t_s[0], t_s[-1], _GRID_S)
    flat = places.reshape(len(t_s), -1)
    x = np.stack([np.interp(even, t_s, column) for column in flat.T])
    rms: list[float] = []
    for order, window in _WINDOW.items():
        changed = np.asarray(savgol_filter(x, window, 4, deriv=order, delta=_GRID_S), np.float64)
        rms.append(float(np.sqrt(np.mean(changed * changed))))
    return np.array(rms)


def rows() -> Iterator[Row]:
    """One row for each recording, or one that says that there are none."""
    folder = Path(os.environ.get("PHALANX_DATASETS", _ROOT / "../shared/datasets")).resolve() / "leapjs"
    files = sorted(folder.glob("*.npz"))
    if not files:
        yield Row("skipped: recorded hands", 0.0, "", f"none at {folder}: set PHALANX_DATASETS")
    for file in files:
        data = read_npz(file, ("t", "hand0_joints", "hand0_palm"), "not a recorded hand")
        t, joints, palm = (np.asarray(data[k], np.float64) for k in ("t", "hand0_joints", "hand0_palm"))
        places = np.concatenate([joints.reshape(len(t), -1, 3)[:, _TIPS], palm[:, None]], axis=1)
        known = np.isfinite(places).all(axis=(1, 2))
        speed, acceleration, jerk = derivatives(t[known], places[known])
        note = f"speed {speed:.2f} m/s, jerk {jerk:.0f} m/s^3 = {jerk / acceleration:.0f} /s times the acceleration"
        yield Row(
            f"recorded hand {file.stem}: acceleration, RMS per axis", float(acceleration), "m/s^2", note
        )
