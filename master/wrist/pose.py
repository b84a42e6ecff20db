"""From the angles of five fingers to the pose of 26 joints in the frame of the wrist camera, with covariances.

The palm does not move against the camera: it is where calibration found it. What moves are two joints and the tip of
each finger; their covariance is that of the angles, carried along the arcs on which these turn them.
"""

import numpy as np

from common.arrays import Code, Float
from common.geometry import matrix_to_quaternion
from common.hand_model import CHAINS, METACARPALS, PALM, WRIST
from common.messages import HandPose, Source
from master.estimator.settings import DEFAULT, Settings
from master.volume import inside
from master.wrist.belief import FingerAngles
from master.wrist.palm_world import NO_WORLD
from master.wrist.setup import WristSetup

_NO_MARKERS = np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3, 3))
_NO_MARKERS[0].flags.writeable = False


class PoseMaker:
    """Makes poses of one device and hand. What it holds was prepared by the constructor."""

    def __init__(self, setup: WristSetup, settings: Settings = DEFAULT) -> None:
        self._setup, self._model = setup, setup.model
        self._palm = np.array([PALM, WRIST, *METACARPALS])
        self._still_m2 = np.broadcast_to(settings.bones_m**2 * np.eye(3), (26, 3, 3))
        self._low, self._high = np.moveaxis(setup.model.limits_rad, -1, 0)

    def __call__(
        self,
        t_ns: int,
        found: FingerAngles,
        source: Code,
        laser_m: Float,
        world: tuple[Float, Float] = NO_WORLD,
    ) -> HandPose:
        """The pose at `t_ns`.

        Args:
            t_ns: Its instant [ns].
            found: The fingers, those that are held among them; NaN: nothing is known of that finger.
            source: (5,) of each finger; NONE: its joints are not valid, and NaN.
            laser_m: (5, 3) where the laser meets them [m].
            world: The palm in the IMU's world (4,), and how sure that is (2,), as of `PalmWorld.at`.
        """
        model, T = self._model, self._setup.T_camera_palm
        angles_rad, tracked = found.angles_rad, found.told
        chains = model.chains(angles_rad)
        joints = model.joints(T, chains)
        R = T[:3, :3]
        cov = self._still_m2.copy()
        cov[CHAINS[:, 1:]] += R @ self._moving_cov(angles_rad, found.cov_rad2) @ R.T
        known = source != Source.NONE
        valid, seen, origin = np.zeros((3, 26), np.uint8)
        valid[CHAINS], seen[CHAINS], origin[CHAINS] = known[:, None], tracked[:, None], source[:, None]
        valid[self._palm], seen[self._palm], origin[self._palm] = 1, tracked.any(), Source.WRIST
        position, orientation = joints.position_m, matrix_to_quaternion(joints.rotation)
        lost = CHAINS[~known].ravel()
        position[lost], orientation[lost], cov[lost] = np.nan, np.nan, np.nan
        return HandPose.known_good(
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
            inside_volume=inside(self._setup.volume, position),
            laser_m=laser_m,
            palm_world_wxyz=world[0],
            palm_world_sigma_rad=world[1],
            level=found.level,
            ambiguous=found.ambiguous,
        )

    def _moving_cov(self, angles_rad: Float, cov_rad2: Float) -> Float:
        """Covariances (5, 3, 3, 3) [m^2], palm frame, of what moves of the fingers; NaN where angles are.

        Unscented (Julier, Uhlmann 1997): a doubt of 20 degrees bends a joint off the tangent of its arc, which the
        poses at the ends of the doubt's axes show and derivatives do not. Like fingers, they stop at the limits.
        """
        known = np.isfinite(angles_rad[:, 0])
        root = np.linalg.cholesky(np.where(known[:, None, None], cov_rad2, np.eye(4)))
        ends = np.sqrt(4.0) * np.moveaxis(root, -1, 0)  # (4, 5, 4)
        poses = np.concatenate([angles_rad[None], angles_rad + ends, angles_rad - ends])
        position = self._model.chains(np.clip(poses, self._low, self._high)).position_m[:, :, 1:]
        off = np.moveaxis(position[1:] - position[0], 0, -2)  # (5, 3, 8, 3)
        return np.swapaxes(off, -1, -2) @ off / len(ends) / 2.0
