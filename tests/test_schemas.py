"""docs/schema holds the JSON schema of every file a user may write, exported from the types: `make schema`."""

from pathlib import Path

import msgspec
import pytest

from common.calibration import CameraCalibration, HandProfile, RigCalibration, schema
from common.frame_recording import Manifest
from common.gesture_settings import GestureSettings
from common.object_profile import ObjectProfile

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "schema"
KINDS: dict[str, type[msgspec.Struct]] = {
    "camera.json": CameraCalibration,
    "gestures.json": GestureSettings,
    "hand.json": HandProfile,
    "object.json": ObjectProfile,
    "recording.json": Manifest,
    "rig.json": RigCalibration,
}


def text_of(kind: type[msgspec.Struct]) -> str:
    """What the file must say, to the last byte."""
    return schema(kind).decode() + "\n"


@pytest.mark.parametrize("name", KINDS)
def test_the_schema_equals_the_type(name: str) -> None:
    path = FOLDER / name
    assert path.is_file(), f"{path} is missing: run `make schema`"
    assert path.read_text() == text_of(KINDS[name]), f"{path} is out of date: run `make schema`"


def test_no_schema_is_left_over() -> None:
    assert {path.name for path in FOLDER.iterdir()} == set(KINDS)


@pytest.mark.parametrize("name", KINDS)
def test_the_schema_refuses_unknown_keys_too(name: str) -> None:
    definitions = msgspec.json.decode(text_of(KINDS[name]), type=dict[str, object])["$defs"]
    for kind, definition in msgspec.convert(definitions, dict[str, dict[str, object]]).items():
        assert definition.get("additionalProperties") is False, kind


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for file, kind in KINDS.items():
        (FOLDER / file).write_text(text_of(kind))
