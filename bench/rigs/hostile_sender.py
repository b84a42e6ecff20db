"""A stolen device of the rig, as a process that attacks the master.

It has its own key, a session as any other, and says what it likes in it. What devices say on the bus it says there.

`python -m bench.rigs.hostile_sender NAME TREE RIG BEACON_PORT BUS COUNT PER_S SEED`, BUS the endpoint of the master's
bus, the rig key in PHALANX_RIG_KEY. It prints `ready` when it has a session, waits for a line, sends COUNT messages,
and prints how many of each type as JSON.
"""

import argparse
import json
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import msgspec
import zenoh
from msgspec import Struct

from bench.rigs.fuzz import SAID, Attack, flood, wire
from bench.rigs.fuzz_examples import Speaker, own_kinds
from common.bus.keys import rig_key
from common.bus.settings import settings
from common.clock import SystemClock
from common.link.datagram import MAX_DATAGRAM, OVERHEAD, Address, Kind
from common.link.handshake import EchoAnswer, Hello, RigKeys, Started
from common.messages import Health, Preview, Still
from common.messages.streams import key_of
from master.rig.setup import RigSetup, load_setup
from slave.uplink import Uplink

_START_S = 60.0
_OWN, _ON_BUS, _OTHERS, _SHAKES = 0.5, 0.2, 0.1, 0.2  # shares of what it says; the last: handshakes
SPARE = 1.05  # so many more are made, for those that fit into no datagram
ON_BUS: Mapping[type[Struct], str] = {Health: "health", Preview: "preview", Still: "still"}  # with its stream


def raw_bus(endpoint: str) -> zenoh.Session:
    """A session on the bus, in which any bytes can be put under any key."""
    made = settings(None, [endpoint], "client", None)
    return zenoh.open(zenoh.Config.from_json5(msgspec.json.encode(made).decode()))


class HostileUplink(Uplink):
    """An uplink that seals any body as any kind.

    It answers echoes rightly besides, so the session lives.
    """

    def notify(self, kind: Kind, body: bytes) -> bool:
        """Send a body in the session; False: there is none, or it does not fit."""
        with self._lock:
            session = self._link._session  # pyright: ignore[reportPrivateUsage]
            if session is None or len(body) > MAX_DATAGRAM - OVERHEAD:
                return False
            return self._data.send(session.sealer.seal(kind, body), session.address)

    def throw(self, datagram: bytes) -> bool:
        """Send a datagram as it is to the master."""
        with self._lock:
            session = self._link._session  # pyright: ignore[reportPrivateUsage]
            return session is not None and self._data.send(datagram, session.address)

    @property
    def master(self) -> tuple[bytes, Address] | None:
        """The nonce and the address of the master, or None without a session."""
        session = self._link._session  # pyright: ignore[reportPrivateUsage]
        return None if session is None else (session.master_nonce, session.address)


class HostileSender:
    """One device that sends attacks.

    Holds its link, its session on the bus, and the plausible messages that they are made from.
    """

    def __init__(
        self, name: str, key: bytes, port: int, setup: RigSetup, endpoint: str, seed: int = 1
    ) -> None:
        """Listen for the master, and connect to its bus at `endpoint`.

        Where `name` is a camera of `setup`, it says what the camera of a simulation sees.
        """
        self._bus = raw_bus(endpoint)
        self.name, self._clock, self._keys = name, SystemClock(), RigKeys(key)
        self.uplink = HostileUplink(name, key, self._clock, port, "127.0.0.1")
        self._hello = self._keys.sealer(self.uplink.session ^ 1)
        self._speaker, self._own, self._seed = Speaker(name, setup), own_kinds(name, setup), seed
        self.sent: Counter[str] = Counter()

    def attacks(self, count: int) -> Iterator[Attack]:
        """So many, most of the kinds that such a device says."""
        shakes = (Hello, Started, EchoAnswer)
        others = [kind for kind in SAID if kind not in (*self._own, *ON_BUS, *shakes)]
        shares: dict[type[Struct], float] = {}
        for kinds, share in ((self._own, _OWN), (ON_BUS, _ON_BUS), (others, _OTHERS), (shakes, _SHAKES)):
            shares |= {kind: share / len(kinds) for kind in kinds}
        return flood(shares, self._speaker.bases, count, self._seed)

    def send(self, attack: Attack) -> bool:
        """Send one; False: it fits into no datagram, or there is no session."""
        body = self._body(attack)
        sent = self._send(attack.kind, body) and (not attack.twice or self._send(attack.kind, body))
        self.sent[attack.kind.__name__ if sent else "unsent"] += 1
        return sent

    def send_message(self, kind: type[Struct], **changes: object) -> bool:
        """Send a plausible message of now with these fields."""
        return self.send(Attack("", kind, changes))

    def close(self) -> None:
        """End its session, and leave the bus."""
        self.uplink.close()
        self._bus.close()

    def send_all(self, attacks: Sequence[Attack], count: int, per_s: float) -> None:
        """Send `count` of them at this rate, or as fast as the machine gives."""
        began = time.monotonic()
        for k, attack in enumerate(attacks):
            if self.sent.total() - self.sent["unsent"] >= count:
                return
            self.send(attack)
            if k % 16 == 15:
                time.sleep(max(0.0, (k + 1) / per_s - (time.monotonic() - began)))

    def _body(self, attack: Attack) -> bytes:
        now_ns, master = self._clock.now_ns(), self.uplink.master
        if attack.kind is Hello and master is not None:
            hello = self._keys.hello(self.name, self.uplink.session, os.urandom(16), master[0])
            return attack.body(wire(hello), now_ns)
        return self._speaker.body(attack, self.uplink.session, now_ns)

    def _send(self, kind: type[Struct], body: bytes) -> bool:
        if kind is Hello:
            fits = len(body) <= MAX_DATAGRAM - OVERHEAD
            return fits and self.uplink.throw(self._hello.seal(Kind.HELLO, body))
        if kind in ON_BUS:  # it waits where the link is full: nothing is dropped on this side
            key, waits = key_of(ON_BUS[kind], self.name), zenoh.CongestionControl.BLOCK
            self._bus.put(key, body, congestion_control=waits)
            return True
        if kind is Started:
            return self.uplink.notify(Kind.STARTED, body)
        return self.uplink.notify(Kind.ECHO_ANSWER if kind is EchoAnswer else Kind.DATA, body)


def main() -> None:
    """Get a session, wait for a line, send."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name")
    parser.add_argument("tree", type=Path)
    parser.add_argument("rig")
    parser.add_argument("port", type=int)
    parser.add_argument("bus")
    parser.add_argument("count", type=int)
    parser.add_argument("per_s", type=float)
    parser.add_argument("seed", type=int)
    options = parser.parse_args()
    setup, key = load_setup(options.tree, options.rig), rig_key(os.environ, None)
    sender = HostileSender(options.name, key, options.port, setup, options.bus, options.seed)
    attacks = list(sender.attacks(round(SPARE * options.count)))
    if not sender.uplink.wait_for_start(_START_S):
        raise SystemExit("no master: does it have this device, this key and this beacon port?")
    print("ready", flush=True)
    sys.stdin.readline()
    began = time.monotonic()
    sender.send_all(attacks, options.count, options.per_s)
    seconds = time.monotonic() - began
    print(json.dumps({"seconds": seconds, **sender.sent}), flush=True)
    sender.close()


if __name__ == "__main__":
    main()
