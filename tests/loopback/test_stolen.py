"""A stolen device of the rig, with the rig key and its own secret, against the others; and secrets that do not fit."""

import pytest
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

from common.link.datagram import Address, Header, Kind, LinkKey, Refusal, Sealer, device_secret, parse, unseal
from common.link.handshake import (
    NONCE_BYTES,
    Beacon,
    EchoAnswer,
    HandshakeT,
    Hello,
    RigKeys,
    Start,
    Unproven,
    Welcome,
    seal,
)
from master.run.link import PENDING_NS, MasterLink
from slave.link import VANISHED_NS, SlaveLink
from tests.loopback.test_handshake import BROADCAST, KEY, MASTER, S, Wires
from tests.network_helpers import detections, seeded

ROOT = bytes(range(100, 132))
THIEF: Address = ("6.6.6.6", 6)


def own(name: str) -> LinkKey:
    """What the device `name` has."""
    return LinkKey(KEY, own=device_secret(ROOT, name))


class Scene:
    """A master with `devices.key`, the victim `left` that sends, and the thief, who has all that `right` had."""

    def __init__(self) -> None:
        self.wires = Wires()
        self.master: MasterLink = self.wires.new_master(key=LinkKey(KEY, ROOT))
        self.left: SlaveLink = self.wires.new_slave("left", key=own("left"))
        (self.address,) = self.wires.slaves
        self.wires.new_slave("right", key=own("right"))
        assert self.wires.run(3.0, self.wires.all_started)
        self.keys = RigKeys(own("right"))
        self.sealer: Sealer = self.keys.sealer(66)
        self._seq = 0

    @property
    def session(self) -> int:
        """Id of the victim's session."""
        assert self.left._session is not None
        return self.left._session.key_id

    def frame_comes(self) -> bool:
        """Whether the victim's next frame is taken by the master."""
        before, self._seq = len(self.wires.got), self._seq + 1
        self.wires.send(
            self.left, detections("left", self.left.process, self._seq, self.wires.clock.now_ns())
        )
        return len(self.wires.got) > before

    def received(self, kind: type[HandshakeT]) -> list[HandshakeT]:
        """All handshakes of a kind that travelled, as the thief reads them."""
        read = ((parse(one, self.keys.rig_tag), one) for one, _, _ in self.wires.seen if one[5] < Kind.START)
        opened = [self.keys.open_as(header, one, kind) for header, one in read if isinstance(header, Header)]
        return [one for one in opened if not isinstance(one, Refusal)]

    def hello(self, name: str = "left", process: int = 7, seed: int = 1) -> bytes:
        """The best hello that the thief can say for another name."""
        nonce = seeded(seed)(NONCE_BYTES)
        return seal(self.sealer, self.keys.hello(name, process, nonce, self.master._nonce))

    def lure(self, counter: int) -> None:
        """Notify a beacon as if it were the master's, in which the victim has no session."""
        self.sealer._counter = counter
        beacon = Beacon(self.master._nonce, "tls/0.0.0.0:47802", {})
        self.wires.carry(seal(self.sealer, beacon), THIEF, BROADCAST)


def test_a_captured_session_opens_for_its_device_and_the_master_alone() -> None:
    scene = Scene()
    assert scene.frame_comes()
    hello = next(one for one in scene.received(Hello) if one.name == "left")
    (welcome,) = {one for one in scene.received(Welcome) if one.slave_nonce == hello.slave_nonce}
    datagrams = [one for one, _, _ in scene.wires.seen if one[12:20] == scene.session.to_bytes(8, "big")]
    assert len(datagrams) > 10
    for who, opens in {
        RigKeys(own("right")): 0,
        RigKeys(KEY): 0,
        RigKeys(LinkKey(KEY, device_secret(ROOT, "right"))): 0,
        RigKeys(LinkKey(KEY, ROOT)): len(datagrams),  # the master: so the try itself is right
    }.items():
        keys = who.session(hello, welcome.session_nonce)
        opened = 0
        for datagram in datagrams:
            header = parse(datagram, who.rig_tag)
            assert isinstance(header, Header)
            ciphers = (ChaCha20Poly1305(key) for key in (keys.to_master, keys.to_slave))
            opened += any(unseal(cipher, header, datagram) is not None for cipher in ciphers)
        assert opened == opens
        assert (keys.key_id == scene.session) is (opens > 0)
        assert (keys.proof == welcome.proof) is (opens > 0)


def test_a_flood_of_hellos_in_anothers_name_takes_no_room_and_ends_no_session() -> None:
    scene = Scene()
    session, replayed = (
        scene.session,
        [one for one, _, to in scene.wires.seen if to == MASTER and one[5] == Kind.HELLO],
    )
    for i in range(1000):
        process = (7, scene.left.process)[i % 2]
        scene.wires.carry(scene.hello(process=process, seed=i), THIEF, MASTER, keep=False)
        if i % 50 == 0:
            scene.wires.run(0.05)
            assert scene.frame_comes()
    assert scene.session == session
    assert scene.master.refused == {Refusal.SECRET: 1000}
    assert not scene.left.refused
    assert all(sender.pending is None for sender in scene.master._senders.values())
    assert len(scene.master._sessions) == 2
    assert {
        name: away.host
        for name, away in scene.master.rejected_peers.lately("unproven", scene.wires.clock.now_ns()).items()
    } == {"left": THIEF[0]}
    assert not scene.master.rejected_peers.lately("duplicate", scene.wires.clock.now_ns())
    for one in replayed:  # from an address of his own: they make nothing new
        scene.wires.carry(one, THIEF, MASTER)
    scene.wires.run(PENDING_NS / S + 0.1)
    assert scene.session == session
    assert scene.frame_comes()


