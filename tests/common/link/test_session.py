"""The handshake: keys follow from every share of both sides, messages are exactly themselves."""

import hmac
from hashlib import sha256
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.bus.keys import ENVIRONMENT, new_key, rig_key
from common.errors import PhalanxError
from common.link.datagram import Header, Kind, LinkKey, Refusal, device_secret, parse
from common.link.handshake import (
    Beacon,
    EchoAnswer,
    EchoAsk,
    Handshake,
    RigKeys,
    Start,
    Started,
    Unproven,
    Welcome,
    new_process_id,
    read,
    seal,
)
from tests.network_helpers import seeded

KEY = bytes(range(32))
A, B, C = (bytes([value]) * 16 for value in b"ABC")
HELLO = RigKeys(KEY).hello("left", 5, slave_nonce=A, master_nonce=B)

MESSAGES: list[tuple[Kind, Handshake]] = [
    (Kind.BEACON, Beacon(A, "tcp/127.0.0.1:47802", {"left": 3, "right": 2**63 - 1})),
    (Kind.BEACON, Beacon(A, "", {})),
    (Kind.HELLO, HELLO),
    (Kind.WELCOME, Welcome(A, B, C, A)),
    (Kind.START, Start(-5)),
    (Kind.STARTED, Started(2**61)),
    (Kind.ECHO_ASK, EchoAsk(0)),
    (Kind.ECHO_ANSWER, EchoAnswer(1, 2, 3)),
    (Kind.UNPROVEN, Unproven(A, B, has_secrets=True)),
]


@pytest.mark.parametrize(("kind", "message"), MESSAGES)
def test_whole_cut_and_with_junk(kind: Kind, message: Handshake) -> None:
    keys = RigKeys(KEY)
    datagram = seal(keys.sealer(9), message)
    header = parse(datagram, keys.rig_tag)
    assert isinstance(header, Header)
    assert header.kind is kind
    body = keys.open(header, datagram)
    assert body is not None
    assert read(kind, body) == message
    for size in range(len(body)):
        assert read(kind, body[:size]) is None
    assert read(kind, body + b"\0") is None
    for size in range(len(datagram)):
        assert isinstance(parse(datagram[:size], keys.rig_tag), Refusal)


@pytest.mark.parametrize("kind", list(Kind))
def test_a_body_of_another_kind_is_refused(kind: Kind) -> None:
    for other, message in MESSAGES:
        body = msgspec.msgpack.encode(message)
        same_fields = {other, kind} == {Kind.START, Kind.STARTED}
        if other is not kind and not same_fields:
            assert read(kind, body) is None


@pytest.mark.parametrize(
    "body",
    [
        {"master_nonce": A[:15], "zenoh_endpoint": "", "sessions": {}},
        {"master_nonce": A, "zenoh_endpoint": "x" * 257, "sessions": {}},
        {"master_nonce": A, "zenoh_endpoint": "", "sessions": {f"c{i}": i for i in range(33)}},
        {"master_nonce": A, "zenoh_endpoint": "", "sessions": {"a/b": 1}},
        {"master_nonce": A, "zenoh_endpoint": "", "sessions": {"left": -1}},
        {"master_nonce": A, "zenoh_endpoint": "", "sessions": {}, "extra": 1},
    ],
)
def test_limits_of_the_beacon(body: object) -> None:
    assert read(Kind.BEACON, msgspec.msgpack.encode(body)) is None


@given(st.sampled_from(Kind), st.binary(max_size=200))
def test_junk_is_none_and_never_an_exception(kind: Kind, body: bytes) -> None:
    result = read(kind, body)
    assert result is None or isinstance(result, Handshake)


def test_broken_utf8_and_deep_nesting_are_none() -> None:
    assert read(Kind.START, b"\x81\xa4t\x85pe\x01") is None
    assert read(Kind.BEACON, b"\x91" * 4000) is None


def test_keys_are_hkdf_of_every_share() -> None:
    """RFC 5869 by hand, from docs/wire.md."""
    root = bytes(range(32, 64))
    secret = _hkdf(root, b"", b"phalanx device left", 32)
    rig = RigKeys(LinkKey(KEY, root))
    okm = _hkdf(KEY + secret, B + C + A, b"phalanx session left", 88)
    keys = rig.session(HELLO, C)
    assert keys.key_id == int.from_bytes(okm[:8], "big") >> 1
    assert keys[1:] == (okm[8:40], okm[40:72], okm[72:])
    proof = _hkdf(KEY + secret, B + A, b"phalanx hello " + (5).to_bytes(8, "big") + b"left", 16)
    assert rig.hello("left", 5, slave_nonce=A, master_nonce=B).proof == proof


