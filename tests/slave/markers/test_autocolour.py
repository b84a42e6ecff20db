"""Colours from a moving hand, against the exact truth of rendered frames."""

import json
from collections.abc import Callable, Sequence
from functools import cache
from itertools import permutations
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.arrays import Float
from common.calibration import CameraCalibration, HsvRange, load
from common.errors import CalibrationError, FitError, RecordingError
from common.sim.record import record_scene
from slave.__main__ import main
from slave.commands.offline import calibrate_colours, detect_recording
from slave.markers.autocolour import (
    MarkerColour,
    Namer,
    by_clicks,
    by_hand,
    by_hues,
    calibrate_moving,
    checked,
    pattern_of,
    votes_of,
)
from slave.markers.colours import ColourRow, calibrate, report
from slave.markers.detector import MarkerDetector
from tests.slave.commands.test_marker_datasets import truth_of
from tests.slave.moving_hand import (
    CAMERAS,
    HANDS,
    MUG_PX,
    NAMES,
    Change,
    Moving,
    cluttered,
    mirrored,
    moving,
    noisy,
    on_wood,
    own_and_foreign,
    repainted,
    scene,
    seconds,
    white_balanced,
    with_watch,
)

BY_HAND = by_hand(HANDS["right"], NAMES)
PATTERN = pattern_of(HANDS["right"], NAMES)
ORDERS = np.array(list(permutations(range(6))))


@cache
def opening() -> Moving:
    """A hand that opens, closes and wanders."""
    return moving(7, "left", seconds(0.0))


@cache
def in_clutter() -> Moving:
    return cluttered(opening())


@cache
def rows_of(frames: Callable[[], Moving]) -> tuple[list[ColourRow], list[str]]:
    """What is calibrated on these frames, and what is written meanwhile."""
    output: list[str] = []
    namer = by_hand(HANDS["right"], NAMES, output.append)
    return calibrate_moving(frames().images, NAMES, namer, output.append), output


def warm(frames: Moving) -> Moving:
    return white_balanced(0.6, 0.9, 1.15)(cluttered(frames))


def cold(frames: Moving) -> Moving:
    return white_balanced(1.35, 1.0, 0.7)(cluttered(frames))


def dark(frames: Moving) -> Moving:
    return noisy(3.0)(white_balanced(0.5, 0.5, 0.5)(frames))


@pytest.mark.parametrize(
    ("seed", "camera", "start_s", "change"),
    [
        (9, "left", 14.0, warm),
        (10, "right", 20.0, cold),
        (11, "left", 35.0, dark),
        (12, "right", 50.0, on_wood),
    ],
)
def test_every_marker_gets_its_own_colour(seed: int, camera: str, start_s: float, change: Change) -> None:
    frames = change(moving(seed, camera, seconds(start_s)))
    check_own(frames, calibrate_moving(frames.images, NAMES, BY_HAND))


def check_own(frames: Moving, rows: list[ColourRow]) -> None:
    assert tuple(row.name for row in rows) == NAMES
    own, foreign = own_and_foreign(frames, {row.name: row.range for row in rows})
    assert own > 0.97
    assert foreign == 0.0
    assert all(not row.others or max(row.others.values()) < 0.01 for row in rows)
    assert all(row.skin < 0.001 for row in rows)


def found_and_wrong(frames: Moving, ranges: dict[str, HsvRange]) -> tuple[float, int]:
    detector = MarkerDetector(msgspec.structs.replace(CAMERAS["left"], markers=ranges), NAMES)
    uv = np.array([detector.fresh().push(image, 0).uv for image in frames.images])
    seen = np.isfinite(uv[..., 0])
    right = np.hypot(*np.moveaxis(uv - frames.uv, -1, 0)) <= np.maximum(3.0, np.sqrt(frames.area / np.pi))
    half = frames.visible >= 0.5
    return float((half & seen & right).sum() / half.sum()), int((seen & ~right).sum())


