"""Depth: how still a resting marker's depth stands, the law of the shipped rig, fits of disparity, recorded sweeps.

Static: a hand at rest 0.6 m before the rig `desk`, rendered with fresh sensor noise in every frame, through detector,
synchronisation and triangulation, before and after the filter. Several places, because a centroid's noise depends on
where in a pixel it lies. Law: depth by the shipped power law against triangulation, over the volume of the rig.
"""

import json
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bench.played import message_of
from bench.report import CALIBRATION, Row, command, datasets, rig_files, rms, skipped
from common.arrays import Float
from common.hand.model import HandModel
from common.sim.motion import REST, HandState, angles_of, base_pose
from common.sim.render import Renderer
from common.sim.scene import Scene, view_centre
from master.calibrate.depth.fit import fit_affine_disparity, fit_power_law, ideal_of, relative_error
from master.estimator.sensors import CameraArrays
from master.fabrik.depth import AffineDisparity
from master.fabrik.intersection import triangulate
from master.rig.pipeline import build_pipeline, line_of
from master.rig.setup import RigSetup, load_setup
from master.run.app import StageTimes
from slave.markers.detector import MarkerDetector

AWAY_M = 0.60
SETTLING = 30  # frames for the filter to forget its start
_PLACES, _FRAMES = 4, 120
_RIG = AffineDisparity(37.3, 2.64)  # f B of the published optics, 0.3 deg of yaw
_SWEEP_M = np.linspace(0.2, 1.0, 17)
_SESSIONS, _POINTS = 300, 4000


@dataclass(frozen=True, slots=True)
class Resting:
    """A hand that does not move."""

    state: HandState
    period_s: float = 60.0

    def at(self, t_s: float) -> HandState:
        """Return the same at every time."""
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


def rows() -> Iterator[Row]:
    """Measure a resting hand, the law, the fits and the sweeps."""
    cv2.setNumThreads(1)
    desk = load_setup(CALIBRATION, "desk")
    yield from _static_rows(desk)
    yield from _law_rows(desk)
    yield from _fit_rows()
    yield from _sweep_rows()


def static(setup: RigSetup, place: int, frames: int = _FRAMES) -> Static:
    """Render and track a hand at rest at one place, at the rate of the cameras; the first frames are not judged."""
    rng = np.random.default_rng([place, 60])
    rig = setup.rig
    model = HandModel.of(rig_files(rig.name)[2])
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


def _static_rows(setup: RigSetup) -> Iterator[Row]:
    """Noise of the depth of all markers of a resting hand, beside D^2 / (f B) sqrt(2) sigma."""
    runs = [static(setup, place) for place in range(_PLACES)]
    raw = 1e3 * np.concatenate([run.raw_m.std(axis=0, ddof=1) for run in runs])
    filtered = 1e3 * np.concatenate([run.filtered_m.std(axis=0, ddof=1) for run in runs])
    away = np.concatenate([run.raw_m.mean(axis=0) for run in runs])
    noise = np.concatenate([run.uv[..., 0].std(axis=1, ddof=1) for run in runs], axis=1)  # (2, markers)
    stated = np.concatenate([run.sigma_px.mean(axis=1) for run in runs], axis=1)
    left, right = (setup.models[name] for name in setup.rig.cameras)
    per_pixel = 1e3 * ideal_of(left, right).metres_per_pixel(away)
    expected = per_pixel * np.hypot(*noise)
    at = f"{away.min():.2f}-{away.max():.2f} m, {raw.size} markers, {_FRAMES - SETTLING} frames each"
    yield Row(
        "resting hand: centroid noise along the rows", rms(noise), "px RMS", f"stated {rms(stated):.3f}; {at}"
    )
    yield Row(
        "resting hand: depth before the filter", rms(raw), "mm RMS", f"worst {raw.max():.2f}; goal <= 1"
    )
    yield Row("  predicted, D^2/(f B) sqrt(2) sigma", rms(expected), "mm RMS", f"worst {expected.max():.2f}")
    note = f"worst {filtered.max():.2f}; goal <= 1"
    yield Row("resting hand: depth after the filter", rms(filtered), "mm RMS", note)


