"""Tables of what the wrist camera sees of each posture of a finger.

The palm stands still before the camera, so a finger of known bones has four angles: abduction, and the flexions of
MCP, PIP and DIP. Each finger's table holds a grid of the last three, and a parabola through three values of the
abduction, with which it changes smoothly. The thumb's four angles are one list.

For each posture the finger is drawn as round cones, lit from the lens: a surface at distance t whose normal is
inclined by theta to the ray gives back light in proportion to cos(theta) / t^2. A few *samples* are kept, pixels and
the root of the light there (nearness): along the bones, and above the highest point of the finger, where there is
nothing of it.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from common.arrays import Float, Float32
from common.geometry.tapered_capsules import Capsules, first_hits, terms
from common.geometry.transforms import rotation_vector_to_matrix
from common.hand.model import CHAINS, FINGER_JOINTS, Fingertips
from slave.wrist.led_image import NEAREST_M, WristView, circle_of, thumb_postures, unseen

MCP_RAD = np.radians(np.arange(-10.0, 111.0, 6.0))
PIP_RAD = np.radians(np.arange(0.0, 121.0, 6.0))
DIP_PER_PIP = (0.6, 0.84)
ABDUCTION_RAD = float(np.radians(15.0))  # the outer two of the three abductions
THUMB_POSTURES = (7, 8, 5, 6)  # values of its angles
DIRECTIONS = 8  # of the outline of a fingertip, from the right clockwise
# Samples: the middle of the fingertip, along the bones, the highest joint of the finger in the image; above that; and
# the end of the finger.
END, BONES, HIGHEST, ABOVE, APEX = 0, slice(0, 6), 6, slice(7, 13), 13
SAMPLES = APEX + 1
_ALONG = ((2, 0.35), (1, 0.75), (1, 0.3), (0, 0.75), (0, 0.5))  # bone, share of it
_ABOVE = tuple((far, angle) for far in (1.4, 1.9) for angle in (-0.5, 0.0, 0.5))  # of the joint's radius, rad


class Postures(NamedTuple):
    """Postures of all five fingers: H of the thumb, then 4 L of index ... little.

    Attributes:
        thumb: H.
        uv: (H + 4 L, 3, SAMPLES, 2) pixels of the samples: coefficients of a parabola in the abduction / ABDUCTION_RAD.
        middle: (H + 4 L, 3, 2) the same of the sample END.
        near: (H + 4 L, APEX) nearness there [1/m] of the finger itself; 0: it is not there.
        thumb_laser: (2, H) where the skin meets the laser's plane [m], in the plane's coordinates; NaN: it does not.
        laser: (3, 2, 4, L) the same as parabolas, of index ... little.
        open: (H + 4 L, DIRECTIONS) 1: the outline of the fingertip shows there, 0: the finger goes on.
        end: (H + 4 L, 3) of the end: radius of its outline [px], cosine between the last bone and the way to the camera
            (1: it points at the camera), whether the finger itself leaves it to be seen.
        twist: (H + 4 L, 5) what a twist of the finger about its first bone, before it is bent, moves: END and APEX
            [px/rad], and where the laser meets it across the fingers [m/rad].
    """

    thumb: int
    uv: Float32
    middle: Float32
    near: Float32
    thumb_laser: Float32
    laser: Float32
    open: Float32
    end: Float32
    twist: Float32


@lru_cache(maxsize=8)
def plane_axes(view: WristView) -> Float:
    """Unit vectors (2, 3) in the laser's plane: to the right in the image, and away."""
    across = np.array([1.0, 0.0, 0.0]) - view.normal[0] * view.normal
    across /= np.linalg.norm(across)
    away = np.cross(across, view.normal)
    return np.stack([across, away if away[2] > 0.0 else -away])


@lru_cache(maxsize=8)
def postures_of(view: WristView) -> Postures:
    """Tables of a wrist rig and hand; CalibrationError: it does not see the fingers."""
    knuckles = view.optics.project(
        view.model.forward(view.T_camera_palm, np.zeros((5, 4))).position_m[CHAINS[1:, 0]]
    )
    if not (np.isfinite(knuckles).all() and knuckles[:, 1].max() < view.optics.height_px):
        raise unseen("fingers")
    pip, share = (each.ravel() for each in np.meshgrid(PIP_RAD, DIP_PER_PIP, indexing="ij"))
    long = np.zeros((len(MCP_RAD), len(pip), 3, 5, 4))
    long[..., 0] = ABDUCTION_RAD * np.array([-1.0, 0.0, 1.0])[:, None]
    long[..., 1] = MCP_RAD[:, None, None, None]
    long[..., 2], long[..., 3] = pip[:, None, None], (share * pip)[:, None, None]
    long = long.reshape(-1, 3, 5, 4)
    thumb = thumb_postures(view, *THUMB_POSTURES)[:, None]
    fingers = [_postures(view, finger, long if finger else thumb) for finger in range(5)]
    laser, *others = zip(*fingers, strict=True)
    uv, *others = (np.concatenate(each).astype(np.float32) for each in others)
    middle = np.ascontiguousarray(uv[:, :, END])
    of_thumb = np.ascontiguousarray(laser[0][:, 0].T, np.float32)
    of_fingers = np.ascontiguousarray(np.moveaxis(np.array(laser[1:]), (2, 3), (0, 1)), np.float32)
    near, open_, end, twist = others
    return Postures(len(thumb), uv, middle, near, of_thumb, of_fingers, open_, end, twist)


