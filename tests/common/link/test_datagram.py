"""The sealed datagram: what is whole comes through, what is not is refused under its reason."""

import pytest
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
from hypothesis import given, settings
from hypothesis import strategies as st

from common.link.datagram import (
    HEADER,
    MAX_DATAGRAM,
    OVERHEAD,
    WINDOW,
    Header,
    Kind,
    Opened,
    Opener,
    Refusal,
    ReplayWindow,
    Sealer,
    parse,
)
from common.messages import MAX_MARKERS, WIRE_VERSION

KEY = bytes(range(32))
RIG = 0x1234ABCD
ID = 77


def receive(datagram: bytes, opener: Opener) -> Opened | Refusal:
    header = parse(datagram, RIG)
    return header if isinstance(header, Refusal) else opener.open(header, datagram)


@given(st.sampled_from(Kind), st.binary(max_size=MAX_DATAGRAM - OVERHEAD))
def test_what_was_sealed_is_opened_once(kind: Kind, body: bytes) -> None:
    datagram = Sealer(KEY, RIG, ID).seal(kind, body)
    assert len(datagram) == OVERHEAD + len(body)
    assert parse(datagram, RIG) == Header(kind, ID, 1)
    opener = Opener(KEY)
    assert receive(datagram, opener) == Opened(body, False)
    assert receive(datagram, opener) is Refusal.DUPLICATE


def test_the_layout_is_the_documented_one() -> None:
    """Sealed by hand from docs/wire.md, with nothing of `Sealer`."""
    header = b"PHLX" + bytes([WIRE_VERSION, 8]) + (28 + 5 + 16).to_bytes(2, "big")
    header += RIG.to_bytes(4, "big") + ID.to_bytes(8, "big") + (3).to_bytes(8, "big")
    nonce = bytes(4) + (3).to_bytes(8, "big")
    datagram = header + ChaCha20Poly1305(KEY).encrypt(nonce, b"hello", header)
    assert receive(datagram, Opener(KEY)) == Opened(b"hello", False)
    sealer = Sealer(KEY, RIG, ID)
    assert [sealer.seal(Kind.DATA, b"hello") for _ in range(3)][2] == datagram


def test_cut_at_every_byte_and_with_junk_behind() -> None:
    datagram = Sealer(KEY, RIG, ID).seal(Kind.DATA, b"some body")
    opener = Opener(KEY)
    assert receive(b"", opener) is Refusal.FOREIGN
    for size in range(1, len(datagram)):
        assert receive(datagram[:size], opener) is Refusal.CUT, size
    for junk in (b"\0", b"x" * 100, datagram):
        assert receive(datagram + junk, opener) is Refusal.JUNK
    assert receive(datagram + bytes(MAX_DATAGRAM), opener) is Refusal.OVERSIZED
    assert receive(datagram, opener) == Opened(b"some body", False)


def test_every_flipped_bit_is_refused() -> None:
    datagram = Sealer(KEY, RIG, ID).seal(Kind.DATA, b"some body")
    expected = (
        [Refusal.FOREIGN] * 4  # magic
        + [Refusal.VERSION]
        + [None]  # kind: unknown, or known and then forged
        + [None] * 2  # length: cut or junk
        + [Refusal.FOREIGN] * 4  # rig
        + [Refusal.FORGED] * (len(datagram) - 12)
    )
    for bit in range(8 * len(datagram)):
        mutated = bytearray(datagram)
        mutated[bit // 8] ^= 1 << bit % 8
        result = receive(bytes(mutated), Opener(KEY))
        assert isinstance(result, Refusal), bit
        assert expected[bit // 8] in (None, result), bit


def test_another_key_another_rig_another_version() -> None:
    assert receive(Sealer(bytes(32), RIG, ID).seal(Kind.DATA, b"x"), Opener(KEY)) is Refusal.FORGED
    assert receive(Sealer(KEY, RIG + 1, ID).seal(Kind.DATA, b"x"), Opener(KEY)) is Refusal.FOREIGN
    datagram = bytearray(Sealer(KEY, RIG, ID).seal(Kind.DATA, b"x"))
    datagram[4] = WIRE_VERSION + 1
    assert receive(bytes(datagram), Opener(KEY)) is Refusal.VERSION
    datagram[4], datagram[5] = WIRE_VERSION, 200
    assert receive(bytes(datagram), Opener(KEY)) is Refusal.UNEXPECTED


def test_the_largest_message_fits_and_a_larger_body_is_the_callers_error() -> None:
    assert MAX_MARKERS * (16 + 8 + 8 + 8 + 16) + 300 + OVERHEAD < MAX_DATAGRAM
    with pytest.raises(ValueError, match="at most"):
        Sealer(KEY, RIG, ID).seal(Kind.DATA, bytes(MAX_DATAGRAM))


def test_no_nonce_is_used_twice() -> None:
    sealer = Sealer(KEY, RIG, ID)
    headers = [parse(sealer.seal(Kind.DATA, b""), RIG) for _ in range(1000)]
    assert len({header.counter for header in headers if isinstance(header, Header)}) == 1000


def test_a_forged_datagram_does_not_use_up_its_counter() -> None:
    sealer, opener = Sealer(KEY, RIG, ID), Opener(KEY)
    good = sealer.seal(Kind.DATA, b"x")
    forged = HEADER.pack(b"PHLX", WIRE_VERSION, Kind.DATA, len(good), RIG, ID, 2**63) + good[HEADER.size :]
    assert receive(forged, opener) is Refusal.FORGED
    assert receive(good, opener) == Opened(b"x", False)


@settings(max_examples=200)
@given(st.lists(st.integers(1, 3 * WINDOW), max_size=300))
def test_the_window_takes_each_counter_once(counters: list[int]) -> None:
    """The model: a set of all taken counters, and the rule for what is too old."""
    window, taken = ReplayWindow(), set[int]()
    for counter in counters:
        highest = max(taken, default=0)
        result = window.take(counter)
        if counter in taken and highest - counter < WINDOW:
            assert result is Refusal.DUPLICATE
        elif highest - counter >= WINDOW:
            assert result is Refusal.REPLAYED
        else:
            assert result is (counter < highest)
            taken.add(counter)
        assert window._received < 1 << WINDOW
        assert window.missing == max(taken, default=0) - len(taken)


def test_the_window_at_its_limits() -> None:
    window = ReplayWindow()
    assert window.take(0) is Refusal.DUPLICATE  # never sent: counting begins at 1
    assert window.take(2**64 - 1) is False  # a huge jump costs no memory
    assert window.take(2**64 - WINDOW) is True
    assert window.take(2**64 - 1 - WINDOW) is Refusal.REPLAYED


@given(st.sets(st.integers(1, 60), min_size=2))
def test_what_is_missing_between_two_that_came(came: set[int]) -> None:
    window = ReplayWindow()
    for counter in came:
        window.take(counter)
    first, *_, last = sorted(came)
    assert window.missing_between(first, last) == last - first - len(came) + 1
    assert window.missing_between(0, first) == first - 1


def test_what_is_too_old_to_be_known_counts_as_missing() -> None:
    window = ReplayWindow()
    for counter in (1, 2, 3, 5000):
        window.take(counter)
    assert window.missing_between(3, 5000) == 4996
    assert window.missing_between(1, 3) == 1
