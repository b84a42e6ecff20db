"""Observations of a motion from the wrist, and the mounting fitted to them."""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from master.calibrate.extrinsics.unknown import Unknown

OUTLIER_SIGMAS = 2.5  # standard deviations from which an observation is down-weighted


@dataclass(frozen=True, slots=True, eq=False)
class StrobeCycles:
    """Observations of the device over T strobe cycles.

    Fingers index ... little; NaN: not seen.

    Attributes:
        t_s: (T,) stamps [s], rising.
        laser_m, laser_sigma_m: (T, 4, 2) on the plane, across and along, and standard deviations of the sensing.
        tip_uv: (T, 4, 2) [px], seen `tip_late_s` later than the laser.
        tip_sigma_px: (T, 4).
        tip_late_s: Of the frame that shows the tips.
    """

    t_s: Float
    laser_m: Float
    laser_sigma_m: Float
    tip_uv: Float
    tip_sigma_px: Float
    tip_late_s: float

    def of(self, rows: Int | Bool) -> "StrobeCycles":
        """Some of them."""
        return StrobeCycles(
            self.t_s[rows],
            self.laser_m[rows],
            self.laser_sigma_m[rows],
            self.tip_uv[rows],
            self.tip_sigma_px[rows],
            self.tip_late_s,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """The most probable mounting.

    Attributes:
        unknown: It.
        covariance: (UNKNOWN, UNKNOWN) of steps on it.
        wrist_angles_rad: (T, 2) flexion and deviation of the wrist in each strobe cycle.
        twist_rad: (T,) what no wrist does.
        off: (T, 4, SEEN) seen minus fitted, in standard deviations; NaN: not seen.
        sigma: (T, 4, SEEN) these [m, px].
        shown: (T, 4, SEEN) as fitted.
        marker_m: Rms of what is left at the markers.
        steps: SensorMessage.
    """

    unknown: Unknown
    covariance: Float
    wrist_angles_rad: Float
    twist_rad: Float
    off: Float
    sigma: Float
    shown: Float
    marker_m: float
    steps: int

    @property
    def rms(self) -> float:
        """Return the root mean square of `off`, with outliers clipped at their limit."""
        return float(np.sqrt(np.nanmean(np.minimum(np.abs(self.off), 2.0 * OUTLIER_SIGMAS) ** 2)))

    @property
    def outlier_share(self) -> float:
        """Share of the sights that are farther off than noise explains."""
        pairs = np.hypot(self.off[..., 0::2], self.off[..., 1::2])
        return float((pairs > 2.0 * OUTLIER_SIGMAS).sum() / max(np.isfinite(pairs).sum(), 1))
