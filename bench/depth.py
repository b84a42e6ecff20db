"""Depth: how still a resting marker's depth stands, what the fits of disparity are worth, and the recorded sweeps.

Static: a hand at rest 0.6 m before the standard rig, rendered with fresh sensor noise in every frame, through detector,
pairing and triangulation, before and after the filter. Several places, because a centroid's noise depends on where
in a pixel it lies.
"""

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bench.played import message_of
from bench.row import Row
from common.arrays import Float
from common.calibration import HandProfile, load
from common.hand.model import HandModel
from common.sim.motion import REST, HandState, angles_of, base_pose
from common.sim.render import Renderer
from common.sim.scene import Scene, view_centre
from master.calibrate.depth.fit import fit_affine_disparity, fit_power_law, ideal_of, relative_error
from master.fabrik.depth import AffineDisparity
from master.rig.files import load_setup
from master.rig.pipeline import build_pipeline
from master.rig.setup import RigSetup
from master.run.stages import StageTimes
from slave.markers.detector import MarkerDetector

ROOT = Path(__file__).resolve().parents[1]
AWAY_M = 0.60
PLACES = 4
FRAMES = 120
SETTLING = 30  # frames for the filter to forget its start
RIG = AffineDisparity(37.3, 2.64)  # f B of the published optics, 0.3 deg of yaw
SWEEP_M = np.linspace(0.2, 1.0, 17)
SESSIONS = 300


@dataclass(frozen=True, slots=True)
class Resting:
    """A hand that does not move."""

    state: HandState
    period_s: float = 60.0

    def at(self, t_s: float) -> HandState:
        """The same at every time."""
        return self.state


@dataclass(frozen=True, slots=True, eq=False)
class Static:
    """One place of the hand.

    Attributes:
        raw_m, filtered_m: Depth (T, M) [m] along the rig's z.
        uv: (2, T, M, 2) centroids [px].
        sigma_px: (2, T, M) as the slaves state it.
    """

    raw_m: Float
    filtered_m: Float
    uv: Float
    sigma_px: Float


def rows() -> list[Row]:
    """Rows (name, value, unit, what it is held against)."""
    cv2.setNumThreads(1)
    return [*_static_rows(), *_fit_rows(), *_sweep_rows()]


def static(setup: RigSetup, place: int, frames: int = FRAMES) -> Static:
    """Render and track a hand at rest at one place, at the rate of the cameras; the first frames are not judged."""
    rng = np.random.default_rng([place, 60])
    rig = setup.rig
    model = HandModel.of(load(ROOT / "calib_json/hands" / f"{rig.hand}.json", HandProfile))
    angles = angles_of(model, np.array(REST, np.float64), np.zeros((5, 4)))
    centre = view_centre(rig)
    centre[2] = AWAY_M
    pose = base_pose(model, centre, rng.uniform(-0.004, 0.004, 3), np.zeros(3))
    # The finger tips lie nearer than the middle of the hand: move it until its caps are at the distance on average.
    resting = Resting(HandState(pose, angles))
    caps = model.marker_points(model.forward(pose, angles), rig.markers)
    pose[2, 3] += AWAY_M - float(caps[:, 2].mean())
    scene = Scene(rig, setup.cameras, model, resting, centre, (), seed=place)
    renderers = [Renderer(scene, name) for name in rig.cameras]
    detectors = [MarkerDetector(setup.cameras[name], rig.markers) for name in rig.cameras]
    pipeline = build_pipeline(setup, StageTimes())
    period_ns = round(1e9 / setup.cameras[rig.cameras[0]].frame_rate_hz)
    raw: list[Float] = []
    filtered: list[Float] = []
    seen = np.full((2, 2, frames, len(rig.markers), 2), np.nan)
    for k in range(frames):
        t_ns = 1_000_000_000 + k * period_ns
        for c, name in enumerate(rig.cameras):
            found = detectors[c].push(renderers[c].render(t_ns * 1e-9), t_ns)
            seen[0, c, k], seen[1, c, k] = found.uv, found.sigma_px[:, None]
            for solved in pipeline.push(message_of(name, k, t_ns, found)):
                raw.append(solved.pose.markers_raw_m[:, 2])
                filtered.append(solved.pose.markers_m[:, 2])
    keep = slice(SETTLING, None)
    return Static(np.array(raw)[keep], np.array(filtered)[keep], seen[0, :, keep], seen[1, :, keep, :, 0])


