"""Received gestures of the hands, in the form a person follows them.

It covers the gestures that last now, and the last things reported. Bounded.
"""

import time
from collections import deque
from dataclasses import dataclass

from common.messages import Gesture

KEPT = 30


@dataclass(frozen=True, slots=True)
class ReceivedGesture:
    """One received gesture, with its time of receipt [s, monotonic].

    It holds the message that began or ended it.
    """

    received_s: float
    gesture: Gesture


class ReceivedGestures:
    """Newest message of each lasting gesture, and the last begins, ends and taps."""

    def __init__(self) -> None:
        """Start without any gesture."""
        self._held: dict[tuple[str, str], ReceivedGesture] = {}
        self._events: deque[ReceivedGesture] = deque(maxlen=KEPT)

    def push(self, gesture: Gesture, now_s: float) -> None:
        """Receive one message at `now_s` [s], monotonic."""
        key = (gesture.hand, gesture.kind)
        received = ReceivedGesture(now_s, gesture)
        if gesture.phase != "update":
            self._events.append(received)
        most = 64
        if gesture.phase == "end":
            self._held.pop(key, None)
        elif key in self._held or len(self._held) < most:
            self._held[key] = received

    def held(self, now_s: float | None = None) -> dict[tuple[str, str], Gesture]:
        """(hand, kind) -> what lasts at `now_s` [s], by default now."""
        now_s = time.monotonic() if now_s is None else now_s
        # a gesture is repeated with every pose of its hand: not received for so long, it is over
        hold_s = 0.5
        return {
            key: received.gesture
            for key, received in list(self._held.items())
            if now_s - received.received_s < hold_s
        }

    def events(self) -> list[ReceivedGesture]:
        """The last begins, ends and taps, newest first."""
        return list(self._events)[::-1]
