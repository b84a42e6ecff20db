"""A worker empties a bounded queue on its own thread: nobody waits for a sink.

    whoever offers ── offer ──▶ bounded queue ──▶ thread ──▶ file, bus or network

Full, it loses its oldest item (of a live output: what is late is old by then), or refuses the new one (of a
recording: a gap rather than no beginning). Whoever offers counts what is lost.
"""

import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

ItemT = TypeVar("ItemT")


class Worker(Generic[ItemT]):
    """Bounded queue and the one thread that takes from it."""

    def __init__(
        self, name: str, work: Callable[[], None], depth: int, *, loses_oldest: bool = False
    ) -> None:
        """Hold at most `depth` items; `work` runs on the thread from `start` on."""
        self._depth, self._loses_oldest = depth, loses_oldest
        self._queue: deque[ItemT] = deque()
        self._changed = threading.Condition()
        self._busy = False
        self.closing = False
        self._thread = threading.Thread(target=work, name=name, daemon=True)
        self.start = self._thread.start

    @property
    def waiting(self) -> int:
        """Items in the queue."""
        return len(self._queue)

    def offer(self, item: ItemT) -> ItemT | None:
        """Queue an item without waiting; return which one is lost for it, None: none."""
        lost: ItemT | None = None
        with self._changed:
            if self.closing:
                return item
            if len(self._queue) >= self._depth:
                if not self._loses_oldest:
                    return item
                lost = self._queue.popleft()
            self._queue.append(item)
            self._changed.notify_all()
        return lost

    def wait(self, timeout_s: float | None = None) -> bool:
        """On the thread: wait for an item, or until closing; whether there is one."""
        with self._changed:
            self._busy = False
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._queue or self.closing, timeout_s)
            self._busy = bool(self._queue)
            return self._busy

    def take(self, timeout_s: float | None = None) -> ItemT | None:
        """On the thread: the oldest item; None: none in time, or closing."""
        with self._changed:
            return self._queue.popleft() if self.wait(timeout_s) else None

    def rest(self, timeout_s: float) -> None:
        """On the thread: wait this long, or until closing."""
        with self._changed:
            self._changed.wait_for(lambda: self.closing, timeout_s)

    def clear(self) -> list[ItemT]:
        """Take all items at once."""
        with self._changed:
            items = list(self._queue)
            self._queue.clear()
        return items

    def drain(self, timeout_s: float) -> None:
        """Wait until nothing is queued and the last item is done, at most this long."""
        with self._changed:
            self._changed.wait_for(lambda: not (self._queue or self._busy), timeout_s)

    def close(self, timeout_s: float | None = None) -> bool:
        """Refuse items from now on; return if the thread ended in time."""
        with self._changed:
            self.closing = True
            self._changed.notify_all()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()
