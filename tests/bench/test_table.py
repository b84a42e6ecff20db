"""The table of the benchmark: every section can be asked for, and what could not be measured breaks no JSON."""

import importlib
import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from bench import filters
from bench.__main__ import SECTIONS, main
from bench.row import Row


@pytest.mark.parametrize("section", SECTIONS)
def test_every_section_is_there_and_in_the_help(section: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert callable(importlib.import_module(f"bench.{section}").rows)
    with pytest.raises(SystemExit):
        main(["--help"])
    assert f"\n  {section:18s} {SECTIONS[section]}\n" in capsys.readouterr().out


def test_a_row_without_a_number_is_null_in_json(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def made() -> Iterator[Row]:
        yield Row("lag", 1.5, "ms", "goal 2")
        yield Row("of nothing", float("nan"), "mm", "")

    monkeypatch.setattr(filters, "rows", made)
    assert main(["filters", "--json", str(tmp_path / "rows.json")]) == 0
    rows = json.loads((tmp_path / "rows.json").read_text())["filters"]
    assert [row["value"] for row in rows] == [1.5, None]
    assert "lag" in capsys.readouterr().out


def test_a_section_that_is_not_there_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["nothing"])
    assert "unknown section 'nothing'" in capsys.readouterr().err
