"""A folder that is made once: whole or not at all, and not a second time."""

from pathlib import Path

import pytest

from tests.cached import key_of, made_once


def test_it_is_made_once_and_what_was_worked_with_goes(tmp_path: Path) -> None:
    made: list[Path] = []

    def make(folder: Path) -> None:
        made.append(folder)
        (folder / "file").write_text("whole")
        (folder.parent / "work").write_text("beside it")

    place = tmp_path / "cache/one"
    assert made_once(place, make) == made_once(place, make) == place
    assert len(made) == 1
    assert [path.name for path in tmp_path.rglob("*")] == ["cache", "one", "file"]


def test_what_fails_leaves_nothing(tmp_path: Path) -> None:
    def make(folder: Path) -> None:
        (folder / "half").write_text("")
        raise RuntimeError("planted")

    with pytest.raises(RuntimeError, match="planted"):
        made_once(tmp_path / "one", make)
    assert list(tmp_path.iterdir()) == []


def test_other_inputs_have_another_name() -> None:
    assert key_of("a") == key_of("a") != key_of("b")
