"""Three back-of-hand markers instead of one, which constrain palm orientation.

The three markers rotate with the palm.

They lie above metacarpals, where skin moves least: one near the wrist, one each behind the knuckles of index and little
finger. So they span a triangle as large as the back of a hand allows: noise of 1 mm turns one with sides of 4 to 5 cm
by a degree or two.
"""

import msgspec
import numpy as np

from common.arrays import Float
from common.calibration import HandProfile, MarkerMount
from common.hand.model import JOINTS, PALM_FRAME, HandModel

# Marker: joints at both ends of a metacarpal, and how far along it.
_PLACES = {
    "back": ("middle-finger-metacarpal", "middle-finger-phalanx-proximal", 0.1),
    "back2": ("index-finger-metacarpal", "index-finger-phalanx-proximal", 0.75),
    "back3": ("pinky-finger-metacarpal", "pinky-finger-phalanx-proximal", 0.75),
}


def with_three_back_markers(profile: HandProfile, name: str) -> HandProfile:
    """Return the hand under another name with three markers on its back.

    The markers are `back`, `back2` and `back3`; an existing `back` is moved.

    Raises:
        CalibrationError: The profile is broken.
    """
    model = HandModel.of(profile)
    mounts = {
        marker: MarkerMount(joint=PALM_FRAME, offset_m=_above(model, *at)) for marker, at in _PLACES.items()
    }
    return msgspec.structs.replace(profile, name=name, markers=profile.markers | mounts)


def _above(model: HandModel, near: str, far: str, share: float) -> tuple[float, float, float]:
    """Place (3,) [m], palm frame, on the skin above a metacarpal."""
    a, b = (JOINTS.index(joint) for joint in (near, far))
    middle: Float = (1.0 - share) * model.rest_position_m[a] + share * model.rest_position_m[b]
    radius = (1.0 - share) * model.radius_m[a] + share * model.radius_m[b]
    thickness_m = 0.0015  # from skin to the middle of what is painted
    x, y, z = np.round(middle + np.array([0.0, radius + thickness_m, 0.0]), 7).tolist()
    return x, y, z
