"""Runs of exact detections of one moving hand; the messages are made once for rigs that only solve them otherwise."""

from functools import cache

from common.messages import MarkerDetections
from tests.hand_helpers import rig_file
from tests.synthetic_run import SyntheticRun, setup_of, synthetic_run

LONGEST = 70


@cache
def _messages() -> tuple[MarkerDetections, ...]:
    return tuple(synthetic_run(LONGEST).messages)


def run_of(frames: int, **changes: object) -> SyntheticRun:
    """That of `synthetic_run`; the changes to the rig leave its cameras where they are."""
    setup = setup_of(rig_file(**changes))  # pyright: ignore[reportArgumentType]
    return SyntheticRun(setup, [message for message in _messages() if message.seq < frames])
