"""Asks the cameras for their pictures as long as somebody looks, and reads how large those are."""

import logging
import threading
from collections.abc import Iterable

from common.bus import Bus
from common.errors import BusError
from common.messages import Command

PERIOD_S = 2.0  # a camera shows itself for 3 s after each request
TIMEOUT_S = 0.9

_log = logging.getLogger(__name__)


class PreviewAsker:
    """Asks each camera by a thread of its own: one that is not there keeps no other waiting. Holds the threads."""

    def __init__(self, bus: Bus, cameras: Iterable[str], period_s: float = PERIOD_S) -> None:
        """Begin to ask `cameras` on `bus`, which must stay open until `close`."""
        self._bus = bus
        self._period_s = period_s
        self._closing = threading.Event()
        self._threads = [
            threading.Thread(target=self._work, args=(camera,), name=f"ask {camera}", daemon=True)
            for camera in cameras
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Ask no more; waits for an unanswered question, at most a second. Safe to call twice."""
        self._closing.set()
        for thread in self._threads:
            thread.join()

    def _work(self, camera: str) -> None:
        silent = False
        while not self._closing.is_set():
            try:
                self._bus.ask(Command(camera, "preview"), TIMEOUT_S)
                silent = False
            except BusError as error:
                if not silent and not self._closing.is_set():  # said once, not every two seconds
                    _log.info("no picture of camera %s yet: %s", camera, error)
                silent = True
            self._closing.wait(self._period_s)


def jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Width and height [px] in the frame header of a JPEG file (ITU-T T.81, B.2.2), or None if it has none."""
    at = 2
    while data[:2] == b"\xff\xd8" and at + 9 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # those three are tables, not frames
            height = int.from_bytes(data[at + 5 : at + 7], "big")
            width = int.from_bytes(data[at + 7 : at + 9], "big")
            return (width, height) if width and height else None
        at += 2 + length
    return None
