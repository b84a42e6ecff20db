"""From laser points to flexion: simulated hands whose flesh no table knows, and rendered ones (PHALANX_DATASETS).

Exact points tell what the table costs; points with 0.3 px of noise and points found in the frames, what is left of it.
Only fingers that the pose calls tracked count, at a PIP up to 85 degrees.
"""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np

from bench.row import Row, median_us
from common.arrays import Bool, Float
from common.calibration import HandProfile, load
from common.frame_recording import Illumination, open_recording
from common.hand_model import CHAINS, HandModel
from common.messages import HandPose, WristDetections
from common.sim.wrist.scene import WristScene
from master.rig import load_setup
from master.wrist.forward import ForwardTable
from master.wrist.invert import Inverse
from master.wrist.pipeline import WristPipeline
from master.wrist.setup import WristSetup
from slave.wrist.offline import detect_wrist_recording

_ROOT = Path(__file__).parent.parent
_SEEDS = (11, 12, 13, 14, 15, 16)
_POSES = 40
_NOISE_PX = 0.3
_TRIPLE_NS = 33_333_333
_USUAL_RAD = np.radians(85.0)
_CLOSED_RAD = np.radians(105.0)
_RECORDINGS = {"curl": "right", "spread": "right", "mcp": "right", "left_small": "left-small"}


def rows() -> Iterator[Row]:
    """One row per kind of hand and points, then what a message costs."""
    yield from _simulated()
    data = Path(os.environ.get("PHALANX_DATASETS", _ROOT / "../shared/datasets")).resolve()
    if not (data / "wrist").is_dir():
        yield Row("skipped", 0.0, "", f"no recordings at {data}: set PHALANX_DATASETS")
        return
    for name, hand in _RECORDINGS.items():
        yield from _rendered(data / "wrist" / name, data / "hands" / f"webxr-{hand}.json")


def _simulated() -> Iterator[Row]:
    setups = [load_setup(_ROOT / "calib_json", rig) for rig in ("wrist", "wrist-left")]
    tables = [Inverse(ForwardTable.of(rig.wrist)) for rig in setups if rig.wrist is not None]
    error: dict[str, list[Float]] = {"exact": [], "noise": [], "cubic": []}
    missed = said = closed = 0
    for k, seed in enumerate(_SEEDS):
        rig, inverse = setups[k % 2], tables[k % 2]
        assert rig.wrist is not None
        scene = WristScene.by_name("curl", rig.rig, rig.cameras, rig.hand.profile, seed)
        truths = [scene.truth(float(t)) for t in np.linspace(0.0, 0.5 * scene.motion.period_s, _POSES)]
        uv = np.array([now.laser_uv[1:6] for now in truths])
        pip = np.array([now.angles_rad[1:, 2] for now in truths])
        noise = _NOISE_PX * np.random.default_rng(seed).normal(size=uv.shape)
        for kind, cubic, points in (("exact", False, uv), ("noise", False, uv + noise), ("cubic", True, uv)):
            found, tracked = _solved(replace(rig.wrist, cubic=cubic), inverse, points, _NOISE_PX)
            error[kind].append((found - pip)[tracked & (pip <= _USUAL_RAD)])
            if kind == "exact":
                missed += int((~tracked & (pip <= _USUAL_RAD)).sum())
                said += int((~tracked & (pip >= _CLOSED_RAD)).sum())
                closed += int((pip >= _CLOSED_RAD).sum())
    by_hand = [_rms(one) for one in error["exact"]]
    spread = f"hands {min(by_hand):.1f} to {max(by_hand):.1f}"
    goal = "goal 2"
    yield Row(
        "simulated hands, exact points: PIP to 85 deg, RMS", _rms(*error["exact"]), "deg", f"{goal}; {spread}"
    )
    yield Row("  with 0.3 px of noise", _rms(*error["noise"]), "deg", goal)
    yield Row("  the printed cubic", _rms(*error["cubic"]), "deg", "baseline")
    yield Row("  fingers not tracked, PIP to 85 deg", missed, "", f"of {_POSES * 4 * len(_SEEDS)} poses")
    yield Row("  said to be bent past the table, PIP over 105 deg", 100.0 * said / closed, "%", "goal 100")
    yield from _cost(setups[0].wrist)