def _static_rows() -> list[Row]:
    """Noise of the depth of all markers of a resting hand, beside D^2 / (f B) sqrt(2) sigma."""
    setup = load_setup(ROOT / "calib_json", "desk")
    runs = [static(setup, place) for place in range(PLACES)]
    raw = 1e3 * np.concatenate([run.raw_m.std(axis=0, ddof=1) for run in runs])
    filtered = 1e3 * np.concatenate([run.filtered_m.std(axis=0, ddof=1) for run in runs])
    away = np.concatenate([run.raw_m.mean(axis=0) for run in runs])
    noise = np.concatenate([run.uv[..., 0].std(axis=1, ddof=1) for run in runs], axis=1)  # (2, markers)
    stated = np.concatenate([run.sigma_px.mean(axis=1) for run in runs], axis=1)
    left, right = (setup.models[name] for name in setup.rig.cameras)
    per_pixel = 1e3 * ideal_of(left, right).metres_per_pixel(away)
    expected, promised = per_pixel * np.hypot(*noise), per_pixel * np.hypot(*stated)
    at = f"{away.min():.2f}-{away.max():.2f} m, {raw.size} markers, {FRAMES - SETTLING} frames each"
    return [
        Row("resting hand: centroid noise along the rows", _rms(noise), "px RMS", f"stated {_rms(stated):.3f}; {at}"),
        Row("resting hand: depth before the filter", _rms(raw), "mm RMS", f"worst {raw.max():.2f}; goal <= 1"),
        Row(
            "  predicted, D^2/(f B) sqrt(2) sigma", _rms(expected), "mm RMS",
            f"worst {expected.max():.2f}; from stated sigma {_rms(promised):.2f}",
        ),
        Row("resting hand: depth after the filter", _rms(filtered), "mm RMS", f"worst {filtered.max():.2f}; goal <= 1"),
    ]  # fmt: skip


def _fit_rows() -> list[Row]:
    """Sessions with a ruler that errs by a millimetre and disparities that err by 0.1 px."""
    rng = np.random.default_rng(2)
    truth = RIG.disparity(SWEEP_M)
    errors: dict[str, list[float]] = {"power law": [], "affine": [], "affine, least squares in px": []}
    for _ in range(SESSIONS):
        x = RIG.disparity(SWEEP_M + rng.normal(0.0, 1e-3, SWEEP_M.size)) + rng.normal(0.0, 0.1, SWEEP_M.size)
        flat = np.linalg.lstsq(np.stack([1.0 / SWEEP_M, np.ones_like(x)], axis=1), x, rcond=None)[0]
        laws = (
            fit_power_law(x, SWEEP_M)[0],
            fit_affine_disparity(x, SWEEP_M)[0],
            AffineDisparity(float(flat[0]), float(flat[1])),
        )
        for name, law in zip(errors, laws, strict=True):
            errors[name].append(float(np.abs(relative_error(law, truth, SWEEP_M)).mean()))
    note = "yawed pair, 17 distances, 0.1 px and 1 mm of noise; error of the law over the range"
    return [Row(f"session: {name}", 100 * float(np.mean(e)), "% mean", note) for name, e in errors.items()]


def _sweep_rows() -> list[Row]:
    """The recorded sweeps through the commands a user calls."""
    data = Path(os.environ.get("PHALANX_DATASETS", ROOT / "../shared/datasets")).resolve() / "stereo"
    if not data.is_dir():
        return [Row("skipped", 0.0, "", f"no recordings at {data}: set PHALANX_DATASETS")]
    out: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        colours = Path(folder) / "colours"
        for camera in ("left", "right"):
            target = colours / "cameras" / f"{camera}.json"
            _run("slave", "colours", data / "calib_colors", "--camera", camera, "-o", target)
        for name in ("sweep_paper", "sweep_rough"):
            found, recording = Path(folder) / name, data / name
            for camera in ("left", "right"):
                target = found / f"detections_{camera}.npz"
                _run(
                    "slave",
                    "run",
                    "--name",
                    camera,
                    "--camera",
                    f"replay:{recording}",
                    "--calibration",
                    colours,
                    "-o",
                    target,
                )
            fit, checked = (_calibrate(verb, recording, found) for verb in ("depth", "verify"))
            law, models = fit["power_law"], fit["laws"]
            out += [
                Row(f"{name}: k", law["k_m"], "m", "published 45.433" if name == "sweep_paper" else ""),
                Row(f"{name}: z", law["z"], "", "published -1.035" if name == "sweep_paper" else ""),
                *(Row(f"{name}: {m}", models[m]["mean_percent"], "% mean", _most(models[m])) for m in models),
                Row(
                    f"{name}: stereo", checked["models"]["stereo"]["mean_percent"], "% mean",
                    f"{_most(checked['models']['stereo'])}; goal 0.5, max 1.2",
                ),
            ]  # fmt: skip
    return out


def _most(figures: dict[str, float]) -> str:
    return f"max {figures['max_percent']:.2f} %"


def _calibrate(verb: str, recording: Path, found: Path) -> Any:
    target = found / f"{verb}.json"
    _run("master", "calibrate", verb, recording, "--detections", found, "--json", target)
    return json.loads(target.read_text())


def _run(module: str, *arguments: object) -> None:
    command = [sys.executable, "-m", module, *map(str, arguments)]
    subprocess.run(command, check=True, capture_output=True, cwd=ROOT)


def _rms(values: Float) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
