"""A report is one table for a person and for programs, and each calibration ends in the same way."""

import json
from argparse import Namespace
from pathlib import Path

import numpy as np
import pytest

from master.calibrate.report import Column, Table, finish, plain

TABLE = Table(
    (
        Column("distance", np.array([0.5, 1.0]), ".1f", "m", "distance_m"),
        Column("law", np.array([-0.25, np.nan]), "+.2f", "%", "error_percent.law", (0.25, np.nan)),
        Column("", np.array([True, False]), key="used"),
        Column("note", ("", "rejected")),
    ),
    ("mean", "each left out"),
)


def test_what_is_unknown_is_a_dash_for_a_person_and_null_for_programs() -> None:
    assert TABLE.lines() == [
        "  distance      law  note",
        "     0.5 m  -0.25 %",
        "     1.0 m        -  rejected",
        "  mean       0.25 %",
        "  each left out        -",
    ]
    assert TABLE.json() == [
        {"distance_m": 0.5, "error_percent": {"law": -0.25}, "used": True},
        {"distance_m": 1.0, "error_percent": {"law": None}, "used": False},
    ]
    assert plain(np.array([[1.0, np.nan]])) == [[1.0, None]]
    assert plain(np.int64(3)) == 3


def test_without_out_nothing_is_written_and_with_it_the_paths_are_in_the_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    written, drawn = list[Path](), list[Path]()

    def write(out: Path) -> dict[Path, str]:
        written.append(out)
        return {out / "rigs" / "desk.json": "power_law"}

    report, picture = tmp_path / "report.json", tmp_path / "picture.png"
    for out in (None, tmp_path):
        options = Namespace(out=out, json_file=report, picture=picture)
        finish(options, ["a line"], {"k_m": 45.2}, drawn.append, write)
    first, _, second = capsys.readouterr().out.partition("nothing written: give --out DIR\n")
    assert first == f"a line\ndrew {picture}\n"
    assert second == f"a line\ndrew {picture}\nwrote {tmp_path / 'rigs' / 'desk.json'}: power_law\n"
    assert written == [tmp_path]
    assert drawn == [picture, picture]
    assert json.loads(report.read_text()) == {"k_m": 45.2, "written": [str(tmp_path / "rigs" / "desk.json")]}
