"""A hand from points: the estimator for markers whose places are measured, without cameras or the card's line."""

from math import inf

import numpy as np

from common.arrays import Float
from common.geometry.camera_model import CameraModel
from common.hand.model import HandModel
from master.estimator.epoch import Epoch, Fitted, OrientationMeasurement
from master.estimator.estimator import Estimator
from master.estimator.settings import DEFAULT, Settings

TOWARDS = np.array([0.0, 0.0, -1.0])  # from hands to cameras that look along the rig's +z
_SURE_RAD = np.radians(15.0)  # better known than this about every axis, a rotation says how the palm lies
NO_RAY = CameraModel(np.eye(3), np.zeros(5), np.eye(4), 640, 480, 0.0)


class PointHand:
    """Push machine. Holds the estimator, to which all places are given with their covariances."""

    def __init__(
        self,
        model: HandModel,
        markers: tuple[str, ...],
        *,
        continuous: bool = True,
        natural: bool = False,
        faces: bool = True,
        settings: Settings = DEFAULT,
    ) -> None:
        """Prepare.

        Args:
            model: The hand.
            markers: Its markers, in the order of the points.
            continuous, natural, settings: As of `Estimator`.
            faces: Whether a back that is seen is believed to look towards the cameras.

        Raises:
            CalibrationError: The profile mounts no marker of one of the names.
        """
        settings = settings if faces else settings._replace(back_normal_rad=inf)
        self.estimator = Estimator(
            [NO_RAY],
            model,
            markers,
            markers,
            continuous=continuous,
            natural=natural,
            settings=settings,
        )

    def push(
        self,
        t_ns: int,
        points_m: Float,
        cov_m2: Float,
        back_normal: Float = TOWARDS,
        orientation: tuple[Float, Float] | None = None,
    ) -> Fitted:
        """Fit one epoch.

        Args:
            t_ns: When.
            points_m, cov_m2: (M, 3) [m] and (M, 3, 3) [m^2] of the markers, rig frame; NaN: not seen.
            back_normal: (3,) unit vector from the hand to the cameras.
            orientation: The measured rotation (3, 3) and its covariance (3, 3) [rad^2], rig axes; None: not known.
        """
        measured = None
        if orientation is not None:
            rotation, cov_rad2 = orientation
            sure = bool(np.linalg.eigvalsh(cov_rad2)[-1] < _SURE_RAD**2)
            measured = OrientationMeasurement(rotation, np.asarray(np.linalg.inv(cov_rad2), np.float64), sure)
        return self.estimator.push(Epoch(t_ns, points_m, back_normal, cov_m2=cov_m2, orientation=measured))
