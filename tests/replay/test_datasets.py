"""The whole offline line on rendered recordings with exact truth: colours, detection, solving, by its commands.

The bars are those the project has set itself: no wrong blob, 95 % of half-visible markers found, caps within 4 mm,
joints within 8 mm, the same bytes on every run.
"""

from pathlib import Path

import numpy as np
import pytest

from common.arrays import Bool, Float
from master.outputs.poses import Poses
from tests.replay.replayed import Replay, colours_of, command, replay

HANDS = ("calib_colors", "static", "flex90", "poses_left", "translate_8ms", "lights_0_warm")
SWEEPS = ("sweep_paper", "sweep_rough")


@pytest.fixture(scope="module")
def calibration(datasets: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A calib_json tree: colours learnt from the clicks of calib_colors, hands of the data sets."""
    return colours_of(datasets, tmp_path_factory.mktemp("calib_json"))


@pytest.fixture(scope="module")
def replays(datasets: Path, calibration: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Replay]:
    """Every recording of the set, replayed once."""
    stereo, given = datasets / "stereo", ("--calibration", calibration)
    return {name: replay(stereo / name, tmp_path_factory.mktemp(name), *given) for name in (*HANDS, *SWEEPS)}


def seen_and_true(replayed: Replay) -> tuple[Float, Float, Float, Float]:
    """Found uv (N, 2, M, 2), true uv, visible share (N, 2, M), area of the whole marker [px^2] (N, 2, M)."""
    truth = replayed.truth()
    found = np.stack([replayed.detections(camera)["uv"] for camera in ("left", "right")], axis=1)
    count = len(found)
    if "depth" in truth:  # one flat marker, the one whose paint the set uses
        shown = {"sweep_paper": 1, "sweep_rough": 2}[replayed.recording.name]
        uv, frac, px = np.full(found.shape, np.nan), np.zeros(found.shape[:3]), np.zeros(found.shape[:3])
        uv[:, :, shown], frac[:, :, shown], px[:, :, shown] = truth["uv"], truth["frac"], truth["px"]
        return found, uv, frac, px

    def stretch(values: Float) -> Float:  # one truth for all frames of a still hand
        return np.broadcast_to(values, (count, *values.shape[1:]))

    return found, stretch(truth["uv"]), stretch(truth["frac"]), stretch(truth["px"])


def wrong(found: Float, uv: Float, frac: Float, px: Float) -> Bool:
    """Reported where nothing is to be seen, or farther off than 3 px and half a blob's diameter."""
    reported = np.isfinite(found).all(axis=-1)
    limit = np.maximum(3.0, np.sqrt(np.maximum(px, 0.0) / np.pi))
    off = np.linalg.norm(found - uv, axis=-1)
    return reported & ((frac == 0.0) | ~(off <= limit))


@pytest.mark.parametrize("name", [*HANDS, *SWEEPS])
def test_no_wrong_blob_is_reported(replays: dict[str, Replay], name: str) -> None:
    found, uv, frac, px = seen_and_true(replays[name])
    assert np.isfinite(found).any()
    bad = np.argwhere(wrong(found, uv, frac, px))
    assert len(bad) == 0, f"(frame, camera, marker): {bad.tolist()}"


@pytest.mark.parametrize("name", [*HANDS, *SWEEPS])
def test_at_least_95_of_100_markers_are_found(replays: dict[str, Replay], name: str) -> None:
    found, _, frac, _ = seen_and_true(replays[name])
    wanted = frac >= 0.5
    hit = wanted & np.isfinite(found).all(axis=-1)
    missed = np.argwhere(wanted & ~hit).tolist()
    assert hit.sum() >= 0.95 * wanted.sum(), f"{hit.sum()} of {wanted.sum()}; missing {missed}"


def test_a_planted_wrong_blob_is_noticed(replays: dict[str, Replay]) -> None:
    found, uv, frac, px = (values.copy() for values in seen_and_true(replays["calib_colors"]))
    found[0, 0, 1] += np.sqrt(px[0, 0, 1] / np.pi) + 4.0
    assert wrong(found, uv, frac, px).sum() == 1
    frac[0, 1, 2] = 0.0
    assert wrong(found, uv, frac, px).sum() == 2


@pytest.mark.parametrize("name", [*HANDS, *SWEEPS])
def test_caps_are_within_two_and_a_half_millimetres(replays: dict[str, Replay], name: str) -> None:
    replayed = replays[name]
    truth, raw = replayed.truth(), Poses.load(replayed.out / "poses.npz").markers_raw_m
    _, _, frac, _ = seen_and_true(replayed)
    clear = (frac >= 0.5).all(axis=1)
    centroid = truth["center"][:, None] if "depth" in truth else truth["paint_centroid"]
    error_mm = 1e3 * np.linalg.norm(raw - centroid, axis=-1)[clear]
    assert np.isfinite(error_mm).any()
    assert np.nanmedian(error_mm) <= 2.5
    assert replayed.summary["marker_raw_mm"] == pytest.approx(np.nanmedian(error_mm), abs=1e-3)


@pytest.mark.parametrize("name", HANDS)
def test_joints_of_visible_fingers_are_within_five_millimetres(replays: dict[str, Replay], name: str) -> None:
    replayed = replays[name]
    summary = replayed.summary
    assert summary["joint_mm_visible"] <= 5.0
    # Of the six unrelated poses hardly two tips show in one frame; two more are slivers that are not found.
    assert summary["pip_deg_visible"] <= (7.0 if name == "poses_left" else 6.0)
    # The score against our own sum: fingers clear in both cameras, and the wrist.
    truth, poses = replayed.truth(), Poses.load(replayed.out / "poses.npz")
    _, _, frac, _ = seen_and_true(replayed)
    clear = np.asarray((frac >= 0.5).all(axis=1))
    fingers = np.repeat(np.arange(5), [4, 5, 5, 5, 5])
    use = np.concatenate([np.ones((len(clear), 1), dtype=bool), clear[:, fingers]], axis=1)
    error_mm = 1e3 * np.linalg.norm(poses.position_m[:, 1:] - truth["joints"], axis=-1)
    use &= np.isfinite(error_mm)
    assert summary["joint_mm_visible"] == pytest.approx(error_mm[use].mean(), abs=1e-3)


@pytest.mark.parametrize("name", HANDS)
def test_a_pose_for_every_frame_of_the_reference_camera(replays: dict[str, Replay], name: str) -> None:
    poses, left = Poses.load(replays[name].out / "poses.npz"), replays[name].detections("left")
    assert len(poses) == len(left["t_ns"])
    assert (np.diff(poses.t_ns) > 0).all()
    model_ok = np.isfinite(poses.position_m).all(axis=(1, 2))
    np.testing.assert_array_equal(poses.valid.all(axis=1), model_ok)


def test_a_process_of_its_own_writes_the_same_bytes(
    replays: dict[str, Replay], root: Path, calibration: Path, tmp_path: Path
) -> None:
    first = replays["translate_8ms"]
    options = ("--calibration", calibration, "--out", tmp_path)
    command(root, "master", "replay", first.recording, *options)
    names = sorted(path.name for path in first.out.glob("*.npz"))
    assert names == ["detections_left.npz", "detections_right.npz", "poses.npz"]
    for name in names:
        assert (first.out / name).read_bytes() == (tmp_path / name).read_bytes(), name
