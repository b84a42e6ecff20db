"""Round cones model the skin of fingers: their gaps and their palmar side.

A round cone is the union of balls whose middles go along a line and whose radii go evenly from one end to the other:
nearly the flesh on a bone. So the gap of two is the least, over s and t in 0..1, of

    |(a + s u) - (b + t v)| - (r_a + s d_a) - (r_b + t d_b),

which is convex in (s, t): descending in each in turn, in closed form, leads to it. `foot_of` and `nearest` take
numbers as well as arrays and call nothing of their own, so that kernels may compile them.

Where the laser meets a finger depends on its palmar skin: a chain of spheres joined by cones. A sphere has the radius
by which the palmar side is round, and its centre is put so that the skin is as far from the bone as it should be. If
the hand file gives `radius_m`, that is the distance from every joint. If not, it is a share of the distance between
the knuckles of index and little finger, since the breadth of a hand gives the thickness of its fingers (Buchholz,
Armstrong, "An ellipsoidal representation of human hand anthropometry", Human Factors 33, 1991). The shares are those of
the generic hand of the WebXR Input Profiles (MIT), cut across while its own rig bends it to a PIP of 50 degrees:
skin folds. Breadths and depths of the scalable hand of Sancho-Bru et al. (0.23 and 0.23 of the breadth of the hand at
the proximal bone of the index finger, 0.17 and 0.16 at the middle bone of the little finger), with 0.57 of the depth on
the palmar side, give the same within 0.8 mm RMS and 1.5 mm at most, and as much may be wrong for another person:
`SPREAD`. The file's `palmar_scale` (`phalanx calibrate wrist subject`) multiplies distances and radii.
"""

from dataclasses import dataclass
from typing import TypeAlias, get_args

import numpy as np

from common.arrays import Float
from common.calibration import Finger
from common.geometry.tapered_capsules import Capsules, terms
from common.geometry.tapered_capsules import first_hits as capsule_hits
from common.hand.model import CHAINS, Chains, HandModel

Foot: TypeAlias = tuple[Float, Float, Float, Float, Float, Float]

ROUNDS = 12  # what is left then is below 0.1 mm, at worst where fingers are parallel


def finger_segments(joints_m: Float, radius_m: Float) -> Capsules:
    """Segments (..., 5, 3), thumb ... little, of joints (..., 26, 3), radii (26,)."""
    chain, radius = joints_m[..., CHAINS, :], radius_m[CHAINS]
    return Capsules(chain[..., :-1, :], chain[..., 1:, :], radius[..., :-1], radius[..., 1:])


@dataclass(frozen=True, slots=True, eq=False)
class Gaps:
    """Where two sets of cones are nearest.

    Attributes:
        gap_m: (...) [m] between the skins, negative where they overlap.
        on_a, on_b: (...) 0..1 how far along each cone the two balls are that are nearest.
        middle_m: (..., 3) [m] half way between the skins there.
        a_to_b: (..., 3) unit vector from the one ball to the other.
    """

    gap_m: Float
    on_a: Float
    on_b: Float
    middle_m: Float
    a_to_b: Float


def gaps_between(a: Capsules, b: Capsules) -> Gaps:
    """The gaps of cones against cones, broadcast against each other."""
    apart, along_a, along_b = b.start_m - a.start_m, a.stop_m - a.start_m, b.stop_m - b.start_m
    growth_a, growth_b = a.stop_radius_m - a.start_radius_m, b.stop_radius_m - b.start_radius_m
    uu, vv, square = (np.vecdot(one, one) for one in (along_a, along_b, apart))
    uv, au, bv = np.vecdot(along_a, along_b), np.vecdot(apart, along_a), np.vecdot(apart, along_b)
    on_a = foot_of(au / uu, uv / uu, square / uu, 2.0 * bv / uu, vv / uu, growth_a, uu)
    on_b = foot_of(-bv / vv, uv / vv, square / vv, -2.0 * au / vv, uu / vv, growth_b, vv)
    s = t = np.full(apart.shape[:-1], 0.5)
    for _ in range(ROUNDS):
        s, before = nearest(on_a, t), t
        t = nearest(on_b, s)
        if (t == before).all():  # as where the nearest are ends of bones: more rounds change nothing
            break
    from_a = a.start_m + s[..., None] * along_a
    between = b.start_m + t[..., None] * along_b - from_a
    length = np.sqrt(np.vecdot(between, between))
    way = between / np.maximum(length, 1e-9)[..., None]
    radius_a, radius_b = a.start_radius_m + s * growth_a, b.start_radius_m + t * growth_b
    gap = length - radius_a - radius_b
    middle = from_a + (radius_a + 0.5 * gap)[..., None] * way
    return Gaps(gap, s, t, middle, way)


def foot_of(
    foot: Float, foot_by: Float, c0: Float, c1: Float, c2: Float, growth_m: Float, square: Float
) -> Foot:
    """Return where along a cone the foot of a point on the other's bone is.

    The foot is linear in the point's share, and the square of its distance from the bone, in units of the bone's
    length, is a quadratic: so a round needs no vectors.

    Args:
        foot, foot_by: The foot of the other's start, and by how much it goes on; shares of this bone.
        c0, c1, c2: The square of the distance from this cone's start is c0 + c1 x + c2 x^2 of a share x.
        growth_m, square: Of this cone: growth [m], and the square of its bone's length [m^2].

    Returns:
        `foot` and `foot_by`, the three coefficients of the square of the distance from the bone, and by how much the
        nearest place is beyond the foot, to where the cone is thicker, per distance: the tangent of half its angle.
    """
    lean = growth_m / np.sqrt(np.maximum(square - growth_m * growth_m, 1e-12))
    return foot, foot_by, c0 - foot * foot, c1 - 2.0 * foot * foot_by, c2 - foot_by * foot_by, lean