def test_what_is_found_with_them_is_what_is_found_with_clicked_colours() -> None:
    rows, _ = rows_of(in_clutter)
    check_own(in_clutter(), rows)
    still = cluttered(moving(7, "left", (20.0,)))
    clicks = {n: (float(u), float(v)) for n, (u, v) in zip(NAMES, still.uv[0].tolist(), strict=True)}
    clicked = calibrate(still.images[0], clicks)
    fresh = cluttered(moving(7, "left", tuple(np.linspace(6.0, 59.0, 24).tolist())))
    auto_found, auto_wrong = found_and_wrong(fresh, {row.name: row.range for row in rows})
    found, wrong = found_and_wrong(fresh, {row.name: row.range for row in clicked})
    assert auto_found >= found - 0.01
    assert auto_wrong <= wrong
    for row, other in zip(rows, clicked, strict=True):
        assert row.range.reference_bgr_linear == pytest.approx(other.range.reference_bgr_linear, rel=0.35)


def test_things_of_a_paints_colour_on_the_desk_are_counted() -> None:
    rows = {row.name: row for row in rows_of(in_clutter)[0]}
    assert rows["index"].background_px == pytest.approx(np.pi * MUG_PX**2 + 400.0, rel=0.3)
    assert rows["middle"].background_px > 200.0  # the pen
    text = report(list(rows.values()))
    assert "collisions: index, middle" in text
    assert "warning: index" in text
    clean, _ = rows_of(opening)
    check_own(opening(), clean)
    assert max(row.background_px for row in clean) < 24
    assert "no collisions" in report(clean)
    assert "warning" not in report(clean)


def test_what_was_found_is_said() -> None:
    _, output = rows_of(opening)
    assert sum(line.startswith("paint of hue") for line in output) == 6
    assert any("votes" in line for line in output)


def every_other(frames: Moving) -> Moving:
    return Moving(frames.images[::2], frames.uv[::2], frames.visible[::2], frames.area[::2], frames.desk)


def stopped(frames: Moving) -> Moving:
    return noisy(2.0)(Moving([frames.images[0]] * 12, frames.uv, frames.visible, frames.area, frames.desk))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (stopped, "nothing moves"),
        (repainted("thumb", 12), r"5 paints move with the hand .* 6 markers"),
        (with_watch, r"7 colours move|two things of hue|look like the open hand"),
        (mirrored, "mirror image of 'default-right'"),
    ],
)
def test_what_cannot_be_distinguished_is_refused(change: Change, message: str) -> None:
    with pytest.raises(FitError, match=message):
        calibrate_moving(change(every_other(opening())).images, NAMES, BY_HAND)


def test_the_other_hand_is_named_by_its_own_profile() -> None:
    frames = mirrored(every_other(opening()))
    rows = calibrate_moving(frames.images, NAMES, by_hand(HANDS["left"], NAMES))
    assert own_and_foreign(opening(), {row.name: row.range for row in rows})[0] > 0.97


def test_a_few_frames_are_not_enough() -> None:
    with pytest.raises(FitError, match="7 frames, at least 8"):
        calibrate_moving(opening().images[:7], NAMES, BY_HAND)


@given(
    st.permutations(range(6)), st.floats(-3.0, 3.0), st.floats(500.0, 5000.0), st.none() | st.integers(0, 5)
)
def test_a_turned_and_scaled_hand_votes_for_its_order(
    order: list[int], angle: float, scale: float, hidden: int | None
) -> None:
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    uv = (scale * PATTERN @ rotation.T + 300.0)[None, order].copy()
    if hidden is not None:
        uv[0, hidden] = np.nan
    votes, against = votes_of(uv, PATTERN, ORDERS)
    assert [tuple(ORDERS[v]) for v in votes] == [tuple(order)]
    assert against == 0
    votes, against = votes_of(uv * (-1.0, 1.0), PATTERN, ORDERS)
    assert (votes, against) == ([], 1)


def test_points_that_are_no_hand_do_not_vote() -> None:
    angle = np.arange(6) * np.pi / 3.0
    hexagon = 100.0 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    assert votes_of(hexagon[None], PATTERN, ORDERS) == ([], 0)
    hexagon[:2] = np.nan
    assert votes_of(hexagon[None], PATTERN, ORDERS) == ([], 0)


