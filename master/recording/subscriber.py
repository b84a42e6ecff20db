"""Bus subscriptions of a recording.

A thread for each stream, and the master's clock as seen from here.
"""

import threading
from collections import deque
from collections.abc import Sequence

from common.bus.bus import Bus, Subscription
from common.clock import now_ns
from common.messages import Command, Health, Message
from master.recording.probe import came_ns
from master.recording.recorder import MessageRecorder

DEPTH = {"taken": 20_000, "preview": 32, "still": 32}  # messages that may wait for their thread
_ASK_S = 0.9
_ANSWERS = 5


class MasterClock:
    """Offset of the master's clock ahead of this machine's.

    0 on the same machine. Holds the best measurement of it.
    """

    def __init__(self) -> None:
        self.ahead_ns = 0
        self._half_trip_ns: int | None = None

    def push(self, asked_ns: int, answered_ns: int, remote_ns: int) -> None:
        """Take one answer.

        It was sent somewhere between the question and its arrival.
        """
        half_trip_ns = (answered_ns - asked_ns) // 2
        if self._half_trip_ns is None or half_trip_ns < self._half_trip_ns:
            ahead = remote_ns - (asked_ns + answered_ns) // 2
            self.ahead_ns = (
                0 if abs(ahead) <= half_trip_ns else ahead
            )  # one clock looks so, and is exact then
            self._half_trip_ns = half_trip_ns

    def now_ns(self) -> int:
        """The master's time [ns]."""
        return now_ns() + self.ahead_ns


class StreamSubscriber:
    """Subscriptions of one connection, and their threads.

    The threads offer all that comes to a recorder.
    """

    def __init__(
        self, bus: Bus, streams: Sequence[str], recorder: MessageRecorder, clock: MasterClock
    ) -> None:
        """Begin to listen on `bus`, which must stay open until `close`."""
        self._recorder, self._clock = recorder, clock
        self._closing = threading.Event()
        self._end_ns = self._last_ns = 0
        depth = 5_000
        self._inboxes = {stream: bus.subscribe(stream, depth=DEPTH.get(stream, depth)) for stream in streams}
        self.received = dict.fromkeys(streams, 0)
        self._threads = [
            threading.Thread(target=self._work, args=(stream, inbox), name=f"record {stream}", daemon=True)
            for stream, inbox in self._inboxes.items()
        ]
        for thread in self._threads:
            thread.start()

    @property
    def dropped(self) -> dict[str, int]:
        """Stream -> messages that no thread had time for."""
        return {stream: inbox.dropped for stream, inbox in self._inboxes.items() if inbox.dropped}

    def close(self, wait_s: float) -> None:
        """Take pending messages, waiting no longer than `wait_s`.

        The limit is there because the sender may go on. Safe to call twice.
        """
        self._end_ns = now_ns() + round(wait_s * 1e9)
        self._closing.set()
        for thread in self._threads:
            thread.join()
        for inbox in self._inboxes.values():
            inbox.close()

    def _work(self, stream: str, inbox: Subscription) -> None:
        while not self._closing.is_set() or now_ns() < self._end_ns:
            quiet_s = 0.3  # so long nothing has come when all that was sent is there
            message = inbox.get(quiet_s)
            if message is not None:
                self.received[stream] += 1
                now = self._clock.now_ns()
                self._recorder.offer(
                    stream, message, self._taken_ns(message, now) if stream == "taken" else now
                )
            elif self._closing.is_set():
                return

    def _taken_ns(self, message: Message, now_ns: int) -> int:
        """Return the time at which a message was available.

        The master shows several messages at once, and a replay at the original speed needs their own times.

        None before the one before.
        """
        there = came_ns(message, now_ns)
        long_ns = 1_000_000_000
        if not 0 <= now_ns - there < long_ns:
            there = now_ns  # a master that plays publishes the times of then
        self._last_ns = max(self._last_ns, there)
        return self._last_ns


class ProbeLease:
    """Repeated request to the master to show what it takes.

    Determines from its answers what never came.

    Holds the clock, the session of the master, and by how much we were behind it at the last answers.
    """

    def __init__(self, bus: Bus, subscriber: StreamSubscriber, clock: MasterClock) -> None:
        self._bus, self._subscriber, self._clock = bus, subscriber, clock
        self._session: int | None = None
        self._unseen = 0
        self._behind: deque[int] = deque(maxlen=_ANSWERS)
        self.lost = 0

    def ask(self) -> Health:
        """Probe for three seconds more.

        Raises:
            BusError: The master is not there, or refuses.
        """
        asked_ns = now_ns()
        health = self._bus.ask(Command("master", "tap"), _ASK_S)
        self._clock.push(asked_ns, now_ns(), health.t_ns)
        behind = health.counts.get("tap.shown", 0) - self._subscriber.received["taken"]
        if health.session != self._session:
            # What it showed before we listened was not for us.
            self._session, self._unseen = health.session, max(behind, 0) if self._session is None else 0
            self._behind.clear()
        self._behind.append(behind - self._unseen)
        if len(self._behind) == _ANSWERS:
            # What is on its way comes soon, what is lost stays away.
            self.lost = max(self.lost, min(self._behind))
        return health
