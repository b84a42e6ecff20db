"""One live output as it runs.

Its queue and its thread, so that it can be slow, fail or hang by itself.

States: *closed* (not made yet, or it failed; it is made again after a while, for ever) and *open*. What comes while it
is closed, or while its queue is full, is lost to this output alone, and counted.
"""

import threading
from collections import deque
from collections.abc import Callable

from common.clock import Clock, SystemClock
from common.errors import PhalanxError
from common.messages import ResultMessage
from master.outputs.sink import Sink

DEPTH = 64  # messages; what a receiver was too slow for is old by then
FIRST_RETRY_S = 1.0


class Counters:
    """Counts of one output since the process began.

    They outlive the output's being switched off.

    Attributes:
        sent: Messages that it took.
        failed: Times it could not be opened, or broke on a message.
        dropped: Messages that it was too slow for, or that came while it was not open.
        trouble: Why it is not open; empty while nothing is wrong.
    """

    def __init__(self) -> None:
        self.sent = self.failed = self.dropped = 0
        self.trouble = ""


class OutputLine:
    """Feeds one `Sink` on a thread of its own from a queue that drops its oldest.

    Holds the queue, and the sink while it is open.
    """

    def __init__(
        self,
        name: str,
        make: Callable[[], Sink],
        counters: Counters,
        notify: Callable[[str], None],
        clock: Clock | None = None,
    ) -> None:
        """Start at once.

        `make` opens the sink and is called on the line's own thread, again after each failure.
        """
        self._name, self._make, self._counters, self._notify = name, make, counters, notify
        self._clock: Clock = SystemClock() if clock is None else clock
        self._queue: deque[ResultMessage] = deque()
        self._changed = threading.Condition()
        self._closing = False
        self._sink: Sink | None = None
        self._wait_s = FIRST_RETRY_S
        self._thread = threading.Thread(target=self._work, name=f"output {name}", daemon=True)
        self._thread.start()

    @property
    def open(self) -> bool:
        """Whether its sink is open and takes messages."""
        return self._sink is not None

    @property
    def waiting(self) -> int:
        """Messages in its queue."""
        return len(self._queue)

    def offer(self, message: ResultMessage) -> None:
        """Queue one message without waiting.

        The oldest makes room, or the message is lost while the output is closed.
        """
        with self._changed:
            if self._sink is None:
                self._counters.dropped += 1
                return
            if len(self._queue) >= DEPTH:
                self._queue.popleft()
                self._counters.dropped += 1
            self._queue.append(message)
            self._changed.notify()

    def close(self) -> None:
        """Send what waits, close the sink and end the thread. Safe to call twice."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        join_s = 3.0  # an output that hangs is left to the end of the process
        self._thread.join(join_s)
        if self._thread.is_alive():
            self._notify(f"{self._name}: hangs and was left behind")

    def _work(self) -> None:
        try:
            while not self._closing or (self._sink is not None and self._queue):
                if self._sink is None:
                    self._open()
                if self._sink is None:
                    self._pause()
                else:
                    self._send()
        finally:  # also after an error that nobody foresaw: what has no thread any more is not open
            self._shut()

    def _open(self) -> None:
        try:
            self._sink = self._make()
        except (PhalanxError, OSError) as error:
            self._failed(error)
            return
        if self._counters.trouble:
            self._notify(f"{self._name}: open again")
        self._counters.trouble, self._wait_s = "", FIRST_RETRY_S

    def _pause(self) -> None:
        """Wait until the next retry."""
        with self._changed:
            self._changed.wait_for(lambda: self._closing, self._wait_s)
        last_retry_s = 10.0
        self._wait_s = min(2.0 * self._wait_s, last_retry_s)

    def _send(self) -> None:
        """Hand on what waits, or wait for more."""
        with self._changed:
            self._changed.wait_for(lambda: self._queue or self._closing)
            messages = list(self._queue)
            self._queue.clear()
        sink = self._sink
        for number, message in enumerate(messages):
            assert sink is not None  # set and cleared by this thread alone
            try:
                sink.write(message)
            except (PhalanxError, OSError) as error:
                self._counters.dropped += len(messages) - number
                self._shut()
                self._failed(error)
                return
            self._counters.sent += 1

    def _shut(self) -> None:
        sink, self._sink = self._sink, None
        if sink is None:
            return
        with self._changed:
            self._counters.dropped += len(self._queue)
            self._queue.clear()
        try:
            sink.close()
        except (PhalanxError, OSError) as error:
            self._notify(f"{self._name}: closing: {error}")

    def _failed(self, error: Exception) -> None:
        """Count a failure, and report it once.

        The same trouble again is not reported.
        """
        self._counters.failed += 1
        text = str(error)
        if text != self._counters.trouble:
            self._notify(f"{self._name}: {text}; tried again")
        self._counters.trouble = text
