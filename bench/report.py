"""Rows of a benchmark and how they are printed; where the project's files and the recordings lie."""

import json
import math
import os
import platform
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

from common.arrays import Float
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Arrays = TypeVar("Arrays", bound="DataclassInstance")

ROOT = Path(__file__).resolve().parents[1]
CALIBRATION = ROOT / "calib_json"
REGION = 7.815  # 95 % quantile of chi square with three degrees of freedom


class Row(NamedTuple):
    """One measurement: name, value, unit, and what it is compared with (goal, baseline, spread)."""

    name: str
    value: float
    unit: str
    note: str = ""


def datasets() -> Path:
    """Return the folder of recordings, by the environment variable PHALANX_DATASETS."""
    return Path(os.environ.get("PHALANX_DATASETS", ROOT / "../shared/datasets")).resolve()


def skipped(what: str, folder: Path) -> Row:
    """Return the row of a part whose recordings are absent."""
    return Row(f"{what}: skipped", 0.0, "", f"no recordings at {folder}: set PHALANX_DATASETS")


def rig_files(name: str) -> tuple[RigCalibration, dict[str, CameraCalibration], HandProfile]:
    """Load a shipped rig with its cameras and its hand."""
    rig = load(CALIBRATION / f"rigs/{name}.json", RigCalibration)
    cameras = {c: load(CALIBRATION / f"cameras/{c}.json", CameraCalibration) for c in rig.cameras}
    return rig, cameras, load(CALIBRATION / f"hands/{rig.hand}.json", HandProfile)


def command(module: str, *arguments: object) -> None:
    """Run a command of the project, for example `command("slave", "colours", ...)`."""
    words = [sys.executable, "-m", module, *map(str, arguments)]
    subprocess.run(words, check=True, capture_output=True, cwd=ROOT)


def detect(folder: Path, camera: str, target: Path, *options: object) -> None:
    """Have the slave find in a recording what it finds; `target`: where to."""
    command("slave", "run", "--name", camera, "--camera", f"replay:{folder}", *options, "-o", target)


def machine() -> dict[str, object]:
    """Return what a figure that depends on the machine was measured on."""
    return {"machine": platform.machine(), "cores": os.cpu_count(), "python": platform.python_version()}


def show(rows: Iterable[Row]) -> list[Row]:
    """Print rows as they are measured; return them."""
    out: list[Row] = []
    for row in rows:
        out.append(row)
        number = f"{row.value:.4g}" if abs(row.value) < 1e4 else f"{row.value:.0f}"
        print(f"  {row.name:58s} {number:>10s} {row.unit:8s} {row.note}", flush=True)
    return out


def write_json(file: Path, tables: Mapping[str, Sequence[Row]]) -> None:
    """Write rows by section; null stands for a value that could not be measured."""

    def plain(row: Row) -> dict[str, object]:
        fields: dict[str, object] = row._asdict()
        return fields | {"value": float(row.value) if math.isfinite(row.value) else None}

    found = {name: [plain(row) for row in rows] for name, rows in tables.items()}
    file.write_text(json.dumps(found, indent=1, allow_nan=False))


def rms(values: Float | Sequence[float]) -> float:
    """Return the root mean square of all finite values; NaN: there is none."""
    finite = np.asarray(values)[np.isfinite(values)]
    return float(np.sqrt(np.mean(np.square(finite)))) if finite.size else float("nan")


def inside(chi2: Float) -> float:
    """Return the share of squared errors (N,), in units of covariance, inside the 95 % region [%]."""
    return 100.0 * float((chi2 < REGION).mean())


def chi_squares(off: Float, cov: Float) -> Float:
    """Return squared errors (..., n) in units of their covariances (..., n, n)."""
    return np.vecdot(off, np.linalg.solve(cov, off[..., None])[..., 0])


def joined(parts: Sequence[Arrays]) -> Arrays:
    """Return dataclasses of arrays as one, each array end to end."""
    names = [field.name for field in fields(parts[0])]
    return replace(parts[0], **{n: np.concatenate([getattr(one, n) for one in parts]) for n in names})
