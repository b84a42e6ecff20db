"""Initial guess of a mounting: how the IMU lies, and the clock offsets.

To some degrees and ms.

**Turns.** With a wrist that is about straight the palm's turn is R_rig_palm = R_rig_world R_world_imu R_imu_palm with
two constant turns. In quaternions the sum of the cosines of half of what is left is bilinear in the two,

    sum_t <q_rig_palm, q_rig_world q_world_imu q_imu_palm> = q_rig_world' M q_imu_palm,

so the first singular vectors of M (4, 4) are the turns, and its singular value is how well the two tracks agree: it
is greatest where the IMU's clock is right.

**Tips.** Camera and IMU are one body, which is carried by the wrist joint. So where the camera should see a marker on a
fingertip is given by markers and IMU, however the wrist is bent and fingers are. The camera's clock is right where the
tips that it sees move as these do.
"""

from dataclasses import dataclass, replace

import numpy as np

from common.arrays import Float
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import cross, matrix_to_quaternion, quaternion_to_matrix
from master.calibrate.extrinsics.seen import StrobeCycles
from master.calibrate.extrinsics.tracks import HandTrack, ImuTrack
from master.calibrate.extrinsics.unknown import Unknown

_SEARCH_S = np.arange(-0.12, 0.1201, 0.01)
_FEWEST = 20  # epochs


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """A first guess.

    Attributes:
        T_camera_palm: (4, 4) of the rig file.
        R_palm_imu, R_rig_world: (3, 3).
        imu_late_s, camera_late_s: How much later the samples, the frames are than their stamps state.
    """

    T_camera_palm: Float
    R_palm_imu: Float
    R_rig_world: Float
    imu_late_s: float
    camera_late_s: float

    @property
    def unknown(self) -> Unknown:
        """As what is to be fitted."""
        return Unknown(
            self.T_camera_palm[:3, :3] @ self.R_palm_imu,
            self.T_camera_palm[:3, 3],
            self.R_palm_imu,
            self.R_rig_world,
            np.zeros(12),
            self.camera_late_s,
            self.imu_late_s,
            np.zeros(4),
            np.zeros(4),
        )


def started(
    hand: HandTrack,
    tips_m: Float,
    imu: ImuTrack,
    optics: CameraModel,
    T_camera_palm: Float,
    cycles: StrobeCycles,
) -> Start | None:
    """The first guess; None: hand and IMU were hardly seen at the same time.

    Args:
        hand, imu: What was seen of the hand, and felt.
        tips_m: (N, 4, 3) the markers on index ... little of the hand's epochs, rig frame; NaN: not seen.
        optics: The wrist camera.
        T_camera_palm: (4, 4) first guess of the rig file.
        cycles: What was seen from the wrist.
    """
    best: tuple[float, float, Float, Float] | None = None
    for late_s in _SEARCH_S.tolist():
        found = _aligned(hand, imu, late_s)
        if found is not None and (best is None or found[0] > best[0]):
            best = (found[0], late_s, found[1], found[2])
    if best is None:
        return None
    start = Start(T_camera_palm, best[3].T, best[2], best[1], 0.0)
    return replace(start, camera_late_s=_camera_late_s(hand, tips_m, imu, optics, start, cycles))


def _aligned(hand: HandTrack, imu: ImuTrack, late_s: float) -> tuple[float, Float, Float] | None:
    """Align the hand's and the IMU's orientations for a given latency of the samples.

    Returns how well the tracks agree (1: exactly), R_rig_world and R_imu_palm.
    """
    held = imu.held_at(hand.t_s - late_s)
    known = np.isfinite(held[:, 0, 0])
    if known.sum() < _FEWEST:
        return None
    palm = _continuous(matrix_to_quaternion(hand.T_rig_palm[known, :3, :3]))
    world = _continuous(matrix_to_quaternion(held[known]))
    # <p, w q v> over all unit quaternions e_i, e_j in place of w and v.
    e = np.eye(4)
    left = _product(e[:, None], world[None])  # (4, T, 4)
    M = np.einsum("tk,itjk->ij", palm, _product(left[:, :, None], e[None, None])) / len(palm)
    u, s, vt = np.linalg.svd(M)
    return float(s[0]), quaternion_to_matrix(u[:, 0]), quaternion_to_matrix(vt[0])


def _camera_late_s(
    hand: HandTrack, tips_m: Float, imu: ImuTrack, optics: CameraModel, first: "Start", cycles: StrobeCycles
) -> float:
    """By the correlation of tips that are seen with where markers on them should be."""
    held = imu.held_at(hand.t_s - first.imu_late_s)
    R_camera_imu = first.T_camera_palm[:3, :3] @ first.R_palm_imu
    R = R_camera_imu @ np.swapaxes(first.R_rig_world @ held, 1, 2)  # camera by rig
    arm = tips_m - hand.T_rig_palm[:, None, :3, 3]
    expected = optics.project(arm @ np.swapaxes(R, 1, 2) + first.T_camera_palm[:3, 3])
    agree = np.zeros(len(_SEARCH_S))
    for f, axis in np.ndindex(tips_m.shape[1], 2):
        known, seen = np.isfinite(expected[:, f, axis]), np.isfinite(cycles.tip_uv[:, f, axis])
        if known.sum() < _FEWEST or seen.sum() < _FEWEST:
            continue
        at, shown = cycles.t_s[seen] + cycles.tip_late_s, cycles.tip_uv[seen, f, axis]
        for k, late_s in enumerate(_SEARCH_S.tolist()):
            off = shown - np.interp(at + late_s, hand.t_s[known], expected[known, f, axis])
            agree[k] -= float(np.abs(off - np.median(off)).mean())
    return float(_SEARCH_S[int(agree.argmax())])


def _continuous(q: Float) -> Float:
    """Quaternions (T, 4) with the signs that let each be near the last."""
    flips = np.sign(np.vecdot(q[1:], q[:-1]))
    signs = np.multiply.accumulate(np.concatenate([[1.0], np.where(flips == 0.0, 1.0, flips)]))
    return q * np.asarray(signs, np.float64)[:, None]


def _product(p: Float, q: Float) -> Float:
    """Hamilton's product of quaternions (..., 4)."""
    w: Float = p[..., :1] * q[..., :1] - np.vecdot(p[..., 1:], q[..., 1:])[..., None]
    v: Float = p[..., :1] * q[..., 1:] + q[..., :1] * p[..., 1:] + cross(p[..., 1:], q[..., 1:])
    return np.asarray(np.concatenate([w, v], axis=-1), np.float64)
