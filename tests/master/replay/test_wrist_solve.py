"""A wrist recording offline: files in, the same bytes out on every run, errors that name the file."""

import json
from pathlib import Path

import numpy as np
import pytest

from common.arrays import Float
from common.errors import RecordingError
from common.geometry.transforms import quaternion_to_matrix
from common.messages import WristDetections
from common.recording.frame_recording import FrameRecording, FrameRow, Illumination, Manifest
from common.sim.wrist.scene import WristTruth
from master.outputs.poses import Poses
from master.replay.offline import solve
from master.replay.recorded import recorded_cycles
from master.rig.setup import RigSetup
from tests.hand_helpers import camera_file, rig_file
from tests.wrist_run import CYCLE_NS, START_NS, exact_cycle, wrist_scene, wrist_setup

N = 12
ARRAYS = ("laser_uv", "laser_sigma_px", "laser_px", "tip_uv", "tip_sigma_px", "tip_depth")


@pytest.fixture(scope="module")
def setup(root: Path) -> RigSetup:
    return wrist_setup(root)


@pytest.fixture(scope="module")
def truths(setup: RigSetup) -> list[WristTruth]:
    scene = wrist_scene(setup, "curl")
    return [scene.truth(float(t)) for t in np.linspace(0.5, 3.0, N)]  # an open hand that closes


@pytest.fixture(scope="module")
def cycles(setup: RigSetup, truths: list[WristTruth]) -> list[WristDetections]:
    return [exact_cycle(setup, now, k) for k, now in enumerate(truths)]


def write_detections(folder: Path, cycles: list[WristDetections], **changes: object) -> None:
    data: dict[str, object] = {name: np.array([getattr(one, name) for one in cycles]) for name in ARRAYS}
    data |= {name: np.array([getattr(one, name) for one in cycles], np.int64) for name in ("t_ns", "seq")}
    data |= changes
    np.savez(
        folder / "detections_wrist.npz",
        **{name: array for name, array in data.items() if array is not None},  # pyright: ignore[reportArgumentType]
    )


def recording(folder: Path, setup: RigSetup, *, continuous: bool = False) -> FrameRecording:
    manifest = Manifest(version=1, kind="wrist", cameras=setup.cameras, rig=setup.rig, continuous=continuous)
    lit = (Illumination.AMBIENT, Illumination.LASER, Illumination.LED)
    rows = [
        FrameRow("wrist", 3 * k + j, START_NS + k * CYCLE_NS + (j - 1) * 11_111_111, lit[j], f"{k}-{j}.png")
        for k in range(N)
        for j in range(3)
    ]
    return FrameRecording(folder, manifest, tuple(rows))


def write_truth(folder: Path, truths: list[WristTruth]) -> None:
    angles = np.zeros((N, 21))
    angles[:, [7, 11, 15, 19]] = [now.angles_rad[1:, 2] for now in truths]
    arrays = {name: np.array([getattr(now, name) for now in truths]) for name in
              ("laser_pt", "laser_len_vis", "tip_uv", "tip_visible")}  # fmt: skip
    joints = np.array([now.joints.position_m[1:] for now in truths])
    np.savez(folder / "truth.npz", joints=joints, angles=angles, **arrays)  # pyright: ignore[reportArgumentType]


def test_a_recording_is_solved_scored_and_repeated_byte_by_byte(
    tmp_path: Path, setup: RigSetup, truths: list[WristTruth], cycles: list[WristDetections]
) -> None:
    write_detections(tmp_path, cycles)
    write_truth(tmp_path, truths)
    progress: list[tuple[int, int]] = []
    outs = [tmp_path / "first", tmp_path / "second"]
    summary: dict[str, object] = {}
    for out in outs:
        out.mkdir()
        opened = recording(tmp_path, setup)
        summary = solve(opened, [setup], tmp_path, out, lambda d, t: progress.append((d, t)))
    assert (outs[0] / "poses.npz").read_bytes() == (outs[1] / "poses.npz").read_bytes()
    assert progress[:N] == [(k, N) for k in range(1, N + 1)]
    poses = Poses.load(outs[0] / "poses.npz")
    assert poses.marker_count == 0
    assert len(poses) == summary["poses"] == summary["poses_valid"] == N
    np.testing.assert_array_equal(poses.t_ns, [one.t_ns for one in cycles])
    stored = json.loads((outs[1] / "summary.json").read_text())
    assert stored == json.loads(json.dumps(summary))
    # A ray through the true centroid meets the plane in the true point.
    assert stored["laser_mm"] < 0.01
    assert stored["laser_right"] == 1.0
    assert stored["tip_px"] == stored["tip_false"] == 0.0
    assert stored["tip_within_6px"] == 1.0
    assert stored["cycles_missed"] == stored["lost"] == 0
    assert stored["camera_hz"]["wrist"] == pytest.approx(90.0, abs=0.1)
    for key in ("laser_mm_thumb", "laser_missed", "pip_rms_deg", "pip_deg", "joint_mm", "stage_us"):
        assert key in stored
    assert "marker_mm" not in stored


