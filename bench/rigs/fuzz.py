"""Messages of a hostile sender, made from the message types themselves.

They are whole but for one field, or wrong all over.

An `Attack` says how a plausible message of now becomes a hostile one, so a flood can be made before it is sent and
still be of its moment. `attacks` gives all of one type; `flood` draws from those of many, with a seed.
"""

import random
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias, get_args

import msgspec
from msgspec import Struct, inspect

from bench.rigs.fuzz_values import dtype_of, hostile, nested
from common.link.handshake import EchoAnswer, Hello, Started
from common.messages import AnyMessage, Message

Fields: TypeAlias = dict[str, object]
SAID: tuple[type[Struct], ...] = (*get_args(AnyMessage), Hello, Started, EchoAnswer)  # what a slave may say
_ZERO: Mapping[type, object] = {
    inspect.IntType: 1,
    inspect.FloatType: 1.0,
    inspect.BoolType: False,
    inspect.StrType: "name",
    inspect.BytesType: bytes(16),
    inspect.CustomType: bytes(8),
    inspect.DictType: {"name": 1},
    inspect.NoneType: None,
}


@dataclass(frozen=True, slots=True)
class Now:
    """A time of the moment of sending, so much later [ns]."""

    later_ns: int = 0


@dataclass(frozen=True, slots=True)
class Attack:
    """How a plausible message becomes a hostile one.

    Attributes:
        what: For a person: type, field and value.
        kind: The type.
        changes: Fields that are put in, as msgpack has them; a `Now` is resolved when it is sent.
        without: Fields that are left out.
        tail: Bytes behind the message.
        whole: All of the bytes, in place of a message.
        twice: The same bytes are sent again.
    """

    what: str
    kind: type[Struct]
    changes: Mapping[str, object] = field(default_factory=dict[str, object])
    without: frozenset[str] = frozenset()
    tail: bytes = b""
    whole: bytes | None = None
    twice: bool = False

    def body(self, base: Mapping[str, object], now_ns: int) -> bytes:
        """The bytes, made of a plausible message."""
        if self.whole is not None:
            return self.whole
        fields = {name: value for name, value in base.items() if name not in self.without}
        fields |= self.changes
        for name, value in fields.items():
            if isinstance(value, Now):
                fields[name] = now_ns + value.later_ns
        return _ENCODER.encode(fields) + self.tail


_ENCODER = msgspec.msgpack.Encoder()


def wire(message: Struct) -> Fields:
    """The fields of a message as msgpack has them, arrays as bytes."""
    out: Fields = {"type": type(message).__name__} if isinstance(message, Message) else {}
    for one in msgspec.structs.fields(type(message)):
        value = getattr(message, one.name)
        dtype = dtype_of(one.type)
        out[one.encode_name] = (
            msgspec.to_builtins(value, builtin_types=(bytes,))
            if dtype is None
            else value.astype(dtype).tobytes()
        )
    return out


def plausible(kind: type[Struct]) -> Fields:
    """A message of this type, for types of which no example is known.

    Each field has the simplest value of its own type.
    """
    info = inspect.type_info(kind)
    assert isinstance(info, inspect.StructType)
    out: Fields = {} if info.tag is None else {"type": info.tag}
    return out | {one.encode_name: _simplest(one.type) for one in info.fields}


def _simplest(kind: inspect.Type) -> object:
    if isinstance(kind, inspect.StructType):
        return plausible(kind.cls)
    if isinstance(kind, inspect.LiteralType):
        return kind.values[0]
    if isinstance(kind, inspect.VarTupleType | inspect.ListType):
        return [_simplest(kind.item_type)]
    if isinstance(kind, inspect.Metadata):
        return _simplest(kind.type)
    if isinstance(kind, inspect.UnionType):
        return _simplest(kind.types[0])
    if type(kind) not in _ZERO:
        raise TypeError(f"{kind}: nothing plausible is known for this type; add it to {__name__}")
    return _ZERO[type(kind)]


def attacks(kind: type[Struct], base: Mapping[str, object], source: random.Random) -> Iterator[Attack]:
    """Every attack with one message of a type.

    Each field takes each hostile value; besides there are bytes that are no message at all.

    Raises:
        TypeError: A field has a type whose hostile values are not known.
    """
    yield from _fields(kind, base, source)
    name, whole = kind.__name__, _ENCODER.encode(base)
    for one in base:
        yield Attack(f"{name} without {one}", kind, without=frozenset({one}))
    yield Attack(f"{name} with one more field", kind, {"also": 1})
    yield Attack(f"{name} with one more field, deep", kind, {"also": nested(1500)})
    yield Attack(f"{name} with bytes behind", kind, tail=b"\0")
    yield Attack(f"{name} twice in one", kind, tail=whole[: max(0, 3800 - len(whole))])
    yield Attack(f"{name} cut", kind, whole=whole[: source.randrange(1, len(whole))])
    yield Attack(f"{name} as an array", kind, whole=_ENCODER.encode(list(base.values())[:20]))
    yield Attack(f"{name} with a map too long", kind, whole=b"\xdf\xff\xff\xff\xff" + whole[1:])
    yield Attack("nothing", kind, whole=b"")
    yield Attack("deep", kind, whole=b"\x91" * 4000)
    yield Attack("noise", kind, whole=source.randbytes(source.randrange(1, 300)))
    for tag in ("", "Unknown", "Message", 1, None):
        yield Attack(f"{name} said to be {tag!r}", kind, {"type": tag})