def _postures(view: WristView, finger: int, angles: Float) -> tuple[Float, ...]:
    """Rows of one finger at angles (H, A, 5, 4) [rad], A = 3 abductions or 1.

    `laser` (H, 3, 2), then `uv`, `near`, `open`, `end`, `twist` as of `Postures`.
    """
    count, nodes = angles.shape[:2]
    joints = view.model.forward(view.T_camera_palm, angles.reshape(-1, 5, 4))
    chain = joints.position_m[:, CHAINS[finger]]
    radius = view.model.radius_m[list(FINGER_JOINTS[finger])][-4:]
    tip = joints.rotation[:, CHAINS[finger, 3]]
    along = -tip[:, :, 2]
    dorsal_m = Fingertips.of(view.model).dorsal_m
    overhang = 1.3  # of the radius of the tip: how far skin reaches beyond the tip joint, 1.0 to 1.7 by hand
    # of how far the fingertip's outermost point lies towards the nail: the middle of what is seen of it
    ball = 0.7
    end = chain[:, 3] + (overhang - 1.0) * radius[3] * along + ball * dorsal_m * tip[:, :, 1]
    apex = end + radius[3] * along + (1.0 - ball) * dorsal_m * tip[:, :, 1]
    bones = np.concatenate([chain[:, :3], end[:, None]], axis=1)
    surface = _surface_lines(bones, radius)
    laser = _on_plane(view, surface)
    project = view.optics.project
    points = [surface[k][0] + share * (surface[k][1] - surface[k][0]) for k, share in _ALONG]
    above = _above(view, bones, radius, nodes)
    uv = np.stack([project(end), *(project(each) for each in points), *above, project(apex)], axis=1)
    uv = uv.reshape(count, nodes, SAMPLES, 2)
    middle = nodes // 2
    bones, apex, along = (
        each.reshape(count, nodes, *each.shape[1:])[:, middle] for each in (bones, apex, along)
    )
    twist = _twist(view, finger, angles[:, middle], bones, apex, radius)
    size = view.optics.matrix[0, 0] * radius[3] / np.maximum(bones[:, 3, 2], NEAREST_M)
    around = 1.4  # of its radius: where other parts of the finger are looked for
    ring = uv[:, middle, END, None] + around * size[:, None, None] * circle_of(DIRECTIONS)
    near, first = _drawn(view, bones, radius, np.concatenate([uv[:, middle], ring], axis=1))
    distance = np.linalg.norm(apex, axis=-1)
    facing = -(along * apex).sum(axis=-1) / distance
    hidden_m = 4e-3  # so far behind the finger's own skin its end still counts as seen
    seen = distance < first[:, APEX] + hidden_m
    good = (bones[..., 2] > NEAREST_M).all(axis=1) & np.isfinite(uv.reshape(count, -1)).all(axis=1)
    laser[~good.repeat(nodes)] = np.nan
    near[~good] = 0.0
    return (
        _parabola((laser @ plane_axes(view).T).reshape(count, nodes, 1, 2))[:, :, 0],
        np.nan_to_num(_parabola(uv)),
        near[:, :APEX],
        np.asarray(near[:, SAMPLES:] == 0.0, np.float64),
        np.nan_to_num(np.stack([size, facing, seen], axis=-1)),
        np.nan_to_num(twist),
    )


def _twist(view: WristView, finger: int, angles: Float, bones: Float, apex: Float, radius: Float) -> Float:
    """`Postures.twist` (H, 5) at angles (H, 5, 4), joints (H, 4, 3), end (H, 3) [m]."""
    straight = angles[:1].copy()
    straight[..., 1:] = 0.0
    chain = view.model.forward(view.T_camera_palm, straight).position_m[0, CHAINS[finger]]
    axis = chain[1] - chain[0]
    twist_rad = 0.05  # for derivatives
    rotation = rotation_vector_to_matrix(twist_rad * axis / np.linalg.norm(axis))
    moved: list[Float] = []
    for by in (np.eye(3), rotation):
        rotated, tip = ((each - chain[0]) @ by.T + chain[0] for each in (bones, apex))
        laser = _on_plane(view, _surface_lines(rotated, radius)) @ plane_axes(view)[0]
        moved.append(
            np.concatenate(
                [view.optics.project(rotated[:, 3]), view.optics.project(tip), laser[:, None]], axis=1
            )
        )
    return (moved[1] - moved[0]) / twist_rad


