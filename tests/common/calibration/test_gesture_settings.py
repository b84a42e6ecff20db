"""The file of gestures: defaults, and what is refused with file and key."""

from pathlib import Path

import msgspec
import pytest

from common.calibration import load, parse, save
from common.calibration.gesture_settings import (
    GestureSettings,
    HoldSettings,
    PoseShape,
    Span,
    default_gestures,
)
from common.errors import CalibrationError
from common.sim.motion import POSES

FILE = Path(__file__).parents[3] / "calib_json" / "gestures" / "default.json"
WIDE = Span(low=0.0, high=1.0, soft=1.0)


def test_the_defaults_are_the_file_that_comes_with_the_project() -> None:
    assert load(FILE, GestureSettings) == default_gestures()


def test_the_study_poses_are_those_of_the_simulation() -> None:
    assert set(default_gestures().poses) == set(POSES)


def test_it_comes_back_as_it_was_saved(tmp_path: Path) -> None:
    mine = msgspec.structs.replace(
        default_gestures(), name="mine", poses={"one": PoseShape(ranges={"index_pip_deg": WIDE})}
    )
    save(tmp_path / "mine.json", mine)
    assert load(tmp_path / "mine.json", GestureSettings) == mine


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (
            {"poses": {"x": PoseShape(ranges={"index_pip_deg": Span(low=2.0, high=1.0, soft=1.0)})}},
            "poses.x.ranges",
        ),
        ({"hold": HoldSettings(begin=0.3, end=0.4)}, "hold.end"),
    ],
)
def test_contradictions_are_refused_with_their_key(change: dict[str, object], key: str) -> None:
    wrong = msgspec.structs.replace(default_gestures(), **change)
    with pytest.raises(CalibrationError, match=rf"here.json: {key}"):
        parse(msgspec.json.encode(wrong), GestureSettings, "here.json")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b'"index_bend_deg"', b'"sixth_bend_deg"'),  # a quantity that there is not
        (b'"soft":9.0', b'"soft":0.0'),
        (b'"begin":0.45', b'"begin":1.5'),
        (b'"hold":', b'"holt":'),
        (b'"version":1', b'"version":2'),
    ],
)
def test_what_the_types_refuse_names_the_file(old: bytes, new: bytes) -> None:
    text = msgspec.json.encode(default_gestures())
    assert old in text
    with pytest.raises(CalibrationError, match=r"here\.json"):
        parse(text.replace(old, new, 1), GestureSettings, "here.json")
