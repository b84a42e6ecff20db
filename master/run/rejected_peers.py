"""Who was rejected lately, by name.

Second processes under one name, slaves of another wire version, slaves whose secret is not the one that the
master has for their name, and slaves whose rig has other markers.

A person who looks for a camera that does not come reads it in the checklist. What is kept is bounded by the names of
the rig, and forgotten `LATELY_NS` after the last time.
"""

from collections.abc import Iterable
from typing import NamedTuple, TypeVar

from common.link.datagram import HEADER, MAGIC, Header, Kind
from common.link.session import RigKeys

SeenT = TypeVar("SeenT")


class RejectedPeer(NamedTuple):
    """Where somebody who was rejected sends from: host, and what wire version."""

    host: str
    version: int


class MarkerCounts(NamedTuple):
    """How many markers a slave sends, and how many the master's rig has."""

    sent: int
    expected: int


class RejectedPeers:
    """Record of rejected senders of the rig.

    Push machine. Holds for each sender when it was last rejected, and from where.
    """

    def __init__(self, keys: RigKeys, names: Iterable[str]) -> None:
        """Nobody was, yet; `names` are those of the rig."""
        self._keys, self._names = keys, frozenset(names)
        self._duplicates: dict[str, tuple[int, RejectedPeer]] = {}
        self._versions: dict[str, tuple[int, RejectedPeer]] = {}
        self._unproven: dict[str, tuple[int, RejectedPeer]] = {}
        self._markers: dict[str, tuple[int, MarkerCounts]] = {}
        self._next_ns: int | None = None

    def duplicate(self, name: str, host: str, version: int, t_ns: int) -> None:
        """Record a duplicate sender `name`, which sent a hello at `t_ns` [ns].

        A second process under this name, while the first one was well.
        """
        self._duplicates[name] = t_ns, RejectedPeer(host, version)

    def unproven(self, name: str, host: str, version: int, t_ns: int) -> None:
        """Record a hello at `t_ns` [ns] as `name` without that device's secret.

        The sender is at `host`.
        """
        self._unproven[name] = t_ns, RejectedPeer(host, version)

    def marker_count(self, name: str, sent: int, expected: int, t_ns: int) -> None:
        """The slave `name` sent another number of markers than its rig has here.

        It sent `sent` at `t_ns` [ns]; the rig has `expected`.
        """
        self._markers[name] = t_ns, MarkerCounts(sent, expected)

    def other_version(self, datagram: bytes, host: str, t_ns: int) -> None:
        """Take a datagram of another wire version.

        What is not a rightly sealed hello of this rig is ignored.
        """
        if len(datagram) < HEADER.size or (self._next_ns is not None and t_ns < self._next_ns):
            return
        magic, version, kind, _, rig, key_id, counter = HEADER.unpack_from(datagram)
        if magic != MAGIC or kind != Kind.HELLO or rig != self._keys.rig_tag:
            return
        poll_ns = 100_000_000  # a flood of hellos of another version costs one unsealing in so long
        self._next_ns = t_ns + poll_ns
        name = self._keys.name_in(Header(Kind.HELLO, key_id, counter), datagram)
        if name in self._names:
            self._versions[name] = t_ns, RejectedPeer(host, version)

    def duplicates(self, t_ns: int) -> dict[str, RejectedPeer]:
        """Name -> where its second process is, as of `t_ns` [ns]."""
        return _lately(self._duplicates, t_ns)

    def versions(self, t_ns: int) -> dict[str, RejectedPeer]:
        """Name -> where it is and what it speaks, as of `t_ns` [ns]."""
        return _lately(self._versions, t_ns)

    def secrets(self, t_ns: int) -> dict[str, RejectedPeer]:
        """Return where senders send a hello without their secret, as of `t_ns` [ns].

        A mapping from name to where.
        """
        return _lately(self._unproven, t_ns)

    def marker_counts(self, t_ns: int) -> dict[str, MarkerCounts]:
        """Name -> how many markers its slave sent lately and its rig has here.

        Of those names alone where the two differ, as of `t_ns` [ns].
        """
        return _lately(self._markers, t_ns)


def _lately(seen: dict[str, tuple[int, SeenT]], t_ns: int) -> dict[str, SeenT]:
    lately_ns = 1_500_000_000  # both send a hello again within a second
    return {name: what for name, (seen_ns, what) in seen.items() if t_ns - seen_ns < lately_ns}
