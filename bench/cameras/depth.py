"""Depth: how still a resting marker's depth stands.

A hand at rest 0.6 m before the rig `desk`, rendered with new sensor noise in every frame, through detector,
synchronisation and triangulation, before and after the filter. Several places: a centroid's noise depends on where in
a pixel it lies.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from bench.played import START_NS, Trajectory, message_of
from bench.report import CALIBRATION, Row, rig_files, rms
from common.arrays import Float
from common.hand.model import HandModel
from common.sim.motion import REST, HandState, angles_of, base_pose
from common.sim.render import Renderer
from common.sim.scene import Scene, view_centre
from master.calibrate.depth.fit import ideal_of
from master.rig.pipeline import build_pipeline
from master.rig.setup import RigSetup, load_setup
from master.run.app import StageTimes
from slave.markers.detector import MarkerDetector

AWAY_M = 0.60
SETTLING = 30  # frames for the filter to forget its start
_FRAMES = 120


@dataclass(frozen=True, slots=True, eq=False)
class Static:
    """One place of the hand."""

    raw_m: Float  # depth (T, M) along the rig's z
    filtered_m: Float  # (T, M)
    uv: Float  # (2, T, M, 2) centroids [px]


def rows() -> Iterator[Row]:
    """Measure a resting hand."""
    cv2.setNumThreads(1)
    desk = load_setup(CALIBRATION, "desk")
    yield from _static_rows(desk)


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
    resting = Trajectory(lambda _t_s: HandState(pose, angles))
    caps = model.marker_points(model.forward(pose, angles), rig.markers)
    pose[2, 3] += AWAY_M - float(caps[:, 2].mean())
    scene = Scene(rig, setup.cameras, model, resting, centre, (), seed=place)
    renderers = [Renderer(scene, name) for name in rig.cameras]
    detectors = [MarkerDetector(setup.cameras[name], rig.markers) for name in rig.cameras]
    pipeline = build_pipeline(setup, StageTimes())
    period_ns = round(1e9 / setup.cameras[rig.cameras[0]].frame_rate_hz)
    raw: list[Float] = []
    filtered: list[Float] = []
    seen = np.full((2, frames, len(rig.markers), 2), np.nan)
    for k in range(frames):
        t_ns = START_NS + k * period_ns
        for c, name in enumerate(rig.cameras):
            found = detectors[c].push(renderers[c].render(t_ns * 1e-9), t_ns)
            seen[c, k] = found.uv
            for solved in pipeline.push(message_of(name, k, t_ns, found)):
                raw.append(solved.pose.markers_raw_m[:, 2])
                filtered.append(solved.pose.markers_m[:, 2])
    keep = slice(SETTLING, None)
    return Static(np.array(raw)[keep], np.array(filtered)[keep], seen[:, keep])


def _static_rows(setup: RigSetup) -> Iterator[Row]:
    """Noise of the depth of all markers of a resting hand, beside D^2 / (f B) sqrt(2) sigma."""
    places = 4
    runs = [static(setup, place) for place in range(places)]
    raw = 1e3 * np.concatenate([run.raw_m.std(axis=0, ddof=1) for run in runs])
    filtered = 1e3 * np.concatenate([run.filtered_m.std(axis=0, ddof=1) for run in runs])
    away = np.concatenate([run.raw_m.mean(axis=0) for run in runs])
    noise = np.concatenate([run.uv[..., 0].std(axis=1, ddof=1) for run in runs], axis=1)  # (2, markers)
    left, right = (setup.models[name] for name in setup.rig.cameras)
    per_pixel = 1e3 * ideal_of(left, right).metres_per_pixel(away)
    expected = per_pixel * np.hypot(*noise)
    at = f"{away.min():.2f}-{away.max():.2f} m, {raw.size} markers, {_FRAMES - SETTLING} frames each"
    note = f"worst {raw.max():.2f}; goal <= 1; {at}"
    yield Row("resting hand: depth before the filter", rms(raw), "mm RMS", note)
    yield Row("  predicted, D^2/(f B) sqrt(2) sigma", rms(expected), "mm RMS", f"worst {expected.max():.2f}")
    note = f"worst {filtered.max():.2f}; goal <= 1"
    yield Row("resting hand: depth after the filter", rms(filtered), "mm RMS", note)
