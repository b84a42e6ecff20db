"""From what a wrist camera found in a triple to rows: rays, points on the laser plane, and the level asked for.

fk     laser points only, of fingers that bend naturally
ik     only fingers of which laser point and tip are both seen; of the others nothing is said
auto   what there is: a finger whose tip is not seen is told by its laser point, as far as that goes
"""

from collections import Counter
from math import nan

import numpy as np

from common.arrays import Bool, Float
from common.hand_model import FINGERS
from common.messages import WristDetections
from master.estimator.cubic import CubicLaw
from master.estimator.epoch import WristRows
from master.wrist_setup import WristSetup

_NO_LAW = np.full(5, nan)
_ONES = np.ones((5, 1))


class TripleReader:
    """Makes rows of the triples of one device; counts what it leaves out: `outside`, `no_plane`, by finger."""

    def __init__(self, setup: WristSetup, cubic: CubicLaw | None, counts: Counter[str]) -> None:
        self._setup, self._cubic, self._counts = setup, cubic, counts
        self._size = np.array([setup.optics.width_px, setup.optics.height_px])

    def read(self, message: WristDetections, t_ns: int) -> tuple[WristRows, Float]:
        """The rows of a triple for an epoch, and its laser points (5, 3) [m], camera frame; NaN: not seen."""
        setup, level = self._setup, self._setup.level
        uv = np.concatenate([message.laser_uv, message.tip_uv])
        sigma = np.concatenate([message.laser_sigma_px, message.tip_sigma_px])
        seen = np.isfinite(uv[:, 0])
        inside = ((uv >= -0.5) & (uv <= self._size - 0.5)).all(axis=1) & (sigma <= self._size.max())
        rays = setup.optics.undistort(np.where(inside[:, None], uv, nan))
        laser, tip = rays[:5].copy(), rays[5:].copy()
        ray = np.concatenate([laser, _ONES], axis=1)
        away = setup.offset_m / (ray @ setup.normal)
        points_m = ray * np.where(away > 0.0, away, nan)[:, None]
        for event, fingers in (
            ("outside", seen[:5] & ~inside[:5]),
            ("no_plane", inside[:5] & np.isnan(points_m[:, 0])),
            ("tip_outside", seen[5:] & ~inside[5:]),
        ):
            if fingers.any():
                self._count(event, fingers)
        if level == "fk":
            tip[:] = nan
        elif level == "ik":
            alone = ~(np.isfinite(laser[:, 0]) & np.isfinite(tip[:, 0]))
            laser[alone], tip[alone] = nan, nan
        law = _NO_LAW if self._cubic is None else np.where(np.isnan(tip[:, 0]), self._cubic(points_m), nan)
        late_s = 1e-9 * (message.t_ns + setup.late_ns - t_ns)
        rows = WristRows(
            laser,
            message.laser_sigma_px,
            message.laser_px,
            tip,
            message.tip_sigma_px,
            message.tip_depth,
            late_s,
            late_s + setup.frame_s,
            law,
        )
        return rows, points_m

    def _count(self, event: str, fingers: Bool) -> None:
        for f in np.flatnonzero(fingers):
            self._counts[f"{event}.{FINGERS[f]}"] += 1
