"""Palmar skin of flexed fingers: chains of round cones along the bones.

Computes where rays meet them first.

Where the laser meets a finger depends on its skin, and its bones lie nearer to the back than to the palm. Each finger
is a chain of spheres joined by cones. A sphere has the radius by which the palmar side is round, and its centre is put
so that the skin is as far from the bone as it should be.

If the hand file gives `radius_m`, the skin is that far from every joint. If not, it is that of a hand of this size:
shares of the distance between the knuckles of index and little finger, since the breadth of a hand gives the thickness
of its fingers (Buchholz, Armstrong, "An ellipsoidal representation of human hand anthropometry", Human Factors 33,
1991). The shares are those of the generic hand of the WebXR Input Profiles (MIT), cut across at these places while its
own rig bends it to a PIP of 50 degrees, because skin folds. The breadths and depths by breadth of hand of the scalable
hand of Sancho-Bru et al. (0.23 and 0.23 of it at the proximal bone of the index finger, 0.17 and 0.16 at the middle
bone of the little finger), with 0.57 of the depth on the palmar side of the bone, give the same within 0.8 mm RMS and
1.5 mm at most, and as much may be wrong for another person: `SPREAD`. What a guided motion measures of a person
(`phalanx calibrate wrist subject`) is the file's `palmar_scale`, which multiplies both.
"""

from dataclasses import dataclass
from typing import get_args

import numpy as np

from common.arrays import Float
from common.calibration import Finger
from common.geometry.tapered_capsules import Capsules, terms
from common.geometry.tapered_capsules import first_hits as capsule_hits
from common.hand.model import CHAINS, Chains, HandModel

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
        """Return the palmar surface of a hand file, or of a hand of its size.

        As thick as the file's `palmar_scale` states.
        """
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
    """Return the distance along rays at which each cone of a chain is first hit.

    Unit rays (..., R, 3) from `origin` (3,); result (..., R, K - 1); inf: missed.

    Args:
        origin: Outside of all cones.
        rays: In the frame of the centres.
        centres: (..., K, 3) of the spheres of a chain.
        radius: (K,).
    """
    chain = Capsules(centres[..., :-1, :], centres[..., 1:, :], radius[:-1], radius[1:])
    known = terms(chain, origin, np.float64)[..., None, :]
    hits: Float = capsule_hits(known, np.moveaxis(rays, -1, 0)[..., None])
    return hits
