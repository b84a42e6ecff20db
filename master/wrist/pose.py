"""From the angles of five fingers to the pose of 26 joints in the frame of the wrist camera, with covariances.

The palm does not move against the camera: it is where calibration found it. What moves are the three joints and the tip
of each finger; their covariance is that of the angles, carried by the arcs on which each angle turns them.
"""

import numpy as np

from common.arrays import Bool, Code, Float
from common.geometry import cross, matrix_to_quaternion
from common.hand_model import CHAINS, METACARPALS, PALM, WRIST
from common.messages import HandPose, Source
from master.ik.priors import Priors
from master.wrist.setup import WristSetup

_TURNED_BY = np.array([0, 0, 1, 2])  # joint of the chain about which abduction, flexion, PIP, DIP turn
_MOVES = np.array([[j > k for k in _TURNED_BY] for j in (1, 2, 3)])
_NO_MARKERS = np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3, 3))
_NO_MARKERS[0].flags.writeable = False


class PoseMaker:
    """Makes poses of one device and hand. What it holds was prepared by the constructor."""

    def __init__(self, setup: WristSetup, priors: Priors | None = None) -> None:
        priors = priors or Priors()
        self._setup, self._model = setup, setup.model
        self._palm = np.array([PALM, WRIST, *METACARPALS])
        self._still_m2 = np.broadcast_to(priors.model_m**2 * np.eye(3), (26, 3, 3))
        self._inside = np.ones(26, np.bool_)

    def __call__(
        self, t_ns: int, angles_rad: Float, cov_rad2: Float, source: Code, tracked: Bool, laser_m: Float
    ) -> HandPose:
        """The pose at `t_ns`.

        Args:
            t_ns: Its instant [ns].
            angles_rad: (5, 4), within the limits; NaN: nothing is known of that finger.
            cov_rad2: (5, 4, 4).
            source: (5,) of each finger; NONE: its joints are not valid, and NaN.
            tracked: (5,) fingers that are observed now.
            laser_m: (5, 3) where the laser meets them [m].
        """
        model, T = self._model, self._setup.T_camera_palm
        chains = model.chains(angles_rad)
        joints = model.joints(T, chains)
        R = T[:3, :3]
        cov = self._still_m2.copy()
        cov[CHAINS[:, 1:]] += R @ self._moving_cov(chains.position_m, chains.rotation, cov_rad2) @ R.T
        known = source != Source.NONE
        valid, seen, origin = np.zeros((3, 26), np.uint8)
        valid[CHAINS], seen[CHAINS], origin[CHAINS] = known[:, None], tracked[:, None], source[:, None]
        valid[self._palm], seen[self._palm], origin[self._palm] = 1, tracked.any(), Source.WRIST
        position, orientation = joints.position_m, matrix_to_quaternion(joints.rotation)
        lost = CHAINS[~known].ravel()
        position[lost], orientation[lost], cov[lost] = np.nan, np.nan, np.nan
        return HandPose(
            hand=model.profile.name,
            t_ns=t_ns,
            position_m=position,
            orientation_wxyz=orientation,
            radius_m=model.radius_m,
            valid=valid.astype(np.bool_),
            tracked=seen.astype(np.bool_),
            cov_m2=cov,
            source=origin,
            angles_rad=angles_rad,
            markers_m=_NO_MARKERS[0],
            markers_raw_m=_NO_MARKERS[1],
            markers_cov_m2=_NO_MARKERS[2],
            inside_volume=self._inside,
            laser_m=laser_m,
        )

    def _moving_cov(self, position_m: Float, rotation: Float, cov_rad2: Float) -> Float:
        """Covariances (5, 3, 3, 3) [m^2], palm frame, of what moves of the chains (5, 4, ...)."""
        model = self._model
        axes = np.empty((5, 4, 3))
        axes[1:, 0] = 0.0, model.side_sign, 0.0
        axes[0, 0] = model.side_sign * model.rest_rotation[CHAINS[0, 0]][:, 1]
        axes[:, 1:] = -rotation[:, :3, :, 0]
        arm = position_m[:, 1:, None] - position_m[:, None, _TURNED_BY]
        by_angle = np.where(_MOVES[..., None], cross(np.broadcast_to(axes[:, None], arm.shape), arm), 0.0)
        return np.swapaxes(by_angle, -1, -2) @ cov_rad2[:, None] @ by_angle
