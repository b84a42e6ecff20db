"""Login sessions, and the limit on failed tries.

Push machines: they receive the time as an argument, and both have bounded memory.
"""

import asyncio
import hashlib
import secrets
from collections import OrderedDict
from dataclasses import dataclass, field
from ipaddress import IPv6Address, ip_address, ip_network

LONGEST_WAIT_S = 300.0


@dataclass(eq=False, slots=True)
class Session:
    """One browser that is logged in, until then [s]; `ended` is set when it logs out."""

    until_s: float
    ended: asyncio.Event = field(default_factory=asyncio.Event)


class Sessions:
    """Sessions stored by the hash of their token.

    Thus a lookup reveals nothing about which token would have matched.
    """

    # a working day
    def __init__(self, life_s: float = 12 * 3600.0, most: int = 64) -> None:
        """Nobody is logged in. With more than `most` the oldest is logged out."""
        self._life_s, self._most = life_s, most
        self._by_hash: OrderedDict[bytes, Session] = OrderedDict()

    def begin(self, now_s: float) -> str:
        """Log in; the token is for the browser alone."""
        token_bytes = 32
        token = secrets.token_urlsafe(token_bytes)
        while len(self._by_hash) >= self._most:
            self._by_hash.popitem(last=False)[1].ended.set()
        self._by_hash[_hash(token)] = Session(now_s + self._life_s)
        return token

    def find(self, token: str, now_s: float) -> Session | None:
        """The session of a token, unless it is over."""
        session = self._by_hash.get(_hash(token))
        if session is None or now_s < session.until_s:
            return session
        self.end(token)
        return None

    def end(self, token: str) -> None:
        """Log out; nothing happens where there is no such session."""
        if (session := self._by_hash.pop(_hash(token), None)) is not None:
            session.ended.set()

    def __len__(self) -> int:
        """How many are kept."""
        return len(self._by_hash)


class Backoff:
    """Failed logins per address, with the time until which each must wait.

    The address that was quiet for longest is forgotten first.
    """

    def __init__(self, most: int = 1024) -> None:
        """Nobody failed."""
        self._most = most
        self._failures: OrderedDict[str, tuple[int, float]] = OrderedDict()

    def wait_s(self, address: str, now_s: float) -> float:
        """How long this address has to wait before it may try; 0: it may now."""
        _, until_s = self._failures.get(_network(address), (0, now_s))
        return max(0.0, until_s - now_s)

    def failed(self, address: str, now_s: float) -> None:
        """Record a wrong password from an address.

        After three, the wait doubles each time, to five minutes.
        """
        key = _network(address)
        count = self._failures.pop(key, (0, 0.0))[0] + 1
        free_tries = 3
        first_wait_s = 1.0
        wait_s = min(LONGEST_WAIT_S, first_wait_s * 2.0 ** min(count - free_tries, 30))
        self._failures[key] = (count, now_s + (wait_s if count >= free_tries else 0.0))
        while len(self._failures) > self._most:
            self._failures.popitem(last=False)

    def passed(self, address: str) -> None:
        """It gave the right one."""
        self._failures.pop(_network(address), None)

    def __len__(self) -> int:
        """How many addresses are kept."""
        return len(self._failures)


def _hash(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", "surrogatepass")).digest()


def _network(address: str) -> str:
    """Return the network whose failed tries are counted together.

    It is an IPv4 address, or the 64 bits of IPv6 that one machine has for itself.
    """
    try:
        found = ip_address(address.split("%", 1)[0])
    except ValueError:
        return address
    if isinstance(found, IPv6Address):
        if found.ipv4_mapped is not None:
            return str(found.ipv4_mapped)
        return str(ip_network((found, 64), strict=False))
    return str(found)
