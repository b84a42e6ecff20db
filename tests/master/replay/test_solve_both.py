"""A recording of cameras and wrist device of one hand: solved as one, scored against both truths; and either alone."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
import pytest

from bench.both.scene import Both, Observed, shown
from common.calibration import ImuCalibration
from common.errors import CalibrationError, RecordingError
from common.imu.csv_table import write_imu
from common.messages import ImuSample, MarkerDetections, WristDetections
from common.recording.frame_recording import FrameRecording, Manifest
from common.sim.record import named_angles
from common.sim.render import Renderer
from common.sim.wrist.record import WristTake
from master.outputs.poses import Poses
from master.replay.offline import rigs_to_solve, solve
from master.replay.recorded import recorded_samples
from master.rig.setup import RigSetup, setups_of
from tests.hand_helpers import LEFT

SECONDS = 0.4
MARKERS = ("t_ns", "seq", "uv", "quality", "sigma_px", "alt_uv")
CYCLES = ("t_ns", "seq", "laser_uv", "laser_sigma_px", "laser_px", "tip_uv", "tip_sigma_px", "tip_depth")


@dataclass(frozen=True)
class Recorded:
    """A recording without frames, whose detections and truth stand in its folder."""

    both: Both
    opened: FrameRecording

    def solve(
        self,
        out: Path,
        only: Literal["markers", "wrist"] | None = None,
        solver_mode: Literal["fk"] | None = None,
    ) -> dict[str, object]:
        rigs = rigs_to_solve(self.opened.manifest, [], only, solver_mode)
        out.mkdir()
        setups = setups_of(rigs, self.opened.manifest.cameras, lambda _name: self.both.markers.hand)
        return solve(self.opened, setups, self.opened.folder, out)


def write_detections(folder: Path, messages: Sequence[Observed]) -> None:
    cameras: dict[str, list[MarkerDetections | WristDetections]] = {}
    for message in messages:
        if not isinstance(message, ImuSample):
            cameras.setdefault(message.camera, []).append(message)
    for camera, seen in cameras.items():
        names = MARKERS if isinstance(seen[0], MarkerDetections) else CYCLES
        arrays = {name: np.array([getattr(one, name) for one in seen]) for name in names}
        arrays |= {"area_px2": np.array([one.area for one in seen if isinstance(one, MarkerDetections)])}
        np.savez(folder / f"detections_{camera}.npz", **arrays)  # pyright: ignore[reportArgumentType]


def write_truth(folder: Path, both: Both) -> None:
    times = np.arange(0.0, SECONDS, 1.0 / 60.0)
    truths = [both.scene.truth(t) for t in times.tolist()]
    renderers = [Renderer(both.scene, name) for name in both.markers.rig.cameras]
    arrays = {
        "t_ref": times,
        "joints": [one.joints.position_m[1:] for one in truths],
        "angles": [named_angles(both.scene.model, one.angles_rad) for one in truths],
        "paint_centroid": [one.markers_m for one in truths],
        "frac": [
            [np.nan_to_num(renderer.markers(t).visible) for renderer in renderers] for t in times.tolist()
        ],
    }
    wrist_scene = {
        f"wrist_{name}": array for name, array in WristTake(both.wrist_scene, SECONDS).truth().items()
    }
    np.savez(folder / "truth.npz", **arrays, **wrist_scene)  # pyright: ignore[reportArgumentType]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    folder = tmp_path_factory.mktemp("both")
    seen = shown("both-curl", SECONDS, 5)
    both = seen.both
    write_detections(folder, seen.messages)
    write_imu(folder, [one for one in seen.messages if isinstance(one, ImuSample)])
    write_truth(folder, both)
    cameras = both.markers.cameras | both.wrist.cameras
    manifest = Manifest(version=1, kind="both", cameras=cameras, rig=both.markers.rig, rigs=(both.wrist.rig,))
    return Recorded(both, FrameRecording(folder, manifest, ()))


def test_both_streams_make_one_hand_that_is_scored_against_both_truths(
    recorded: Recorded, tmp_path: Path
) -> None:
    summary = recorded.solve(tmp_path / "out", solver_mode="fk")
    poses = Poses.load(tmp_path / "out/poses.npz")
    assert len(poses) == summary["poses"]
    assert len(poses) > 15
    assert poses.marker_count == 6
    assert np.isfinite(poses.laser_m).any()
    assert set(summary) >= {"joint_mm", "pip_deg", "joint_mm_visible", "laser_mm", "laser_right", "cycles"}
    assert summary["joint_mm"] < 6.0  # type: ignore[operator]
    assert summary["laser_mm"] < 2.0  # type: ignore[operator]
    assert summary["cycles"] == len(np.load(recorded.opened.folder / "detections_wrist.npz")["t_ns"])
    assert summary["cycles_missed"] <= 1.0  # type: ignore[operator]
    assert summary["lost"] == 0
    assert summary["camera_hz"] == pytest.approx({"left": 60.0, "right": 60.0, "wrist": 90.0}, rel=1e-3)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "poses.npz",
        "summary.json",
        "gestures.jsonl",
    }


def test_either_stream_is_solved_alone_from_the_same_detections(
    recorded: Recorded, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    markers = recorded.solve(tmp_path / "markers", "markers")
    wrist = recorded.solve(tmp_path / "wrist", "wrist", "fk")
    assert "not used" not in caplog.text  # the IMU is of a rig that is left out
    assert set(markers) & {"joint_mm", "laser_mm", "cycles_missed"} == {"joint_mm"}
    assert set(wrist) & {"marker_mm", "laser_mm", "cycles_missed"} == {"laser_mm", "cycles_missed"}
    assert Poses.load(tmp_path / "wrist/poses.npz").marker_count == 0
    for name in ("left", "right"):
        assert name not in wrist["camera_hz"]  # type: ignore[operator]
    counts = wrist["counts"]
    assert isinstance(counts, dict)
    assert counts["orientation.missing"] > 20  # samples were told; what the filter makes of them needs longer


def test_what_is_not_there_is_refused_by_name(recorded: Recorded) -> None:
    manifest = recorded.opened.manifest
    with pytest.raises(RecordingError, match="no rig 'attic'; it has desk, wrist"):
        rigs_to_solve(manifest, ["attic"])
    with pytest.raises(RecordingError, match="no rig to solve of kind 'wrist'; it has desk of markers"):
        rigs_to_solve(manifest, ["desk"], "wrist")
    with pytest.raises(CalibrationError, match="--solver-mode: rig 'desk' is of markers"):
        rigs_to_solve(manifest, [], "markers", "fk")
    assert [rig.solver_mode for rig in rigs_to_solve(manifest, [], None, "fk")] == ["auto", "fk"]
    with pytest.raises(CalibrationError, match=r"--solver: .* of a wrist device"):
        rigs_to_solve(manifest, [], "wrist", None, "fabrik")
    solvers = [rig.solver for rig in rigs_to_solve(manifest, [], None, None, "fabrik")]
    assert solvers == ["fabrik", "estimator"]


def test_a_second_hand_has_files_of_its_own_and_no_score_of_the_first(
    recorded: Recorded, tmp_path: Path
) -> None:
    both, left = recorded.both, msgspec.structs.replace(recorded.both.markers.rig, hand="made-left")
    wrist_scene = msgspec.structs.replace(both.wrist.rig, solver_mode="fk")
    first = RigSetup.of(wrist_scene, both.wrist.cameras, both.wrist.hand)
    second = RigSetup.of(left, both.markers.cameras, LEFT)
    solve(recorded.opened, (first, second), recorded.opened.folder, tmp_path)
    names = {"poses.npz", "summary.json", "poses-made-left.npz", "summary-made-left.json", "gestures.jsonl"}
    assert {path.name for path in tmp_path.iterdir()} == names
    assert Poses.load(tmp_path / "poses-made-left.npz").hand == "made-left"
    other = msgspec.json.decode((tmp_path / "summary-made-left.json").read_bytes())
    assert "joint_mm" not in other


def test_an_imu_whose_world_is_not_placed_is_of_no_use_to_a_hand_with_markers(
    recorded: Recorded, caplog: pytest.LogCaptureFixture
) -> None:
    both = recorded.both
    assert both.wrist.rig.imu is not None
    unplaced = msgspec.structs.replace(both.wrist.rig, imu=ImuCalibration(q_palm_imu=(1.0, 0.0, 0.0, 0.0)))
    wrist_scene = RigSetup.of(unplaced, both.wrist.cameras, both.wrist.hand)
    samples, _ = recorded_samples(recorded.opened, RigSetup.joined([both.markers, wrist_scene]))
    assert samples == ()
    assert "imu.csv: not used" in caplog.text
    samples, _ = recorded_samples(recorded.opened, wrist_scene)
    assert len(samples) > 20
