import socket
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest
import rerun as rr
from msgspec.structs import replace

from common.arrays import Image
from common.calibration import CameraCalibration, Volume
from common.errors import PhalanxError, RecordingError
from common.geometry.transforms import rigid
from common.hand.model import JOINTS, TIPS, HandModel
from common.hand.profiles import generated_profile
from common.messages import Command, HandPose, Health, Preview, Source
from master.outputs.bus import BusSink
from master.outputs.poses import Poses, PosesTruth
from master.outputs.rerun import ViewerProcess, run_viewer, viewer_arguments, write_rrd
from master.outputs.rerun_scene import RerunScene
from master.rig.setup import RigSetup
from tests.hand_helpers import camera_file, detections, rig_file
from tests.memory_bus import LoopbackBus
from tests.results import pose_of

MODEL = HandModel.of(generated_profile("test-hand", "right"))
RIG = rig_file(name="desk", hand="test-hand")
CAMERAS = {name: camera_file(name, row_time_us=20.0) for name in RIG.cameras}
SETUP = RigSetup.of(RIG, CAMERAS, MODEL)
STEP_NS = 16_666_667


def moving_hand(rows: int) -> list[HandPose]:
    """A hand that closes: middle finger's marker lost in row 3, whole little finger invalid in row 4."""
    T = rigid(np.diag([1.0, -1.0, -1.0]), np.array([0.04, 0.1, 0.42]))
    poses = []
    for i in range(rows):
        angles = np.full((5, 4), 0.05) + 0.1 * i * np.array([0.0, 1.0, 1.0, 0.6])
        joints = MODEL.forward(T, np.clip(angles, MODEL.limits_rad[..., 0], MODEL.limits_rad[..., 1]))
        source = np.full(26, Source.SOLVED, np.uint8)
        source[TIPS] = Source.MEASURED
        valid = np.ones(26, np.bool_)
        markers = MODEL.marker_points(joints, RIG.markers).copy()
        if i == 3:
            source[11:16], markers[2] = Source.HELD, np.nan
        if i == 4:
            valid[21:26] = False
        poses.append(
            pose_of(
                MODEL,
                joints,
                t_ns=10**15 + i * STEP_NS,
                valid=valid,
                tracked=valid & (source == Source.MEASURED),
                cov_m2=np.tile(np.diag([1e-6, 1e-6, 9e-6]), (26, 1, 1)),
                source=source,
                angles_rad=angles,
                markers_m=markers,
                markers_raw_m=markers + 0.001,
                latency_ns=8_000_000,
            )
        )
    return poses


def small_jpeg(width: int, height: int) -> bytes:
    return cv2.imencode(".jpg", np.full((height, width, 3), 90, np.uint8))[1].tobytes()


def truth_of(poses: Poses, off_m: float) -> PosesTruth:
    return PosesTruth(poses.position_m + np.array([off_m, 0.0, 0.0]), poses.markers_raw_m)


def rows_of(path: Path) -> dict[str, int]:
    """Rows of every entity that changes with time, read back by the SDK's own reader."""
    rows: dict[str, int] = {}
    for chunk in rr.chunk.RrdReader(path).stream():
        if not chunk.is_static:
            rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + chunk.num_rows
    return rows


def column(path: Path, entity: str, component: str) -> tuple[list[int], list[list[object]]]:
    """Times [ns] and values, row by row, of one component."""
    times: list[int] = []
    values: list[list[object]] = []
    for chunk in rr.chunk.RrdReader(path).stream():
        if chunk.entity_path == entity and not chunk.is_static:
            table = chunk.to_record_batch()
            name = next(key for key in table.schema.names if key.endswith(component))
            times += table.column("capture").cast("int64").to_pylist()
            values += table.column(name).to_pylist()
    return times, values


