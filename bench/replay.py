"""Recorded frames with exact truth through the whole line: what each recording scores."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from bench.row import Row
from master.commands.summary import read_summary

_ROOT = Path(__file__).parent.parent
_RECORDINGS = (
    "calib_colors",
    "static",
    "lights_0_warm",
    "translate_8ms",
    "flex90",
    "poses_left",
    "sweep_paper",
    "sweep_rough",
)


def rows() -> list[Row]:
    """Scores of every recording; a single named row where the data are absent."""
    data = Path(os.environ.get("PHALANX_DATASETS", _ROOT / "../shared/datasets")).resolve()
    if not (data / "stereo").is_dir():
        return [Row("skipped", 0.0, "", f"no recordings at {data}: set PHALANX_DATASETS")]
    out: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        calibration = Path(folder) / "calibration"
        (calibration / "cameras").mkdir(parents=True)
        (calibration / "hands").symlink_to(data / "hands")
        for camera in ("left", "right"):
            target = calibration / "cameras" / f"{camera}.json"
            _run("slave", "colours", data / "stereo/calib_colors", "--camera", camera, "-o", target)
        for name in _RECORDINGS:
            result = Path(folder) / name
            _run("master", "replay", data / "stereo" / name, "--calibration", calibration, "--out", result)
            summary = read_summary(result / "summary.json")
            for key, label, unit, goal in _SCORES:
                if isinstance(value := summary.get(key), int | float):
                    out.append(Row(f"{name}: {label}", float(value), unit, goal))
    return out


_SCORES = (
    ("marker_raw_mm", "cap, median, before the filter", "mm", "goal 4"),
    ("joint_mm_visible", "joints of visible fingers, mean", "mm", "goal 8"),
    ("pip_deg_visible", "PIP of visible fingers, mean", "deg", ""),
    ("joint_mm", "all joints, mean", "mm", ""),
)


def _run(module: str, *arguments: object) -> None:
    subprocess.run(
        [sys.executable, "-m", module, *map(str, arguments)], check=True, capture_output=True, cwd=_ROOT
    )
