"""Things that the hand holds in front of the wrist camera.

Bodies that follow those of the flesh, matt and dark.

They hide what is behind them from the camera, and keep the laser and the LEDs from it.
"""

from collections.abc import Sequence

import numpy as np

from common.arrays import Float
from common.geometry.tapered_capsules import Capsules
from common.sim.held import Cylinder

ALBEDO = 0.05  # of matt black coating or rubber in the near infrared, against usual skin


def bodies_of(things: Sequence[Cylinder], T_camera_rig: Float) -> Capsules:
    """Return round cones of equal radii that stand for closed cylinders.

    In the camera's frame.

    Their round ends hold as much as the flat ones: a hand that holds one in its middle touches none of them.

    Raises:
        ValueError: One is wider than long; it would be a ball.
    """
    start, stop, radius = [np.empty((0, 3))], [np.empty((0, 3))], np.array([one.radius_m for one in things])
    for one in things:
        if one.length_m < 2.0 * one.radius_m:
            raise ValueError(
                f"cylinder of {one.length_m} m: shorter than its width of {2.0 * one.radius_m} m"
            )
        T = T_camera_rig @ one.T_rig_object
        half = (0.5 * one.length_m - 2.0 / 3.0 * one.radius_m) * T[:3, 2]  # 4/3 pi r^3 are in the ends
        start.append(T[:3, 3] - half[None])
        stop.append(T[:3, 3] + half[None])
    return Capsules(np.concatenate(start), np.concatenate(stop), radius, radius)


def with_things(capsules: Capsules, things: Capsules) -> Capsules:
    """The bodies of the flesh, and after them those of things."""
    return Capsules(
        np.concatenate([capsules.start_m, things.start_m]),
        np.concatenate([capsules.stop_m, things.stop_m]),
        np.concatenate([capsules.start_radius_m, things.start_radius_m]),
        np.concatenate([capsules.stop_radius_m, things.stop_radius_m]),
    )
