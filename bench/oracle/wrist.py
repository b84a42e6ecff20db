"""The oracle's sets of a wrist device: rendered hands, detected, and hands before both kinds of rig.

Of a device alone the palm stands where calibration found it, in the frame of its camera. Recorded hands are those of
the data folder, meshes are rendered by `bench.wrist_mesh`. Before both kinds of rig messages are made of the truth
(`bench.both.shown`), or found by both slaves in rendered frames (`bench.both.watched`). Hidden is a finger whose
tip is not in sight of the wrist camera; before both, one whose marker fewer than two cameras have in sight.
"""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np

from bench.both.scene import Both, Observed, Shown
from bench.both.shown import shown_of
from bench.both.watched import watched
from bench.oracle.freeze import Piece, calibration_files
from bench.oracle.recorded import angles_of, hand_of
from bench.oracle.scenes import truth_of
from bench.oracle.truth import Truth
from bench.report import CALIBRATION, command
from bench.wrist_mesh.sets import set_named, write_set
from common.errors import RecordingError
from common.hand.model import FINGERS
from common.messages import WristDetections
from common.recording.frame_recording import open_recording
from common.recording.recorded_files import read_npz
from master.evaluation.wrist_score import load_wrist_truth
from master.replay.recorded import recorded_cycles

RECORDED = ("curl", "mcp", "spread", "left_small")
MESHES = {"random": 24, "left_random": 16, "six": 6, "motion": 30}  # triples
FUSED = {
    "fused-poses": ("both-poses", "desk", "wrist"),
    "fused-curl": ("both-curl", "desk", "wrist"),
    "fused-travel": ("both-travel", "desk", "wrist"),
    "fused-grasp": ("grasp", "desk", "wrist"),
    "fused-grip": ("grasp", "desk-back3", "wrist-back3"),
    "fused-grip-slow": ("grasp", "desk-back3", "wrist-back3"),
}
RENDERED = {
    "rendered-grasp": ("grasp", "desk", "wrist"),
    "rendered-grip": ("grasp", "desk-back3", "wrist-back3"),
}
_SLOW, _EVERY = "fused-grip-slow", 3  # of the triples: as many as a busy machine makes
_MESH_SEED, _SEEDS, _SECONDS = 271, (31, 32), 8.0
_ABOUT_S = 0.02


def recorded(data: Path) -> Iterator[Piece]:
    """Rendered recordings of wrist devices; `data` is the data folder."""
    for name in RECORDED:
        yield _detected(data / "wrist" / name, data / "hands")


def meshes(data: Path) -> Iterator[Piece]:
    """Mesh hands, rendered now, with a seed that nothing is tuned by."""
    with tempfile.TemporaryDirectory() as name:
        for kind, cycles in MESHES.items():
            folder = Path(name) / kind
            write_set(set_named(kind, data, cycles, _MESH_SEED), data, folder, _MESH_SEED)
            yield _detected(folder, data / "hands")


def _detected(folder: Path, hands: Path) -> Piece:
    recording = open_recording(folder)
    rig = recording.manifest.wrist_rig()
    camera, hand = rig.cameras[0], hands / f"{rig.hand}.json"
    files = {
        f"rigs/{rig.name}.json": msgspec.json.encode(rig),
        f"cameras/{camera}.json": msgspec.json.encode(recording.manifest.cameras[camera]),
        f"hands/{rig.hand}.json": hand.read_bytes(),
    }
    with tempfile.TemporaryDirectory() as name:
        target = Path(name) / f"detections_{camera}.npz"
        command(
            "slave", "run", "--name", camera, "--camera", f"replay:{folder}", "--hand", hand, "-o", target
        )
        messages = list(recorded_cycles(Path(name), camera))
    found = load_wrist_truth(recording, camera)
    if found is None:
        raise RecordingError(f"{folder}: nothing says what is true of it")
    angles = angles_of(read_npz(folder / "truth.npz")["angles"])
    truth = Truth(found.t_ns, hand_of(found.joints_m), angles, recording.manifest.continuous)
    return Piece(folder.name, (rig.name,), files, messages, replace(truth, hidden=~found.tip_visible))


def fused(name: str, seconds: float = _SECONDS, seeds: Sequence[int] = _SEEDS) -> Iterator[Piece]:
    """A hand before marker cameras, with a wrist device and its IMU, once for each seed.

    `name`: a key of `FUSED` or `RENDERED`.
    """
    scene, *rigs = (FUSED | RENDERED)[name]
    sensed = watched if name in RENDERED else shown_of
    files = calibration_files(CALIBRATION, rigs[0]) | calibration_files(CALIBRATION, rigs[1])
    for seed in seeds:
        shown = sensed(Both.of(scene, seed, rigs=(rigs[0], rigs[1])), seconds)
        messages = _thinned(shown.messages) if name == _SLOW else shown.messages
        yield Piece(f"seed{seed}", tuple(rigs), files, messages, _truth_of(shown))


def _thinned(messages: list[Observed]) -> list[Observed]:
    """The same with every third triple alone; a triple has three frames."""
    return [one for one in messages if not isinstance(one, WristDetections) or one.seq // 3 % _EVERY == 0]


def _truth_of(shown: Shown) -> Truth:
    scene = shown.both.scene
    truth = truth_of(scene, shown.seconds)
    cameras = shown.line_of_sight.cameras_of(1e-9 * (truth.t_ns - truth.t_ns[0]), _ABOUT_S)
    markers = [scene.rig.markers.index(name) for name in FINGERS]
    return replace(truth, hidden=np.asarray(cameras[:, markers] < 2, np.bool_))
