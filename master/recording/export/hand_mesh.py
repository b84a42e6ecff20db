"""Simple skin mesh for a skeleton.

Closed convex pieces lie over the bones, each the hull of a few spheres.

Of a finger's bone these are the spheres of its two joints, a round cone; the palm is made of the hulls over
the wrist and neighbouring metacarpals, the ball of the thumb of one between thumb and palm. The pieces overlap,
and a sphere moves with one joint, so that nothing opens where a joint bends.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from common.arrays import Float, Int
from common.hand.model import FINGER_JOINTS, WRIST
from master.recording.export.skeleton import Skeleton

_ROUND = 140  # points of a sphere
_GOLDEN = np.pi * (3.0 - np.sqrt(5.0))


@dataclass(frozen=True, slots=True, eq=False)
class Skin:
    """Triangles over a hand at rest.

    Attributes:
        vertex_m: (V, 3) [m], palm frame.
        normal: (V, 3) outward unit normals.
        joint: (V,) the joint that a vertex moves with.
        triangle: (F, 3) vertices, anticlockwise as seen from outside.
    """

    vertex_m: Float
    normal: Float
    joint: Int
    triangle: Int


@dataclass(frozen=True, slots=True)
class _Ball:
    """A sphere of skin.

    It has a centre (3,) [m] in the palm frame, a radius [m], and the joint that it moves with.
    """

    centre_m: Float
    radius_m: float
    joint: int


def skin_of(skeleton: Skeleton) -> Skin:
    """The skin of a hand at rest."""
    pieces = [_hull(balls) for balls in (*_fingers(skeleton), *_palm(skeleton))]
    first = np.cumsum([0, *(len(piece.vertex_m) for piece in pieces[:-1])])
    return Skin(
        vertex_m=np.concatenate([piece.vertex_m for piece in pieces]),
        normal=np.concatenate([piece.normal for piece in pieces]),
        joint=np.concatenate([piece.joint for piece in pieces]),
        triangle=np.concatenate([piece.triangle + start for piece, start in zip(pieces, first, strict=True)]),
    )


def _fingers(skeleton: Skeleton) -> list[list[_Ball]]:
    """Return the spheres of the finger bones.

    The thumb's metacarpal is among the bones; both ends of a bone move with the nearer joint.
    """
    bones = [
        bone
        for chain in FINGER_JOINTS
        for bone in pairwise(chain if chain is FINGER_JOINTS[0] else chain[1:])
    ]
    return [[_ball(skeleton, a, a), _ball(skeleton, b, a)] for a, b in bones]


def _palm(skeleton: Skeleton) -> list[list[_Ball]]:
    """Return the spheres of the palm.

    They are what is rigid with the wrist, and the ball of the thumb, which is pulled between both.
    """
    fingers = FINGER_JOINTS[1:]
    bones = [[_ball(skeleton, joint, WRIST) for joint in chain[:2]] for chain in fingers]
    wrist = _wrist(skeleton)
    webs = [[*wrist, *left, *right] for left, right in pairwise(bones)]
    metacarpal, proximal = FINGER_JOINTS[0][:2]
    index = bones[0]
    thumb = [
        _ball(skeleton, metacarpal, metacarpal),
        _between(skeleton, metacarpal, proximal, metacarpal),
        index[0],
        _between(skeleton, *fingers[0][:2], WRIST),
    ]
    heel = [*wrist, _ball(skeleton, metacarpal, WRIST), index[0]]
    return [*webs, heel, thumb]


def _wrist(skeleton: Skeleton) -> list[_Ball]:
    """Return two spheres across the wrist.

    They are as wide as the wrist's radius states, and flat.
    """
    radius = float(skeleton.radius_m[WRIST])
    flat = 0.62  # a wrist is flat: of its radius, two such spheres side by side
    aside = np.array([(1.0 - flat) * radius, 0.0, 0.0])
    return [_Ball(skeleton.position_m[WRIST] + side * aside, flat * radius, WRIST) for side in (-1.0, 1.0)]


def _ball(skeleton: Skeleton, at: int, joint: int) -> _Ball:
    return _Ball(skeleton.position_m[at], float(skeleton.radius_m[at]), joint)


def _between(skeleton: Skeleton, a: int, b: int, joint: int) -> _Ball:
    ball = 0.55  # how far up the metacarpals the ball of the thumb reaches
    centre = (1.0 - ball) * skeleton.position_m[a] + ball * skeleton.position_m[b]
    radius = (1.0 - ball) * skeleton.radius_m[a] + ball * skeleton.radius_m[b]
    return _Ball(centre, float(radius), joint)


def _hull(balls: list[_Ball]) -> Skin:
    """Return the convex hull of spheres.

    The normals are the spheres' own, so that the hull looks round.
    """
    directions = _directions()
    points = np.concatenate([ball.centre_m + ball.radius_m * directions for ball in balls])
    normals = np.tile(directions, (len(balls), 1))
    joints = np.repeat([ball.joint for ball in balls], len(directions))
    used, triangle = _convex(points)
    corners = points[used][triangle]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.vecdot(across, corners.mean(axis=1) - points.mean(axis=0)) < 0.0
    triangle[inward] = triangle[inward][:, ::-1]
    return Skin(points[used], normals[used], joints[used].astype(np.int64), triangle)


def _convex(points: Float) -> tuple[Int, Int]:
    """Return the convex hull of points (N, 3).

    The result is the indices (V,) of the points on the hull, and its triangles (F, 3) of those.
    """
    hull: Any = ConvexHull(points)  # scipy has no types
    used: Int = np.array(hull.vertices, np.int64)
    place = np.zeros(len(points), np.int64)
    place[used] = np.arange(len(used))
    triangles: Int = np.array(hull.simplices, np.int64)
    return used, place[triangles]


def _directions() -> Float:
    """Return unit vectors (_ROUND, 3) in all directions.

    They lie on a spiral from pole to pole (Fibonacci's).
    """
    z = 1.0 - 2.0 * (np.arange(_ROUND) + 0.5) / _ROUND
    across, angle = np.sqrt(1.0 - z * z), _GOLDEN * np.arange(_ROUND)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)
