"""Digest of a run: SHA-256 over all poses in their order.

Another is over objects, contact and gestures.

Each message counts as it is encoded for the wire, with `latency_ns` set to 0: how long the machine took is no part of
the result.
"""

import hashlib
from collections.abc import Iterable

import msgspec

from common.messages import Contact, Gesture, HandPose, ObjectPose, ResultMessage, encode

KINDS = {HandPose: "poses", ObjectPose: "objects", Contact: "contacts", Gesture: "gestures"}


class ResultDigest:
    """Holds a sum for each kind of message, and how many there were."""

    def __init__(self, results: Iterable[ResultMessage] = ()) -> None:
        """Begin with `results`."""
        self._sums = {name: hashlib.sha256() for name in KINDS.values()}
        self.counts = dict.fromkeys(KINDS.values(), 0)
        for message in results:
            self.take(message)

    def take(self, message: ResultMessage) -> None:
        """Count one message."""
        name = KINDS[type(message)]
        if isinstance(message, HandPose | ObjectPose) and message.latency_ns:
            message = msgspec.structs.replace(message, latency_ns=0)
        self._sums[name].update(encode(message))
        self.counts[name] += 1

    def hex(self, name: str = "poses") -> str:
        """The sum of one kind, as 64 characters."""
        return self._sums[name].hexdigest()

    def lines(self) -> list[str]:
        """A line for each kind that there was, poses always."""
        return [
            f"sha256 of {count} {name}: {self.hex(name)}"
            for name, count in self.counts.items()
            if count or name == "poses"
        ]
