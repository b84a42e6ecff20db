"""A master that solves nothing: each message goes through link, queue and bus at once, as an empty pose.

The baseline of the live latency, with the options of the master: `python -m bench.idle_master run ...`
"""

import numpy as np

from common.arrays import Float
from common.messages import MarkerDetections
from master.__main__ import main
from master.ik.tracker import TrackedHand, pose_of
from master.estimator.pipeline import MarkerPipeline, SolvedPose

_NOTHING = TrackedHand(
    None, np.zeros(26, bool), np.zeros(26, bool), np.zeros(26, np.uint8), np.zeros(6, np.int64)
)


def pass_on(self: MarkerPipeline, message: MarkerDetections) -> list[SolvedPose]:
    """An empty pose for every message, in place of `MarkerPipeline.push`."""
    nowhere: Float = np.full((len(message.area), 3), np.nan)
    unknown = np.full((len(message.area), 3, 3), np.nan)
    pose = pose_of(_NOTHING, self.model, message.t_ns, nowhere, nowhere, unknown)
    return [SolvedPose(pose, message.ready_t_ns)]


if __name__ == "__main__":
    MarkerPipeline.push = pass_on
    main()
