"""A stolen device of the rig, as a process that attacks the master.

It has its own key, a session as any other, and says what it likes in it.

`python -m bench.hostile_sender NAME TREE RIG BEACON_PORT COUNT PER_S SEED [--endpoint BUS]`, the rig key in
PHALANX_RIG_KEY. It prints `ready` when it has a session, waits for a line, sends, and prints what it sent as JSON.
"""

import argparse
import json
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

from msgspec import Struct

from bench.hostile_examples import Speaker, own_kinds
from bench.hostile_messages import SAID, Attack, flood, wire
from common.clock import SystemClock
from common.datagram import MAX_DATAGRAM, OVERHEAD, Address, Kind
from common.keys import rig_key
from common.session import EchoAnswer, Hello, RigKeys, Started
from master.rig import RigSetup, load_setup
from slave.uplink import Uplink

_START_S = 60.0
_OWN, _OTHERS, _SHAKES = 0.6, 0.2, 0.2  # of what it says: its own kinds, those of others, handshakes


class HostileUplink(Uplink):
    """An uplink that seals any body as any kind.

    It answers echoes rightly besides, so the session lives.
    """

    def say(self, kind: Kind, body: bytes) -> bool:
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

    Holds its link, and the plausible messages that they are made from.
    """

    def __init__(self, name: str, key: bytes, port: int, setup: RigSetup, seed: int = 1) -> None:
        """Listen for the master.

        Where `name` is a camera of `setup`, it says what the camera of a simulation sees.
        """
        self.name, self._clock, self._keys = name, SystemClock(), RigKeys(key)
        self.uplink = HostileUplink(name, key, self._clock, port, "127.0.0.1")
        self._hello = self._keys.sealer(self.uplink.session ^ 1)
        self._speaker, self._own, self._seed = Speaker(name, setup), own_kinds(name, setup), seed
        self.sent: Counter[str] = Counter()

    def attacks(self, count: int) -> Iterator[Attack]:
        """So many, most of the kinds that such a device says."""
        shakes = (Hello, Started, EchoAnswer)
        others = [kind for kind in SAID if kind not in (*self._own, *shakes)]
        shares: dict[type[Struct], float] = {}
        for kinds, share in ((self._own, _OWN), (others, _OTHERS), (shakes, _SHAKES)):
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

    def send_all(self, attacks: Sequence[Attack], per_s: float) -> None:
        """Send them at this rate, or as fast as the machine gives."""
        began = time.monotonic()
        for k, attack in enumerate(attacks):
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
        if kind is Started:
            return self.uplink.say(Kind.STARTED, body)
        return self.uplink.say(Kind.ECHO_ANSWER if kind is EchoAnswer else Kind.DATA, body)


def main() -> None:
    """Get a session, wait for a line, send."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name")
    parser.add_argument("tree", type=Path)
    parser.add_argument("rig")
    parser.add_argument("port", type=int)
    parser.add_argument("count", type=int)
    parser.add_argument("per_s", type=float)
    parser.add_argument("seed", type=int)
    options = parser.parse_args()
    setup = load_setup(options.tree, options.rig)
    sender = HostileSender(options.name, rig_key(os.environ, None), options.port, setup, options.seed)
    attacks = list(islice(sender.attacks(options.count), options.count))
    if not sender.uplink.wait_for_start(_START_S):
        raise SystemExit("no master: does it have this device, this key and this beacon port?")
    print("ready", flush=True)
    sys.stdin.readline()
    began = time.monotonic()
    sender.send_all(attacks, options.per_s)
    seconds = time.monotonic() - began
    said = {"seconds": seconds, **sender.sent}
    print(json.dumps(said), flush=True)
    sender.uplink.close()


if __name__ == "__main__":
    main()
