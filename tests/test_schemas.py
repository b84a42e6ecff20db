"""docs/schema holds the JSON schema of every file a user may write, and of the bus, from the types: `make schema`."""

from pathlib import Path
from typing import get_args

import msgspec
import pytest

from common.arrays import Float
from common.calibration import CameraCalibration, HandProfile, RigCalibration, schema
from common.calibration.gesture_settings import GestureSettings
from common.calibration.object_profile import ObjectProfile
from common.calibration.output_settings import OutputSettings
from common.errors import MessageError
from common.link.handshake import state_pages
from common.messages import AnyMessage, HandPose, Health, decode, encode
from common.messages.schema import bounds_table, bus_schema
from common.messages.state import METRICS, is_known, metrics_page
from common.recording.frame_recording import Manifest

MESSAGES = "messages.json"
FOLDER = Path(__file__).resolve().parents[1] / "docs" / "schema"
KINDS: dict[str, type[msgspec.Struct]] = {
    "camera.json": CameraCalibration,
    "gestures.json": GestureSettings,
    "hand.json": HandProfile,
    "object.json": ObjectProfile,
    "outputs.json": OutputSettings,
    "recording.json": Manifest,
    "rig.json": RigCalibration,
}


ALL = (*KINDS, MESSAGES)
WIRE = FOLDER.parent / "wire.md"
METRICS_PAGE = FOLDER.parent / "metrics.md"
MADE = {"bounds": bounds_table, "handshake": state_pages}


def with_made_parts(page: str) -> str:
    """Return the page of the wire with its generated parts as the code has them."""
    for name, make in MADE.items():
        begin, end = f"<!-- {name}: `make schema` writes this -->\n\n", f"\n<!-- end of {name} -->"
        before, rest = page.split(begin)
        page = before + begin + make() + end + rest.split(end)[1]
    return page


def text_of(name: str) -> str:
    """What the file must say, to the last byte."""
    return (bus_schema() if name == MESSAGES else schema(KINDS[name])).decode() + "\n"


@pytest.mark.parametrize("name", ALL)
def test_the_schema_equals_the_type(name: str) -> None:
    path = FOLDER / name
    assert path.is_file(), f"{path} is missing: run `make schema`"
    assert path.read_text() == text_of(name), f"{path} is out of date: run `make schema`"


def test_the_page_of_the_wire_lists_the_bounds_of_every_message() -> None:
    assert with_made_parts(WIRE.read_text()) == WIRE.read_text(), f"{WIRE} is out of date: run `make schema`"
    for kind in get_args(AnyMessage):
        numbers = {field.name for field in msgspec.structs.fields(kind) if field.type in (float, int, Float)}
        assert not numbers, f"{kind.__name__}: {', '.join(numbers)}: a number without bounds"


def test_the_page_of_metrics_is_the_table() -> None:
    assert METRICS_PAGE.read_text() == metrics_page(), f"{METRICS_PAGE} is out of date: run `make schema`"
    assert len({metric.name for metric in METRICS}) == len(METRICS)


@pytest.mark.parametrize(
    ("name", "known"),
    [
        ("rate_hz", True),
        ("rate_khz", False),
        ("left.clock_offset_us", True),
        ("left.clock_offset_s", False),
        (".clock_offset_us", False),
        ("colour.index", True),
        ("colour.", False),
        (f"overlap.{30 * 'a'}..{30 * 'b'}"[:64], True),
        (64 * "a", False),
    ],
)
def test_a_health_with_a_metric_that_is_not_in_the_table_is_refused(name: str, known: bool) -> None:
    assert is_known(name) == known
    if known:
        assert Health("left", 1, 2, {}, {name: 1.0}).metrics == {name: 1.0}
        return
    with pytest.raises(ValueError, match="is not in the table of metrics"):
        Health("left", 1, 2, {}, {name: 1.0})
    good = encode(Health("left", 1, 2, {}, {"rate_hz": 1.0}))
    with pytest.raises(MessageError, match="not in the table"):
        decode(good.replace(b"rate_hz", name.encode()[:7].ljust(7, b"x")))


def test_no_schema_is_left_over() -> None:
    assert {path.name for path in FOLDER.iterdir()} == set(ALL)


@pytest.mark.parametrize("name", ALL)
def test_the_schema_refuses_unknown_keys_too(name: str) -> None:
    definitions = msgspec.json.decode(text_of(name), type=dict[str, object])["$defs"]
    for kind, definition in msgspec.convert(definitions, dict[str, dict[str, object]]).items():
        assert definition.get("additionalProperties") is False, kind


def test_the_schema_of_the_bus_says_of_every_field_how_it_travels() -> None:
    definitions = msgspec.json.decode(bus_schema(), type=dict[str, object])["$defs"]
    parts = msgspec.convert(definitions, dict[str, dict[str, object]])
    assert {kind.__name__ for kind in get_args(AnyMessage)} <= set(parts)
    fields = msgspec.convert(parts["HandPose"]["properties"], dict[str, dict[str, object]])
    assert set(fields) == {"type", *(field.encode_name for field in msgspec.structs.fields(HandPose))}
    assert all(fields.values())
    assert [fields[name].get("x-dtype") for name in ("position_m", "source", "valid", "t_ns")] == [
        "<f8",
        "u1",
        "?",
        None,
    ]


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for file in ALL:
        (FOLDER / file).write_text(text_of(file))
    METRICS_PAGE.write_text(metrics_page())
    WIRE.write_text(with_made_parts(WIRE.read_text()))
