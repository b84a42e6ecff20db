"""The oracle: what it counts, by hand, and that a worse solver fails where a solver against itself does not."""

import json
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from bench.__main__ import main
from bench.hands.motion import recordings
from bench.oracle import sets
from bench.oracle.score import ALL, Solved, compare, figures, judged, samples_of, table
from bench.oracle.sets import CALIBRATION, DESK, Replayed, shown_piece
from bench.oracle.solve import run
from bench.oracle.truth import Piece, Truth, calibration_files, freeze, sets_of, truths_of
from common.arrays import Float
from common.errors import RecordingError
from common.recording.recorded_files import read_npz, write_npz
from common.sim.scenes import scene_by_name
from master.rig.setup import load_setup

_STEP_NS = 10_000_000


@cache
def piece() -> Piece:
    """A fifth of a second of the standard scene."""
    desk = load_setup(CALIBRATION, DESK)
    scene = scene_by_name("standard", desk.rig, desk.cameras, desk.hand.profile, 7)
    return shown_piece("seed7", calibration_files(CALIBRATION, DESK), scene, 0.2, 7)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one frozen set and a run of it."""
    folder = tmp_path_factory.mktemp("oracle")
    freeze(folder, "standard", [piece()])
    assert set(run(folder, "base", ["standard"], None)) == {"standard"}
    return folder


def moving(count: int = 60, still: bool = False) -> tuple[Truth, Solved]:
    """A hand that swings by 5 cm once a second, and a run that has it exactly, with 2 mm of claimed deviation."""
    t_ns = _STEP_NS * np.arange(-20, count + 20)
    swing = np.zeros(len(t_ns)) if still else 0.05 * np.sin(2e-9 * np.pi * t_ns)
    joints_m = np.tile(np.array([0.0, 0.0, 0.5]), (len(t_ns), 26, 1))
    joints_m[:, :, 0] += swing[:, None]
    truth = Truth(t_ns, joints_m, np.zeros((len(t_ns), 5, 4)))
    shown = slice(20, 20 + count)
    solved = Solved(
        piece=np.array(["one"] * count, np.str_),
        t_ns=t_ns[shown],
        position_m=joints_m[shown].copy(),
        angles_rad=np.zeros((count, 5, 4)),
        cov_m2=np.tile(4e-6 * np.eye(3), (count, 26, 1, 1)),
        valid=np.ones((count, 26), np.bool_),
        tracked=np.ones((count, 26), np.bool_),
        spent_us=np.full(count, 100.0),
    )
    return truth, solved


def figures_of(truth: Truth, solved: Solved, other: Solved | None = None) -> dict[str, float]:
    return figures(samples_of(solved, {"one": truth}, other))


def test_truth_is_read_between_its_rows_and_not_beyond() -> None:
    joints_m = np.zeros((2, 26, 3))
    joints_m[1] = 0.01
    truth = Truth(np.array([0, 10_000_000]), joints_m, np.zeros((2, 5, 4)))
    found = truth.at(np.array([2_500_000, 20_000_000]))[0]
    np.testing.assert_allclose(found[0], 0.0025)
    assert np.isnan(found[1]).all()
    still = replace(truth, continuous=False).at(np.array([15_000_000, 200_000_000]))[0]
    np.testing.assert_allclose(still[0], 0.01)
    assert np.isnan(still[1]).all()


def test_an_exact_run_has_no_error_and_no_lag() -> None:
    found = figures_of(*moving())
    assert found["joint mm"] == found["99 % mm"] == found["PIP deg"] == found["false TRACKED %"] == 0.0
    assert found["cover %"] == found["valid %"] == found["TRACKED %"] == 100.0
    assert found["lag ms"] == pytest.approx(0.0, abs=0.1)
    assert np.isnan(found["jitter mm"])  # it never rests
    assert found["pose us"] == 100.0


def test_a_region_holds_the_truth_up_to_its_edge() -> None:
    truth, solved = moving()
    edge_m = 2e-3 * np.sqrt(7.814728)
    for share, inside in ((0.99, 100.0), (1.01, 0.0)):
        off = replace(solved, position_m=solved.position_m + np.array([0.0, share * edge_m, 0.0]))
        assert figures_of(truth, off)["cover %"] == inside
    unknown = replace(solved, cov_m2=np.full_like(solved.cov_m2, np.nan))
    assert figures_of(truth, unknown)["cover %"] == 0.0


def test_a_tracked_joint_is_false_by_its_place_or_by_the_bend_of_its_finger() -> None:
    truth, solved = moving()
    off_m = np.zeros((26, 3))
    off_m[1, 2] = 0.016
    away = replace(solved, position_m=solved.position_m + off_m)
    assert figures_of(truth, away)["false TRACKED %"] == pytest.approx(100.0 / 26)
    bent = solved.angles_rad.copy()
    bent[:, 2, 2] = np.radians(21.0)
    wrong = replace(solved, angles_rad=bent)
    assert figures_of(truth, wrong)["false TRACKED %"] == pytest.approx(500.0 / 26)
    hidden = replace(wrong, tracked=solved.tracked & (np.arange(26) < 11))
    assert figures_of(truth, hidden)["false TRACKED %"] == 0.0


def test_what_follows_late_has_that_lag() -> None:
    truth, solved = moving(150)
    late = replace(solved, position_m=truth.at(solved.t_ns - 13_000_000)[0])
    assert figures_of(truth, late)["lag ms"] == pytest.approx(13.0, abs=0.2)


def test_jitter_is_what_moves_while_the_truth_rests() -> None:
    truth, solved = moving(still=True)
    shaken = solved.position_m.copy()
    shaken[::2, :, 1] += 1e-3
    found = figures_of(truth, replace(solved, position_m=shaken))
    assert found["jitter mm"] == pytest.approx(1.0)
    assert np.isnan(found["lag ms"])


def test_poses_that_only_the_other_run_has_are_missed() -> None:
    truth, solved = moving(60)
    half = Solved(**{name: getattr(solved, name)[::2] for name in Solved.__slots__})
    found = figures_of(truth, half, solved)
    assert found["no hand"] == 30.0
    assert found["valid %"] == pytest.approx(50.0)
    assert figures_of(truth, solved, half)["no hand"] == 0.0


def test_a_hand_where_there_is_none_is_a_ghost() -> None:
    truth, solved = moving(10)
    nothing = replace(truth, joints_m=np.full_like(truth.joints_m, np.nan))
    was, now = figures_of(nothing, replace(solved, valid=~solved.valid)), figures_of(nothing, solved)
    assert now["ghosts"] == 10.0
    assert any("ghosts" in text for text in judged("sweeps", was, now).fails)


def test_the_same_code_makes_the_same_hands(out: Path) -> None:
    assert set(run(out, "again", ["standard"], None)) == {"standard"}
    once, again = (read_npz(out / name / "standard.npz") for name in ("base", "again"))
    for name in once.keys() - {"spent_us"}:
        np.testing.assert_array_equal(once[name], again[name])
    assert once["position_m"].shape == (12, 26, 3)
    assert (once["spent_us"] > 0.0).all()
    found = compare(out, "base", "again", ["standard"])
    assert [one.name for one in found] == ["standard", ALL]
    assert found[0].fails == ()
    assert found[0].new["joint mm"] < 5.0


@pytest.mark.parametrize(
    ("off_mm", "cov", "hide", "what"),
    [(0.5, 1.0, False, "joint mm"), (0.0, 0.01, False, "cover %"), (0.0, 1.0, True, "valid %")],
)
def test_a_worse_solver_fails(
    out: Path, capsys: pytest.CaptureFixture[str], off_mm: float, cov: float, hide: bool, what: str
) -> None:
    worse = read_npz(out / "base" / "standard.npz")
    truth = truths_of(out, "standard")["seed7"].at(worse["t_ns"].astype(np.int64))[0]
    error: Float = worse["position_m"] - truth
    away = error / np.linalg.norm(error, axis=2, keepdims=True)
    worse["position_m"] = worse["position_m"] + 1e-3 * off_mm * away
    worse["cov_m2"] = cov * worse["cov_m2"]
    if hide:
        worse["valid"][:, 20:] = worse["tracked"][:, 20:] = False
    (out / "worse").mkdir(exist_ok=True)
    write_npz(out / "worse" / "standard.npz", worse)
    kept = out / "figures.json"
    assert main(["oracle", "compare", "base", "worse", "--out", str(out), "--json", str(kept)]) == 1
    assert "FAILS" in capsys.readouterr().out
    assert any(what in text for text in json.loads(kept.read_text())["standard"]["fails"])


def test_both_solvers_are_run_in_turns_by_processes(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = Path(__file__).resolve().parents[2]
    code = main(["oracle", "compare", "then", "now", "--tree", str(root), "--out", str(out)])
    shown = capsys.readouterr().out
    found = compare(out, "then", "now", ["standard"])
    assert code == int(any(one.fails for one in found))
    assert table(found) in shown
    then, base = (read_npz(out / name / "standard.npz")["position_m"] for name in ("then", "base"))
    np.testing.assert_array_equal(then, base)


def test_what_is_not_frozen_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str], out: Path) -> None:
    assert main(["oracle", "run", "--name", "x", "--out", str(tmp_path)]) == 2
    assert "nothing is frozen" in capsys.readouterr().err
    assert main(["oracle", "run", "--name", "x", "--out", str(out), "--sets", "attic"]) == 2
    assert "'attic'" in capsys.readouterr().err
    with pytest.raises(RecordingError):
        compare(out, "base", "never", ["standard"])


def test_without_the_data_the_simulated_sets_are_frozen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def short(*_: str) -> Iterator[Piece]:
        yield piece()

    for name in ("scenes", "held", "in_room"):
        monkeypatch.setattr(sets, name, short)
    monkeypatch.setattr(sets, "fused", short)
    monkeypatch.setenv("PHALANX_DATASETS", str(tmp_path / "nowhere"))
    assert main(["oracle", "freeze", "--out", str(tmp_path)]) == 0
    assert "only the simulated sets" in capsys.readouterr().out
    assert sets_of(tmp_path) == [
        "both-travel",
        *(f"fused-{name}" for name in ("curl", "grasp", "grip", "grip-slow", "poses", "travel")),
        "grasp",
        "held",
        "rendered-grasp",
        "rendered-grip",
        "room",
        "standard",
    ]
    assert main(["oracle", "freeze", "--out", str(tmp_path), "--sets", "leap"]) == 2
    assert "PHALANX_DATASETS" in capsys.readouterr().err


def test_a_recorded_hand_is_played_as_it_was(datasets: Path) -> None:
    recorded = next(one for one in recordings(datasets / "leapjs") if one.name == "wave")
    played = Replayed.of(recorded, recorded.model(), np.array([0.0, 0.0, 0.5]))
    k = 17
    found = played.joints(float(played.t_s[k]))
    between = np.linalg.norm(found[:, None] - found, axis=2)
    exact = recorded.in_rig()[k]
    np.testing.assert_allclose(between, np.linalg.norm(exact[:, None] - exact, axis=2), atol=1e-6)
    state = played.at(float(played.t_s[k - 1]))
    drawn = recorded.model().chains(state.angles_rad).position_m.reshape(20, 3)
    assert np.abs(drawn - recorded.fingers_m[k - 1].reshape(20, 3)).max() < 2e-3
    dorsal = np.array([played.palm(float(t))[:3, 1] for t in played.t_s]).mean(axis=0)
    assert dorsal[2] < -0.9  # towards the cameras
