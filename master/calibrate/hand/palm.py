"""Palm in a motion capture: its frame at every epoch, and which hand it is.

Wrist, knuckles and the thumb's root are one rigid body, whose shape is the mean of all frames laid on one another
(generalised Procrustes analysis; Gower, 1975). The palm frame is that in which this shape lies nearest to the generated
profile's, scaled: so it is the frame of all our hands, origin at the wrist, +z to the fingers, +y out of the back.

Knuckles and wrist are nearly a plane, and a plane is its own mirror image: which side is the back, and so which hand it
is, follows from the fingers. They bend into the palm, towards -y.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float
from common.errors import FitError
from common.geometry.transforms import fit_rigid
from common.hand.model import CHAINS, METACARPALS, WRIST, HandModel
from common.hand.profiles import generated_profile
from master.mocap.joint_motion import Side
from master.mocap.track import known

PALM_JOINTS = (WRIST, *CHAINS[:, 0].tolist(), *METACARPALS)
_SIDES: tuple[Side, Side] = ("right", "left")
_ROUNDS = 5


@dataclass(frozen=True, slots=True, eq=False)
class Palm:
    """The palm of one hand.

    Attributes:
        side: right or left.
        mirrored: Positions were turned over in x first: their axes are left-handed.
        chains_m: (T, 5, 4, 3) [m] the joints of `CHAINS` in the palm frame.
        shape_m: (26, 3) [m] the palm's own joints in it; NaN: not in the file, or not of the palm.
        rms_m: How far the palm's joints are off that shape.
        outlier: (T,) frames whose palm is none.
    """

    side: Side
    mirrored: bool
    chains_m: Float
    shape_m: Float
    rms_m: float
    outlier: Bool


def find_palm(joints_m: Float, side: Side | None, where: str) -> Palm:
    """Find the palm frame of joints (T, 26, 3) [m].

    NaN: not seen. Of the given side, or of the side that the joints show.

    Raises:
        FitError: The palm is never seen whole, or the fingers do not determine which side is the back.
    """
    mine = list(PALM_JOINTS)
    there = [joint for joint in mine if known(joints_m[:, joint]).mean() > 0.5]
    least_joints = 4
    if WRIST not in there or len(there) < least_joints:
        raise FitError(f"{where}: wrist and three knuckles, or more, must be seen in half of the frames")
    body = joints_m[:, there]
    whole = np.asarray(known(body).all(axis=1), np.bool_)
    if whole.sum() < 2:
        raise FitError(f"{where}: wrist, knuckles and thumb root are never seen together")
    shape, T_file_shape, distance = _mean_shape(body[whole])
    outlier = np.zeros(len(joints_m), np.bool_)
    outlier[~whole] = True
    # of the median distance of a frame's palm from the shape
    floor_m = 5e-3  # real palms arch by a millimetre or two
    outlier[np.flatnonzero(whole)[distance > max(4.0 * float(np.median(distance)), floor_m)]] = True
    in_shape = np.full_like(joints_m, np.nan)
    transposed = np.swapaxes(T_file_shape[:, :3, :3], 1, 2)
    moved = joints_m[whole] - T_file_shape[:, None, :3, 3]
    in_shape[whole] = np.einsum("tij,tkj->tki", transposed, moved)
    fits: dict[Side, Float] = {one: palm_axes(shape, there, one) for one in _SIDES}
    shown = _side_shown(in_shape[~outlier], fits, where)
    wanted = side or shown
    flip = np.array([-1.0 if wanted != shown else 1.0, 1.0, 1.0])
    R = palm_axes(shape * flip, there, wanted)
    local = (in_shape * flip - shape[there.index(WRIST)] * flip) @ R
    own = np.full((26, 3), np.nan)
    own[there] = (shape - shape[there.index(WRIST)]) * flip @ R
    rms = float(np.sqrt((distance[~outlier[whole]] ** 2).mean()))
    return Palm(wanted, wanted != shown, local[:, CHAINS], own, rms, outlier)


def _mean_shape(body_m: Float) -> tuple[Float, Float, Float]:
    """Return the mean shape (K, 3) of a body's points (T, K, 3).

    Also its poses (T, 4, 4) and the points' distances (T,) from it.
    """
    shape = body_m[len(body_m) // 2]
    T = np.zeros((len(body_m), 4, 4))
    for _ in range(_ROUNDS):
        T = fit_rigid(body_m, np.broadcast_to(shape, body_m.shape))
        back = np.einsum("tji,tkj->tki", T[:, :3, :3], body_m - T[:, None, :3, 3])
        shape = np.asarray(np.median(back, axis=0), np.float64)
    T = fit_rigid(body_m, np.broadcast_to(shape, body_m.shape))
    back = np.einsum("tji,tkj->tki", T[:, :3, :3], body_m - T[:, None, :3, 3])
    return shape, T, np.sqrt(((back - shape) ** 2).sum(axis=2).mean(axis=1))


def palm_axes(shape_m: Float, joints: list[int], side: Side) -> Float:
    """The palm's axes as columns (3, 3), in those of a shape (K, 3) of some joints."""
    rest = HandModel.of(generated_profile("palm", side)).rest_position_m[joints]
    size = np.linalg.norm(shape_m - shape_m.mean(axis=0)) / np.linalg.norm(rest - rest.mean(axis=0))
    return fit_rigid(shape_m, size * rest)[:3, :3]


def _side_shown(in_shape: Float, fits: dict[Side, Float], where: str) -> Side:
    """Return the side of the hand whose fingers flex towards -y.

    That is about +x, whatever the knuckles do.

    Raises:
        FitError: They bend too little, or aside.
    """
    chains = in_shape[:, CHAINS[1:]]
    chains = chains[known(chains).all(axis=(1, 2))]
    bones = np.diff(chains, axis=2)
    bones /= np.linalg.norm(bones, axis=3, keepdims=True)
    normal = np.cross(bones[:, :, :2], bones[:, :, 1:]).sum(axis=(0, 1, 2))
    length = float(np.linalg.norm(normal))
    along = {side: float(normal @ R[:, 0]) / max(length, 1e-12) for side, R in fits.items()}
    sure = 0.5  # of the mean axis about which fingers bend, along +x
    right: list[Side] = [side for side in _SIDES if along[side] > sure]
    if len(right) != 1:
        raise FitError(
            f"{where}: fingers bend about an axis that is {along['right']:+.2f} that of a right hand and"
            f" {along['left']:+.2f} that of a left one, where +1 is expected of one alone: record fists; if names were"
            " matched wrongly, give --joints"
        )
    return right[0]
