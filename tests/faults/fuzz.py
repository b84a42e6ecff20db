"""Messages of a hostile sender, made from the message types themselves: wrong in one field, or all over.

A field's type is taken as `msgspec.inspect` describes it, so a new field of a known type is attacked by itself, and one
of a type that is not known is an error. An `Attack` turns a plausible message of now into a hostile one, so that a
flood can be made before it is sent. `attacks` gives all of one type; `flood` draws from those of many, with a seed.
"""

import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf, nan
from typing import Annotated, TypeAlias, cast, get_args, get_origin

import msgspec
import numpy as np
from msgspec import Struct, inspect

from common.arrays import Bool, Code, Float, Ids
from common.link.handshake import EchoAnswer, Hello, Started
from common.messages import AnyMessage, Message

Value: TypeAlias = tuple[str, object]  # what it is, and the value as msgpack takes it
DTYPES: Mapping[object, np.dtype[np.generic]] = {
    Float: np.dtype("<f8"),
    Bool: np.dtype("?"),
    Code: np.dtype("u1"),
    Ids: np.dtype("<u2"),
}
INTS = (0, -1, 1, 2**31, 2**53, 2**62, 2**63 - 1, -(2**63), 2**64 - 1)
FLOATS = (nan, inf, -inf, 0.0, -0.0, 5e-324, 1e-300, 1e300, 1e308, -1e300, 1e9, 1e15, 1e18, -1.0)
BROKEN_UTF8 = msgspec.Raw(b"\xa3\xed\xa0\x80")  # a lone surrogate, as msgpack text
STRINGS: tuple[str | msgspec.Raw, ...] = (
    "", "x" * 64, "x" * 65, "a\0b", "\x1b]0;owned\x07", "\x1b[2J\x1b[31m", "left\n", "\u202egpj", "../../etc/passwd",
    "-", ".", "left", "master", "\uff11", "*", "a/b", "$*", BROKEN_UTF8,
)  # fmt: skip
_MOST_BYTES = 3000  # what fits into a datagram beside the other fields


def hostile(
    kind: inspect.Type, base: object, source: random.Random, annotation: object = None
) -> Iterator[Value]:
    """All hostile values of one field with the plausible value `base`, as msgpack has it; TypeError: none are known.

    `source`: of what is drawn at random; `annotation`: of the field, which gives the dtype of an array.
    """
    yield from _of_type(kind, base, source, annotation)
    yield from wrong_types(base)


