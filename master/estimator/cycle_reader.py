"""Conversion of a wrist camera's strobe cycle to estimator rows.

The rows hold rays and points on the laser plane, for the level asked for.

fk     laser points only, of fingers that bend naturally
ik     only fingers of which laser point and tip are both seen; the others are not reported
auto   what there is: a finger whose tip is not seen is solved from its laser point, as far as that goes
"""

from collections import Counter
from math import nan

import numpy as np

from common.arrays import Float
from common.hand.model import FINGERS
from common.messages import WristDetections
from master.estimator.cubic import CubicLaw
from master.estimator.epoch import WristRows
from master.rig.wrist import WristSetup

_NO_LAW = np.full(5, nan)


class CycleReader:
    """Reader that converts the strobe cycles of one device to rows.

    It counts what it rejects: `outside`, `no_plane`, by finger.
    """

    def __init__(self, setup: WristSetup, cubic: CubicLaw | None, counts: Counter[str]) -> None:
        self._setup, self._cubic, self._counts = setup, cubic, counts

    def read(self, message: WristDetections, t_ns: int) -> tuple[WristRows, Float]:
        """Return the rows of a strobe cycle for an epoch, and its laser points.

        The laser points are (5, 3) [m], camera frame; NaN: not seen.
        """
        setup, solver_mode = self._setup, self._setup.solver_mode
        uv = np.concatenate([message.laser_uv, message.tip_uv])
        self._reject("outside", uv[:5], message.laser_sigma_px)
        self._reject("tip_outside", uv[5:], message.tip_sigma_px)
        xy1 = np.ones((10, 3))
        xy1[:, :2] = setup.optics.undistort(uv)
        away = setup.offset_m / (xy1[:5] @ setup.normal)
        for f, (u, far) in enumerate(zip(uv[:5, 0].tolist(), away.tolist(), strict=True)):
            if u == u and not far > 0.0:  # NaN was not seen
                away[f] = nan
                self._counts[f"no_plane.{FINGERS[f]}"] += 1
        points_m = xy1[:5] * away[:, None]
        laser, tip = xy1[:5, :2].copy(), xy1[5:, :2].copy()
        if solver_mode == "fk":
            tip[:] = nan
        elif solver_mode == "ik":
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

    def _reject(self, event: str, uv: Float, sigma_px: Float) -> None:
        """Write NaN to points (5, 2) that are unusable, and count them.

        These are points outside the picture, and those that may be anywhere in it.
        """
        optics = self._setup.optics
        right, low = optics.width_px - 0.5, optics.height_px - 0.5
        most_px = max(optics.width_px, optics.height_px)
        for f, ((u, v), sigma) in enumerate(zip(uv.tolist(), sigma_px.tolist(), strict=True)):
            inside = -0.5 <= u <= right and -0.5 <= v <= low and sigma <= most_px
            if u == u and not inside:
                uv[f] = nan
                self._counts[f"{event}.{FINGERS[f]}"] += 1