def nearest(on: Foot, share: Float) -> Float:
    """Where along a cone, 0..1, its skin is nearest to a point of the other's bone.

    `share`: of the point along that bone.
    """
    foot, foot_by, off_2, off_by, off_by_2, lean = on
    beyond = lean * np.sqrt(np.maximum(off_2 + share * (off_by + share * off_by_2), 0.0))
    return np.minimum(np.maximum(foot + share * foot_by + beyond, 0.0), 1.0)


SPREAD = 0.10  # of the palmar distance, standard deviation
# Of the spheres of a finger: on which of its three bones, and at what share of it.
PLACES = ((0, 0.0), (0, 0.3), (0, 0.5), (0, 0.75), (1, 0.0), (1, 0.5), (2, 0.0), (2, 1.0))
ROOT = 4  # spheres of the first bone, which of a thumb is in its ball
_BONE = np.array([bone for bone, _ in PLACES])
_SHARE = np.array([share for _, share in PLACES])
_JOINTS = (4, 6)  # spheres that sit on a joint, where the skin lies on the bisector
# Palmar distance of the skin from the bone, and radius [share of the distance of the knuckles], thumb ... little. The
# pads of the palm reach over the first half of a finger's first bone.
_PALMAR = np.array(
    [
        [0.200, 0.200, 0.200, 0.200, 0.180, 0.173, 0.155, 0.133],
        [0.250, 0.205, 0.168, 0.163, 0.142, 0.128, 0.102, 0.100],
        [0.300, 0.245, 0.188, 0.183, 0.163, 0.133, 0.107, 0.105],
        [0.250, 0.200, 0.166, 0.145, 0.150, 0.133, 0.112, 0.104],
        [0.230, 0.170, 0.117, 0.114, 0.105, 0.104, 0.089, 0.081],
    ]
)
_RADIUS = np.array(
    [
        [0.200, 0.200, 0.200, 0.200, 0.165, 0.155, 0.160, 0.140],
        [0.153, 0.153, 0.153, 0.142, 0.143, 0.133, 0.132, 0.112],
        [0.137, 0.137, 0.137, 0.135, 0.133, 0.133, 0.130, 0.119],
        [0.127, 0.127, 0.127, 0.132, 0.128, 0.120, 0.109, 0.100],
        [0.135, 0.135, 0.135, 0.125, 0.122, 0.112, 0.110, 0.100],
    ]
)


@dataclass(frozen=True, slots=True, eq=False)
class PalmarSurface:
    """The skin of one hand.

    Attributes:
        palmar_m: (5, 8) distance of the skin from the bone on the palmar side [m], finger by sphere.
        radius_m: (5, 8) of the spheres [m].
    """

    palmar_m: Float
    radius_m: Float

    @classmethod
    def of(cls, model: HandModel) -> "PalmarSurface":
        """The surface of a hand file, or of a hand of its size, times its `palmar_scale`."""
        thick = np.array([[model.profile.palmar_scale.get(finger, 1.0)] for finger in get_args(Finger)])
        if model.profile.radius_m is None:
            knuckles = model.rest_position_m[CHAINS[[1, 4], 0]]
            size = float(np.linalg.norm(knuckles[1] - knuckles[0]))
            return cls(thick * size * _PALMAR, thick * size * _RADIUS)
        near, far = (model.radius_m[CHAINS[:, _BONE + k]] for k in (0, 1))
        radius = thick * (near + _SHARE * (far - near))
        return cls(radius, radius)

    def spheres(self, chains: Chains) -> Float:
        """Centres (..., 5, 8, 3) [m] of the spheres, in the frame of the chains."""
        bone = chains.position_m[..., 1:, :] - chains.position_m[..., :-1, :]
        along = bone / np.sqrt(np.vecdot(bone, bone))[..., None]
        dorsal = chains.rotation[..., :3, :, 1]
        dorsal = dorsal - np.vecdot(dorsal, along)[..., None] * along
        dorsal = dorsal / np.sqrt(np.vecdot(dorsal, dorsal))[..., None]
        back = dorsal[..., _BONE, :]
        for sphere in _JOINTS:
            between = dorsal[..., _BONE[sphere] - 1, :] + dorsal[..., _BONE[sphere], :]
            back[..., sphere, :] = between / np.sqrt(np.vecdot(between, between))[..., None]
        on_bone = chains.position_m[..., _BONE, :] + _SHARE[:, None] * bone[..., _BONE, :]
        return on_bone + (self.radius_m - self.palmar_m)[..., None] * back


def first_hits(origin: Float, rays: Float, centres: Float, radius: Float) -> Float:
    """Distance along unit rays at which a chain's cones are first hit; inf: missed.

    Rays (..., R, 3) from `origin` (3,) outside of all cones, spheres of a chain at `centres` (..., K, 3) with `radius`
    (K,), all in one frame; result (..., R, K - 1).
    """
    chain = Capsules(centres[..., :-1, :], centres[..., 1:, :], radius[:-1], radius[1:])
    known = terms(chain, origin, np.float64)[..., None, :]
    hits: Float = capsule_hits(known, np.moveaxis(rays, -1, 0)[..., None])
    return hits