def _fields(kind: type[Struct], base: Mapping[str, object], source: random.Random) -> Iterator[Attack]:
    info = inspect.type_info(kind)
    assert isinstance(info, inspect.StructType)
    types = {one.encode_name: one.type for one in msgspec.structs.fields(kind)}
    for one in info.fields:
        name = one.encode_name
        for what, value in hostile(one.type, base[name], source, types[name]):
            yield Attack(f"{kind.__name__}.{name}: {what}", kind, {name: value})


def over_time(kind: type[Struct], base: Mapping[str, object]) -> Iterator[list[Attack]]:
    """Attacks of several messages, to be sent in this order."""
    name, most, least = kind.__name__, 2**63 - 1, -(2**63)

    def said(what: str, *changes: Mapping[str, object], twice: bool = False) -> list[Attack]:
        return [Attack(f"{name} over time: {what}", kind, change, twice=twice) for change in changes]

    yield said("the same twice", {}, twice=True)
    if "seq" in base:
        yield said("seq to and fro", *({"seq": n} for n in (0, most, 0, most, 1, most - 1)))
        yield said("seq backwards", *({"seq": n} for n in (2**40, 2**39, 2**38, 3, 2, 1)))
        yield said("another session each time", *({"session": n, "seq": n} for n in (0, 1, most, 2, 3)))
        yield said("sessions in turn", *({"session": n % 2, "seq": most * (n % 2)} for n in range(6)))
    if "t_ns" in base:
        times = (
            0,
            Now(),
            -1,
            Now(),
            least,
            Now(),
            most,
            Now(),
            Now(-(10**9)),
            Now(10**9),
            Now(40_000_000),
            Now(),
        )
        yield said("times", *({"t_ns": t} for t in times))
        yield said("one time again and again", *({"t_ns": Now()} for _ in range(8)))
    if "ready_t_ns" in base:
        times = (least, most, 0, Now(-(10**10)), Now(10**10), Now(10**12), Now(-(10**12)))
        yield said("ready", *({"ready_t_ns": t} for t in times))
        yield said(
            "ready before", *({"t_ns": Now(), "ready_t_ns": Now(-later)} for later in (1, 10**6, 10**9))
        )
    if kind is EchoAnswer:
        for t1, t2, t3 in (
            (least, most, most), (least, least, least), (most, most, most), (Now(), most, most), (Now(), least, least),
            (Now(-(10**6)), Now(), Now()), (Now(-(10**6)), 0, 0), (0, 0, 0), (Now(10**9), 0, 0), (least, least, most),
        ):  # fmt: skip
            yield said(f"{t1}, {t2}, {t3}", *[{"t1_ns": t1, "t2_ns": t2, "t3_ns": t3}] * 3)


def all_attacks(
    kinds: Sequence[type[Struct]], bases: Mapping[type[Struct], Mapping[str, object]], source: random.Random
) -> dict[type[Struct], list[list[Attack]]]:
    """Of each type all attacks, those of one message and those over time."""
    out: dict[type[Struct], list[list[Attack]]] = {}
    for kind in kinds:
        base = bases.get(kind) or plausible(kind)
        out[kind] = [[one] for one in attacks(kind, base, source)] + list(over_time(kind, base))
    return out


def flood(
    shares: Mapping[type[Struct], float],
    bases: Mapping[type[Struct], Mapping[str, object]],
    count: int,
    seed: int,
) -> Iterator[Attack]:
    """Draw `count` attacks, with the message types in these shares.

    In half of them one field is wrong, in a tenth three are; the rest is any attack.
    """
    source = random.Random(seed)
    kinds = list(shares)
    known = all_attacks(kinds, bases, source)
    single = {kind: list(_fields(kind, bases.get(kind) or plausible(kind), source)) for kind in kinds}
    weights = [shares[kind] for kind in kinds]
    sent = 0
    while sent < count:
        kind, how = source.choices(kinds, weights)[0], source.random()
        if how < 0.5:
            chosen = [source.choice(single[kind])]
        elif how < 0.6:
            several = [source.choice(single[kind]) for _ in range(3)]
            changes = {name: value for one in several for name, value in one.changes.items()}
            chosen = [Attack(f"{kind.__name__}: {', '.join(changes)}", kind, changes)]
        else:
            chosen = source.choice(known[kind])
        yield from chosen[: count - sent]
        sent += len(chosen)