def ranges_at(*hues: float) -> dict[str, HsvRange]:
    return {
        name: HsvRange(hsv_low=(round(h - 8) % 180, 60, 40), hsv_high=(round(h + 8) % 180, 255, 255))
        for name, h in zip(NAMES, hues, strict=True)
    }


def colours_at(*hues: float) -> list[MarkerColour]:
    return [MarkerColour(hue % 180.0, ()) for hue in hues]


def named(namer: Namer, colours: list[MarkerColour]) -> tuple[str, ...]:
    return namer(colours, np.full((1, len(colours), 2), np.nan))


@given(st.floats(-11.0, 11.0), st.permutations(range(6)))
def test_names_by_hue_survive_another_lamp(shift: float, order: list[int]) -> None:
    hues = (92.0, 68.0, 113.0, 136.0, 172.0, 4.0)
    shifted = [hues[k] + shift for k in order]  # across 0 and 180, too
    namer = by_hues(ranges_at(*hues), NAMES, "old.json")
    assert named(namer, colours_at(*shifted)) == tuple(NAMES[k] for k in order)


def test_hues_that_fit_in_two_orders_name_nothing() -> None:
    even = tuple(30.0 * k for k in range(6))
    namer = by_hues(ranges_at(*even), NAMES, "old.json")
    assert named(namer, colours_at(*even)) == NAMES
    with pytest.raises(FitError, match=r"old.json: its hues fit in two orders"):
        named(namer, colours_at(*(h + 14.0 for h in even)))
    with pytest.raises(CalibrationError, match="no range for thumb, index"):
        by_hues(None, NAMES, "old.json")


def test_clicks_name_what_they_hit() -> None:
    uv = {n: (float(u), float(v)) for n, (u, v) in zip(NAMES, opening().uv[0].tolist(), strict=True)}
    given: list[tuple[Sequence[MarkerColour], Float]] = []

    def noted(colours: Sequence[MarkerColour], places: Float) -> tuple[str, ...]:
        given.append((colours, places))
        return by_clicks(uv, NAMES, 640)(colours, places)

    rows = calibrate_moving(opening().images, NAMES, noted)
    assert own_and_foreign(opening(), {row.name: row.range for row in rows}) == (1.0, 0.0)
    with pytest.raises(FitError, match=r"clicks.ring: no moving paint at \(20.0, 20.0\)"):
        by_clicks({**uv, "ring": (20.0, 20.0)}, NAMES, 640)(*given[0])
    with pytest.raises(FitError, match=r"clicks.ring: on the same paint as clicks.index"):
        by_clicks({**uv, "ring": uv["index"]}, NAMES, 640)(*given[0])


@pytest.mark.parametrize("names", [NAMES[:4], (*NAMES, "wrist", "knuckle")])
def test_too_few_or_too_many_markers_need_another_way_to_be_named(names: tuple[str, ...]) -> None:
    profile = HANDS["right"]
    mounts = profile.markers | dict.fromkeys(names[6:], profile.markers["back"])
    namer = by_hand(msgspec.structs.replace(profile, markers=mounts), names)
    with pytest.raises(FitError, match=f"{len(names)} markers cannot be named from the shape"):
        named(namer, [MarkerColour(20.0 * k, ()) for k in range(len(names))])


