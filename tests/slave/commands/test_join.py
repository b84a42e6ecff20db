"""Recordings of single cameras become one of the rig only where they belong together."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.calibration import RigCalibration
from common.errors import RecordingError
from common.imu.csv_table import read_imu, write_imu
from common.messages import ImuSample
from common.recording.frame_recording import Illumination, Manifest, RecordedClock, open_recording
from common.recording.frame_writing import RecordingWriter, encode_png
from common.recording.pictures import MAX_FILE_BYTES
from slave.__main__ import main
from slave.commands.join import join_recordings
from slave.commands.offline import detect_recording
from tests.common.recording.test_frame_writing import check_whole, small_disk
from tests.slave.painted import CENTRES, camera, hand, render

POSE = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
NAMES = ("left", "right", "top")
RIG = RigCalibration(
    version=1,
    name="desk",
    kind="markers",
    cameras=NAMES,
    hand="default-right",
    T_rig_camera={name: ((1.0, 0.0, 0.0, 0.1 * i), *POSE[1:]) for i, name in enumerate(NAMES)},
)
WRIST = RigCalibration(version=1, name="wrist", kind="wrist", cameras=("wrist",), hand="default-right")
HERE = RecordedClock(id="here", wall_ahead_ns=1_700_000_000_000_000_000)
THERE = RecordedClock(id="there", wall_ahead_ns=1_700_000_007_000_000_250)  # booted 7 s later than the other
IMAGE = render(hand())


def part(folder: Path, name: str, first_ns: int = 1000, step_ns: int = 100, **changes: object) -> Path:
    """Three frames of one camera."""
    manifest = Manifest(
        version=1,
        kind="markers",
        cameras={n: msgspec.structs.replace(camera(), name=n) for n in NAMES},
        rig=RIG,
        note=f"from {name}",
        clock=HERE,
    )
    writer = RecordingWriter(folder / name, msgspec.structs.replace(manifest, **changes))
    for k in range(3):
        image = np.roll(IMAGE, 4 * k + NAMES.index(name), axis=1)
        writer.add(name, 5 + k, first_ns + step_ns * k, Illumination.AMBIENT, encode_png(image))
    writer.close()
    return folder / name


def test_frames_of_all_cameras_in_the_order_of_time(tmp_path: Path) -> None:
    parts = [part(tmp_path, "left"), part(tmp_path, "right", 1050)]
    steps: list[tuple[int, int]] = []
    counts = join_recordings(
        parts, tmp_path / "wave", progress=lambda done, total: steps.append((done, total))
    )
    assert counts == {"left": 3, "right": 3}
    assert steps == [(k, 6) for k in range(1, 7)]
    joined = open_recording(tmp_path / "wave")
    assert [(row.camera, row.t_ns) for row in joined.rows] == [
        ("left", 1000), ("right", 1050), ("left", 1100), ("right", 1150), ("left", 1200), ("right", 1250),
    ]  # fmt: skip
    for folder in parts:
        before, after = open_recording(folder), joined.frames_of(folder.name)
        for one, two in zip(before.rows, after, strict=True):
            assert (one.seq, one.t_ns, one.illumination) == (two.seq, two.t_ns, two.illumination)
            assert (folder / one.file).read_bytes() == (joined.folder / two.file).read_bytes()
    assert joined.manifest.note == "from left; from right"
    assert joined.manifest.rig == RIG
    assert check_whole(tmp_path / "wave") == 6
    for offset, name in enumerate(("left", "right")):
        found = detect_recording(tmp_path / "wave", name)
        np.testing.assert_allclose(found.uv[1], CENTRES + np.array([304.0 + offset, 200.0]), atol=0.3)


def test_the_imu_of_one_part_comes_along_on_the_clock_of_the_first(tmp_path: Path) -> None:
    parts = [part(tmp_path, "left"), part(tmp_path, "right", 1050 - 7_000_000_250, clock=THERE)]
    nothing = np.full(3, np.nan)
    quaternion = np.array([1.0, 0.0, 0.0, 0.0])
    write_imu(
        parts[1],
        [
            ImuSample("x", 0, k, 50 * k - 7_000_000_250, nothing, nothing, nothing, quaternion)
            for k in range(9)
        ],
    )
    join_recordings(parts, tmp_path / "wave", by_wall_clock=True)
    assert [one.t_ns for one in read_imu(tmp_path / "wave", "x")] == [50 * k for k in range(9)]
    join_recordings(parts[:1], tmp_path / "alone")
    assert not (tmp_path / "alone" / "imu.csv").exists()


def test_joined_recordings_can_be_joined_again(tmp_path: Path) -> None:
    two = tmp_path / "two"
    join_recordings([part(tmp_path, "left"), part(tmp_path, "right")], two)
    assert join_recordings([two, part(tmp_path, "top")], tmp_path / "three") == dict.fromkeys(NAMES, 3)


def device(folder: Path, first_ns: int = 1020) -> Path:
    """A triple of a wrist device."""
    wrist = msgspec.structs.replace(camera(), name="wrist")
    manifest = Manifest(version=1, kind="wrist", cameras={"wrist": wrist}, rig=WRIST, clock=HERE)
    writer = RecordingWriter(folder / "wrist", manifest)
    for k, lit in enumerate((Illumination.AMBIENT, Illumination.LASER, Illumination.LED)):
        writer.add("wrist", k, first_ns + 70 * k, lit, encode_png(IMAGE[..., 0]))
    writer.close()
    return folder / "wrist"


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_marker_cameras_and_a_wrist_device_become_one_recording_of_both(
    order: tuple[int, ...], tmp_path: Path
) -> None:
    parts = [part(tmp_path, "left"), part(tmp_path, "right", 1050), device(tmp_path)]
    join_recordings([parts[k] for k in order], tmp_path / "both")
    joined = open_recording(tmp_path / "both")
    assert joined.manifest.kind == "both"
    assert (joined.manifest.rig, joined.manifest.rigs) == (RIG, (WRIST,))
    assert set(joined.manifest.cameras) == {*NAMES, "wrist"}
    stamps = [row.t_ns for row in joined.rows]
    assert stamps == sorted(stamps)
    assert [row.illumination.value for row in joined.frames_of("wrist")] == ["ambient", "laser", "led"]
    # A camera that was late is joined to all the others.
    counts = join_recordings([tmp_path / "both", part(tmp_path, "top")], tmp_path / "all")
    assert counts == {**dict.fromkeys(NAMES, 3), "wrist": 3}
    assert open_recording(tmp_path / "all").manifest.rigs == (WRIST,)


def test_each_camera_brings_its_own_file_and_clicks(tmp_path: Path) -> None:
    darker = {n: msgspec.structs.replace(camera(), name=n, exposure_us=1000.0) for n in NAMES}
    clicks = {"left": {"thumb": (1.0, 2.0)}, "right": {"thumb": (3.0, 4.0)}}
    left = part(tmp_path, "left", clicks=clicks)
    join_recordings([left, part(tmp_path, "right", cameras=darker)], tmp_path / "wave")
    manifest = open_recording(tmp_path / "wave").manifest
    assert {n: c.exposure_us for n, c in manifest.cameras.items()} == {
        "left": 5000,
        "right": 1000,
        "top": 5000,
    }
    assert manifest.clicks == {"left": clicks["left"]}


def test_two_clocks_are_joined_on_request_only_and_by_their_wall_clocks(tmp_path: Path) -> None:
    parts = [part(tmp_path, "left", 20_000_000_000), part(tmp_path, "right", 12_999_999_900, clock=THERE)]
    with pytest.raises(
        RecordingError, match=r"right: its clock is not that of .*left: another machine.*--by-wall"
    ):
        join_recordings(parts, tmp_path / "wave")
    assert not (tmp_path / "wave").exists()
    join_recordings(parts, tmp_path / "wave", by_wall_clock=True)
    joined = open_recording(tmp_path / "wave")
    assert [row.t_ns - 20_000_000_000 for row in joined.frames_of("left")] == [0, 100, 200]
    assert [row.t_ns - 20_000_000_000 for row in joined.frames_of("right")] == [150, 250, 350]


Spoil = Callable[[Path], list[Path]]


def other_rig(folder: Path) -> list[Path]:
    moved = msgspec.structs.replace(
        RIG, T_rig_camera={**RIG.T_rig_camera, "top": (*POSE[:2], (0, 0, 1, 9), POSE[3])}
    )
    return [part(folder, "left"), part(folder, "right", rig=moved)]


def one_camera_twice(folder: Path) -> list[Path]:
    return [part(folder, "left"), part(folder / "again", "left")]


def at_another_time(folder: Path) -> list[Path]:
    return [part(folder, "left", 1000), part(folder, "right", 3_000_001_200)]


def poses_and_motion(folder: Path) -> list[Path]:
    return [part(folder, "left"), part(folder, "right", continuous=False)]


def other_cameras(folder: Path) -> list[Path]:
    more = {n: msgspec.structs.replace(camera(), name=n) for n in (*NAMES, "attic")}
    return [part(folder, "left"), part(folder, "right", cameras=more)]


def camera_of_two_rigs(folder: Path) -> list[Path]:
    other = msgspec.structs.replace(RIG, name="shelf")
    return [part(folder, "left"), part(folder, "right", rig=other)]


def other_kind(folder: Path) -> list[Path]:
    return [part(folder, "left"), part(folder, "right", kind="both")]


def no_clock(folder: Path) -> list[Path]:
    return [part(folder, "left"), part(folder, "right", clock=None)]


def no_frame(folder: Path) -> list[Path]:
    right = part(folder, "right")
    (right / "frames.csv").write_text("camera,seq,t_ns,illumination,file\n")
    return [part(folder, "left"), right]


def with_more_than_frames(folder: Path) -> list[Path]:
    (part(folder, "left") / "truth.npz").write_bytes(b"")
    return [folder / "left", part(folder, "right")]


def with_two_imus(folder: Path) -> list[Path]:
    parts = [part(folder, "left"), part(folder, "right")]
    for one in parts:
        write_imu(one, [])
    return parts


def a_file_gone(folder: Path) -> list[Path]:
    (part(folder, "right") / "right/000001.png").unlink()
    return [part(folder, "left"), folder / "right"]


def not_there(folder: Path) -> list[Path]:
    return [part(folder, "left"), folder / "right"]


@pytest.mark.parametrize(
    ("spoil", "output"),
    [
        (
            other_rig,
            r"right/recording\.json: rig\.T_rig_camera differs from that of .*left: .*one calibration",
        ),
        (one_camera_twice, r"again/left: frames of camera 'left' are in .*left as well"),
        (at_another_time, r"right begins 3\.000 s after the end of .*left: no moment"),
        (poses_and_motion, r"right/recording\.json: continuous differs"),
        (other_cameras, r"right/recording\.json: cameras: 'attic' is in only one"),
        (camera_of_two_rigs, r"right/recording\.json: cameras: 'left' is that of another rig in .*left"),
        (other_kind, r"right/recording\.json: kind differs"),
        (no_clock, r"right/recording\.json: clock: missing"),
        (no_frame, r"right/frames\.csv: no frame in it"),
        (with_more_than_frames, r"left/truth\.npz: a truth cannot be joined"),
        (with_two_imus, r"right/imu\.csv: .*left has an IMU as well"),
        (a_file_gone, r"right/000001\.png: cannot read: No such file"),
        (not_there, r"right/recording\.json: cannot read"),
    ],
)
def test_what_does_not_belong_together_is_named_and_nothing_is_written(
    spoil: Spoil, output: str, tmp_path: Path
) -> None:
    with pytest.raises(RecordingError, match=output):
        join_recordings(spoil(tmp_path), tmp_path / "wave", by_wall_clock=True)
    assert not (tmp_path / "wave").exists()


def test_a_disk_too_small_is_said_before_the_work(tmp_path: Path) -> None:
    parts = [part(tmp_path, "left"), part(tmp_path, "right")]
    with small_disk(tmp_path / "disk", "16k") as disk:
        with pytest.raises(RecordingError, match=r"MB are needed, 0\.0 MB are free on the disk"):
            join_recordings(parts, disk / "deep/wave")
        assert not any(disk.iterdir())


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parts = [str(part(tmp_path, "left")), str(part(tmp_path, "right"))]
    out = tmp_path / "wave"
    assert main(["record", "--join", *parts, "-o", str(out)]) == 0
    assert f"{out}: left 3 frames, right 3 frames" in capsys.readouterr().out
    assert main(["record", "--join", *parts, "-o", str(out)]) == 1
    assert "wave: holds something already" in capsys.readouterr().err
    shutil.rmtree(out)
    with pytest.raises(SystemExit, match="2"):
        main(["record", "--join", "-o", str(out)])


def test_a_frame_that_claims_to_be_huge_is_not_read(tmp_path: Path) -> None:
    parts = [part(tmp_path, "left"), part(tmp_path, "right")]
    os.truncate(parts[1] / open_recording(parts[1]).rows[1].file, MAX_FILE_BYTES + 1)  # takes no room
    with pytest.raises(RecordingError, match=r"right/.*\.png: has 268435457 bytes, at most 268435456"):
        join_recordings(parts, tmp_path / "wave")
