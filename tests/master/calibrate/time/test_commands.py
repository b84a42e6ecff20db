"""`calibrate cameras time`: offsets to the rig file, refusals that say what to do, and the offset at work."""

from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.calibration import RigCalibration, load, save
from common.errors import CalibrationError, PhalanxError
from common.messages import MarkerDetections
from common.recording.frame_recording import Manifest
from master.calibrate.time_offsets import measure_times, shifted
from tests import timing_scenes as scenes
from tests.cli import invoke
from tests.hand_helpers import camera_file, rig_file
from tests.picture_helpers import mirrored
from tests.timing_scenes import Motion, cameras, recorded

RATES = {"left": 60.0, "right": 60.0}
NAMES = ("left", "right")


def messages_of(
    motion: Motion, late_ms: float, seconds: float = 8.0, seed: int = 1
) -> list[MarkerDetections]:
    return recorded(cameras(), motion, 60.0, seconds, {"right": late_ms}, seed)


def write_recording(folder: Path, messages: list[MarkerDetections], *, continuous: bool = True) -> Path:
    """A recording without images, and its detections beside it; returns the folder of these."""
    folder.mkdir()
    files = {name: camera_file(name, 60.0, scenes.ROW_TIME_US) for name in NAMES}
    manifest = Manifest(version=1, kind="markers", cameras=files, rig=rig_file(), continuous=continuous)
    (folder / "recording.json").write_bytes(msgspec.json.encode(manifest))
    (folder / "frames.csv").write_text("camera,seq,t_ns,illumination,file\n")
    found = folder / "found"
    found.mkdir()
    for name in NAMES:
        own = [message for message in messages if message.camera == name]
        np.savez(
            found / f"detections_{name}.npz",
            t_ns=np.array([m.t_ns for m in own], np.int64),
            seq=np.array([m.seq for m in own], np.int64),
            uv=np.array([m.uv for m in own]),
            area_px2=np.array([m.area for m in own]),
            quality=np.array([m.quality for m in own]),
            sigma_px=np.array([m.sigma_px for m in own]),
        )
    return found


def run(*arguments: str | Path) -> tuple[int, str]:
    try:
        result = invoke("calibrate", "cameras", "time", *arguments)
    except PhalanxError as error:
        return 1, str(error)
    return result.exit_code, result.output


@pytest.mark.parametrize("late_ms", [-8.0, 2.5])
def test_a_lie_is_measured_to_a_fifth_of_a_millisecond(late_ms: float) -> None:
    for motion in (scenes.sideways(2), scenes.natural(2)):
        [right] = measure_times(cameras(), RATES, messages_of(motion, late_ms))
        assert right.camera == "right"
        assert right.significant
        assert abs(right.offset.offset_ns - late_ms * 1e6) < max(0.2e6, 3.0 * right.offset.sigma_ns)
        assert abs(right.to_write_us - late_ms * 1e3) < 500.0


def test_the_truth_is_written_as_nought() -> None:
    [right] = measure_times(cameras(), RATES, messages_of(scenes.natural(4), 0.0))
    assert not right.significant
    assert right.to_write_us == 0.0


def test_the_offset_measured_is_the_one_that_makes_the_rest_nought() -> None:
    messages = messages_of(scenes.natural(5), 6.0)
    [right] = measure_times(cameras(), RATES, messages)
    [rest] = measure_times(cameras(), RATES, shifted(messages, {"right": right.offset.offset_ns}))
    assert abs(rest.offset.offset_ns) < 0.05e6


@pytest.mark.parametrize(
    ("motion", "seconds", "late"), [(scenes.resting, 8.0, 0.0), (scenes.natural, 0.2, 0.0)]
)
def test_too_little_motion_is_refused_with_what_to_do(
    motion: Callable[[int], Motion], seconds: float, late: float
) -> None:
    messages = messages_of(motion(1), late, seconds)
    with pytest.raises(
        CalibrationError, match=r"camera 'right' cannot be measured.*px/s.*record ten seconds"
    ) as error:
        measure_times(cameras(), RATES, messages)
    assert "up and down" in str(error.value)