def test_names_that_the_shape_of_the_hand_contradicts_are_refused() -> None:
    output: list[str] = []
    unsure = by_hand(HANDS["right"], NAMES[:4])
    colours = colours_at(92.0, 68.0, 113.0, 136.0, 172.0, 42.0)
    hues = by_hues(ranges_at(92.0, 68.0, 113.0, 136.0, 172.0, 42.0), NAMES, "old.json")
    assert named(checked(hues, lambda _colours, _uv: NAMES, output.append), colours) == NAMES
    assert output == []
    assert named(checked(hues, unsure, output.append), colours) == NAMES
    assert "not checked" in output[0]
    swapped = ("index", "thumb", *NAMES[2:])
    with pytest.raises(FitError, match=r"hue 92: thumb or index, hue 68: index or thumb"):
        named(checked(hues, lambda _colours, _uv: swapped, output.append), colours)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a second of a hand that travels, by both cameras, without clicks."""
    folder = tmp_path_factory.mktemp("recording") / "travel"
    world = scene(7)
    travel = next(act for act in world.motion.acts if act.name == "travel")  # type: ignore[attr-defined]
    record_scene(folder, world, 0.5, travel.start_s + 0.8)
    path = folder / "recording.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "clicks": {}}))
    return folder


def test_a_recording_without_clicks_makes_a_camera_file(
    recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    root: Path,
) -> None:
    monkeypatch.chdir(root)
    left, right = tmp_path / "cameras/left.json", tmp_path / "cameras/right.json"
    assert main(["colours", str(recording), "--camera", "left", "-o", str(left)]) == 0
    assert main(["colours", str(recording), "--camera", "right", "--like", str(left), "-o", str(right)]) == 0
    out, err = capsys.readouterr()
    assert out.count("no collisions") == 2
    assert "left: reading 30 of 30 frames" in err
    assert load(left, CameraCalibration).markers is not None
    with np.load(recording / "truth.npz") as truth:
        for index, camera in enumerate(("left", "right")):
            found = detect_recording(recording, camera, tmp_path)
            error = np.hypot(*np.moveaxis(found.uv - truth["uv"][:, index], -1, 0))
            half = truth["frac"][:, index] >= 0.5
            assert np.isfinite(found.uv[..., 0])[half].mean() > 0.95
            assert np.nanmax(error) < 3.0


def test_a_wrong_profile_or_half_the_clicks_are_refused(
    recording: Path, tmp_path: Path, root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hand = root / "calib_json/hands/default-left.json"
    output = tmp_path / "left.json"
    assert main(["colours", str(recording), "--camera", "left", "--hand", str(hand), "-o", str(output)]) == 1
    assert "mirror image of 'default-left' (left)" in capsys.readouterr().err
    half = tmp_path / "half"
    half.mkdir()
    content = json.loads((recording / "recording.json").read_text())
    content["clicks"] = {"left": {"thumb": [10.0, 10.0]}}
    (half / "recording.json").write_text(json.dumps(content))
    (half / "frames.csv").write_text((recording / "frames.csv").read_text())
    with pytest.raises(RecordingError, match=r"clicks\.left: nothing for index, .* or --auto"):
        calibrate_colours(half, "left", output)
    assert not output.exists()


def test_rendered_frames_of_another_kind(datasets: Path, tmp_path: Path) -> None:
    """Path-traced skin, cloth and light, which share nothing with the simulation."""
    hand = datasets / "hands/webxr-right.json"
    for index, camera in enumerate(("left", "right")):
        output = tmp_path / f"cameras/{camera}.json"
        rows = calibrate_colours(datasets / "stereo/translate_8ms", camera, output, hand=hand)
        assert all(row.own > 0.99 and not row.others and row.background_px < 24 for row in rows)
        for name in ("lights_0_warm", "flex90"):
            folder = datasets / "stereo" / name
            found = detect_recording(folder, camera, tmp_path)
            truth = truth_of(folder, index, len(found.t_ns))
            error = np.hypot(*np.moveaxis(found.uv - truth.uv, -1, 0))
            seen = np.isfinite(found.uv[..., 0])
            assert (error[seen] <= np.maximum(3.0, np.sqrt(truth.area / np.pi))[seen]).all()
            assert seen[truth.frac >= 0.5].mean() >= 0.97


def test_fingers_that_never_move_are_not_taken_for_paint(datasets: Path, tmp_path: Path) -> None:
    hand = (
        datasets / "hands/webxr-right.json"
    )  # only thumb and index bend; the palm rests, skin all around its patch
    with pytest.raises(FitError, match=r"3 paints move .* hue 112, 142, 167 never moved"):
        calibrate_colours(datasets / "stereo/flex90", "left", tmp_path / "left.json", hand=hand)
