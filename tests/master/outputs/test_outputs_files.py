import errno
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from common.errors import RecordingError
from common.messages import HandPose
from master.outputs.poses import Poses, PosesFile, PosesTruth

FIXED = "t_ns position_m orientation_wxyz radius_m valid tracked cov_m2 angles_rad markers_m markers_raw_m"


def random_pose(index: int, markers: int = 6, hand: str = "default-right") -> HandPose:
    rng = np.random.default_rng(index)
    raw = rng.normal(size=(markers, 3))
    rotations = rng.normal(size=(26, 4))
    raw[index % max(markers, 1) :][:1] = np.nan
    return HandPose(
        hand=hand,
        t_ns=2**60 + index,  # beyond what a float64 holds exactly
        position_m=rng.normal(size=(26, 3)),
        orientation_wxyz=rotations / np.linalg.norm(rotations, axis=1, keepdims=True),
        radius_m=rng.uniform(0.005, 0.02, 26),
        valid=rng.random(26) < 0.9,
        tracked=rng.random(26) < 0.5,
        cov_m2=rng.normal(size=(26, 3, 3)),
        source=rng.integers(0, 5, 26).astype(np.uint8),
        angles_rad=rng.normal(size=(5, 4)),
        markers_m=raw * 0.5,
        markers_raw_m=raw,
        markers_cov_m2=rng.normal(size=(len(raw), 3, 3)),
        inside_volume=rng.random(26) < 0.5,
        latency_ns=index * 1000,
    )


def write(path: Path, poses: list[HandPose], markers: int = 6) -> None:
    sink = PosesFile(path, poses[0].hand if poses else "default-right", markers)
    for pose in poses:
        sink.write(pose)
    sink.close()


def test_what_is_written_is_read_back_exactly(tmp_path: Path) -> None:
    poses = [random_pose(i) for i in range(40)]
    write(tmp_path / "poses.npz", poses)
    loaded = Poses.load(tmp_path / "poses.npz")
    assert loaded.hand == "default-right"
    assert len(loaded) == 40
    for again, pose in zip(loaded.messages(), poses, strict=True):
        for field in HandPose.__struct_fields__:
            np.testing.assert_array_equal(getattr(again, field), getattr(pose, field), err_msg=field)


def test_any_numpy_reads_the_fixed_keys_without_us(tmp_path: Path) -> None:
    write(tmp_path / "poses.npz", [random_pose(i) for i in range(3)])
    with np.load(tmp_path / "poses.npz") as data:
        assert set(FIXED.split()) <= set(data.files)
        assert data["t_ns"].dtype == np.int64
        assert data["cov_m2"].shape == (3, 26, 3, 3)
        assert data["markers_raw_m"].shape == (3, 6, 3)
        assert data["valid"].dtype == np.bool_


def test_two_runs_are_byte_identical_and_another_pose_is_not(tmp_path: Path) -> None:
    poses = [random_pose(i) for i in range(10)]
    write(tmp_path / "a.npz", poses)
    write(tmp_path / "b.npz", poses)
    write(tmp_path / "c.npz", Poses.of(poses).messages())
    write(tmp_path / "d.npz", [*poses[:-1], random_pose(99)])
    first = (tmp_path / "a.npz").read_bytes()
    assert first == (tmp_path / "b.npz").read_bytes()
    assert first == (tmp_path / "c.npz").read_bytes()
    assert first != (tmp_path / "d.npz").read_bytes()


def test_a_run_that_saw_nothing_is_a_file_of_no_rows(tmp_path: Path) -> None:
    write(tmp_path / "poses.npz", [], markers=4)
    loaded = Poses.load(tmp_path / "poses.npz")
    assert len(loaded) == 0
    assert loaded.marker_count == 4


def test_the_file_appears_only_when_it_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "poses.npz"
    path.write_bytes(b"an older run")
    sink = PosesFile(path, "default-right", 6)
    sink.write(random_pose(0))
    assert [p.name for p in tmp_path.iterdir()] == ["poses.npz"]
    assert path.read_bytes() == b"an older run"
    sink.close()
    sink.close()
    assert len(Poses.load(path)) == 1
    assert [p.name for p in tmp_path.iterdir()] == ["poses.npz"]


def test_full_disk_is_a_clear_error_and_leaves_nothing_half_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "poses.npz"
    sink = PosesFile(path, "default-right", 6)
    sink.write(random_pose(0))

    def full(*args: object, **kwargs: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(RecordingError, match=r"poses\.npz: cannot write: No space left.*free the disk"):
        sink.close()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_disk_that_fills_while_tracking_is_reported_by_write(tmp_path: Path) -> None:
    sink = PosesFile(tmp_path / "poses.npz", "default-right", 6)
    sink._spool.close()
    sink._spool = Path("/dev/full").open("r+b", buffering=0)  # noqa: SIM115
    with pytest.raises(RecordingError, match="No space left"):
        sink.write(random_pose(0))
    sink.close()  # the run may still end in good order
    assert list(tmp_path.iterdir()) == []


def test_missing_folder_is_reported_at_the_start(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="nowhere"):
        PosesFile(tmp_path / "nowhere" / "poses.npz", "default-right", 6)


@pytest.mark.parametrize("pose", [random_pose(1, markers=5), random_pose(1, hand="other")])
def test_a_pose_that_does_not_fit_the_file_is_refused(tmp_path: Path, pose: HandPose) -> None:
    sink = PosesFile(tmp_path / "poses.npz", "default-right", 6)
    with pytest.raises(ValueError, match="does not fit"):
        sink.write(pose)
    sink.close()


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-300])


def _junk(path: Path) -> None:
    path.write_bytes(b"junk")


def _keyless(path: Path) -> None:
    np.savez(path, t_ns=np.zeros(1, np.int64))


def _wrong_shape(path: Path) -> None:
    with np.load(path) as data:
        arrays = dict(data)
    arrays["valid"] = np.ones((1, 25), bool)
    np.savez(path, **arrays)


def _pickled(path: Path) -> None:
    with np.load(path) as data:
        arrays = dict(data)
    arrays["valid"] = np.array([{}], dtype=object)
    np.savez(path, **arrays)


@pytest.mark.parametrize("spoil", [Path.unlink, _cut, _junk, _keyless, _wrong_shape, _pickled])
def test_a_broken_file_is_refused_by_name(tmp_path: Path, spoil: Callable[[Path], None]) -> None:
    path = tmp_path / "poses.npz"
    write(path, [random_pose(0)])
    spoil(path)
    with pytest.raises(RecordingError, match=r"poses\.npz"):
        Poses.load(path)


def test_truth_gives_millimetres_and_leaves_invalid_joints_out() -> None:
    pose = random_pose(3)
    poses = Poses.of([pose])
    webxr = poses.position_m[:, 1:] + np.array([0.003, 0.0, 0.004])  # 5 mm off
    truth = PosesTruth.of_webxr(webxr, poses.markers_raw_m + np.array([0.0, 0.002, 0.0]))
    error = truth.errors_m(poses)["joints"]
    np.testing.assert_array_equal(np.isnan(error), ~poses.valid[:, 1:])
    np.testing.assert_allclose(error[poses.valid[:, 1:]], 0.005, rtol=1e-9)
    seen = truth.errors_m(poses)["markers"][0]
    np.testing.assert_allclose(seen[~np.isnan(seen)], 0.002, rtol=1e-9)
    np.testing.assert_allclose(truth.joints_m[0, 0], (webxr[0, 10] + webxr[0, 11]) / 2)
