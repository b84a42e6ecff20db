"""What a hostile sender sends: every field of every type is attacked, a new one by itself, and the decoder holds."""

import random
from collections import Counter
from typing import Annotated

import msgspec
import numpy as np
import pytest
from msgspec import Meta, Struct

from common.arrays import Float
from common.errors import MessageError
from common.link.datagram import Kind
from common.link.handshake import EchoAnswer, Hello, Started, read
from common.messages import Message, TrackerPose, decode, encode
from common.messages.parts import Count, within
from tests.faults.fuzz import MESSAGE_TYPES, Attack, Now, all_attacks, attacks, flood
from tests.faults.hostile_sender import Speaker, examples

MESSAGES = [kind for kind in MESSAGE_TYPES if issubclass(kind, Message)]
SHAKES: dict[type[Struct], Kind] = {Hello: Kind.HELLO, Started: Kind.STARTED, EchoAnswer: Kind.ECHO_ANSWER}


class _Nested(Struct, frozen=True):
    inner: Annotated[str, Meta(max_length=3)]


class _Planted(Message, frozen=True, eq=False, tag=True):
    """A message type that nobody has written an attack for."""

    number: Count
    places_m: Annotated[Float, within(-2.0, 2.0)]
    parts: tuple[_Nested, ...]
    maybe: float | None = None


class _Unknown(Message, frozen=True, eq=False, tag=True):
    when: frozenset[int]


def of_type(kind: type[Struct]) -> list[Attack]:
    found = all_attacks([kind], examples("left"), random.Random(1))
    return [attack for group in found[kind] for attack in group]


def test_there_is_a_plausible_message_of_each_type() -> None:
    known = examples("left")
    assert set(known) == set(MESSAGE_TYPES)
    for kind, base in known.items():
        body = msgspec.msgpack.encode(base)
        made = decode(body) if kind in MESSAGES else read(SHAKES[kind], body)
        assert type(made) is kind


@pytest.mark.parametrize("kind", MESSAGE_TYPES, ids=lambda kind: kind.__name__)
def test_every_field_is_attacked_with_many_values_and_left_out(kind: type[Struct]) -> None:
    single = [attack for attack in of_type(kind) if attack.whole is None]
    changed = Counter(name for attack in single for name in attack.changes)
    fields = {field.encode_name for field in msgspec.structs.fields(kind)}
    assert fields <= set(changed)
    assert min(changed[name] for name in fields) >= 15
    assert fields <= {name for attack in single for name in attack.without}


def test_a_new_field_of_a_new_type_is_attacked_by_itself() -> None:
    plausible = {"number": 1, "places_m": bytes(8), "parts": [{"inner": "name"}], "maybe": 1.0}
    found = list(attacks(_Planted, plausible, random.Random(1)))
    values: dict[str, list[object]] = {}
    for attack in found:
        for name, value in attack.changes.items():
            values.setdefault(name, []).append(value)
    assert {"number", "places_m", "parts", "maybe"} <= set(values)
    assert {0, -1, 2**63 - 1, 2**63} <= {value for value in values["number"] if isinstance(value, int)}
    beyond = np.nextafter(2.0, 3.0).tobytes()
    assert beyond in values["places_m"], "just beyond the bound that the field states"
    assert any(isinstance(one, list) and len(one) == 65 for one in values["parts"])
    assert [{"inner": "xxxx"}] in values["parts"]
    assert None in values["maybe"]


def test_a_field_whose_type_is_not_known_is_an_error() -> None:
    with pytest.raises(TypeError, match="no hostile values are known"):
        list(attacks(_Unknown, {"when": []}, random.Random(1)))


@pytest.mark.parametrize("kind", MESSAGES, ids=lambda kind: kind.__name__)
def test_the_decoder_gives_a_message_or_refuses_it(kind: type[Struct]) -> None:
    base, outcomes = examples("left")[kind], Counter[bool]()
    for attack in of_type(kind):
        try:
            message = decode(attack.body(base, 10**12))
        except MessageError:
            outcomes[False] += 1
        else:
            outcomes[True] += 1
            assert type(decode(encode(message))) is type(message), attack.what
    assert min(outcomes[True], outcomes[False]) >= 5, "some are within all bounds, and go deep"


@pytest.mark.parametrize("kind", SHAKES, ids=lambda kind: kind.__name__)
def test_a_handshake_is_read_or_it_is_none(kind: type[Struct]) -> None:
    base = examples("left")[kind]
    made = [read(SHAKES[kind], attack.body(base, 10**12)) for attack in of_type(kind)]
    assert {type(one) for one in made} == {kind, type(None)}


def test_what_is_nested_ten_thousand_deep_is_refused() -> None:
    for body in (
        b"\x91" * 10_000,
        b"\x81\xa4type" * 10_000,
        b"\x82\xa4type\xa6Health\xa6counts" + b"\x81\xa1a" * 10_000,
    ):
        with pytest.raises(MessageError):
            decode(body)


def test_a_flood_repeats_with_its_seed_and_half_of_it_is_whole_but_for_one_field() -> None:
    known, shares = examples("left"), dict.fromkeys(MESSAGE_TYPES, 1.0)
    first, again, other = (list(flood(shares, known, 2000, seed)) for seed in (1, 1, 2))
    assert len(first) == 2000
    assert [one.what for one in first] == [one.what for one in again]
    assert [one.what for one in first] != [one.what for one in other]
    single = [one for one in first if one.whole is None and len(one.changes) == 1 and not one.without]
    assert len(single) > 1000
    assert {one.kind for one in first} == set(MESSAGE_TYPES)


def test_times_are_those_of_the_moment_of_sending() -> None:
    attack = Attack("", Started, {"start_t_ns": Now(5)})
    assert msgspec.msgpack.decode(attack.body({"start_t_ns": 0}, 1000)) == {"start_t_ns": 1005}


def test_what_is_not_attacked_is_of_the_session_and_its_number_is_the_next() -> None:
    speaker, plain = Speaker("left"), Attack("", TrackerPose)
    leap = Attack("", TrackerPose, {"seq": 1000})
    made = [decode(speaker.body(attack, 7, 10**12)) for attack in (plain, plain, leap, plain)]
    assert [one.seq for one in made if isinstance(one, TrackerPose)] == [1, 2, 1000, 1001]
    assert {(one.session, one.t_ns) for one in made if isinstance(one, TrackerPose)} == {(7, 10**12)}
