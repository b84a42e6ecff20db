"""Hostile datagrams by the hundred thousand into both ends of the link: no crash, no growth, no effect."""

import gc
import random
import tracemalloc
from collections.abc import Iterator

import pytest

from common.link.datagram import HEADER, MAGIC, MAX_DATAGRAM, Kind, Refusal
from common.link.handshake import RigKeys
from common.messages import WIRE_VERSION
from master.run.link import MasterLink
from slave.link import SlaveLink
from tests.loopback.test_handshake import KEY, Wires, started_pair
from tests.network_helpers import detections

BATCH = 10_000
TOTAL = 200_000
SOURCE = ("6.6.6.6", 6)


def junk(source: random.Random, count: int) -> Iterator[bytes]:
    """Random bytes of random length, in one draw."""
    pool = source.randbytes(1 << 20)
    for _ in range(count):
        start = source.randrange(len(pool) - 300)
        yield pool[start : start + source.randrange(300)]


def headed(source: random.Random, count: int, rig_tag: int, key_ids: list[int]) -> Iterator[bytes]:
    """A header that passes every cheap check, with a random body: the cipher has to say no."""
    pool = source.randbytes(1 << 20)
    kinds = list(Kind)
    for _ in range(count):
        start = source.randrange(len(pool) - 300)
        body = pool[start : start + 16 + source.randrange(100)]
        key_id = source.choice(key_ids)
        kind = source.choice(kinds)
        counter = source.getrandbits(64)
        yield HEADER.pack(MAGIC, WIRE_VERSION, kind, 28 + len(body), rig_tag, key_id, counter) + body


def mutated(source: random.Random, count: int, originals: list[bytes]) -> Iterator[bytes]:
    """Genuine datagrams with bits flipped, cut, lengthened, or grafted onto each other."""
    for _ in range(count):
        datagram = bytearray(source.choice(originals))
        how = source.randrange(8)
        if how == 0:
            del datagram[source.randrange(len(datagram)) :]
        elif how == 1:
            datagram += source.randbytes(source.choice((1, 16, 300, MAX_DATAGRAM)))
        elif how == 2:
            other = source.choice(originals)
            cut = source.randrange(len(datagram))
            grafted = datagram[:cut] + other[cut:]
            datagram = grafted if bytes(grafted) not in originals else grafted[:-1]
        else:
            for _ in range(how - 2):
                bit = source.randrange(8 * len(datagram))
                datagram[bit // 8] ^= 1 << bit % 8
        yield bytes(datagram)


def feed(master: MasterLink, slave: SlaveLink, datagrams: Iterator[bytes], t_ns: int) -> int:
    count = 0
    for count, datagram in enumerate(datagrams, start=1):
        which = count % 4
        if which == 0:
            slave.receive_beacon(datagram, SOURCE, t_ns)
        elif which == 1:
            slave.receive(datagram, SOURCE, t_ns)
        else:
            assert master.receive(datagram, SOURCE, t_ns) is None
    return count


@pytest.fixture
def wires() -> Wires:
    return Wires()


def test_random_and_mutated_datagrams(wires: Wires) -> None:
    source = random.Random(2024)
    master, left, _ = started_pair(wires)
    wires.run(3.0)
    for seq in range(20):
        wires.send(left, detections("left", left.process, seq))
    assert len(wires.got) == 20
    originals = list(dict.fromkeys(datagram for datagram, _, _ in wires.seen))[:200]
    assert len(originals) == 200
    rig_tag = RigKeys(KEY).rig_tag
    key_ids = [1, left.process, *master._sessions]
    t_ns = wires.clock.now_ns()
    master.refused.clear()
    left.refused.clear()
    sessions, session = dict(master._sessions), left._session

    def batch() -> int:
        count = feed(master, left, junk(source, BATCH * 6 // 10), t_ns)
        count += feed(master, left, headed(source, BATCH // 10, rig_tag, key_ids), t_ns)
        return count + feed(master, left, mutated(source, BATCH * 3 // 10, originals), t_ns)

    total = batch()
    gc.collect()
    tracemalloc.start()
    total += batch()
    gc.collect()
    before = tracemalloc.get_traced_memory()[0]
    for _ in range(2):
        total += batch()
    gc.collect()
    after = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert after - before < 25_000  # bytes in 20 000 datagrams: nothing is kept
    objects = len(gc.get_objects())
    while total < TOTAL:
        total += batch()
    gc.collect()
    assert len(gc.get_objects()) - objects < 500

    refused = master.refused + left.refused
    # A few mutations hit twice the same bit, or a reordering of nothing: genuine after all.
    untouched = total - sum(refused.values())
    assert 0 <= untouched < total // 100
    assert set(refused) >= {
        Refusal.FOREIGN,
        Refusal.CUT,
        Refusal.JUNK,
        Refusal.OVERSIZED,
        Refusal.VERSION,
        Refusal.UNEXPECTED,
        Refusal.STALE,
        Refusal.FORGED,
    }
    assert master._sessions == sessions
    assert left._session is session
    wires.send(left, detections("left", left.process, 100))
    assert wires.got[-1].seq == 100
