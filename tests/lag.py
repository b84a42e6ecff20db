"""How far the machine is behind, beside what is measured on it."""

import threading
import time


class Lag:
    """The worst delay of a sleep of this process: how far the machine is behind. Holds a thread."""

    STEP_S = 0.02

    def __init__(self) -> None:
        """Measure from now on."""
        self.late_s: list[float] = []
        self._stop = threading.Event()
        threading.Thread(target=self._measure, daemon=True).start()

    @property
    def worst_s(self) -> float:
        """Of all sleeps so far."""
        return max(self.late_s, default=0.0)

    def close(self) -> None:
        """Measure no more."""
        self._stop.set()

    def _measure(self) -> None:
        while not self._stop.is_set():
            began = time.monotonic()
            time.sleep(self.STEP_S)
            self.late_s.append(time.monotonic() - began - self.STEP_S)
