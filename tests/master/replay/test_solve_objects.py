"""A recording with an object solved offline: files, scores, the same bytes again; missing tags are asked for."""

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.errors import RecordingError
from common.messages import ObjectSource, TagDetections
from common.recording.frame_recording import FrameRecording, Manifest
from master.outputs.result_files import Contacts, ObjectPoses, contact_path, object_path
from master.replay.offline import rigs_to_solve, solve
from master.rig.setup import RigSetup, load_setups, setups_with_hands
from tests.object_run import PERIOD_NS, START_NS, ObjectRun, Sent, object_run

FRAMES = 18


def stacked(messages: Sequence[Sent], *names: str) -> dict[str, object]:
    return {name: np.array([getattr(one, name) for one in messages]) for name in names}


def write(folder: Path, shown: ObjectRun) -> None:
    """Detections, tags and truth, as the slave and a simulation write them."""
    for camera in shown.setup.models:
        own = [one for one in shown.messages if getattr(one, "camera", "") == camera]
        frames = [one for one in own if not isinstance(one, TagDetections)]
        arrays = stacked(frames, "t_ns", "seq", "uv", "quality", "sigma_px") | {
            "area_px2": np.array([getattr(one, "area") for one in frames])  # noqa: B009
        }
        np.savez(folder / f"detections_{camera}.npz", **arrays)  # pyright: ignore[reportArgumentType]
        tags = [one for one in own if isinstance(one, TagDetections)]
        arrays = stacked(tags, "t_ns", "seq") | {
            name: np.concatenate([getattr(one, name) for one in tags]) for name in ("ids", "uv", "sigma_px")
        }
        row = np.repeat(np.arange(len(tags)), [len(one.ids) for one in tags])
        np.savez(folder / f"tags_{camera}.npz", **arrays, row=row)  # pyright: ignore[reportArgumentType]
    first = min(one.t_ns for one in shown.messages)
    t_s = (np.arange(-2, FRAMES + 2) * PERIOD_NS + first - START_NS) * 1e-9
    poses = [shown.scene.truth(t).objects["cube"] for t in t_s.tolist()]
    truths = [shown.scene.truth(t) for t in t_s.tolist()]
    np.savez(
        folder / "truth.npz",
        t_ref=t_s,
        object_cube=poses,
        joints=[one.joints.position_m[1:] for one in truths],
        angles=np.zeros((len(t_s), 20)),
        paint_centroid=[one.markers_m for one in truths],
        frac=np.ones((len(t_s), 2, 6)),
    )


@pytest.fixture(scope="module")
def shown(root: Path) -> ObjectRun:
    return object_run(root, "desk-cube", FRAMES, "grasp", 60)


@pytest.fixture
def recorded(shown: ObjectRun, tmp_path: Path) -> FrameRecording:
    write(tmp_path, shown)
    setup = shown.setup
    manifest = Manifest(
        version=1, kind="markers", cameras=setup.cameras, rig=setup.rig, objects={"cube": setup.objects[0]}
    )
    return FrameRecording(tmp_path, manifest, ())


def setups_of(recorded: FrameRecording, root: Path) -> tuple[RigSetup, ...]:
    manifest = recorded.manifest
    rigs = rigs_to_solve(manifest, [])
    return setups_with_hands(rigs, manifest.cameras, root / "calib_json", None, manifest.objects)


def test_an_object_is_solved_scored_and_written_alike_every_time(
    recorded: FrameRecording, root: Path
) -> None:
    setups = setups_of(recorded, root)
    outs = [recorded.folder / "first", recorded.folder / "second"]
    summary: dict[str, object] = {}
    for out in outs:
        out.mkdir()
        summary = solve(recorded, setups, recorded.folder, out)
    names = {path.name for path in outs[0].iterdir()}
    assert names == {
        *("poses.npz", "object_cube.npz", "contact_default-right_cube.npz", "gestures.jsonl", "summary.json")
    }
    for name in names - {"summary.json"}:  # that has the times of the stages
        assert (outs[0] / name).read_bytes() == (outs[1] / name).read_bytes(), name
    poses = ObjectPoses.load(object_path(outs[0], "cube"))
    assert set(poses.source[poses.tracked].tolist()) == {int(ObjectSource.TAGS)}
    assert (poses.latency_ns == 0).all()
    assert len(Contacts.load(contact_path(outs[0], "default-right", "cube"))) == summary["poses"]
    assert summary["object_mm"] < 1.0  # type: ignore[operator]
    assert summary["object_deg"] < 1.0  # type: ignore[operator]
    assert summary["object_tracked"] > 0.7  # type: ignore[operator]
    assert summary["lost"] == 0, "frames that were not searched for tags are not lost"
    assert summary["counts"]["object.cube.poses"] == len(poses)  # type: ignore[index]
    assert summary["camera_hz"] == pytest.approx({"left": 60.0, "right": 60.0}, rel=1e-3)


def test_a_wrist_device_with_the_cameras_changes_nothing_of_the_object(
    recorded: FrameRecording, root: Path
) -> None:
    (wrist,) = load_setups(root / "calib_json", ("wrist",))
    nothing = {"t_ns": np.zeros(0, np.int64), "laser_uv": np.zeros((0, 5, 2)), "tip_uv": np.zeros((0, 5, 2))}
    np.savez(recorded.folder / "detections_wrist.npz", **nothing)  # pyright: ignore[reportArgumentType]
    manifest = msgspec.structs.replace(
        recorded.manifest,
        kind="both",
        cameras=recorded.manifest.cameras | wrist.cameras,
        rigs=(msgspec.structs.replace(wrist.rig, imu=None),),
    )
    both = FrameRecording(recorded.folder, manifest, ())
    (recorded.folder / "truth.npz").unlink()  # it has none of the wrist device
    found: list[bytes] = []
    for one in (recorded, both):
        out = recorded.folder / one.manifest.kind
        out.mkdir()
        solve(one, setups_of(one, root), recorded.folder, out)
        found.append(object_path(out, "cube").read_bytes())
    assert found[0] == found[1]


def test_tags_that_nobody_looked_for_are_asked_for(recorded: FrameRecording, root: Path) -> None:
    (recorded.folder / "tags_right.npz").unlink()
    with pytest.raises(RecordingError, match=r"tags_right\.npz.*`phalanx-slave run -o` for camera 'right'"):
        solve(recorded, setups_of(recorded, root), recorded.folder, recorded.folder)