def test_a_run_written_as_rrd_is_all_there(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    poses = Poses.of(moving_hand(6))
    seen = [detections("left", i, int(t), np.full((6, 2), 100.0 + i)) for i, t in enumerate(poses.t_ns)]
    frames = [("right", int(t), np.full((48, 64, 3), 90, np.uint8)) for t in poses.t_ns]
    write_rrd(path, poses, SETUP, {"left": seen}, truth_of(poses, 0.004), frames)
    rows = rows_of(path)
    for entity in ("skeleton", "joints", "at_limit", "uncertainty"):
        assert rows[f"/world/hand/test-hand/{entity}"] == 6
    for entity in ("markers/raw", "markers/filtered", "rays/left", "rays/right", "truth/skeleton"):
        assert rows[f"/world/{entity}"] == 6
    assert rows["/world/cameras/left/detections"] == 6
    assert rows["/world/cameras/right/image"] == 1  # 83 ms of images: one at 10 Hz
    assert rows["/plots/latency_ms"] == 6
    assert rows["/world/cameras/left/markers"] == 6
    _, jitter = column(path, "/plots/jitter_mm/middle", "scalars")
    assert np.isnan(np.array(jitter, float).ravel()).tolist() == [
        row == 3 for row in range(6)
    ]  # lost in row 3
    assert rows["/plots/error_mm/joints"] == 6
    assert len(rr.chunk.RrdReader(path).blueprints()) == 1
    assert [p.name for p in tmp_path.iterdir()] == ["run.rrd"]


def test_rows_hold_what_the_poses_say_at_their_exact_times(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    poses = Poses.of(moving_hand(6))
    write_rrd(path, poses, SETUP, None, truth_of(poses, 0.004))
    times, joints = column(path, "/world/hand/test-hand/joints", "positions")
    assert times == poses.t_ns.tolist()
    assert [len(row) for row in joints] == [26, 26, 26, 26, 21, 26]  # an invalid joint is not shown
    np.testing.assert_allclose(np.array(joints[0]), poses.position_m[0], atol=1e-6)
    _, strips = column(path, "/world/hand/test-hand/skeleton", "strips")
    # Row 4: the little finger and the palm's outline lack invalid joints.
    assert [len(row) for row in strips] == [6, 6, 6, 6, 4, 6]
    _, colours = column(path, "/world/hand/test-hand/skeleton", "colors")
    assert colours[3][2] != colours[2][2]  # the middle finger is held in row 3
    assert colours[3][1] == colours[2][1]
    _, markers = column(path, "/world/markers/raw", "positions")
    assert [len(row) for row in markers] == [6, 6, 6, 5, 6, 6]
    _, error = column(path, "/plots/error_mm/joints", "scalars")
    np.testing.assert_allclose(np.array(error).ravel(), 4.0, rtol=1e-6)
    _, jitter = column(path, "/plots/jitter_mm/index", "scalars")
    np.testing.assert_allclose(np.array(jitter).ravel(), np.sqrt(3.0), rtol=1e-6)
    _, rate = column(path, "/plots/rate_hz", "scalars")
    np.testing.assert_allclose(np.array(rate).ravel(), [np.nan] + 5 * [60.0], rtol=1e-6)
    _, size = column(path, "/world/hand/test-hand/uncertainty", "half_sizes")
    np.testing.assert_allclose(np.sort(np.array(size[0])[0]), [0.002, 0.002, 0.006], rtol=1e-5)  # 2 sigma


def test_a_joint_at_its_limit_is_marked_and_one_inside_is_not(tmp_path: Path) -> None:
    pose = moving_hand(1)[0]
    angles = np.full((5, 4), 0.3)
    angles[:, 0] = 0.05
    angles[1, 2] = MODEL.limits_rad[1, 2, 1]
    bent = replace(pose, angles_rad=angles)
    write_rrd(tmp_path / "run.rrd", Poses.of([bent]), SETUP)
    _, at = column(tmp_path / "run.rrd", "/world/hand/test-hand/at_limit", "positions")
    assert len(at[0]) == 1
    pip = JOINTS.index("index-finger-phalanx-intermediate")
    np.testing.assert_allclose(np.array(at[0][0]), pose.position_m[pip], atol=1e-6)


def test_a_spread_is_at_its_limit_earlier_in_a_fist(tmp_path: Path) -> None:
    pose = moving_hand(1)[0]
    fist = np.zeros((5, 4)) + 0.02
    fist[1, :2] = np.radians([12.0, 80.0])  # of the 15 that a straight finger may, it has 10.6
    flat = fist.copy()
    flat[1, 1] = 0.1
    poses = Poses.of([replace(pose, angles_rad=angles) for angles in (fist, flat)])
    write_rrd(tmp_path / "run.rrd", poses, SETUP)
    _, at = column(tmp_path / "run.rrd", "/world/hand/test-hand/at_limit", "positions")
    assert [len(frame) for frame in at] == [1, 0]


def test_an_offline_run_has_no_latency_plot_and_an_empty_run_is_a_valid_file(tmp_path: Path) -> None:
    pose = moving_hand(1)[0]
    offline = replace(pose, latency_ns=0)
    poses = Poses.of([offline])
    write_rrd(tmp_path / "one.rrd", poses, SETUP)
    assert "/plots/latency_ms" not in rows_of(tmp_path / "one.rrd")
    write_rrd(tmp_path / "none.rrd", poses.rows(0, 0), SETUP)
    # Only the recording's own properties and no pose.
    assert not [entity for entity in rows_of(tmp_path / "none.rrd") if entity.startswith("/world")]


def test_images_are_limited_to_ten_a_second_for_each_camera() -> None:
    scene = RerunScene(rr.RecordingStream("test"), [SETUP])
    image = np.zeros((240, 320), np.uint8)
    jpeg = small_jpeg(320, 240)
    taken = [scene.log_image("left", image, t * 1_000_000) for t in range(0, 1000, 16)]
    assert sum(taken) == 9  # every 7th of 63 frames, 112 ms apart
    assert scene.log_image("right", jpeg, 1_000_000)
    assert not scene.log_image("right", b"\xff\xd8\xff jpeg", 201_000_000)
    assert not scene.log_image("wrist", jpeg, 201_000_000)
    assert scene.log_image("right", jpeg, 201_000_000)  # what was refused did not count
    assert scene.log_image("left", image, 5)  # a replay that starts over is shown again


class Viewing:
    """A viewer in mode save on a thread; leaving the block stops it and raises what it raised."""

    def __init__(
        self, bus: LoopbackBus, path: Path, cameras: Mapping[str, CameraCalibration] = CAMERAS
    ) -> None:
        self.stop = threading.Event()
        self.ready = threading.Event()
        self.shown = -1
        self._args = (bus, path, cameras)
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        bus, path, cameras = self._args
        self.shown = run_viewer(
            bus,
            [RigSetup.of(RIG, cameras, MODEL)],
            mode="save",
            path=path,
            stop=self.stop,
            on_ready=lambda text: self.ready.set(),
        )

    def __enter__(self) -> "Viewing":
        self._thread.start()
        assert self.ready.wait(60.0)
        return self

    def __exit__(self, *_: object) -> None:
        self.stop.set()
        self._thread.join(60.0)
        assert not self._thread.is_alive()


def test_the_viewer_records_what_the_sink_publishes_and_ends_on_stop(tmp_path: Path) -> None:
    path = tmp_path / "live.rrd"
    bus = LoopbackBus()
    sink = BusSink(bus)
    with Viewing(bus, path) as viewing:
        for pose in moving_hand(20):
            sink.write(pose)
        bus.publish("health", "left", Health("left", 1, 5, {"frames": 20}, {"rate_hz": 60.0}))
        assert not path.exists()  # not before it is complete
    sink.close()
    assert viewing.shown == 20
    rows = rows_of(path)
    assert rows["/world/hand/test-hand/skeleton"] == 20
    assert rows["/plots/health/left/frames"] == 1
    times, value = column(path, "/plots/health/left/rate_hz", "scalars")
    # The slave's own clock said 5 ns; the report stands at the newest pose of the timeline.
    assert times[0] >= 10**15
    assert value == [[60.0]]
    bus.close()


def test_the_cameras_are_asked_and_show_themselves_in_the_recording(tmp_path: Path) -> None:
    path = tmp_path / "live.rrd"
    bus = LoopbackBus()
    asked = threading.Event()

    def answer(command: Command) -> Health:
        assert command.verb == "preview"
        asked.set()
        return Health("left", 1, 5, {}, {})

    bus.serve("left", answer)  # the right camera is not there, which keeps nothing waiting
    pose = moving_hand(1)[0]
    with Viewing(bus, path):
        assert asked.wait(60.0)
        bus.publish("hand", pose.hand, pose)
        for i in range(4):  # 20 Hz, on the slave's own clock
            bus.publish("preview", "left", Preview("left", 7 + i * 50_000_000, small_jpeg(320, 240)))
        bus.publish("preview", "wrist", Preview("wrist", 7, small_jpeg(320, 240)))
    rows = rows_of(path)
    assert rows["/world/cameras/left/image"] == 2
    assert "/world/cameras/wrist/image" not in rows
    times, _ = column(path, "/world/cameras/left/image", "blob")
    assert set(times) == {pose.t_ns}  # the timeline has the master's clock
    bus.close()


def test_without_a_pose_the_master_gives_the_time_and_without_a_master_nothing_is_shown(
    tmp_path: Path,
) -> None:
    bus = LoopbackBus()
    picture = Preview("left", 7, small_jpeg(320, 240))
    with Viewing(bus, tmp_path / "alone.rrd"):
        bus.publish("health", "left", Health("left", 1, 5, {"frames": 20}, {}))
        bus.publish("preview", "left", picture)
    assert not [
        entity for entity in rows_of(tmp_path / "alone.rrd") if entity.startswith(("/world", "/plots"))
    ]
    with Viewing(bus, tmp_path / "master.rrd"):
        bus.publish("health", "master", Health("master", 1, 10**12, {}, {}))
        bus.publish("preview", "left", picture)
    times, _ = column(tmp_path / "master.rrd", "/world/cameras/left/image", "blob")
    assert times == [10**12]
    bus.close()


def test_a_small_image_fills_the_view_of_its_camera(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    poses = Poses.of(moving_hand(1))
    write_rrd(path, poses, SETUP, images=[("left", 0, small_jpeg(320, 120))])
    chunks = [c for c in rr.chunk.RrdReader(path).stream() if c.entity_path == "/world/cameras/left/image"]
    table = next(c for c in chunks if c.is_static).to_record_batch()
    scale = next(name for name in table.schema.names if name.endswith("scale"))
    assert table.column(scale).to_pylist() == [[[2.0, 4.0, 1.0]]]


def test_markers_stand_in_the_camera_view_where_a_pinhole_sees_them(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    poses = Poses.of(moving_hand(4))
    write_rrd(path, poses, SETUP)
    _, right = column(path, "/world/cameras/right/markers", "positions")
    assert [len(row) for row in right] == [6, 6, 6, 5]
    x, y, z = (poses.markers_raw_m[0] - [0.075, 0.0, 0.0]).T
    # Rerun's pixels begin at the corner of the first, ours at its centre: 319.5 becomes 320.
    np.testing.assert_allclose(
        np.array(right[0]), np.stack([500.0 * x / z + 320.0, 500.0 * y / z + 240.0], axis=-1), atol=1e-3
    )


def test_an_uncertainty_larger_than_the_fingers_is_not_drawn(tmp_path: Path) -> None:
    pose = moving_hand(1)[0]
    cov = pose.cov_m2.copy()
    cov[TIPS[1]] = np.diag([1e-6, 1e-6, 0.016**2])  # 2 sigma: 32 mm
    cov[TIPS[2]] = np.nan
    write_rrd(tmp_path / "run.rrd", Poses.of([replace(pose, cov_m2=cov)]), SETUP)
    _, centres = column(tmp_path / "run.rrd", "/world/hand/test-hand/uncertainty", "centers")
    np.testing.assert_allclose(np.array(centres[0]), pose.position_m[TIPS[[0, 3, 4]]], atol=1e-6)


def test_a_place_that_cannot_be_written_is_a_clear_error(tmp_path: Path) -> None:
    path = tmp_path / "nowhere" / "run.rrd"
    with pytest.raises(RecordingError, match=r"run\.rrd: cannot write"):
        write_rrd(path, Poses.of(moving_hand(1)), SETUP)
    bus = LoopbackBus()
    with pytest.raises(RecordingError, match=r"run\.rrd"):
        run_viewer(bus, [SETUP], mode="save", path=path, stop=threading.Event())
    with pytest.raises(ValueError, match="mode 'save'"):
        run_viewer(bus, [SETUP], mode="save", path=None, stop=threading.Event())
    bus.close()


def test_an_error_midway_leaves_the_older_file_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    path.write_bytes(b"older")

    def images() -> Iterator[tuple[str, int, Image]]:
        yield ("left", 0, np.zeros((8, 8), np.uint8))
        raise RecordingError("frame 1 is broken")

    with pytest.raises(RecordingError, match="frame 1 is broken"):
        write_rrd(path, Poses.of(moving_hand(2)), SETUP, images=images())
    assert path.read_bytes() == b"older"
    assert [p.name for p in tmp_path.iterdir()] == ["run.rrd"]


@pytest.mark.parametrize("web_port", [None, 9090])
def test_every_viewer_is_bound_to_this_machine_with_a_memory_limit(web_port: int | None) -> None:
    arguments = viewer_arguments(1234, web_port)
    assert arguments[arguments.index("--bind") + 1] == "127.0.0.1"
    assert "--server-memory-limit" in arguments
    assert ("--memory-limit" in arguments) == (web_port is None)


def test_a_viewer_without_a_display_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(PhalanxError, match=r"cannot open a window.*--web or --save"):
        ViewerProcess(None)


def test_a_viewer_whose_display_does_not_answer_is_an_error_also_when_it_began_to_listen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("DISPLAY", ":4711")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    bus = LoopbackBus()
    with pytest.raises(PhalanxError, match=r"viewer ended \(exit \d+\): .+--web or --save"):
        run_viewer(bus, [SETUP], mode="spawn", path=None, stop=threading.Event())
    bus.close()


def test_the_web_viewer_takes_poses_is_closed_to_other_addresses_and_ends_on_stop() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    bus = LoopbackBus()
    stop = threading.Event()
    addresses: list[str] = []

    def ready(address: str) -> None:
        addresses.append(address)
        # 127.0.0.2 is this machine too: it answers where a server listens on every interface.
        for host, is_open in (("127.0.0.1", True), ("127.0.0.2", False)):
            with socket.socket() as client:
                addresses.append(f"{host} {(client.connect_ex((host, port)) == 0) == is_open}")
        for pose in moving_hand(5):
            bus.publish("hand", pose.hand, pose)
        stop.set()

    shown = run_viewer(bus, [SETUP], mode="web", path=None, stop=stop, web_port=port, on_ready=ready)
    assert shown == 5
    assert addresses[0].startswith(f"http://127.0.0.1:{port}?url=")
    assert addresses[1:] == ["127.0.0.1 True", "127.0.0.2 True"]
    with socket.socket() as client:
        assert client.connect_ex(("127.0.0.1", port)) != 0  # nothing is left running
    bus.close()


def boxes_of(path: Path) -> list[list[float]]:
    """Half sizes [m] of the boxes of the stated volume."""
    return [
        half
        for chunk in rr.chunk.RrdReader(path).stream()
        if chunk.entity_path == "/world/volume" and chunk.is_static
        for row in chunk.to_record_batch().column("Boxes3D:half_sizes").to_pylist()
        for half in row
    ]


def test_the_stated_volume_is_a_box_and_there_is_none_without(tmp_path: Path) -> None:
    poses = Poses.of(moving_hand(2))
    volume = Volume(low_m=(-0.2, -0.1, 0.4), high_m=(0.2, 0.3, 0.9))
    write_rrd(tmp_path / "with.rrd", poses, RigSetup.of(replace(RIG, volume=volume), CAMERAS, MODEL))
    write_rrd(tmp_path / "without.rrd", poses, SETUP)
    np.testing.assert_allclose(boxes_of(tmp_path / "with.rrd"), [[0.2, 0.2, 0.25]], rtol=1e-6)
    assert boxes_of(tmp_path / "without.rrd") == []
