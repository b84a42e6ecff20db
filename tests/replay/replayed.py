"""Recordings replayed as `phalanx replay` does, but in this process; a tree of colours; what a replay left."""

import json
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from common.arrays import Float
from common.calibration import HsvRange
from common.recording.frame_recording import load_manifest
from slave.__main__ import main as slave
from slave.markers.classify import ColourTable, table_of
from tests.cli import invoke


@dataclass(frozen=True)
class Replay:
    """One replayed recording, and where the results are."""

    recording: Path
    out: Path

    @property
    def summary(self) -> dict[str, float]:
        return json.loads((self.out / "summary.json").read_text())

    def truth(self) -> dict[str, Float]:
        with np.load(self.recording / "truth.npz") as file:
            return {name: file[name] for name in file.files}

    def detections(self, camera: str) -> dict[str, Float]:
        with np.load(self.out / f"detections_{camera}.npz") as file:
            return {name: file[name] for name in file.files}


def command(root: Path, *arguments: object) -> str:
    """What a command prints, as a process of its own."""
    words = [sys.executable, "-m", *map(str, arguments)]
    done = subprocess.run(words, cwd=root, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, f"{' '.join(words)}\n{done.stdout}{done.stderr}"
    return done.stdout


_TABLES: dict[tuple[str, ...], ColourTable] = {}


def _table_of(markers: Sequence[str], ranges: Mapping[str, HsvRange] | None, where: str) -> ColourTable:
    """The table of these colours, made once."""
    key = (*markers, repr(ranges))
    if key not in _TABLES:
        _TABLES[key] = table_of(markers, ranges, where)
    return _TABLES[key]


def detect(recording: Path, camera: str, out: Path, *options: object) -> None:
    """Write detections_<camera>.npz."""
    words = ["run", "--name", camera, "--camera", f"replay:{recording}", *map(str, options)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("slave.markers.reloadable.table_of", _table_of)
        assert slave([*words, "-o", str(out / f"detections_{camera}.npz")]) == 0


def solve(recording: Path, detections: Path, out: Path, *options: object) -> Replay:
    """Solve what was detected; options as of `phalanx replay`."""
    done = invoke("replay", recording, "--detections", detections, "--out", out, *options)
    assert done.exit_code == 0, done.output
    return Replay(recording, out)


def replay(recording: Path, out: Path, *options: object) -> Replay:
    """Detect and solve; options that both take: --calibration or, of a wrist device, --hand."""
    for rig in load_manifest(recording).all_rigs:
        for camera in rig.cameras:
            detect(recording, camera, out, *options)
    return solve(recording, out, out, *options)


def colours_of(datasets: Path, tree: Path) -> Path:
    """Write into a tree the camera files with the colours of the clicks of calib_colors."""
    recording = datasets / "stereo" / "calib_colors"
    if not recording.is_dir():
        pytest.skip(f"no rendered stereo recordings at {recording.parent}")
    for camera in ("left", "right"):
        output = str(tree / "cameras" / f"{camera}.json")
        assert slave(["colours", str(recording), "--camera", camera, "-o", output]) == 0
    if not (tree / "hands").exists():
        shutil.copytree(datasets / "hands", tree / "hands")
    return tree
