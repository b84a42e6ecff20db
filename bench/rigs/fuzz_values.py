"""Values that a hostile sender puts into a field, by the field's type.

They are beyond bounds, absurd, or of another type.

`hostile` takes a type as `msgspec.inspect` describes it, so a new field of a known type is attacked without a word
here, and a field of a type that is not known is an error.
"""

import random
from collections.abc import Callable, Iterator, Mapping
from math import inf, nan
from typing import Annotated, TypeAlias, cast, get_args, get_origin

import msgspec
import numpy as np
from msgspec import inspect

from common.arrays import Bool, Code, Float, Ids

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
_DEEP = 1500


def hostile(
    kind: inspect.Type, base: object, source: random.Random, annotation: object = None
) -> Iterator[Value]:
    """All hostile values of one field.

    Args:
        kind: Its type.
        base: A plausible value of it, as msgpack has it.
        source: Of what is drawn at random.
        annotation: Of the field, which says of an array what its elements are.

    Raises:
        TypeError: The type has no values here.
    """
    yield from _of_type(kind, base, source, annotation)
    yield from wrong_types(base)


def wrong_types(base: object) -> Iterator[Value]:
    """Values of every other msgpack type, and nested without end."""
    for other in (None, True, 7, 1.5, "text", b"bytes", [], [1, 2], {}, {"a": 1}):
        if type(other) is not type(base):
            yield f"{other!r} in place of it", other
    yield "an array in itself", nested(_DEEP)
    yield "a map in itself", msgspec.Raw(b"\x81\xa1a" * (_DEEP // 3) + b"\xc0")
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
            for size in dict.fromkeys(
                (0, 1, 15, 17, kind.min_length or 0, (kind.max_length or 0) + 1, _MOST_BYTES)
            ):
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
    """Hostile values of an array, as bytes.

    Of wrong sizes; of the right size with one entry, or all, hostile; the right entries in other places.
    """
    item = dtype.itemsize
    for size in dict.fromkeys(
        (0, 1, item, len(base) - item, len(base) + item, len(base) + 1, 48 * item, 49 * item)
    ):
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
    """Values at, just beyond and within the bounds that a field states.

    The field is a number, or an array of which elements are replaced.
    """
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
        yield (
            f"each {what}, some not seen",
            np.array([source.choice((draw(), nan)) for _ in whole], dtype).tobytes(),
        )


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
    for field in kind.fields:
        for what, value in hostile(field.type, base[field.encode_name], source):
            yield f"{field.name} {what}", base | {field.encode_name: value}
        yield f"without {field.name}", {name: one for name, one in base.items() if name != field.encode_name}
    yield "a field too many", base | {"also": 1}
