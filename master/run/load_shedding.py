"""Load shedding of a master that falls behind.

It solves the newest epoch, and no message is lost for it.

An epoch is dropped (*shed*, counted as `instants_shed`) when what waits already completes a newer one of the same
hand: where the hand was then interests nobody any more. All messages are taken, for a camera's past shows where its
markers are at every epoch. A newer epoch waits when the leading camera, the first of the rig, has a frame in the
queue, and every other camera has one there that is not older. So what is dropped is a period of the cameras older than
what is solved in its place: datagrams that come together, and jitter of less than half a period, leave nothing out
while the solver takes less than a period (waiting is then never longer than the jitter: Lindley's recursion).

How much waits is looked at once for each message, and nothing but `LoadShedding.skip` comes of it: with the
messages and that number, what is solved can be solved again bit for bit (`master.recording`).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from common.messages import Detections, Message
from master.rig.setup import RigSetup
from master.run.message_queue import QUEUE_PER_CAMERA, Span

MOST = QUEUE_PER_CAMERA  # epochs in a row: as many as can wait; a master that has no time but for messages solves some


@dataclass(frozen=True, slots=True)
class Cameras:
    """The cameras whose frames make the epochs of one hand, the leading one first.

    Attributes:
        centre_ns: Camera -> middle of its frames after their stamps [ns].
        silent_ns: A camera that sent nothing for so long is not waited for.
    """

    centre_ns: Mapping[str, int]
    silent_ns: int

    @classmethod
    def of(cls, setup: RigSetup, names: Sequence[str]) -> "Cameras":
        """Those of these names."""
        models = {name: setup.models[name] for name in names if name in setup.models}
        late_us = setup.rig.stamp_offset_us
        centre_ns = {
            name: round(1e3 * late_us.get(name, 0.0) + 0.5 * (model.height_px - 1) * model.row_time_ns)
            for name, model in models.items()
        }
        slowest_hz = min(setup.cameras[name].frame_rate_hz for name in names)
        # of the slowest camera: so long nothing waits for one that sends nothing, as in `Pairing`
        silent_periods = 12
        return cls(dict.fromkeys(names, 0) | centre_ns, round(silent_periods * 1e9 / slowest_hz))

    def newer_waits(self, waiting: Mapping[str, Span], newest_ns: Mapping[str, int], t_ns: int) -> bool:
        """Check whether the waiting messages complete an epoch.

        Args:
            waiting: Camera -> when its frames are that wait [ns].
            newest_ns: Camera -> when its last frame is that was taken [ns].
            t_ns: When the frame is that is taken now [ns].
        """
        received = [
            name
            for name in self.centre_ns
            if name in waiting or t_ns - newest_ns.get(name, t_ns - self.silent_ns) < self.silent_ns
        ]
        if not all(name in waiting for name in received):
            return False
        next_ns = waiting[received[0]].oldest_ns + self.centre_ns[received[0]]
        return all(waiting[name].newest_ns + self.centre_ns[name] >= next_ns for name in received)


class LoadShedding:
    """Whether a master is behind. Holds the time of the last frame of each camera.

    Attributes:
        waiting: Camera -> when its frames are that have come and were not taken yet [ns].
        skip: How many epochs are dropped between two that are solved, of each hand; 0: none.
    """

    def __init__(self, setups: Sequence[RigSetup] = ()) -> None:
        """Initialise for a master of these hands that is not behind.

        Without hands it is as far behind as it is set.
        """
        self.waiting: Callable[[], Mapping[str, Span]] = dict[str, Span]
        self.skip = 0
        self._newest_ns: dict[str, int] = {}
        self._cameras: dict[str, list[Cameras]] = {}
        for setup in setups:
            of_wrist = setup.wrist_cameras
            marked = [name for name in setup.models if name not in of_wrist]
            for names in (marked, *([name] for name in of_wrist)):
                for name in names:
                    self._cameras.setdefault(name, []).append(Cameras.of(setup, names))

    def look(self, message: Message) -> None:
        """Take a message and check what waits behind it.

        Only with a frame it changes what is skipped.
        """
        if not isinstance(message, Detections):
            return
        waiting, monitored = self.waiting(), self._cameras.get(message.camera)
        self._newest_ns[message.camera] = message.t_ns
        behind = bool(waiting and monitored) and all(
            cameras.newer_waits(waiting, self._newest_ns, message.t_ns) for cameras in monitored or ()
        )
        self.skip = MOST if behind else 0


class Shedding:
    """Decision for each epoch of one hand whether it is skipped.

    Holds how many in a row were.
    """

    def __init__(self, load_shedding: LoadShedding) -> None:
        """Skip epochs as `load_shedding` states."""
        self._load_shedding = load_shedding
        self._in_a_row = 0

    def __call__(self) -> bool:
        """Return whether the next epoch is skipped."""
        self._in_a_row = self._in_a_row + 1 if self._in_a_row < self._load_shedding.skip else 0
        return self._in_a_row > 0
