"""Several hands behind one push: every message goes to the hands that know its sender; each has its own pipeline."""

from collections import Counter
from collections.abc import Sequence
from math import nan
from typing import Protocol

from common.arrays import Float
from common.messages import Detections, ImuSample
from master.rig import RigSetup
from master.stereo.pipeline import SolvedPose

_NAME = 64  # characters of a name in `Health`


class Line(Protocol):
    """What makes poses of one hand: the pipeline of its setup, or a `LivePipeline`."""

    @property
    def counts(self) -> Counter[str]:
        """Events since the start."""
        ...

    def push(self, message: Detections) -> list[SolvedPose]:
        """Take one camera's detections; return the poses they complete, oldest first."""
        ...

    def push_orientation(self, t_ns: int, orientation_wxyz: Float, heading_sigma_rad: float = nan) -> None:
        """Take what the hand's IMU says of its own orientation (4,)."""
        ...

    def flush(self) -> list[SolvedPose]:
        """At the end of a recording: the poses that still wait for something."""
        ...


class Hands:
    """Push machine over all hands of a master. Holds who is sent what."""

    def __init__(self, setups: Sequence[RigSetup], lines: Sequence[Line]) -> None:
        """Join each hand's setup, of which cameras and IMUs count, with the line that solves it."""
        self._hands = tuple(zip(setups, lines, strict=True))
        self._cameras = {
            name: [hand for hand in self._hands if name in hand[0].cameras]
            for setup in setups
            for name in setup.camera_names
        }
        self._imus = {name: line for setup, line in self._hands for name in setup.imus}

    @property
    def counts(self) -> Counter[str]:
        """Events of all hands; with more than one, each under the name of its hand."""
        if len(self._hands) == 1:
            return self._hands[0][1].counts
        return Counter(
            {
                f"{setup.hand.profile.name}.{event}"[:_NAME]: number
                for setup, line in self._hands
                for event, number in dict(line.counts).items()  # the loop may add one: a copy is made at once
            }
        )

    def push(self, message: Detections) -> list[SolvedPose]:
        """Take one camera's detections; return the poses they complete, hand by hand, oldest first."""
        known = self._cameras.get(message.camera, [])
        return [solved for setup, line in known for solved in line.push(setup.own(message))]

    def flush(self) -> list[SolvedPose]:
        """At the end of a recording: the poses that still wait, hand by hand."""
        return [solved for _, line in self._hands for solved in line.flush()]

    def push_sample(self, sample: ImuSample) -> None:
        """Take a sample of an IMU; only the hand that wears it is told."""
        if (line := self._imus.get(sample.source)) is not None:
            line.push_orientation(sample.t_ns, sample.orientation_wxyz, sample.heading_sigma_rad)