def test_cycles_that_are_missing_are_counted_and_their_points_are_missed(
    tmp_path: Path, setup: RigSetup, truths: list[WristTruth], cycles: list[WristDetections]
) -> None:
    write_detections(tmp_path, [one for k, one in enumerate(cycles) if k not in (3, 4, 7)])
    write_truth(tmp_path, truths)
    summary = solve(recording(tmp_path, setup), [setup], tmp_path, tmp_path)
    assert summary["lost"] == 3
    assert summary["cycles_missed"] == 3
    assert summary["poses"] == N - 3
    assert isinstance(summary["laser_missed"], float)
    assert summary["laser_missed"] >= 9
    assert summary["laser_mm"] == pytest.approx(0.0, abs=0.01)


def test_unrelated_poses_do_not_depend_on_their_order(
    tmp_path: Path, setup: RigSetup, cycles: list[WristDetections]
) -> None:
    backwards = list(reversed(cycles))
    angles: dict[str, Float] = {}
    for name, rows in (("there", cycles), ("back", backwards)):
        folder = tmp_path / name
        folder.mkdir()
        times = np.array([one.t_ns for one in cycles], np.int64)
        numbers = np.array([one.seq for one in cycles], np.int64)
        write_detections(folder, rows, t_ns=times, seq=numbers)
        solve(recording(folder, setup), [setup], folder, folder)
        angles[name] = Poses.load(folder / "poses.npz").angles_rad
    # Hinges and the unit of light are of the subject, and learnt from whatever pose comes.
    np.testing.assert_allclose(angles["there"], angles["back"][::-1], atol=np.radians(8.0))


def test_its_imu_turns_the_palm_in_the_world_and_nothing_in_the_camera(
    tmp_path: Path, setup: RigSetup, cycles: list[WristDetections]
) -> None:
    write_detections(tmp_path, cycles)
    solve(recording(tmp_path, setup), [setup], tmp_path, tmp_path)
    without = Poses.load(tmp_path / "poses.npz")
    assert np.isnan(without.palm_world_wxyz).all()
    rows = [f"{START_NS + 8_000_000 * k},0,0,0,0,0,9.81,1,0,0,0" for k in range(40)]
    header = "t_ns,gx,gy,gz,ax,ay,az,qw,qx,qy,qz"
    (tmp_path / "imu.csv").write_text("\n".join([header, *rows]) + "\n")
    summary = solve(recording(tmp_path, setup), [setup], tmp_path, tmp_path)
    found = Poses.load(tmp_path / "poses.npz")
    (tmp_path / "imu.csv").write_text(
        "\n".join([f"{header},heading_sigma", *(f"{row},0.3" for row in rows)]) + "\n"
    )
    solve(recording(tmp_path, setup), [setup], tmp_path, tmp_path)
    poses = Poses.load(tmp_path / "poses.npz")
    np.testing.assert_array_equal(found.position_m, without.position_m)
    np.testing.assert_array_equal(found.angles_rad, without.angles_rad)
    imu = setup.rig.imu
    assert imu is not None
    assert imu.q_palm_imu is not None
    received = (
        np.abs(found.t_ns - START_NS - 156_000_000) <= 206_000_000
    )  # the last sample is at 312 ms, and 50 ms
    assert received.any()
    np.testing.assert_array_equal(np.isfinite(found.palm_world_wxyz[:, 0]), received)
    np.testing.assert_allclose(
        quaternion_to_matrix(found.palm_world_wxyz[received]),
        np.broadcast_to(quaternion_to_matrix(np.array(imu.q_palm_imu)).T, (received.sum(), 3, 3)),
        atol=1e-9,
    )
    drift_rad = imu.heading_drift_rad_s * 1e-9 * (found.t_ns[received] - START_NS)  # as the rig file has it
    np.testing.assert_allclose(
        found.palm_world_sigma_rad[received, 1], drift_rad, atol=0.17
    )  # 50 ms at 3 rad/s
    assert found.palm_world_sigma_rad[received, 1].min() < 0.02
    np.testing.assert_allclose(poses.palm_world_sigma_rad[received, 1], 0.3, rtol=0.15)  # as the IMU says
    counts = summary["counts"]
    assert isinstance(counts, dict)
    assert counts["orientation.used"] == received.sum()
    assert counts.get("orientation.absent", 0) == (~received).sum()


def test_an_imu_that_gives_no_orientation_is_led_by_gravity(
    tmp_path: Path, setup: RigSetup, cycles: list[WristDetections]
) -> None:
    write_detections(tmp_path, cycles)
    force = 9.81 * np.array([0.0, 0.5, np.sqrt(0.75)])
    rows = [f"{START_NS + 8_000_000 * k},0,0,0,{','.join(map(str, force.tolist()))}" for k in range(-120, 60)]
    (tmp_path / "imu.csv").write_text("\n".join(["t_ns,gx,gy,gz,ax,ay,az", *rows]) + "\n")
    solve(recording(tmp_path, setup), [setup], tmp_path, tmp_path)
    found = Poses.load(tmp_path / "poses.npz")
    imu = setup.rig.imu
    assert imu is not None
    assert imu.q_palm_imu is not None
    up = quaternion_to_matrix(found.palm_world_wxyz)[:, 2] @ quaternion_to_matrix(np.array(imu.q_palm_imu))
    np.testing.assert_allclose(up, np.broadcast_to(force / 9.81, up.shape), atol=1e-4)
    np.testing.assert_allclose(found.palm_world_sigma_rad[:, 0], imu.orientation_sigma_rad, rtol=0.3)


