"""Asks the cameras for their pictures as long as somebody looks."""

import logging
import threading
from collections.abc import Callable, Iterable

from common.bus.bus import Bus
from common.clock import now_ns
from common.errors import BusError
from common.messages import Command

TIMEOUT_S = 0.9

_log = logging.getLogger(__name__)


class PictureAsker:
    """Requester of camera pictures, one thread per camera.

    A camera that is not there keeps no other waiting. Holds the threads.
    """

    def __init__(
        self,
        bus: Bus,
        cameras: Iterable[str],
        verb: str = "preview",
        # a camera shows itself for 3 s after each request
        period_s: float = 2.0,
        notify: Callable[[str], None] = _log.info,
    ) -> None:
        """Begin to ask.

        Args:
            bus: Must stay open until `close`.
            cameras: Whom.
            verb: "preview", which a camera shows for three seconds, or "still", one whole frame.
            period_s: From one question to the next.
            say: Called once when a camera does not answer, and again after it was there.
        """
        self._bus, self._verb, self._period_s, self._notify = bus, verb, period_s, notify
        self._closing = threading.Event()
        self._threads = [
            threading.Thread(target=self._work, args=(camera,), name=f"{verb} {camera}", daemon=True)
            for camera in cameras
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Stop asking.

        Waits for an unanswered request, at most a second. Safe to call twice.
        """
        self._closing.set()
        for thread in self._threads:
            thread.join()

    def _work(self, camera: str) -> None:
        silent, due_ns = False, now_ns()
        while not self._closing.wait(max(due_ns - now_ns(), 0) * 1e-9):
            # Never faster than it answers, and no burst after it was away.
            due_ns = max(due_ns + round(self._period_s * 1e9), now_ns())
            try:
                self._bus.ask(Command(camera, self._verb), TIMEOUT_S)
                silent = False
            except BusError as error:
                if not silent and not self._closing.is_set():
                    self._notify(f"no picture of camera {camera} yet: {error}")
                silent = True
