"""The unknowns of a mounting have a prior, observations and a first guess.

The first guess is right to some degrees and ms:

**Rotations.** With a wrist that is about straight the palm's rotation is R_rig_palm = R_rig_world R_world_imu
R_imu_palm with two constant rotations. In quaternions the sum of the cosines of half of the residual is
bilinear in the two,

    sum_t <q_rig_palm, q_rig_world q_world_imu q_imu_palm> = q_rig_world' M q_imu_palm,

so the first singular vectors of M (4, 4) are the rotations, and its singular value is how well the two tracks
agree: it is greatest where the IMU's clock is right.

**Tips.** Camera and IMU are one body, which is carried by the wrist joint. So where the camera should see a
marker on a fingertip is given by markers and IMU, however wrist and fingers are bent. The camera's clock is
right where the tips that it sees move as these do.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from common.arrays import Bool, Float, Int
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import (
    cross,
    matrix_to_quaternion,
    quaternion_to_matrix,
    rigid,
    rotation_vector_to_matrix,
)
from common.hand.skin import SPREAD
from master.calibrate.extrinsics.tracks import HandTrack, ImuTrack

UNKNOWN = 34
CAMERA_IMU, SHIFT, FOREARM_IMU, RIG_WORLD, ZERO = (slice(3 * k, 3 * k + 3) for k in range(5))
CAMERA_LATE, IMU_LATE = 15, 16
THICK, REACH, GAIN = slice(17, 21), slice(21, 25), slice(25, 34)
_ZERO_RAD_S = np.radians(2.5)  # of the zero of a gyroscope when it is switched on (`common.imu.fusion`)


@dataclass(frozen=True, slots=True, eq=False)
class Unknown:
    """Unknowns that all epochs share.

    Camera and IMU are one body, so their relative rotation is fixed by every motion; how both are rotated
    against the palm of a straight wrist, by what the wrist does.
    """

    R_camera_imu: Float  # (3, 3) IMU axes -> camera axes
    shift_m: Float  # (3,) the wrist joint in the camera's frame
    R_forearm_imu: Float  # (3, 3) IMU axes -> forearm, which is the palm of a straight wrist
    R_rig_world: Float  # (3, 3) the world of the IMU's track -> rig
    gyro: Float  # (12,) errors of its gyroscope, as of `tracks.ImuTrack`
    camera_late_s: float  # this and imu_late_s: how much later frames, samples are than their stamps state
    imu_late_s: float
    thick: Float  # this and reach_m: (4,) of the fingers, as of `tracks.LinesOfSight`
    reach_m: Float

    @property
    def T_camera_palm(self) -> Float:
        """(4, 4) with a straight wrist."""
        return rigid(self.R_camera_imu @ self.R_forearm_imu.T, self.shift_m)

    def retracted(self, step: Float) -> Self:
        """After a step (UNKNOWN,); rotations in front: by axes of camera, forearm, rig."""
        return type(self)(
            rotation_vector_to_matrix(step[CAMERA_IMU]) @ self.R_camera_imu,
            self.shift_m + step[SHIFT],
            rotation_vector_to_matrix(step[FOREARM_IMU]) @ self.R_forearm_imu,
            rotation_vector_to_matrix(step[RIG_WORLD]) @ self.R_rig_world,
            self.gyro + np.concatenate([step[ZERO], step[GAIN]]),
            self.camera_late_s + float(step[CAMERA_LATE]),
            self.imu_late_s + float(step[IMU_LATE]),
            self.thick + step[THICK],
            self.reach_m + step[REACH],
        )

    def off(self, first: Self) -> Float:
        """Deviation (UNKNOWN,) from the prior; 0 for rotations, which have none."""
        out = np.zeros(UNKNOWN)
        out[SHIFT], out[ZERO], out[GAIN] = self.shift_m - first.shift_m, self.gyro[:3], self.gyro[3:]
        out[CAMERA_LATE] = self.camera_late_s - first.camera_late_s
        out[IMU_LATE] = self.imu_late_s - first.imu_late_s
        out[THICK], out[REACH] = self.thick, self.reach_m
        return out


def prior_sigma() -> Float:
    """Prior standard deviations (UNKNOWN,)."""
    any_rad, any_m, any_s = 1.0, 0.03, 0.1  # standard deviations of what nothing is known of
    sigma = np.full(UNKNOWN, any_rad)
    sigma[SHIFT], sigma[ZERO], sigma[[CAMERA_LATE, IMU_LATE]] = any_m, _ZERO_RAD_S, any_s
    gain = 0.015  # of its axes, and of how they lean to each other (ICM-20948, DS-000189, table 1)
    reach_m = 2e-3
    sigma[THICK], sigma[REACH], sigma[GAIN] = SPREAD, reach_m, gain
    return sigma


OUTLIER_SIGMAS = 2.5  # standard deviations from which an observation is down-weighted


@dataclass(frozen=True, slots=True, eq=False)
class StrobeCycles:
    """Observations of T strobe cycles, fingers index ... little; NaN: not seen."""

    t_s: Float  # (T,) stamps [s], rising
    # this and laser_sigma_m: (T, 4, 2) on the plane, across and along, and standard deviations of the sensing
    laser_m: Float
    laser_sigma_m: Float
    tip_uv: Float  # (T, 4, 2) [px], seen `tip_late_s` later than the laser
    tip_sigma_px: Float  # (T, 4)
    tip_late_s: float

    def of(self, rows: Int | Bool) -> "StrobeCycles":
        """Some of them."""
        laser_m, sigma_m, uv = self.laser_m[rows], self.laser_sigma_m[rows], self.tip_uv[rows]
        return StrobeCycles(self.t_s[rows], laser_m, sigma_m, uv, self.tip_sigma_px[rows], self.tip_late_s)


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """The most probable mounting."""

    unknown: Unknown
    covariance: Float  # (UNKNOWN, UNKNOWN) of steps on `unknown`
    wrist_angles_rad: Float  # (T, 2) flexion and deviation of the wrist in each strobe cycle
    twist_rad: Float  # (T,) what no wrist does
    off: Float  # (T, 4, SEEN) seen minus fitted, in standard deviations; NaN: not seen
    sigma: Float  # (T, 4, SEEN) these [m, px]
    shown: Float  # (T, 4, SEEN) as fitted
    marker_m: float  # rms residual of the markers
    steps: int  # steps taken

    @property
    def rms(self) -> float:
        """Root mean square of `off`, with outliers clipped at their limit."""
        return float(np.sqrt(np.nanmean(np.minimum(np.abs(self.off), 2.0 * OUTLIER_SIGMAS) ** 2)))

    @property
    def outlier_share(self) -> float:
        """Share of the observations that are farther off than noise explains."""
        pairs = np.hypot(self.off[..., 0::2], self.off[..., 1::2])
        return float((pairs > 2.0 * OUTLIER_SIGMAS).sum() / max(np.isfinite(pairs).sum(), 1))


_SEARCH_S = np.arange(-0.12, 0.1201, 0.01)
_FEWEST = 20  # epochs


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """A first guess."""

    T_camera_palm: Float  # (4, 4) of the rig file
    R_palm_imu: Float  # this and R_rig_world: (3, 3)
    R_rig_world: Float
    imu_late_s: float  # this and camera_late_s: how much later samples, frames are than their stamps state
    camera_late_s: float

    @property
    def unknown(self) -> Unknown:
        """As unknowns to be fitted."""
        T, R, none = self.T_camera_palm, self.R_palm_imu, np.zeros(4)
        late_s = self.camera_late_s, self.imu_late_s
        return Unknown(T[:3, :3] @ R, T[:3, 3], R, self.R_rig_world, np.zeros(12), *late_s, none, none)


def started(
    hand: HandTrack,
    tips_m: Float,
    imu: ImuTrack,
    optics: CameraModel,
    T_camera_palm: Float,
    cycles: StrobeCycles,
) -> Start | None:
    """The first guess; None: hand and IMU were hardly seen at the same time.

    `tips_m` (N, 4, 3) are the markers on index ... little of the hand's epochs, rig frame, NaN: not seen;
    T_camera_palm (4, 4) is the rig file's guess.
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
    """Agreement of the tracks (1: exact), R_rig_world and R_imu_palm, for a latency."""
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
    """Latency at which tips move as the markers on them should."""
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
