"""Queue of messages that arrived and were not taken yet.

It is the one queue between the thread that reads the socket and the live loop.

It drops the oldest, so a slow loop sees what is new. Frames, tags, samples of IMUs and poses of trackers have each
their own room in it: none drives another out, and at overload all that is taken is of the same stretch of time.
"""

import threading
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from common.messages import ImuSample, MarkerDetections, TagDetections, TrackerPose, WristDetections
from common.messages.streams import sender_of
from master.run.link_senders import SensorMessage

QUEUE = 64  # frames, or strobe cycles, that may wait, of one or two cameras
QUEUE_PER_CAMERA = 32  # of more: a third of a second at 90 Hz
CAPACITY = {
    "frame": QUEUE,
    "tags": QUEUE,
    "imu": 16 * QUEUE,
    "tracker": 16 * QUEUE,
}  # what comes while so many frames do
# Whose room in the queue a message takes.
_KIND: dict[type[SensorMessage], str] = {
    MarkerDetections: "frame",
    WristDetections: "frame",
    TagDetections: "tags",
    ImuSample: "imu",
    TrackerPose: "tracker",
}


class Span(NamedTuple):
    """Capture times of the oldest and of the newest waiting frame of a camera.

    [ns], master's clock.
    """

    oldest_ns: int
    newest_ns: int


class MessageQueue:
    """Messages in the order in which they came. Safe to use from several threads.

    Holds them, and the times of those of each kind and sender.

    Attributes:
        overflowed: Messages that were dropped, as there was no more room.
    """

    def __init__(self, cameras: int) -> None:
        """Have room for what so many cameras send."""
        self.overflowed = 0
        self._queue: deque[SensorMessage] = deque()
        self._has_capacity = capacity(cameras)
        self._waiting = dict.fromkeys(CAPACITY, 0)
        self._times: dict[tuple[str, str], deque[int]] = {}
        self._changed = threading.Condition()
        self._closed = False

    @property
    def frames(self) -> int:
        """Return the number of waiting frames of all cameras.

        Strobe cycles count as frames do.
        """
        return self._waiting["frame"]

    def frame_spans(self) -> dict[str, Span]:
        """Return the time span of each camera's waiting frames.

        Camera -> span; strobe cycles count as frames do. Only cameras that have a waiting frame are included.
        """
        if not self._waiting["frame"]:
            return {}
        with self._changed:
            return {
                sender: Span(times[0], times[-1])
                for (kind, sender), times in self._times.items()
                if kind == "frame" and times
            }

    def put(self, messages: Sequence[SensorMessage]) -> None:
        """Let them wait, and wake who waits for them: once for all that came together.

        Where there is no more room for a kind, the oldest of the sender goes of which most wait: who sends too much
        loses his own.
        """
        with self._changed:
            for message in messages:
                kind, sender = _KIND[type(message)], sender_of(message)
                self._queue.append(message)
                self._waiting[kind] += 1
                self._times.setdefault((kind, sender), deque()).append(message.t_ns)
                if self._waiting[kind] > self._has_capacity[kind]:
                    self.overflowed += 1
                    self._drop_oldest(kind)
            self._changed.notify()

    def get(self, timeout_s: float) -> SensorMessage | None:
        """Return the oldest waiting message.

        None after `timeout_s`, or once closed and empty.
        """
        with self._changed:
            if not self._queue:
                self._changed.wait_for(lambda: self._queue or self._closed, timeout_s)
                if not self._queue:
                    return None
            message = self._queue.popleft()
            self._left(message)
            return message

    def close(self) -> None:
        """Wake who waits: nothing comes any more."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _drop_oldest(self, kind: str) -> None:
        _, most = max((len(times), sender) for (of, sender), times in self._times.items() if of == kind)
        for k, message in enumerate(self._queue):
            if _KIND[type(message)] == kind and sender_of(message) == most:
                del self._queue[k]
                self._left(message)
                return

    def _left(self, message: SensorMessage) -> None:
        """It waits no more; it was the oldest of its kind and sender."""
        kind = _KIND[type(message)]
        self._waiting[kind] -= 1
        self._times[kind, sender_of(message)].popleft()


def capacity(cameras: int) -> dict[str, int]:
    """How many messages of each kind may wait."""
    frames = max(QUEUE, QUEUE_PER_CAMERA * cameras)
    return CAPACITY | {"frame": frames, "tags": frames}
