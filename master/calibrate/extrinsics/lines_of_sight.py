"""Measurement model of a wrist device: laser points and tips of four fingers.

Also their derivatives by the unknowns.

The laser's cut and the tip are those that the master solves fingers with (`master.calibrate.laser_intersection`,
`common.hand.fingertips`), so that what is fitted is what will be used. Beside the palm's pose and the angles two
numbers of each finger are unknown, which a mounting must not take for its own: how thick its skin is, and where on the
pulp its tip is seen.
"""

from dataclasses import replace

import numpy as np

from common.arrays import Float
from common.geometry.transforms import rotation_vector_to_matrix
from common.hand.fingertips import Fingertips
from common.hand.palmar_surface import PalmarSurface
from master.calibrate.laser_intersection import LaserIntersection
from master.estimator.laser_plane import PlaneAxes
from master.rig.wrist import WristSetup

FINGERS = slice(1, 5)
SEEN = 4  # numbers of a finger: laser point across and along [m], tip [px]
_ROTATION_STEP, _SHIFT_M, _THICK = np.radians(0.2), 2e-4, 0.01  # steps of differences
_STEPS = np.repeat([_ROTATION_STEP, _SHIFT_M, _ROTATION_STEP, _THICK], (3, 3, 4, 1))


class LinesOfSight:
    """Measurement model for one device and one hand.

    Its state was prepared by the constructor.
    """

    def __init__(self, setup: WristSetup) -> None:
        self._setup, self._surface, self._axes = setup, PalmarSurface.of(setup.model), PlaneAxes.of(setup)
        rays = 16
        self._intersection, self._tips = LaserIntersection(setup, rays), Fingertips.of(setup.model)

    def flat(self, point_m: Float) -> Float:
        """Points (..., 3) [m] on the laser plane as (across, along) (..., 2)."""
        return self._axes.flat(point_m)

    def flat_cov(self, cov_m2: Float) -> Float:
        """Covariances (..., 2, 2) of covariances (..., 3, 3)."""
        return self._axes.flat_cov(cov_m2)

    def __call__(self, R: Float, shift_m: Float, angles: Float, thick: Float, reach_m: Float) -> Float:
        """What is seen (T, 4, SEEN); NaN where the laser misses.

        Args:
            R: (T, 3, 3) palm axes -> camera axes.
            shift_m: (3,) the wrist joint, camera frame.
            angles: (T, 5, 4) [rad].
            thick: (4,) natural logarithms of the factors of thickness.
            reach_m: (4,) how far tips are seen beyond where the hand file has them, along the last bone.
        """
        local = self._local(angles, thick, reach_m)
        return self._seen([self._placed_at(R, shift_m, *local)])[0]

    def derivatives(
        self, R: Float, shift_m: Float, angles: Float, thick: Float, reach_m: Float
    ) -> tuple[Float, Float]:
        """What is seen, and by what it moves.

        Returns:
            (T, 4, SEEN), and derivatives (T, 4, SEEN, 12): by a turn of the palm (3, camera axes, about the wrist
            joint), its shift (3), the finger's own four angles, its thickness and reach; 0 where not known.
        """
        surface, radius, _ = local = self._local(angles, thick, reach_m)
        all_of = [self._placed_at(R, shift_m, *local)]
        for k in range(3):
            rotation = rotation_vector_to_matrix(_ROTATION_STEP * np.eye(3)[k])
            all_of.append(self._placed_at(rotation @ R, shift_m, *local))
        for k in range(3):
            all_of.append(self._placed_at(R, shift_m + _SHIFT_M * np.eye(3)[k], *local))
        for k in range(4):
            stepped = self._local(angles + _ROTATION_STEP * np.eye(4)[k], thick, reach_m)
            all_of.append(self._placed_at(R, shift_m, *stepped))
        all_of.append(self._placed_at(R, shift_m, *self._local(angles, thick + _THICK, reach_m)))
        seen = self._seen(all_of)
        out = np.zeros((*seen.shape[1:], len(_STEPS) + 1))
        out[..., :-1] = np.moveaxis(seen[1:] - seen[0], 0, -1) / _STEPS
        farther = self._placed_at(
            R, shift_m, surface, radius, self._local(angles, thick, reach_m + _SHIFT_M)[2]
        )
        out[..., 2:, -1] = (self._setup.optics.project(farther[2]) - seen[0][..., 2:]) / _SHIFT_M
        return seen[0], np.nan_to_num(out)

    def _local(self, angles: Float, thick: Float, reach_m: Float) -> tuple[Float, Float, Float]:
        """Return the finger surface spheres and the tips in the palm frame.

        Spheres (T, 4, K, 3) [m], their radii (4, K), and tips (T, 4, 3) [m].
        """
        chains = self._setup.model.chains(angles)
        factor = np.ones((5, 1))
        factor[FINGERS, 0] = np.exp(thick)
        surface = PalmarSurface(factor * self._surface.palmar_m, factor * self._surface.radius_m)
        beyond = self._tips.beyond_m.copy()
        beyond[FINGERS] += reach_m
        return (
            surface.spheres(chains)[:, FINGERS],
            surface.radius_m[FINGERS],
            replace(self._tips, beyond_m=beyond).points(chains)[:, FINGERS],
        )

    @staticmethod
    def _placed_at(R: Float, shift_m: Float, spheres: Float, radius: Float, tips: Float) -> tuple[Float, ...]:
        """The same in the camera's frame."""
        transposed = np.swapaxes(R, 1, 2)
        return spheres @ transposed[:, None] + shift_m, radius, tips @ transposed + shift_m

    def _seen(self, hands: list[tuple[Float, ...]]) -> Float:
        """(P, T, 4, SEEN) of P hands."""
        radius = np.stack([one[1] for one in hands])[:, None]
        line = self._intersection.line(np.stack([one[0] for one in hands]), radius, np.bool_(False))
        tips = self._setup.optics.project(np.stack([one[2] for one in hands]))
        return np.concatenate([line.point_m, tips], axis=-1)
