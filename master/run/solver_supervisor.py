"""Supervisor guards the solver against failing messages and overload.

A message that gets past all bounds and still makes something raise is a fault of this program. Then
- the sender of the message is silenced for a while (`link_senders`), and the master goes on with the next
  message;
- the solvers that it feeds are replaced by new ones, for their state may be broken;
- the last messages are solved again, on a thread beside, without those of each sender in turn: the sender
  without whom nothing raises is to blame, and is silenced instead. So a camera is not punished for being the
  one whose frame completed what another one broke. Meanwhile further faults are counted and nobody else is
  silenced.

Load shedding: an epoch is dropped (*shed*, counted as `instants_shed`) when what waits already completes a
newer one of the same hand. All messages are taken, for a camera's past shows where its markers are at every
epoch. A newer epoch waits when the leading camera, the first of the rig, has a frame in the queue, and every
other camera has one there that is not older. So what is dropped is a period of the cameras older than what is
solved in its place: datagrams that come together, and jitter of less than half a period, leave nothing out
while the solver takes less than a period (waiting is then never longer than the jitter: Lindley's recursion).
Nothing but `LoadShedding.skip` comes of how much waits: with the messages and that number, what is solved can
be solved again bit for bit (`master.recording`).
"""

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from common.clock import Clock
from common.messages import Detections, Message
from common.messages.streams import sender_of
from master.rig.setup import RigSetup
from master.run.app import Solved
from master.run.dispatcher import Dispatcher
from master.run.ingest import QUEUE_PER_CAMERA, Span
from master.run.link_senders import Quarantine, SensorMessage


class SolverSupervisor:
    """Push machine before a solver; a thread of its own replaces what is broken."""

    def __init__(
        self,
        solve: Callable[[SensorMessage], Iterable[Solved]],
        quarantine: Quarantine,
        clock: Clock,
        renew: Callable[[str], None],
        fresh: Callable[[str], Dispatcher],
    ) -> None:
        """Guard `solve`.

        `renew` lets new solvers take over from those that a sender feeds, and may take its time; `fresh`
        builds a solver of what a sender feeds, in its first state.
        """
        self._solve, self._quarantine, self._clock = solve, quarantine, clock
        self._renew, self._fresh = renew, fresh
        recent = 64  # messages that are solved again: about ten frames of each camera of a usual rig
        self._recent: deque[SensorMessage] = deque(maxlen=recent)
        self._repair: threading.Thread | None = None

    def push(self, message: SensorMessage) -> Iterator[Solved]:
        """Take one message; give what it completes, nothing of a silenced sender."""
        sender = sender_of(message)
        if self._quarantine.holds(sender, self._clock.now_ns()):
            return
        self._recent.append(message)
        try:
            yield from self._solve(message)
        except Exception as error:  # noqa: BLE001
            # Anything at all: the tracking of all others depends on it that none gets through.
            self._failed(sender, error)

    def _failed(self, sender: str, error: Exception) -> None:
        if self._repair is not None and self._repair.is_alive():
            self._quarantine.note(sender, error)
            return
        self._quarantine.fault(sender, error, self._clock.now_ns())
        messages = list(self._recent)
        self._recent.clear()
        self._repair = threading.Thread(
            target=self._mend, args=(messages, sender, error), name="solver repair", daemon=True
        )
        self._repair.start()

    def _mend(self, messages: Sequence[SensorMessage], sender: str, error: Exception) -> None:
        try:
            self._renew(sender)
            found = culprit(messages, lambda: self._fresh(sender))
        except Exception as second:  # noqa: BLE001
            self._quarantine.note(sender, second)  # and the next fault tries again
            return
        if found not in (None, sender):
            self._quarantine.release(sender)
            self._quarantine.fault(found, error, self._clock.now_ns())


def culprit(messages: Sequence[SensorMessage], fresh: Callable[[], Dispatcher]) -> str | None:
    """The one sender without whose messages nothing raises; None: there is none such."""
    senders = dict.fromkeys(sender_of(message) for message in messages)
    if len(senders) < 2 or not _raises(messages, fresh()):
        return None
    found = [
        sender
        for sender in senders
        if not _raises([one for one in messages if sender_of(one) != sender], fresh())
    ]
    return found[0] if len(found) == 1 else None


def _raises(messages: Sequence[SensorMessage], solver: Dispatcher) -> bool:
    try:
        for message in messages:
            for _ in solver.push(message):
                pass
        for _ in solver.flush():
            pass
    except Exception:  # noqa: BLE001
        return True  # whatever it is: it is looked for who causes it
    return False


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
        """Whether what waits completes an epoch newer than the frame of `t_ns` [ns].

        `newest_ns` is when each camera's last frame is that was taken [ns].
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
    """Whether a master is behind.

    Attributes:
        waiting: Camera -> when its frames are that have come and were not taken yet [ns].
        skip: How many epochs are dropped between two that are solved, of each hand; 0: none.
    """

    def __init__(self, setups: Sequence[RigSetup] = ()) -> None:
        """Begin not behind; without hands it is as far behind as it is set."""
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
        """Check what waits behind a message; only a frame changes what is skipped."""
        if not isinstance(message, Detections):
            return
        waiting, monitored = self.waiting(), self._cameras.get(message.camera)
        self._newest_ns[message.camera] = message.t_ns
        behind = bool(waiting and monitored) and all(
            cameras.newer_waits(waiting, self._newest_ns, message.t_ns) for cameras in monitored or ()
        )
        self.skip = MOST if behind else 0


class Shedding:
    """Decision for each epoch of one hand whether it is skipped."""

    def __init__(self, load_shedding: LoadShedding) -> None:
        self._load_shedding = load_shedding
        self._in_a_row = 0

    def __call__(self) -> bool:
        """Whether the next epoch is skipped."""
        self._in_a_row = self._in_a_row + 1 if self._in_a_row < self._load_shedding.skip else 0
        return self._in_a_row > 0
