"""A master that solves nothing: each message goes through link, queue and bus at once, as an empty pose.

The baseline of the live latency, with the options of the master: `python -m bench.idle_master run ...`
"""

import numpy as np

from common.messages import MarkerDetections
from master.__main__ import main
from master.estimator.epoch import Fitted
from master.estimator.pipeline import MarkerPipeline, SolvedPose
from master.estimator.pose import pose_of
from master.fabrik.estimate import MarkerPositions

_UNKNOWN = np.zeros(26, np.bool_)
_NOTHING = Fitted(None, _UNKNOWN, _UNKNOWN, np.zeros(26, np.uint8), np.zeros(6, np.int64))


def pass_on(self: MarkerPipeline, message: MarkerDetections) -> list[SolvedPose]:
    """An empty pose for every message, in place of `MarkerPipeline.push`."""
    count = len(message.area)
    nowhere, unknown = np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan)
    apart, rejected = np.zeros(count, np.bool_), np.zeros((1, count), np.bool_)
    markers = MarkerPositions(nowhere, unknown, unknown, apart, rejected)
    pose = pose_of(_NOTHING, self.model, message.t_ns, nowhere, markers)
    return [SolvedPose(pose, message.ready_t_ns)]


if __name__ == "__main__":
    MarkerPipeline.push = pass_on
    main()
