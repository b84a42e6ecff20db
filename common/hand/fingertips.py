"""Position of a fingertip.

It is the outermost point of the skin along the finger's last bone.

The last joint of a hand file lies inside the fingertip. OpenXR defines its radius as the distance from there to the
skin (XR_EXT_hand_tracking), so where the file gives radii the tip is that far beyond the joint. If it gives none, the
reach is that of a hand of this size, in shares of the distance between the knuckles of index and little finger,
measured like the rest of the skin (`common.hand.palmar_surface`) on the generic hand of the WebXR Input
Profiles (MIT). The
outermost point of such a fingertip lies a little towards the nail; that of a sphere does not.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.hand.model import CHAINS, TIPS, Chains, HandModel

_BEYOND = np.array([0.166, 0.170, 0.197, 0.180, 0.152])  # thumb ... little


@dataclass(frozen=True, slots=True, eq=False)
class Fingertips:
    """The tips of one hand.

    Attributes:
        beyond_m: (5,) how far the skin reaches beyond the last joint, along the last bone [m].
        dorsal_m: How far its outermost point lies on the back's side of the bone's line [m].
    """

    beyond_m: Float
    dorsal_m: float

    @classmethod
    def of(cls, model: HandModel) -> "Fingertips":
        """Those of a hand file, or else of a hand of its size."""
        if model.profile.radius_m is not None:
            return cls(model.radius_m[TIPS], 0.0)
        knuckles = model.rest_position_m[CHAINS[[1, 4], 0]]
        width = float(np.linalg.norm(knuckles[1] - knuckles[0]))
        dorsal = 0.02  # the outermost point, of all five
        return cls(_BEYOND * width, dorsal * width)

    def points(self, chains: Chains) -> Float:
        """Tips (..., 5, 3) [m], in the frame of the chains."""
        joint = chains.position_m[..., 3, :]
        bone = joint - chains.position_m[..., 2, :]
        along = bone / np.sqrt(np.vecdot(bone, bone))[..., None]
        dorsal = chains.rotation[..., 3, :, 1]
        dorsal = dorsal - np.vecdot(dorsal, along)[..., None] * along
        return joint + self.beyond_m[:, None] * along + self.dorsal_m * dorsal
