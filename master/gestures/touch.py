"""Where the thumb is to the fingers, skin to skin, and which sides face each other: what pinches and taps are."""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.geometry import cross
from common.hand_model import CHAINS
from common.skin_gaps import Gaps, RoundCones, gaps_between
from master.gestures.features import HandFeatures

_PAD_SHARE = 0.75  # where along the last bone the features have the pad


@dataclass(frozen=True, slots=True, eq=False)
class ThumbTouch:
    """The thumb's last segment against index ... little.

    Attributes:
        gap_m: (4,) to the last segment of each finger, skin to skin [m], negative: pressed.
        middle_m: (4, 3) half way between them [m], rig frame.
        apart_rad: (4,) by how much the pads of both are turned from facing each other, the worse of the two.
        apart_sigma_rad: (4,) how sure that is.
        key_gap_m: (4, 3) from the thumb's last segment to each segment of each finger, from the knuckle on [m].
        key_on: (4, 3) where along the segment that is, 0 at the joint before it.
        key_palmar: (4, 3) cosine between the way to the thumb there and the palmar side of the segment.
        key_sigma_m: (4, 3) standard deviation [m] of those gaps: of both places along the way between them.
    """

    gap_m: Float
    middle_m: Float
    apart_rad: Float
    apart_sigma_rad: Float
    key_gap_m: Float
    key_on: Float
    key_palmar: Float
    key_sigma_m: Float

    @property
    def sigma_m(self) -> Float:
        """Standard deviation (4,) [m] of `gap_m`."""
        return self.key_sigma_m[:, 2]


def thumb_touch(features: HandFeatures, radius_m: Float) -> ThumbTouch:
    """The gaps of a hand whose joints have the radii (26,) [m]."""
    cones = RoundCones.of_segments(features.joints_m, radius_m)
    found = gaps_between(cones.part(slice(0, 1), slice(2, 3)), cones.part(slice(1, 5), slice(0, 3)))
    palmar = _palmar(features)
    last_way = found.a_to_b[:, 2]
    face = np.minimum(last_way @ palmar[0, 2], -np.vecdot(last_way, palmar[1:, 2]))
    turned = _turned_rad(features)
    return ThumbTouch(
        gap_m=found.gap_m[:, 2],
        middle_m=found.middle_m[:, 2],
        apart_rad=np.arccos(np.minimum(np.maximum(face, -1.0), 1.0)),
        apart_sigma_rad=np.hypot(turned[0], turned[1:]),
        key_gap_m=found.gap_m,
        key_on=found.on_b,
        key_palmar=-np.vecdot(found.a_to_b, palmar[1:]),
        key_sigma_m=_sigma_m(features, found),
    )


def _turned_rad(features: HandFeatures) -> Float:
    """Standard deviations (5,) [rad] of the directions of the last bones: of their ends, over their length."""
    ends = features.joints_cov_m2[CHAINS[:, 2:]]
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(ends[:, 0] + ends[:, 1])[:, 2], 0.0))
    bone = features.joints_m[CHAINS[:, 3]] - features.joints_m[CHAINS[:, 2]]
    return spread / np.sqrt(np.vecdot(bone, bone))


def _sigma_m(features: HandFeatures, found: Gaps) -> Float:
    """Standard deviations (4, 3) [m] of the gaps.

    Of both skins along the way from one to the other, each as its bone has it there, between what its two joints have.
    What both err alike by, the palm's doubt, counts twice: it is small beside the rest where tips are seen.
    """
    cov = features.joints_cov_m2[CHAINS]
    thumb, fingers = cov[0, 2:], cov[1:]
    on_a, on_b = found.on_a[..., None, None], found.on_b[..., None, None]
    both = (1.0 - on_a) * thumb[0] + on_a * thumb[1] + (1.0 - on_b) * fingers[:, :3] + on_b * fingers[:, 1:]
    way = found.a_to_b[..., None]
    return np.sqrt(np.maximum((way.swapaxes(-1, -2) @ both @ way)[..., 0, 0], 0.0))


def _palmar(features: HandFeatures) -> Float:
    """Unit vectors (5, 3, 3) out of the palmar side of each segment, rig frame: across it, in the plane of its bend.

    The pad says it for the last one; the others are turned back by the bends between.
    """
    chain = features.joints_m[CHAINS]
    bone = chain[:, 1:] - chain[:, :-1]
    out = np.empty((5, 3, 3))
    out[:, 2] = features.pads_m - (chain[:, 2] + _PAD_SHARE * bone[:, 2])
    hinge = cross(bone[:, 2], out[:, 2])  # across the finger, the same for all its segments but for twist
    out[:, :2] = cross(hinge[:, None], bone[:, :2])
    return out / np.sqrt(np.vecdot(out, out))[..., None]
