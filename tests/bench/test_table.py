"""The table of the benchmarks: every one can be asked for, and what could not be measured breaks no JSON."""

import importlib
import json
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import pytest

from bench import pose_cost
from bench.__main__ import ALL, main
from bench.hands import mocap
from bench.report import Row
from master.run.app import StageTimes


@pytest.mark.parametrize("name", ALL)
def test_every_benchmark_is_there_and_in_the_help(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    module, what = ALL[name]
    found = importlib.import_module(f"bench.{module}")
    assert callable(getattr(found, "rows", None)) or callable(getattr(found, "main", None))
    with pytest.raises(SystemExit):
        main(["--help"])
    assert f"\n  {name:18s} {what}\n" in capsys.readouterr().out


def test_a_row_without_a_number_is_null_in_json(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def made() -> Iterator[Row]:
        yield Row("lag", 1.5, "ms", "goal 2")
        yield Row("of nothing", float("nan"), "mm", "")

    monkeypatch.setattr(mocap, "rows", made)
    assert main(["mocap", "--json", str(tmp_path / "rows.json")]) == 0
    rows = json.loads((tmp_path / "rows.json").read_text())["mocap"]
    assert [row["value"] for row in rows] == [1.5, None]
    assert "lag" in capsys.readouterr().out


def test_what_a_pose_costs_ends_with_a_line_of_json(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its keys are those that other tools look for."""
    names = ["desk: pairing", *pose_cost.FIGURES.values()]
    monkeypatch.setattr(
        pose_cost, "rows", lambda: (Row(name, k + 0.5, "", "") for k, name in enumerate(names))
    )
    assert main(["pose_cost"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == {
        "desk_ms": 1.5,
        "desk_estimator_ms": 2.5,
        "desk_gestures_ms": 3.5,
        "room_ms": 4.5,
        "fused_ms": 5.5,
        "wrist_triple_ms": 6.5,
        "compile_cold_s": 7.5,
        "start_warm_s": 8.5,
    }


@pytest.mark.parametrize(("rig", "stages"), [("desk", {"hand", "gestures"}), ("wrist", {"hand", "gestures"})])
def test_what_a_pose_costs_is_measured_from_sealed_datagrams(rig: str, stages: set[str]) -> None:
    times = StageTimes()
    turns = list(islice(pose_cost.turns(*pose_cost.played(rig, times)), 3))
    assert len(turns) == 3
    for poses, spent_ms in turns:
        assert 10 <= poses < 20
        assert spent_ms > 0.0
    assert stages <= times.total_us().keys()


def test_a_benchmark_that_is_not_there_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["nothing"])
    assert "unknown benchmark 'nothing'" in capsys.readouterr().err
