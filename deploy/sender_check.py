"""Check that the senders of a deployment are received, before and after it.

Before it, this measures how soon that shows.

A new version that runs and sends nothing costs the stream for as long as it is listened for. So where a master runs and
took all of them before, it waits twice as long as that took, or as the slave's own start did; else `WAIT_SENDERS_S`.
"""

import json
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import cast

from deploy.remote import run_bounded

WAIT_SENDERS_S = (
    12.0  # from READY=1 to the first datagram is a second; each one of waiting is a second without pictures
)
LEAST_S = 4.0  # a master reports its counts once a second, a beacon comes as often


@dataclass(frozen=True, slots=True)
class Ears:
    """How datagrams are received.

    Attributes:
        options: Of `phalanx fleet status --wait`.
        keys: Keys folder.
        seconds: How long they are waited for.
    """

    options: tuple[str, ...]
    keys: Path
    seconds: float = WAIT_SENDERS_S


@dataclass(frozen=True, slots=True)
class Received:
    """Datagrams that were received.

    Attributes:
        rates: Name -> datagrams a second, of those that were received.
        cause: Why nobody could listen; None: somebody did.
        master: Whether it was a master that runs, which others may ask meanwhile.
    """

    rates: Mapping[str, float] = field(default_factory=dict[str, float])
    cause: str | None = None
    master: bool = False


def received_of(names: Sequence[str], ears: Ears, ended: threading.Event | None = None) -> Received:
    """Return which senders `phalanx fleet status --wait` receives.

    It ends early if `ended` is set.
    """
    words = [sys.executable, "-m", "master", "fleet", "status", "--json", "--seconds", str(ears.seconds)]
    words += [*ears.options, *(word for name in names for word in ("--wait", name))]
    lines: list[str] = []
    environment = {"PHALANX_KEYS": str(ears.keys)}
    end_s = 60.0  # of the program that listens, besides what it listens
    code, errors = run_bounded(words, b"", lines.append, ears.seconds + end_s, environment, ended)
    results = [line for line in lines if line.startswith('{"heard"')]
    if not results:
        lines = [*lines, *errors] or [f"phalanx fleet status --wait ended with {code}"]
        return Received(cause=f"cannot listen for it: {lines[-1]}")
    answer = cast(dict[str, object], json.loads(results[-1]))
    rates = cast(dict[str, float], answer["heard"])
    return Received({name: float(rate) for name, rate in rates.items()}, None, answer.get("master") is True)


class Before:
    """Senders received before anything is changed.

    Found out while wheels are gathered and sent. It holds the thread.
    """

    def __init__(self, names: Sequence[str], ears: Ears) -> None:
        """Begin to listen."""
        self._names, self._ears = tuple(names), ears
        self._received, self._took_s = Received(), 0.0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    @property
    def at_master(self) -> bool:
        """Report whether a master runs, so that each machine can be checked by itself.

        It waits for the end of the listening.
        """
        self._thread.join()
        return self._received.master

    def ears(self, start_s: float | None) -> Ears:
        """How to listen for one machine afterwards.

        Args:
            start_s: How long its slaves took to start before [s]; None: they did not run.
        """
        self._thread.join()
        if start_s is None or not self._received.master or set(self._received.rates) < set(self._names):
            return self._ears
        times = 2.0
        seconds = max(LEAST_S, times * self._took_s, times * start_s)
        return replace(self._ears, seconds=min(self._ears.seconds, seconds))

    def end(self) -> None:
        """Listen no longer."""
        self._ended.set()

    def _listen(self) -> None:
        began = time.monotonic()
        before_s = 5.0
        ears = replace(self._ears, seconds=min(before_s, self._ears.seconds))
        self._received = received_of(self._names, ears, self._ended)
        self._took_s = time.monotonic() - began
