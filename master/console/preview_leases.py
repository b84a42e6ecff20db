"""Request camera previews while somebody looks at them, and not longer."""

import threading
import time
from collections.abc import Callable

from common.errors import BusError
from common.messages import Command, Health
from common.messages.preview_wish import PreviewWish


class PreviewLeases:
    """Viewers of each camera, with the time until which each looks.

    It holds one thread per camera as long as somebody looks.
    """

    def __init__(self, ask: Callable[[Command, float], Health]) -> None:
        """Nobody looks yet; `ask` sends a command and waits for the answer."""
        self._ask = ask
        self._lock = threading.Lock()
        self._until: dict[str, dict[tuple[str, ...], float]] = {}
        self._threads: dict[str, threading.Thread] = {}
        self._errors: dict[str, str] = {}

    def look(self, camera: str, mask: tuple[str, ...] = ()) -> None:
        """Request the preview of `camera` for the next 3 s.

        The pixels of these markers are tinted. Never waits.
        """
        with self._lock:
            lease_s = 3.0  # so long a lease holds: whoever still looks renews it before
            self._until.setdefault(camera, {})[mask] = time.monotonic() + lease_s
            if camera not in self._threads:
                thread = threading.Thread(
                    target=self._work, args=(camera,), name=f"look {camera}", daemon=True
                )
                self._threads[camera] = thread
                thread.start()

    def error(self, camera: str) -> str:
        """Why there is no picture of `camera`; empty while it answers."""
        return self._errors.get(camera, "")

    @property
    def looked_at(self) -> frozenset[str]:
        """Cameras that somebody looks at."""
        return frozenset(self._threads)

    def _work(self, camera: str) -> None:
        while (mask := self._mask(camera)) is not None:
            body = PreviewWish(mask=mask, found=True).body() if mask else ""
            try:
                answer_s = 1.5
                self._ask(Command(camera, "preview", body), answer_s)
                self._errors.pop(camera, None)
            except BusError as error:
                self._errors[camera] = str(error)
            ask_every_s = 1.0  # a camera shows itself for 3 s after each request
            time.sleep(ask_every_s)

    def _mask(self, camera: str) -> tuple[str, ...] | None:
        """Return all markers that somebody wants tinted.

        None when nobody looks; the thread is then forgotten.
        """
        with self._lock:
            now = time.monotonic()
            wanted = {mask: until for mask, until in self._until.get(camera, {}).items() if until > now}
            self._until[camera] = wanted
            if not wanted:
                del self._threads[camera], self._until[camera]
                self._errors.pop(camera, None)
                return None
            return tuple(dict.fromkeys(name for mask in wanted for name in mask))