def _parabola(values: Float) -> Float:
    """Coefficients (H, 3, ...) of 1, a, a^2 by values (H, A, ...) at a = -1, 0, 1."""
    if values.shape[1] == 1:
        return np.concatenate([values, np.zeros_like(values), np.zeros_like(values)], axis=1)
    low, middle, high = (values[:, k] for k in range(3))
    return np.stack([middle, 0.5 * (high - low), 0.5 * (high + low) - middle], axis=1)


def _surface_lines(bones: Float, radius: Float) -> list[tuple[Float, Float]]:
    """Start, stop (T, 3) of each bone's skin line before the camera, (T, 4, 3) [m]."""
    out: list[tuple[Float, Float]] = []
    for k in range(3):
        start, stop = bones[:, k], bones[:, k + 1]
        way = (stop - start) / np.linalg.norm(stop - start, axis=-1, keepdims=True)
        toward = -0.5 * (start + stop)
        toward -= (toward * way).sum(axis=-1, keepdims=True) * way
        toward /= np.maximum(np.linalg.norm(toward, axis=-1, keepdims=True), 1e-9)
        # of the radius: where the middle of a visible line on a finger is before its axis
        surface_share = 0.8
        out.append(
            (start + surface_share * radius[k] * toward, stop + surface_share * radius[k + 1] * toward)
        )
    return out


def _on_plane(view: WristView, surface: list[tuple[Float, Float]]) -> Float:
    """Where lines along the skin first meet the laser's plane (T, 3) [m]; NaN: never."""
    best = np.full(surface[0][0].shape, np.nan)
    nearest = np.full(len(best), np.inf)
    for k, (start, stop) in enumerate(surface):
        before, behind = (point @ view.normal - view.offset_m for point in (start, stop))
        with np.errstate(divide="ignore", invalid="ignore"):
            share = before / (before - behind)
        beyond_end = 0.25  # of the last bone: how far its skin goes on beyond its joint
        meets = (share >= -0.02) & (share <= 1.02 + (k == 2) * beyond_end)
        point = start + np.where(meets, share, 0.0)[:, None] * (stop - start)
        distance = np.where(meets, np.linalg.norm(point, axis=-1), np.inf)
        better = distance < nearest
        best[better], nearest[better] = point[better], distance[better]
    return best


def _above(view: WristView, bones: Float, radius: Float, nodes: int) -> list[Float]:
    """Pixels (T, 2) of the highest of joints (T, 4, 3) [m], and above it."""
    uv = view.optics.project(bones)
    size = view.optics.matrix[0, 0] * radius / np.maximum(bones[..., 2], NEAREST_M)
    tops = (uv[..., 1] - size).reshape(-1, nodes, 4)[:, nodes // 2]
    highest = np.repeat(np.where(np.isfinite(tops), tops, np.inf)[:, 1:].argmin(axis=-1) + 1, nodes)
    at = np.arange(len(bones))
    middle, size = uv[at, highest], size[at, highest, None]
    return [
        middle,
        *(middle + size * far * np.array([np.sin(angle), -np.cos(angle)]) for far, angle in _ABOVE),
    ]


def _drawn(view: WristView, bones: Float, radius: Float, uv: Float) -> tuple[Float, Float]:
    """Nearness [1/m], distance [m] (T, S) at pixels (T, S, 2), joints (T, 4, 3) [m]."""
    chunk = 4096  # bounds the memory
    parts = [slice(k, k + chunk) for k in range(0, len(bones), chunk)]
    drawn = [_drawn_some(view, bones[part], radius, uv[part]) for part in parts]
    near, first = (np.concatenate(each) for each in zip(*drawn, strict=True))
    return near, first


def _drawn_some(view: WristView, bones: Float, radius: Float, uv: Float) -> tuple[Float, Float]:
    ray = view.optics.ray(uv)
    count = len(bones)
    near_r, far_r = (np.tile(part, count) for part in (radius[:-1], radius[1:]))
    capsules = Capsules(bones[:, :-1].reshape(-1, 3), bones[:, 1:].reshape(-1, 3), near_r, far_r)
    known = terms(capsules, np.zeros(3), np.float64).reshape(12, count, 3)
    distance = np.stack([first_hits(known[:, :, k, None], np.moveaxis(ray, -1, 0)) for k in range(3)])
    which, distance = distance.argmin(axis=0), distance.min(axis=0)
    hit = np.isfinite(distance)
    body = (3 * np.arange(count, dtype=np.int64)[:, None] + which)[hit]
    normal = capsules.normals(body, ray[hit] * distance[hit][:, None])
    near = np.zeros(distance.shape)
    soft = 0.3  # of the light comes from inside the skin and from the skin around, whatever the incidence
    shade = np.sqrt((np.clip(-(normal * ray[hit]).sum(axis=-1), 0.0, 1.0) + soft) / (1.0 + soft))
    near[hit] = shade / distance[hit]
    return near, distance
