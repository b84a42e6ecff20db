"""A guided session: what to do now, how far that is, and what is missing.

A person is led at a terminal, or by the console, which runs the same command and shows its lines. A line with a
share ("40 %") or a count ("7 of 25") is progress, and `share_of` reads it back.
"""

import re
import sys
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Generic, TypeVar

from common.clock import Clock, SystemClock
from common.command_line import echo
from master.run.process import join_bus

M = TypeVar("M")
Receive = Callable[[float], M | None]
"""The next message, waiting at most so long [s]; None: there was none."""


def _ask(prompt: str) -> str | None:
    echo(prompt, end="")
    line = sys.stdin.readline()
    return line.rstrip("\n") if line else None


def _notify(line: str) -> None:
    if sys.stderr.isatty():
        echo("\r\033[K", end="", error=True)  # the progress goes
    echo(line)


def _progress(share: float) -> None:
    if sys.stderr.isatty():
        echo(f"\rreading {100 * share:3.0f} % ", end="", error=True)


@dataclass(frozen=True, slots=True)
class Person:
    """The person who is guided; by default the one at this terminal.

    Attributes:
        notify: Shows one line.
        ask: Shows a prompt and returns the answer; None: nobody answers any more.
        progress: Shows which share of a reading is done.
    """

    notify: Callable[[str], None] = _notify
    ask: Callable[[str], str | None] = _ask
    progress: Callable[[float], None] = _progress


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a motion is.

    Attributes:
        share: Of all that is wanted, 0..1.
        covered: What was seen so far; empty: nothing yet.
        hint: What to do now, or what is missing.
        enough: Whether the motion may end.
    """

    share: float
    covered: str
    hint: str
    enough: bool = False

    def line(self) -> str:
        """One line for a person, which `share_of` reads."""
        return f"{100 * self.share:3.0f} %  {self.covered}. {self.hint}" if self.covered else self.hint


class Session(Generic[M]):
    """Guides a person while messages of one kind come; it keeps none of them."""

    def __init__(self, receive: Receive[M], person: Person | None = None, clock: Clock | None = None) -> None:
        """Guide a `person` by what `receive` gives, whose times are of `clock`."""
        self.receive, self.person = receive, person or Person()
        self.clock = clock or SystemClock()

    def during(self, seconds: float) -> Iterator[M | None]:
        """What comes within so many seconds; None while nothing does."""
        end_ns = self.clock.now_ns() + round(1e9 * seconds)
        while self.clock.now_ns() < end_ns:
            yield self.receive(0.05)

    def follow(
        self,
        motion: str,
        push: Callable[[M], object],
        progress: Callable[[float], Progress],
        longest_s: float,
    ) -> None:
        """Lead a person through a motion until it is enough, or the time is over.

        Args:
            motion: What to do, said first.
            push: Takes each message.
            progress: How far it is, asked once a second, by the seconds since the beginning.
        """
        self.person.notify(motion)
        begin_ns = printed_ns = self.clock.now_ns()
        for message in self.during(longest_s):
            if message is not None:
                push(message)
            now_ns = self.clock.now_ns()
            if now_ns - printed_ns < 1_000_000_000:
                continue
            printed_ns = now_ns
            so_far = progress(1e-9 * (now_ns - begin_ns))
            self.person.notify(so_far.line())
            if so_far.enough:
                return


@contextmanager
def listening(
    bus: str, streams: Mapping[str, str | None], wanted: Callable[[object], M | None]
) -> Generator[Receive[M]]:
    """Receive what a running master publishes.

    Args:
        bus: Where the master listens.
        streams: Stream -> name of its sender; None: of all.
        wanted: The message where it is of the kind that is wanted, else None.

    Raises:
        BusError: Nobody listens there.
    """
    link = join_bus(bus)
    try:
        waiting = 1024  # messages that may wait while a line is printed
        own = [
            link.subscribe(stream, depth=waiting) if name is None else link.subscribe(stream, name, waiting)
            for stream, name in streams.items()
        ]

        def receive(timeout_s: float) -> M | None:
            for subscription in own[:-1]:
                if (message := subscription.get(0.0)) is not None:
                    return wanted(message)
            message = own[-1].get(timeout_s)
            return None if message is None else wanted(message)

        yield receive
    finally:
        link.close()


_COUNT, _SHARE = re.compile(r"\b(\d+) of (\d+)\b"), re.compile(r"\b(\d{1,3}) %")


def share_of(lines: Iterable[str]) -> float | None:
    """The share of work, 0..1, that the last line with one reports as done."""
    last = None
    for line in lines:
        if (found := _COUNT.search(line)) and int(found[2]):
            last = min(int(found[1]) / int(found[2]), 1.0)
        elif found := _SHARE.search(line):
            last = min(int(found[1]) / 100, 1.0)
    return last
