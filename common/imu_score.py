"""Accuracy of an IMU's tilt against a truth.

Also how consistent the stated standard deviation is with the errors.

The error is that of the vertical: the turn about a level axis that takes the found one to the true one. Headings do not
count, since both worlds may lie anywhere to each other but for their z axes, which are up.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float
from common.geometry.transforms import quaternion_to_matrix


@dataclass(frozen=True, slots=True, eq=False)
class TiltErrors:
    """Tilt errors about both level axes (N, 2), and their stated sigma (N,).

    Per axis [rad], of every sample whose tilt and truth are known.
    """

    error_rad: Float
    sigma_rad: Float

    @classmethod
    def of(cls, found_wxyz: Float, truth_wxyz: Float, sigma_rad: Float) -> "TiltErrors":
        """Return the tilt errors of orientations (T, 4); sigma is (T,).

        Orientations map sensor axes to a world whose z axis is up, NaN where not known.
        """
        known = (
            np.isfinite(found_wxyz).all(axis=1) & np.isfinite(truth_wxyz).all(axis=1) & np.isfinite(sigma_rad)
        )
        found, truth = (quaternion_to_matrix(q[known]) for q in (found_wxyz, truth_wxyz))
        up: Float = (found @ truth[:, 2, :, None])[..., 0]  # the true vertical in the world that was found
        sine = np.hypot(up[:, 0], up[:, 1])
        angle = np.arctan2(sine, up[:, 2]) / np.maximum(sine, 1e-12)
        return cls(np.column_stack((-up[:, 1], up[:, 0])) * angle[:, None], sigma_rad[known])

    @property
    def rms_deg(self) -> float:
        """Root mean square of the inclination's error, both axes together."""
        return float(np.degrees(np.sqrt(np.vecdot(self.error_rad, self.error_rad).mean())))

    @property
    def stated_deg(self) -> float:
        """What that would be if the stated sigmas were exact."""
        return float(np.degrees(np.sqrt(2.0 * np.mean(np.square(self.sigma_rad)))))

    @property
    def within(self) -> float:
        """Share of samples in their 95 % regions."""
        region = 5.991  # chi square, two degrees of freedom, 95 %
        return float((np.vecdot(self.error_rad, self.error_rad) < region * np.square(self.sigma_rad)).mean())

    def where(self, rows: Bool) -> "TiltErrors":
        """Those of some samples (N,)."""
        return TiltErrors(self.error_rad[rows], self.sigma_rad[rows])
