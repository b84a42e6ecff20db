"""From an estimate to the message of a hand."""

import numpy as np

from common.arrays import Float
from common.calibration import Volume
from common.hand.model import HandModel
from common.messages import HandPose
from master.estimator.epoch import Fitted
from master.estimator.kinematics import quaternions
from master.fabrik.estimate import HandEstimate, MarkerPositions
from master.monitor.volume import inside


def pose_of(
    hand: Fitted | HandEstimate,
    model: HandModel,
    t_ns: int,
    smooth_m: Float,
    markers: MarkerPositions,
    volume: Volume | None = None,
) -> HandPose:
    """The message of one hand; all NaN and not valid where nothing is known of it.

    Args:
        hand: Of either solver.
        model: The hand.
        t_ns: The epoch.
        smooth_m: (M, 3) [m] markers after the 1 € filter, and `markers` before it.
        markers: As triangulated.
        volume: What the rig states; joints report whether they lie in it.
    """
    solution = hand.solution
    if solution is None:
        nothing = np.full((26, 3, 3), np.nan)
        position, cov, orientation = nothing[:, 0].copy(), nothing, np.full((26, 4), np.nan)
        angles = np.full((5, 4), np.nan)
    else:
        position, cov, angles = solution.joints.position_m, solution.cov_m2, solution.angles_rad
        orientation = np.empty((26, 4))
        quaternions(solution.joints.rotation, orientation)
    return HandPose.known_good(
        model.profile.name,
        t_ns,
        position_m=position,
        orientation_wxyz=orientation,
        radius_m=model.radius_m,
        valid=hand.valid,
        tracked=hand.tracked,
        cov_m2=cov,
        source=hand.source,
        angles_rad=angles,
        markers_m=smooth_m,
        markers_raw_m=markers.points_m,
        markers_cov_m2=markers.cov_m2,
        inside_volume=inside(volume, position),
    )