def _hkdf(key: bytes, salt: bytes, info: bytes, size: int) -> bytes:
    prk, block, okm = hmac.new(salt or bytes(32), key, sha256).digest(), b"", b""
    for i in range(1, size // 32 + 2):
        block = hmac.new(prk, block + info + bytes([i]), sha256).digest()
        okm += block
    return okm[:size]


def test_a_hello_proves_every_field_and_by_the_secret_of_its_name_alone() -> None:
    master, thief = RigKeys(LinkKey(KEY, C + C)), RigKeys(LinkKey(KEY, own=device_secret(C + C, "right")))
    left = RigKeys(LinkKey(KEY, own=device_secret(C + C, "left")))
    hello = left.hello("left", 5, A, B)
    assert master.proves(hello)
    assert left.session(hello, C) == master.session(hello, C)
    changed = msgspec.structs.replace
    for other in (
        changed(hello, name="right"),
        changed(hello, process=6),
        changed(hello, slave_nonce=C),
        changed(hello, master_nonce=C),
        changed(hello, proof=A),
        thief.hello("left", 5, A, B),
        RigKeys(KEY).hello("left", 5, A, B),
        RigKeys(LinkKey(B + B, C + C)).hello("left", 5, A, B),
    ):
        assert not master.proves(other)
    assert master.proves(thief.hello("right", 5, A, B))


def test_any_other_share_gives_other_keys() -> None:
    base = RigKeys(KEY).session(HELLO, C)
    others = [
        RigKeys(bytes(32)).session(HELLO, C),
        RigKeys(LinkKey(KEY, bytes(32))).session(HELLO, C),
        RigKeys(LinkKey(KEY, own=bytes(32))).session(HELLO, C),
        RigKeys(KEY).session(HELLO, A),
        RigKeys(KEY).session(msgspec.structs.replace(HELLO, slave_nonce=C), C),
        RigKeys(KEY).session(msgspec.structs.replace(HELLO, master_nonce=C), C),
        RigKeys(KEY).session(msgspec.structs.replace(HELLO, name="right"), C),
    ]
    values = {value for keys in (base, *others) for value in keys}
    assert len(values) == 4 * (1 + len(others))


def test_a_process_opens_only_with_its_own_key() -> None:
    keys = RigKeys(KEY)
    datagram = seal(keys.sealer(9), HELLO)
    header = parse(datagram, keys.rig_tag)
    assert isinstance(header, Header)
    assert keys.open(header._replace(key_id=10), datagram) is None
    other = RigKeys(bytes(32))
    assert parse(datagram, other.rig_tag) is Refusal.FOREIGN
    assert other.open(header, datagram) is None


def test_ids_have_63_bits() -> None:
    assert new_process_id(b"\xff" * 8) == 2**63 - 1
    assert new_process_id(seeded(1)(8)) != new_process_id(seeded(2)(8))


@pytest.mark.parametrize("size", [0, 31, 33])
def test_a_rig_key_has_32_bytes(size: int) -> None:
    with pytest.raises(ValueError, match="32"):
        RigKeys(bytes(size))
    for other in ({"root": bytes(size)}, {"own": bytes(size)}):
        with pytest.raises(ValueError, match="32"):
            LinkKey(KEY, **other)


def test_without_secrets_of_their_own_all_follow_from_the_rig_key() -> None:
    alone, has_secrets = LinkKey(KEY), LinkKey(KEY, A + A)
    assert not alone.has_secrets
    assert has_secrets.has_secrets
    assert LinkKey(KEY, own=B + B).has_secrets
    assert alone.secret("left") == device_secret(KEY, "left") != alone.secret("right")
    assert has_secrets.secret("left") == device_secret(A + A, "left") != alone.secret("left")
    assert repr(has_secrets) == "LinkKey()"


def test_the_rig_key_comes_from_the_environment_or_a_private_file(tmp_path: Path) -> None:
    text = new_key()
    assert rig_key({ENVIRONMENT: text}) == bytes.fromhex(text)
    path = tmp_path / "rig.key"
    path.write_text(text + "\n")
    path.chmod(0o600)
    assert rig_key({}, path) == bytes.fromhex(text)
    path.chmod(0o644)
    with pytest.raises(PhalanxError, match="chmod 600"):
        rig_key({}, path)
    with pytest.raises(PhalanxError, match="cannot read"):
        rig_key({}, path.with_name("absent"))
    for bad in ("", "00", "z" * 64, text + "00"):
        with pytest.raises(PhalanxError, match="64 hexadecimal digits"):
            rig_key({ENVIRONMENT: bad})
    with pytest.raises(PhalanxError, match="no rig key"):
        rig_key({})