def test_nothing_seen_in_any_cycle_is_no_crash_and_no_score(
    tmp_path: Path, setup: RigSetup, truths: list[WristTruth], cycles: list[WristDetections]
) -> None:
    nothing = {
        name: np.full(np.array([getattr(one, name) for one in cycles]).shape, np.nan) for name in ARRAYS
    }
    write_detections(tmp_path, cycles, **nothing)
    write_truth(tmp_path, truths)
    summary = solve(recording(tmp_path, setup), [setup], tmp_path, tmp_path)
    assert "laser_mm" not in summary
    assert summary["laser_right"] == 0.0
    assert summary["tip_within_6px"] == 0.0
    assert "tip_false" not in summary
    assert "pip_rms_deg" not in summary  # nothing is tracked


def test_no_cycles_at_all_are_no_poses(tmp_path: Path, setup: RigSetup) -> None:
    empty = {"t_ns": np.zeros(0, np.int64), "laser_uv": np.zeros((0, 5, 2)), "tip_uv": np.zeros((0, 5, 2))}
    np.savez(tmp_path / "detections_wrist.npz", **empty)  # pyright: ignore[reportArgumentType]
    summary = solve(recording(tmp_path, setup), [setup], tmp_path, tmp_path)
    assert summary["poses"] == 0


def test_files_of_the_three_columns_of_the_format_are_enough(
    tmp_path: Path, cycles: list[WristDetections]
) -> None:
    write_detections(tmp_path, cycles)
    full = list(recorded_cycles(tmp_path, "wrist"))
    rest = {name: None for name in (*ARRAYS, "seq") if name not in ("laser_uv", "tip_uv")}
    write_detections(tmp_path, cycles, **rest)
    short = list(recorded_cycles(tmp_path, "wrist"))
    for one, other, exact in zip(full, short, cycles, strict=True):
        np.testing.assert_array_equal(one.laser_uv, other.laser_uv)
        np.testing.assert_array_equal(one.tip_depth, exact.tip_depth)
        np.testing.assert_array_equal(np.isnan(other.tip_sigma_px), np.isnan(other.tip_uv[:, 0]))
        assert other.t_ns == exact.t_ns
    assert [one.seq for one in short] == [3 * k for k in range(N)]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"laser_uv": None}, "key 'laser_uv' is missing"),
        ({"tip_uv": np.zeros((N, 4, 2))}, "tip_uv has shape"),
        ({"laser_uv": np.zeros((N - 1, 5, 2))}, "laser_uv has shape"),
        ({"laser_px": np.zeros((N, 4))}, "laser_px has shape"),
        ({"seq": np.zeros(N - 1, np.int64)}, "seq has shape"),
        ({"t_ns": np.zeros(N)}, "Cannot cast"),
        ({"tip_sigma_px": np.zeros((N, 5))}, "row 0: tip_sigma_px: 0 is not within"),
        ({"laser_uv": np.full((N, 5, 2), np.inf)}, "row 0: laser_uv: inf is not within"),
        ({"laser_uv": np.full(N, "x")}, "could not convert"),
    ],
)
def test_a_broken_file_is_named_with_what_is_wrong_and_what_to_do(
    tmp_path: Path, cycles: list[WristDetections], changes: dict[str, object], message: str
) -> None:
    write_detections(tmp_path, cycles, **changes)
    with pytest.raises(RecordingError, match=rf"detections_wrist\.npz: .*{message}.*phalanx-slave run -o"):
        list(recorded_cycles(tmp_path, "wrist"))


@pytest.mark.parametrize("keep", [0, 1, 100, 2000])
def test_a_cut_file_is_named(tmp_path: Path, cycles: list[WristDetections], keep: int) -> None:
    write_detections(tmp_path, cycles)
    path = tmp_path / "detections_wrist.npz"
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(RecordingError, match=r"detections_wrist\.npz"):
        list(recorded_cycles(tmp_path, "wrist"))


def test_a_recording_of_both_kinds_is_solved_rig_by_rig(setup: RigSetup) -> None:
    markers = rig_file()
    cameras = {name: camera_file(name) for name in markers.cameras} | setup.cameras
    both = Manifest(version=1, kind="both", cameras=cameras, rigs=(setup.rig, markers))
    assert both.rig_named(None) is markers
    assert both.rig_named("wrist") is setup.rig
    alone = Manifest(version=1, kind="wrist", cameras=setup.cameras, rig=setup.rig)
    assert alone.rig_named(None) is setup.rig
    with pytest.raises(RecordingError, match="no rig 'third'; it has bench, wrist"):
        both.rig_named("third")
    with pytest.raises(RecordingError, match="it has none"):
        Manifest(version=1, kind="both", cameras={}).rig_named(None)