def of_right(change: Callable[[MarkerDetections, bool], MarkerDetections]) -> list[MarkerDetections]:
    """A motion in which the right camera is changed, by whether it is in the second half."""
    sent = messages_of(scenes.natural(2), 2.5)
    middle = sent[len(sent) // 2].t_ns
    return [change(one, one.t_ns > middle) if one.camera == "right" else one for one in sent]


@pytest.mark.parametrize(
    ("messages", "cause"),
    [
        (
            lambda: of_right(
                lambda one, late: msgspec.structs.replace(one, t_ns=one.t_ns + 8_000_000 * late)
            ),
            r"late by .* ms in the first half and by .* ms in the second: its stamps jumped",
        ),
        (
            lambda: [
                msgspec.structs.replace(one, camera=NAMES[one.camera == "left"])
                for one in of_right(lambda one, _: one)
            ],
            "no ray of 'right' meets those of 'left': are pictures mirrored, cameras exchanged",
        ),
        (
            lambda: [
                msgspec.structs.replace(one, uv=mirrored(one.uv)) for one in of_right(lambda one, _: one)
            ],
            "no ray of 'right' meets those of 'left': are pictures mirrored, cameras exchanged",
        ),
        (
            lambda: of_right(
                lambda one, _: msgspec.structs.replace(
                    one, uv=np.full_like(one.uv, np.nan), sigma_px=np.full_like(one.sigma_px, np.nan)
                )
            ),
            r"cannot be measured; .* right: 0\.0 s, 0 px/s",
        ),
    ],
    ids=["stamps jump", "exchanged", "mirrored", "NaN"],
)
def test_a_fault_of_the_recording_is_refused_by_name(
    messages: Callable[[], list[MarkerDetections]], cause: str
) -> None:
    with pytest.raises(CalibrationError, match=cause):
        measure_times(cameras(), RATES, messages())


def test_the_rig_file_gets_the_offset_with_its_source_and_keeps_the_rest(tmp_path: Path) -> None:
    found = write_recording(tmp_path / "swing", messages_of(scenes.natural(2), 8.0))
    out = tmp_path / "calib"
    (out / "rigs").mkdir(parents=True)
    before = rig_file(frame_sync="predict", stamp_offset_us={"right": 3.0})
    save(out / "rigs" / "bench.json", before)
    numbers = tmp_path / "time.json"
    picture = tmp_path / "time.png"
    code, text = run(
        tmp_path / "swing", "--detections", found, "--out", out, "--json", numbers, "--picture", picture
    )
    assert code == 0, text
    assert "reference" in text
    assert "wrote" in text
    rig = load(out / "rigs" / "bench.json", RigCalibration)
    assert abs(rig.stamp_offset_us["right"] - 8000.0) < 300.0
    source = rig.provenance["stamp_offset_us"]
    assert (source.tool, source.data) == ("calibrate cameras time", ("swing",))
    assert 0.0 < source.residual["right_sigma_us"] < 500.0
    assert msgspec.structs.replace(rig, stamp_offset_us=before.stamp_offset_us, provenance={}) == before
    assert msgspec.json.decode(numbers.read_bytes())["offset_us"]["right"] == rig.stamp_offset_us["right"]
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_without_out_nothing_is_written(tmp_path: Path) -> None:
    found = write_recording(tmp_path / "swing", messages_of(scenes.natural(2), 0.0))
    code, text = run(tmp_path / "swing", "--detections", found)
    assert code == 0
    assert "its stamps are right" in text
    assert "nothing written" in text
    assert sorted(path.name for path in tmp_path.iterdir()) == ["swing"]


def test_unrelated_frames_and_other_cameras_are_refused(tmp_path: Path) -> None:
    messages = messages_of(scenes.natural(2), 0.0, 2.0)
    found = write_recording(tmp_path / "poses", messages, continuous=False)
    code, text = run(tmp_path / "poses", "--detections", found)
    assert code != 0
    assert "unrelated poses" in text
    found = write_recording(tmp_path / "swing", messages)
    (tmp_path / "three" / "rigs").mkdir(parents=True)
    save(tmp_path / "three" / "rigs" / "bench.json", rig_file(("left", "right", "top")))
    rig = ("--rig", "bench", "--calibration", tmp_path / "three")
    code, text = run(tmp_path / "swing", "--detections", found, *rig)
    assert code != 0
    assert "no camera 'top', which rig" in text
    assert "it has left, right: record all cameras of the rig" in text
    out = tmp_path / "calib"
    (out / "rigs").mkdir(parents=True)
    save(out / "rigs" / "bench.json", rig_file(("right", "left")))
    code, text = run(tmp_path / "swing", "--detections", found, "--out", out)
    assert code != 0
    assert "must be the same" in text


@pytest.mark.parametrize("late_ms", [0.0, 8.0])
def test_a_rendered_recording_of_eighteen_pairs_is_enough(
    late_ms: float, tmp_path: Path, datasets: Path
) -> None:
    """The exact centroids of the visible pixels, 0.1 px of noise; its stamps are true, and shifted here."""
    folder = datasets / "stereo" / "translate_8ms"
    rng = np.random.default_rng(3)
    with np.load(folder / "truth.npz") as truth:
        uv, t_s = truth["uv"] + rng.normal(0.0, 0.1, truth["uv"].shape), truth["t_row0"]
    for c, name in enumerate(NAMES):
        lie_s = 1e-3 * late_ms if name == "right" else 0.0
        seen = np.where(np.isnan(uv[:, c, :, 0]), np.nan, 1.0)
        np.savez(
            tmp_path / f"detections_{name}.npz",
            t_ns=np.round(1e9 * (1.0 + t_s[:, c] - lie_s)).astype(np.int64),
            seq=np.arange(len(uv)),
            uv=uv[:, c],
            area_px2=400.0 * seen,
            quality=seen,
        )
    numbers = tmp_path / "time.json"
    code, text = run(folder, "--detections", tmp_path, "--json", numbers)
    assert code == 0, text
    measured = msgspec.json.decode(numbers.read_bytes())
    assert abs(measured["offset_us"]["right"] - 1e3 * late_ms) < 600.0
    assert measured["significant"]["right"] == (late_ms != 0.0)