def test_what_was_said_for_a_device_that_is_away_confirms_nothing() -> None:
    scene = Scene()
    del scene.wires.slaves[scene.address]
    scene.wires.run(3.0)
    assert "left" not in scene.master.connected()
    scene.wires.carry(scene.hello(), THIEF, MASTER)
    assert scene.master._senders["left"].pending is None
    made = scene.keys.session(scene.keys.hello("left", 7, seeded(1)(16), scene.master._nonce), bytes(16))
    answer = seal(scene.keys.session_sealer(made.to_master, made.key_id), EchoAnswer(1, 2, 3))
    scene.wires.carry(answer, THIEF, MASTER)
    assert scene.master.refused == {Refusal.SECRET: 1, Refusal.STALE: 1}
    assert "left" not in scene.master.connected()


def test_a_master_without_the_devices_secret_is_none_to_it() -> None:
    scene = Scene()
    session = scene.session
    scene.wires.run(1.5)
    scene.lure(10**6)
    hello = scene.left._offer
    assert hello is not None, "it answers: the beacon has the rig's seal"
    for keys in (scene.keys, RigKeys(KEY)):
        nonce = seeded(3)(NONCE_BYTES)
        forged = keys.session(
            keys.hello("left", scene.left.process, hello.slave_nonce, scene.master._nonce), nonce
        )
        welcome = Welcome(scene.master._nonce, hello.slave_nonce, nonce, forged.proof)
        scene.wires.carry(seal(scene.sealer, welcome), THIEF, scene.address)
        start = seal(keys.session_sealer(forged.to_slave, forged.key_id), Start(0))
        scene.wires.carry(start, THIEF, scene.address)
    assert scene.left.refused == {Refusal.SECRET: 2, Refusal.STALE: 2}
    assert scene.session == session
    assert scene.frame_comes()
    assert scene.wires.run(
        2.0, lambda: scene.left._offer is None or scene.left._offer.received_ns < scene.wires.clock.t_ns - S
    )
    assert scene.frame_comes()


def test_a_thief_between_both_reads_nothing_and_when_he_is_gone_they_find_each_other() -> None:
    scene = Scene()
    scene.wires.run(1.5)
    scene.lure(2**62)  # no later beacon of the master is as new as that
    (lured,) = [one for one, to in scene.left.due() if to == THIEF]
    scene.wires.carry(lured, THIEF, MASTER)
    (welcome,) = [one for one, to in scene.master.due() if to == THIEF and one[5] == Kind.WELCOME]
    scene.wires.carry(welcome, THIEF, scene.address)
    assert scene.left._session is not None
    assert scene.left._session.address == THIEF
    (hello,) = [one for one in scene.received(Hello) if one.slave_nonce == scene.left._session.slave_nonce]
    header = parse(welcome, scene.keys.rig_tag)
    assert isinstance(header, Header)
    read = scene.keys.open_as(header, welcome, Welcome)
    assert isinstance(read, Welcome)
    assert scene.keys.session(hello, read.session_nonce).key_id != scene.session
    taken = scene.session
    scene.wires.run(VANISHED_NS / S + 1.5)  # he says no more
    assert scene.left._session.address == MASTER
    assert scene.session != taken
    assert scene.left.started
    assert scene.frame_comes()


@pytest.mark.parametrize(
    ("master", "slave", "output"),
    [
        (LinkKey(KEY, ROOT), KEY, "has the rig key alone: phalanx fleet deploy brings device-left.secret"),
        (KEY, own("left"), "start the master with --keys DIR, a folder that has devices.key"),
        (
            LinkKey(KEY, ROOT),
            own("right"),
            "is not the one that the master at 10.0.0.1 has for it: phalanx fleet deploy",
        ),
    ],
)
def test_secrets_that_do_not_fit_are_named_on_both_sides(
    master: LinkKey | bytes, slave: LinkKey | bytes, output: str
) -> None:
    wires = Wires()
    link, left = wires.new_master(("left",), key=master), wires.new_slave("left", key=slave)
    wires.run(2.0)
    assert not left.started
    assert left.wrong is not None
    assert output in left.wrong
    assert left.refused[Refusal.SECRET] > 10
    assert link.refused[Refusal.SECRET] > 10
    assert set(link.rejected_peers.lately("unproven", wires.clock.now_ns())) == {"left"}
    right = wires.new_slave("left", key=LinkKey(KEY, ROOT) if isinstance(master, LinkKey) else master)
    assert wires.run(2.0, lambda: right.started), "with its secret it is taken at once"


def test_an_unproven_that_the_thief_says_changes_nothing() -> None:
    scene = Scene()
    opened = Unproven(scene.master._nonce, bytes(NONCE_BYTES), has_secrets=False)
    scene.wires.carry(seal(scene.sealer, opened), THIEF, scene.address)
    assert scene.left.refused == {Refusal.REPLAYED: 1}
    assert scene.left.wrong is None
    assert scene.frame_comes()
