"""The table of streams is complete and its keys cannot collide."""

from typing import get_args

import pytest

from common.messages import AnyMessage, Backlog
from common.messages.streams import ALIVE_KEY, STREAMS, Path, key_of


def test_every_message_travels_on_exactly_one_stream() -> None:
    passed_on = STREAMS["device"]  # what came as a datagram, on the bus as it came
    assert passed_on.message is STREAMS["tracker"].message
    tapped = STREAMS[
        "taken"
    ]  # whatever came as a datagram, while somebody records, and what was left out of it
    travelling = [row.message for row in STREAMS.values() if row not in (passed_on, tapped)]
    assert len(travelling) == len(set(travelling))
    assert {*travelling, Backlog} == set(get_args(AnyMessage))


def test_only_datagrams_have_no_key() -> None:
    for name, stream in STREAMS.items():
        assert (stream.key is None) == (stream.path is Path.DATAGRAM), name


def test_marker_data_never_waits_for_a_lost_frame() -> None:
    assert STREAMS["markers"].path is Path.DATAGRAM


def test_commands_are_not_replayed_and_pictures_not_kept() -> None:
    assert {name for name, stream in STREAMS.items() if not stream.recorded} == {
        "command",
        "device",  # the same poses are kept as they come
        "preview",
        "still",
        "taken",  # so are these
    }


def test_keys_differ_by_stream_and_by_name() -> None:
    keyed = [name for name, stream in STREAMS.items() if stream.key is not None]
    keys = {key_of(stream, name) for stream in keyed for name in ("left", "right")}
    keys |= {ALIVE_KEY.format(name=name) for name in ("left", "right")}
    assert len(keys) == 2 * (len(keyed) + 1)
    assert key_of("hand", "right") == "phalanx/hand/right"


def test_a_datagram_stream_has_no_key() -> None:
    with pytest.raises(ValueError, match="datagrams"):
        key_of("markers", "left")