def _cost(setup: WristSetup | None) -> Iterator[Row]:
    assert setup is not None
    pipeline = WristPipeline(setup)
    uv = setup.optics.project(np.array([[x, 0.016, 0.12] for x in (0.05, 0.02, 0.0, -0.02, -0.04)]))
    at_ns = 0

    def step() -> None:
        nonlocal at_ns
        at_ns += _TRIPLE_NS
        pipeline.push(_message(uv, at_ns, _NOISE_PX))

    middle, half = median_us(step, 400)
    yield Row("one message, five fingers", middle, "us", f"goal 500; +- {half:.0f}")


def _rendered(folder: Path, hand: Path) -> Iterator[Row]:
    recording = open_recording(folder)
    rig = recording.manifest.wrist_rig()
    camera = rig.cameras[0]
    setup = WristSetup.of(rig, recording.manifest.cameras[camera], HandModel.of(load(hand, HandProfile)))
    truth = np.load(folder / "truth.npz")
    pip = truth["angles"][:, [7, 11, 15, 19]]
    exact = setup.optics.project(truth["laser_pt"][:, 1:6])
    seen = detect_wrist_recording(folder, camera, hand_file=hand).detections
    row = np.searchsorted(
        [frame.t_ns for frame in recording.frames_of(camera) if frame.illumination is Illumination.LASER],
        seen.t_ns,
    )
    inverse = Inverse(ForwardTable.of(setup))
    from_frames = _solved(setup, inverse, seen.laser_uv, seen.laser_sigma_px, seen.laser_px)
    for what, (found, tracked), exactly in (
        ("exact points", _solved(setup, inverse, exact, _NOISE_PX), pip),
        ("points found in its frames", from_frames, pip[row]),
        (
            "exact points, the printed cubic",
            _solved(replace(setup, cubic=True), inverse, exact, _NOISE_PX),
            pip,
        ),
    ):
        usual = tracked & (exactly <= _USUAL_RAD) & np.isfinite(found)
        error = (found - exactly)[usual]
        note = f"median {np.degrees(np.median(np.abs(error))):.2f}, {usual.sum()} fingers"
        yield Row(f"{folder.name}, {what}: PIP, RMS", _rms(error), "deg", note)


def _solved(
    setup: WristSetup, inverse: Inverse, uv: Float, sigma_px: Float | float, length_px: Float | None = None
) -> tuple[Float, Bool]:
    """PIP (T, 4) [rad] of index ... little and whether they are tracked, of unrelated points (T, 5, 2)."""
    pipeline = WristPipeline(setup, continuous=False, inverse=inverse)
    sigma = np.broadcast_to(sigma_px, uv.shape[:2])
    poses: list[HandPose] = []
    for k, points in enumerate(uv):
        message = _message(points, (k + 1) * _TRIPLE_NS, sigma[k])
        if length_px is not None:
            message = msgspec.structs.replace(message, laser_px=length_px[k])
        poses += [solved.pose for solved in pipeline.push(message)]
    pip = np.array([pose.angles_rad[1:, 2] for pose in poses])
    return pip, np.array([pose.tracked[CHAINS[1:, 1]] for pose in poses])


def _message(uv: Float, t_ns: int, sigma_px: Float | float) -> WristDetections:
    nan = np.full(5, np.nan)
    return WristDetections(
        camera="wrist",
        session=1,
        seq=t_ns // _TRIPLE_NS,
        t_ns=t_ns,
        ready_t_ns=t_ns,
        laser_uv=uv,
        laser_sigma_px=np.where(np.isnan(uv).any(axis=1), np.nan, sigma_px),
        laser_px=nan,
        tip_uv=np.full((5, 2), np.nan),
        tip_sigma_px=nan,
        tip_depth=nan,
    )


def _rms(*error_rad: Float) -> float:
    error = np.degrees(np.concatenate(error_rad))
    return float(np.sqrt(np.mean(error**2))) if len(error) else float("nan")
