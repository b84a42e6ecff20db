"""JSON files: bounded in size and nesting, no key twice, no NaN; errors name the file and the key, on one line."""

import contextlib
import json
import re
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.calibration.files import MAX_BYTES, MAX_DEPTH, decode_json, read_json
from common.errors import CalibrationError


class Inner(msgspec.Struct, forbid_unknown_fields=True):
    size: int = 0


class Outer(msgspec.Struct, forbid_unknown_fields=True):
    parts: dict[str, Inner] = {}
    rows: list[dict[str, float]] = []
    name: str = ""


def refused(raw: bytes, kind: type = object) -> str:
    with pytest.raises(CalibrationError) as caught:
        decode_json(raw, kind, "some.json")
    text = str(caught.value)
    assert text.startswith("some.json: ")
    assert text.isprintable()
    assert len(text) < 800
    return text


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ('{"a": 1, "a": 1}', "`$.a`"),
        ('{"a": 1, "\\u0061": 2}', "`$.a`"),  # another spelling of the same key
        ('{"a": {"b": [0, {"c": 1, "d": 2, "c": 3}]}}', "`$.a.b[1].c`"),
        ('{"a": {"b": 1, "b": 2}, "a": {}}', "`$.a`"),
        ('{"a": {}, "b": {"x y": 1, "x y": 2}}', '`$.b["x y"]`'),
        ('{"\\u001b[31m": 1, "\\u001b[31m": 2}', '`$["\\u001b[31m"]`'),
        ('{"": 1, "": 2}', '`$[""]`'),
    ],
)
def test_a_key_that_stands_twice_is_named(text: str, key: str) -> None:
    assert f"duplicate key - at {key}" in refused(text.encode())


def test_equal_keys_of_different_objects_are_no_duplicates() -> None:
    assert decode_json(b'{"a": {"a": 1}, "b": [{"a": 1}, {"a": 2}]}', object, "x")


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ('{"parts": {"one": {"size": 1}, "two": {"size": "2"}, "three": {}}}', "`$.parts.two.size`"),
        ('{"rows": [{}, {"a": 1, "b": 2, "c": null}]}', "`$.rows[1].c`"),
        ('{"parts": {"one": {}, "a b": {"what": 1}}}', '`$.parts["a b"]`'),
        (
            '{"parts": {"one": {"size": "1"}}, bad',
            "`$.parts[...].size`",
        ),  # malformed further on: as msgspec has it
        ('{"parts": {"one": {"size": "1"}, "one": {"size": 1}, "two": {}}}', "`$.parts[...].size`"),
    ],
)
def test_the_key_of_a_map_is_named(text: str, key: str) -> None:
    assert f"at {key}" in refused(text.encode(), Outer)


@pytest.mark.parametrize(("open_", "close"), [("[", "]"), ('{"a":', "}")])
def test_nesting_is_bounded(open_: str, close: str) -> None:
    def nested(depth: int) -> bytes:
        return (open_ * depth + "0" + close * depth).encode()

    decode_json(nested(MAX_DEPTH), object, "x")
    assert f"nested {MAX_DEPTH + 1} levels deep" in refused(nested(MAX_DEPTH + 1))
    assert "levels deep" in refused(nested(600_000))
    assert "levels deep" in refused((open_ * 600_000).encode())


def test_brackets_and_quotes_in_strings_are_no_nesting() -> None:
    text = json.dumps({"a": "[" * 100, "b": '\\"[[{"' * 100, "c": "\\" * 101, "d": "{" * 100})
    assert decode_json(text.encode(), dict[str, str], "x")["c"] == "\\" * 101


def test_the_size_is_looked_at_before_anything_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "large.json"
    path.write_bytes(b'"' + b" " * (MAX_BYTES - 2) + b'"')
    read_json(path, str)
    with path.open("ab") as file:
        file.truncate(1 << 40)  # a terabyte, of which the disk has 4 MiB
    with pytest.raises(CalibrationError, match=r"large\.json: larger than 4 MiB"):
        read_json(path, str)
    with pytest.raises(CalibrationError, match="/dev/zero: larger than 4 MiB"):  # has no size, and no end
        read_json(Path("/dev/zero"), str)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (b'{"a": NaN}', "malformed"),
        (b"[Infinity]", "malformed"),
        (b"-Infinity", "malformed"),
        (b"1e999", "out of range"),
        (b"9" * 5000, "out of range"),
        (b'"\\ud800"', "truncated|surrogate"),
        (b"\xef\xbb\xbf{}", "malformed"),
        (b"\xff\xfe", "malformed"),
        (b'"\xff"', "utf-8|UTF-8|malformed"),
        (b'"' * (MAX_BYTES - 1), "malformed"),
        (b'\\"' * (MAX_BYTES // 2), "malformed"),
        (b'{"' + b"k" * 100_000 + b'": 1, "' + b"k" * 100_000 + b'": 1}', "duplicate key"),
    ],
    ids=str,
)
def test_what_is_no_json_is_refused(text: bytes, expected: str) -> None:
    assert re.search(expected, refused(text))


def test_keys_with_escape_sequences_do_not_reach_a_terminal() -> None:
    assert r"unknown field `\x1b[2J`" in refused(rb'{"\u001b[2J": 1}', Outer)


@given(st.binary(max_size=60) | st.text(alphabet='{}[]":,\\ab01e.-n', max_size=60).map(str.encode))
def test_bytes_of_any_kind_load_or_are_refused(raw: bytes) -> None:
    for kind in (object, Outer):
        with contextlib.suppress(CalibrationError):
            decode_json(raw, kind, "x")


json_values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**63) | st.floats(-1e300, 1e300) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)


@given(json_values)
def test_what_json_has_comes_back(value: object) -> None:
    assert decode_json(json.dumps(value).encode(), object, "x") == value
