"""docs/wire.md names everything that travels, and the numbers in it are those of the code."""

import re
from pathlib import Path

import msgspec
import pytest

from common.link import datagram, handshake
from common.link.datagram import HEADER, MAX_DATAGRAM, OVERHEAD, WINDOW, Kind, Refusal
from common.link.handshake import (
    Beacon,
    EchoAnswer,
    EchoAsk,
    Handshake,
    Hello,
    Start,
    Started,
    Unproven,
    Welcome,
)
from common.messages import MAX_MARKERS, WIRE_VERSION
from common.messages.streams import ALIVE_KEY, STREAMS

TEXT = (Path(__file__).parents[3] / "docs" / "wire.md").read_text(encoding="utf-8")
CODE = set(re.findall(r"`([^`\n]+)`", TEXT))
HANDSHAKES = (Beacon, Hello, Welcome, Start, Started, EchoAsk, EchoAnswer, Unproven)
TRAVELS = (*(row.message for row in STREAMS.values()), *HANDSHAKES)


@pytest.mark.parametrize("kind", TRAVELS)
def test_every_field_is_described(kind: type[msgspec.Struct]) -> None:
    missing = [field.name for field in msgspec.structs.fields(kind) if field.name not in CODE]
    assert not missing


def test_no_handshake_is_left_out() -> None:
    assert set(Handshake.__subclasses__()) == set(HANDSHAKES)
    for kind in Kind:
        assert f"| {int(kind)} {kind.name} |" in TEXT


def test_every_reason_is_in_the_table() -> None:
    table = TEXT[TEXT.index("## 5.") : TEXT.index("## 6.")]
    rows = {
        name
        for row in re.findall(r"^\| (`.*?) \|", table, re.MULTILINE)
        for name in re.findall(r"`(\w+)`", row)
    }
    assert rows == {str(reason) for reason in Refusal}


def test_numbers_and_keys_agree() -> None:
    assert f"**Wire version {WIRE_VERSION}**" in TEXT
    assert f"At most {MAX_DATAGRAM} bytes; {OVERHEAD} are header and tag" in TEXT
    assert f"the {HEADER.size} header bytes" in TEXT
    assert f"more than {WINDOW} counters old" in TEXT
    assert f"M ≤ {MAX_MARKERS} markers" in TEXT
    assert f"map name → int, ≤ {handshake.MAX_CAMERAS}" in TEXT
    assert f"{datagram.KEY_BYTES} random bytes" in TEXT
    for key in (ALIVE_KEY, *(row.key for row in STREAMS.values() if row.key is not None)):
        assert f"`{key.split('{')[0]}<" in TEXT
