"""Watch from another thread what the camera loop reads.

Its frames go by; nobody holds them up.
"""

import threading
from collections.abc import Iterator
from typing import Generic, TypeVar

from common.errors import CameraError

T = TypeVar("T")


class FrameObserver(Generic[T]):
    """Holds the newest of what went by, and how many there were."""

    def __init__(self) -> None:
        """Nothing went by yet."""
        self._changed = threading.Condition()
        self._newest: T | None = None
        self._count = 0

    @property
    def newest(self) -> T | None:
        """What went by last, if anything."""
        return self._newest

    def put(self, item: T) -> None:
        """The loop has read `item`. Never waits longer than a look at it takes."""
        with self._changed:
            self._newest = item
            self._count += 1
            self._changed.notify_all()

    def following(self, count: int, timeout_s: float) -> Iterator[T]:
        """Wait for `count` items that go by from now on.

        A watcher who is late misses some; those do not count.

        Raises:
            CameraError: None came for `timeout_s` [s].
        """
        return self._after(self._count, count, timeout_s)

    def _after(self, last: int, count: int, timeout_s: float) -> Iterator[T]:
        for _ in range(count):
            with self._changed:
                if not self._changed.wait_for(lambda seen=last: self._count > seen, timeout_s):
                    raise CameraError(
                        f"no frame was read for {timeout_s:g} s: the camera is away, or the slave waits for a master"
                    )
                last, item = self._count, self._newest
            assert item is not None  # it was counted
            yield item
