"""What solving costs by the number of cameras, stage by stage: processor time alone, no socket, no second thread."""

import tempfile
import time
from pathlib import Path

from bench.scale_rig import ROOM, detections_of, in_order, room
from master.rig.files import load_setups
from master.run.dispatcher import Dispatcher
from master.run.stages import StageTimes
from master.run.tuning import LivePipeline

_POSES, _WARM = 200, 20


def solve_us(cameras: int, rate_hz: float) -> dict[str, float]:
    """Processor time of a pose by stage [us], and `all` of it, for a room of so many cameras."""
    with tempfile.TemporaryDirectory() as name:
        setups = load_setups(room(Path(name), cameras, rate_hz), [ROOM])
    messages = in_order(detections_of(setups[0], rate_hz))
    stages = StageTimes(time.thread_time_ns)
    dispatcher = Dispatcher(setups, [LivePipeline(setup, stages) for setup in setups], stages)
    warm, last = _WARM * cameras, (_WARM + _POSES) * cameras
    for message in messages[:warm]:
        list(dispatcher.push(message))
    before, poses = stages.total_us(), dispatcher.counts["poses"]
    begun_ns = time.thread_time_ns()
    for message in messages[warm:last]:
        list(dispatcher.push(message))
    spent_us = (time.thread_time_ns() - begun_ns) * 1e-3
    count = dispatcher.counts["poses"] - poses
    by_stage = {name: (total - before.get(name, 0.0)) / count for name, total in stages.total_us().items()}
    return by_stage | {"all": spent_us / count}