def _law_rows(desk: RigSetup) -> Iterator[Row]:
    """Depth by the shipped law against triangulation, of points over the whole volume, exact and with 0.1 px noise."""
    volume, cameras = desk.rig.volume, tuple(desk.models.values())
    assert volume is not None
    rng, line, count = np.random.default_rng(7), line_of(desk, StageTimes()), len(desk.rig.markers)
    points = rng.uniform(volume.low_m, volume.high_m, (_POINTS // count, count, 3))
    nothing = np.full((2, count), np.nan)
    for noise_px in (0.0, 0.1):
        off: list[Float] = []
        for some in points:
            uv = np.stack([camera.project(some) for camera in cameras])
            seen = ((uv > 0.0) & (uv < [cameras[0].width_px, cameras[0].height_px])).all(axis=(0, 2))
            uv = uv + rng.normal(0.0, noise_px, uv.shape)
            by_law = line.triangulate(uv, np.full((2, count), 0.1), nothing, None, 0.0, as_seen=True).points_m
            by_rays = triangulate(CameraArrays.of(cameras), uv, 0.1).points_m
            off.append((by_law - by_rays)[seen, 2])
        mm = 1e3 * np.concatenate(off)
        note = f"mean of sizes {np.abs(mm).mean():.2f}, worst {np.abs(mm).max():.1f}; goal 3"
        yield Row(f"power law against stereo, {noise_px} px noise: depth", float(mm.mean()), "mm", note)


def _fit_rows() -> Iterator[Row]:
    """Sessions with a ruler that errs by a millimetre and disparities that err by 0.1 px."""
    rng = np.random.default_rng(2)
    truth = _RIG.disparity(_SWEEP_M)
    errors: dict[str, list[float]] = {"power law": [], "affine": []}
    for _ in range(_SESSIONS):
        x = _RIG.disparity(_SWEEP_M + rng.normal(0.0, 1e-3, 17)) + rng.normal(0.0, 0.1, 17)
        laws = (fit_power_law(x, _SWEEP_M)[0], fit_affine_disparity(x, _SWEEP_M)[0])
        for name, law in zip(errors, laws, strict=True):
            errors[name].append(float(np.abs(relative_error(law, truth, _SWEEP_M)).mean()))
    for name, found in errors.items():
        yield Row(
            f"session: {name}",
            100.0 * float(np.mean(found)),
            "% mean",
            "yawed pair, 17 distances, 0.1 px, 1 mm",
        )


def _sweep_rows() -> Iterator[Row]:
    """The recorded sweeps through the commands a user calls."""
    data = datasets() / "stereo"
    if not data.is_dir():
        yield skipped("sweeps", data)
        return
    with tempfile.TemporaryDirectory() as folder:
        colours = Path(folder) / "colours"
        for camera in ("left", "right"):
            target = colours / f"cameras/{camera}.json"
            command("slave", "colours", data / "calib_colors", "--camera", camera, "-o", target)
        for name in ("sweep_paper", "sweep_rough"):
            found, recording = Path(folder) / name, data / name
            for camera in ("left", "right"):
                target = found / f"detections_{camera}.npz"
                place = ("--calibration", colours, "-o", target)
                command("slave", "run", "--name", camera, "--camera", f"replay:{recording}", *place)
            fit, checked = (_calibrated(verb, recording, found) for verb in ("depth", "verify"))
            published = ("published 45.433", "published -1.035") if name == "sweep_paper" else ("", "")
            yield Row(f"{name}: k", fit["power_law"]["k_m"], "m", published[0])
            yield Row(f"{name}: z", fit["power_law"]["z"], "", published[1])
            for law, figures in (fit["laws"] | {"stereo": checked["models"]["stereo"]}).items():
                yield Row(
                    f"{name}: {law}", figures["mean_percent"], "% mean", f"max {figures['max_percent']:.2f} %"
                )


def _calibrated(verb: str, recording: Path, found: Path) -> Any:
    target = found / f"{verb}.json"
    command("master", "calibrate", verb, recording, "--detections", found, "--json", target)
    return json.loads(target.read_text())
