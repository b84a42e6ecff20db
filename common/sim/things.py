"""Things that a hand takes, as one camera sees them.

Outlines, light, and the depth of each behind each pixel.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.geometry.transforms import transform
from common.sim import raster
from common.sim.held import Cylinder
from common.sim.light import LAYER_COSINES
from common.sim.raster import Shape
from common.sim.surface import rim

LAYER_SINES = np.sqrt(1.0 - LAYER_COSINES**2)


@dataclass(frozen=True, slots=True, eq=False)
class SeenThing:
    """One cylinder in one image.

    Attributes:
        layers: Outlines (N, 2) [px]: its own, then the parts of its side where the light falls more and more steeply.
        face: Outline (N, 2) [px] of the end that is turned to the camera, and the cosine of its normal to the light.
        velocity: (2,) [px/s].
        ends_uv: (2, 2) [px] middles of its ends, ends_depth: (2,) [m].
    """

    layers: tuple[Float, ...]
    face: tuple[Float, float]
    velocity: Float
    ends_uv: Float
    ends_depth: Float

    @property
    def shape(self) -> Shape:
        """Its outline."""
        return Shape(self.layers[0], self.velocity)

    def depth(self, uv: Float) -> Float:
        """Depth (...) [m] of its axis where that passes nearest to pixels (..., 2)."""
        start, along = self.ends_uv[0], self.ends_uv[1] - self.ends_uv[0]
        share = np.clip((uv - start) @ along / max(float(along @ along), 1e-9), 0.0, 1.0)
        return self.ends_depth[0] * (1.0 - share) + self.ends_depth[1] * share


def tube_rims(centre: Float, axis: Float, radius_m: float, to_light: Float, circle: Float) -> Float:
    """Return the edges of a tube's shading where it is cut at `centre`.

    Edges (LAYERS, n, 3) [m]: the tube's own edge, then those where it is lit more.

    Args:
        centre: (3,) [m]; axis: unit vector (3,) of the tube.
        radius_m: Its radius.
        to_light: Unit vector (3,).
        circle: `unit_circle` (n, 2).
    """
    across = to_light - (to_light @ axis) * axis
    middle = centre + radius_m * LAYER_COSINES[:, None] * across
    return middle[:, None] + rim(
        np.broadcast_to(axis, (len(LAYER_COSINES), 3)), radius_m * LAYER_SINES, circle
    )


def seen(
    thing: Cylinder,
    later: Cylinder,
    later_s: float,
    T_camera_rig: Float,
    to_light: Float,
    circle: Float,
    project: Callable[[Float], Float],
) -> SeenThing:
    """What a camera sees of a thing, which `later_s` [s] on is at `later`.

    Args:
        thing, later: At two times.
        later_s: The time between them [s].
        T_camera_rig: (4, 4).
        to_light: Unit vector (3,), camera frame.
        circle: `unit_circle` (n, 2).
        project: Points (..., 3) [m] of the camera frame to pixels (..., 2).
    """
    ends, after = (_ends(item, T_camera_rig) for item in (thing, later))
    axis = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    rims = project(np.stack([tube_rims(end, axis, thing.radius_m, to_light, circle) for end in ends]))
    layers = tuple(raster.hull(rims[:, k].reshape(-1, 2)) for k in range(rims.shape[1]))
    facing = 0 if float(axis @ ends[0]) > 0.0 else 1  # whose outward normal points to the camera
    outward = axis if facing else -axis
    ends_uv = project(ends)
    velocity = (project(after) - ends_uv).mean(axis=0) / later_s
    return SeenThing(layers, (rims[facing, 0], float(outward @ to_light)), velocity, ends_uv, ends[:, 2])


def _ends(thing: Cylinder, T_camera_rig: Float) -> Float:
    """Middles of both ends (2, 3) [m], camera frame."""
    half = 0.5 * thing.length_m
    own = np.array([[0.0, 0.0, -half], [0.0, 0.0, half]])
    return transform(T_camera_rig, transform(thing.T_rig_object, own))