def wrong_types(base: object) -> Iterator[Value]:
    """Values of every other msgpack type, and nested without end."""
    for other in (None, True, 7, 1.5, "text", b"bytes", [], [1, 2], {}, {"a": 1}):
        if type(other) is not type(base):
            yield f"{other!r} in place of it", other
    deep = 1500
    yield "an array in itself", nested(deep)
    yield "a map in itself", msgspec.Raw(b"\x81\xa1a" * (deep // 3) + b"\xc0")
    yield "an array of 2^32 - 1 elements", msgspec.Raw(b"\xdd\xff\xff\xff\xff")
    yield "bytes of 2^32 - 1", msgspec.Raw(b"\xc6\xff\xff\xff\xff")
    yield "an extension", msgspec.Raw(b"\xc7\x08\xff" + bytes(8))
    yield "a reserved code", msgspec.Raw(b"\xc1")


def bare(annotation: object) -> object:
    """An annotation without what stands beside its type."""
    return get_args(annotation)[0] if get_origin(annotation) is Annotated else annotation


def dtype_of(annotation: object) -> np.dtype[np.generic] | None:
    """What the elements of an array field are on the wire; None: it is no array."""
    return DTYPES.get(bare(annotation))


def nested(depth: int) -> msgspec.Raw:
    """An array in an array, so deep."""
    return msgspec.Raw(b"\x91" * depth + b"\xc0")


def _of_type(kind: inspect.Type, base: object, source: random.Random, annotation: object) -> Iterator[Value]:
    match kind:
        case inspect.BoolType():
            yield "the other", not base
        case inspect.IntType():
            yield from _numbers(kind, INTS)
            yield "random", source.getrandbits(source.choice((16, 32, 62)))
        case inspect.FloatType():
            yield from _numbers(kind, FLOATS)
            yield "random", source.gauss(0.0, 10.0 ** source.uniform(-3.0, 12.0))
        case inspect.StrType():
            yield from ((f"{text!r}"[:40], text) for text in STRINGS)
            for size in (kind.max_length or 0, (kind.max_length or 0) + 1):
                yield f"{size} characters", "x" * min(size, _MOST_BYTES)
        case inspect.LiteralType():
            yield from ((f"{text!r}"[:40], text) for text in (*STRINGS, *kind.values))
        case inspect.BytesType():
            sizes = (0, 1, 15, 17, kind.min_length or 0, (kind.max_length or 0) + 1, _MOST_BYTES)
            for size in dict.fromkeys(sizes):
                yield f"{size} bytes", source.randbytes(min(size, _MOST_BYTES))
            yield "a JPEG that ends", b"\xff\xd8\xff"
            yield "a JPEG of 30000 x 30000", b"\xff\xd8\xff\xc0\x00\x11\x08\x75\x30\x75\x30\x03" + bytes(300)
        case inspect.Metadata():
            yield from _of_type(kind.type, base, source, annotation)
            if kind.extra and "bounds" in kind.extra:
                bounds = cast(tuple[float, float], kind.extra["bounds"])
                yield from _within_bounds(bounds, base, annotation, source)
        case inspect.CustomType() if dtype_of(annotation) is not None:
            yield from _arrays(DTYPES[bare(annotation)], cast(bytes, base), source)
        case inspect.DictType():
            yield from _dicts(kind, cast(dict[str, object], base), source)
        case inspect.VarTupleType() | inspect.ListType():
            yield from _lists(kind, cast(list[object], base), source)
        case inspect.StructType():
            yield from _structs(kind, cast(dict[str, object], base), source)
        case inspect.UnionType():
            for one in kind.types:
                yield from _of_type(one, base, source, annotation)
        case inspect.NoneType():
            yield "nothing", None
        case _:
            raise TypeError(f"{kind}: no hostile values are known for this type; add them to {__name__}")


def _numbers(kind: inspect.IntType | inspect.FloatType, values: tuple[float, ...]) -> Iterator[Value]:
    yield from ((f"{value:g}", value) for value in values)
    for bound, beyond in ((kind.ge, -1), (kind.le, 1)):
        if bound is not None and -(2**63) <= bound + beyond < 2**64:
            yield "at its bound", bound
            yield "beyond its bound", bound + beyond


def _arrays(dtype: np.dtype[np.generic], base: bytes, source: random.Random) -> Iterator[Value]:
    """Hostile values of an array: wrong sizes; one entry or all hostile; the right entries in other places."""
    item = dtype.itemsize
    sizes = (0, 1, item, len(base) - item, len(base) + item, len(base) + 1, 48 * item, 49 * item)
    for size in dict.fromkeys(sizes):
        yield f"{size} bytes", bytes(max(size, 0))
    yield "huge", bytes(_MOST_BYTES)
    if len(base) < item:
        return
    entries: list[float] = list(FLOATS) if dtype.kind == "f" else [0, 1, 2, 255, 2 ** (8 * item) - 1]
    with np.errstate(over="ignore"):
        for value in entries:
            entry = np.asarray(value).astype(dtype).tobytes()
            at = source.randrange(len(base) // item) * item
            yield f"one entry {value:g}", base[:at] + entry + base[at + item :]
            yield f"all {value:g}", entry * (len(base) // item)
        for what, change in _CHANGES.items():
            array = np.frombuffer(base, dtype)
            if dtype.kind == "f" or what in _ANY_DTYPE:
                yield what, change(array).astype(dtype).tobytes()


_CHANGES: Mapping[str, Callable[[np.ndarray], np.ndarray]] = {
    "all like the first": lambda array: np.full_like(array, array[0]),
    "backwards": lambda array: array[::-1],
    "other way round": lambda array: -array,
    "1e9 farther": lambda array: array + 1e9,
    "1e4 farther": lambda array: array + 1e4,
    "a million times": lambda array: array * 1e6,
    "a hair farther": lambda array: array + 1e-9,
}
_ANY_DTYPE = {"all like the first", "backwards"}


def _within_bounds(
    bounds: tuple[float, float], base: object, annotation: object, source: random.Random
) -> Iterator[Value]:
    """Values at, just beyond and within the bounds that a field states, of a number or of the elements of an array."""
    low, high = bounds
    one = {f"at the bound {bound:g}": bound for bound in bounds}
    one |= {f"beyond the bound {b:g}": float(np.nextafter(b, way)) for b, way in ((low, -inf), (high, inf))}
    one["anywhere within its bounds"] = source.uniform(low, high)
    dtype = dtype_of(annotation)
    if dtype is None:
        yield from one.items()
        return
    whole = np.frombuffer(cast(bytes, base), dtype)
    for what, value in one.items():
        yield f"one entry {what}", np.array(value, dtype).tobytes() + whole[1:].tobytes()
        yield f"all {what}", np.full_like(whole, value).tobytes()
    for what, draw in (
        ("at either bound", lambda: source.choice(bounds)),
        ("anywhere within", lambda: source.uniform(low, high)),
        ("of any size within", lambda: source.choice(bounds) * 10.0 ** source.uniform(-12.0, 0.0)),
    ):
        yield f"each {what}", np.array([draw() for _ in whole], dtype).tobytes()
        some = [source.choice((draw(), nan)) for _ in whole]
        yield f"each {what}, some not seen", np.array(some, dtype).tobytes()


def _dicts(kind: inspect.DictType, base: dict[str, object], source: random.Random) -> Iterator[Value]:
    yield "empty", {}
    value = next(iter(base.values()), 0)
    for count in (512, 513):
        yield f"{count} entries", {f"n{k}": 1 for k in range(count)}
    for what, key in hostile(kind.key_type, "name", source):
        if isinstance(key, str):
            yield f"key {what}", base | {key: value}
    for what, entry in hostile(kind.value_type, value, source):
        yield f"entry {what}", base | {"name": entry}
    yield "a key that is a number", {1: 2}
    yield "a key that is nothing", {None: 2}


def _lists(
    kind: inspect.VarTupleType | inspect.ListType, base: list[object], source: random.Random
) -> Iterator[Value]:
    yield "empty", []
    if base:
        yield "many", base[:1] * 65
        for what, entry in hostile(kind.item_type, base[0], source):
            yield f"entry {what}", [entry, *base[1:]]


def _structs(kind: inspect.StructType, base: dict[str, object], source: random.Random) -> Iterator[Value]:
    for own in kind.fields:
        for what, value in hostile(own.type, base[own.encode_name], source):
            yield f"{own.name} {what}", base | {own.encode_name: value}
        yield f"without {own.name}", {name: one for name, one in base.items() if name != own.encode_name}
    yield "a field too many", base | {"also": 1}


Fields: TypeAlias = dict[str, object]
MESSAGE_TYPES: tuple[type[Struct], ...] = (*get_args(AnyMessage), Hello, Started, EchoAnswer)  # of a slave


@dataclass(frozen=True, slots=True)
class Now:
    """A time of the moment of sending, so much later [ns]."""

    later_ns: int = 0


@dataclass(frozen=True, slots=True)
class Attack:
    """How a plausible message becomes a hostile one; a `Now` among the changes is resolved when it is sent."""

    what: str  # for a person: type, field and value
    kind: type[Struct]  # the type
    changes: Mapping[str, object] = field(default_factory=dict[str, object])
    without: frozenset[str] = frozenset()  # fields that are left out
    tail: bytes = b""  # bytes behind the message
    whole: bytes | None = None  # all of the bytes, in place of a message
    twice: bool = False  # the same bytes are sent again

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
        plain = dtype is None
        out[one.encode_name] = (
            msgspec.to_builtins(value, builtin_types=(bytes,)) if plain else value.astype(dtype).tobytes()
        )
    return out


def attacks(kind: type[Struct], base: Mapping[str, object], source: random.Random) -> Iterator[Attack]:
    """Every attack with one message of a type: each field with each hostile value, and bytes that are no message."""
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

    def sequence(what: str, *changes: Mapping[str, object], twice: bool = False) -> list[Attack]:
        return [Attack(f"{name} over time: {what}", kind, change, twice=twice) for change in changes]

    yield sequence("the same twice", {}, twice=True)
    if "seq" in base:
        yield sequence("seq to and fro", *({"seq": n} for n in (0, most, 0, most, 1, most - 1)))
        yield sequence("seq backwards", *({"seq": n} for n in (2**40, 2**39, 2**38, 3, 2, 1)))
        yield sequence("another session each time", *({"session": n, "seq": n} for n in (0, 1, most, 2, 3)))
        yield sequence("sessions in turn", *({"session": n % 2, "seq": most * (n % 2)} for n in range(6)))
    if "t_ns" in base:
        around = (Now(-(10**9)), Now(10**9), Now(40_000_000), Now())
        times = (0, Now(), -1, Now(), least, Now(), most, Now(), *around)
        yield sequence("times", *({"t_ns": t} for t in times))
        yield sequence("one time again and again", *({"t_ns": Now()} for _ in range(8)))
    if "ready_t_ns" in base:
        times = (least, most, 0, Now(-(10**10)), Now(10**10), Now(10**12), Now(-(10**12)))
        yield sequence("ready", *({"ready_t_ns": t} for t in times))
        yield sequence(
            "ready before", *({"t_ns": Now(), "ready_t_ns": Now(-later)} for later in (1, 10**6, 10**9))
        )
    if kind is EchoAnswer:
        for t1, t2, t3 in (
            (least, most, most), (least, least, least), (most, most, most), (Now(), most, most), (Now(), least, least),
            (Now(-(10**6)), Now(), Now()), (Now(-(10**6)), 0, 0), (0, 0, 0), (Now(10**9), 0, 0), (least, least, most),
        ):  # fmt: skip
            yield sequence(f"{t1}, {t2}, {t3}", *[{"t1_ns": t1, "t2_ns": t2, "t3_ns": t3}] * 3)


def all_attacks(
    kinds: Sequence[type[Struct]], bases: Mapping[type[Struct], Mapping[str, object]], source: random.Random
) -> dict[type[Struct], list[list[Attack]]]:
    """Of each type all attacks, those of one message and those over time."""
    out: dict[type[Struct], list[list[Attack]]] = {}
    for kind in kinds:
        base = bases[kind]
        out[kind] = [[one] for one in attacks(kind, base, source)] + list(over_time(kind, base))
    return out


Bases: TypeAlias = Mapping[type[Struct], Mapping[str, object]]


def flood(shares: Mapping[type[Struct], float], bases: Bases, count: int, seed: int) -> Iterator[Attack]:
    """Draw `count` attacks, with the message types in these shares.

    In half of them one field is wrong, in a tenth three are; the rest is any attack.
    """
    source = random.Random(seed)
    kinds = list(shares)
    known = all_attacks(kinds, bases, source)
    single = {kind: list(_fields(kind, bases[kind], source)) for kind in kinds}
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
