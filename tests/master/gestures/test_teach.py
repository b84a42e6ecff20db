"""PoseTemplate poses: known again from other holds, told from the study's, refused where they are not, saved whole."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.arrays import Float
from common.calibration import HandProfile, load, save
from common.calibration.gesture_settings import GestureSettings, default_gestures
from common.clock import Clock
from common.errors import FitError, PhalanxError
from common.hand.model import HandModel
from common.messages import HandPose
from master.gestures.command import seconds_of, with_pose
from master.gestures.features import FeatureExtractor, HandFeatures
from master.gestures.poses import PoseRecogniser
from master.gestures.templates import Example, learn, template_session, what_lacks
from master.outputs.poses import PosesFile
from tests.cli import invoke
from tests.hand_helpers import RIGHT
from tests.master.gestures.shown_hands import FRAME_NS, OPEN, PINCH, POINT, SMALL, posture, shown

SETTINGS = default_gestures()
CALIB_JSON = Path(__file__).parents[3] / "calib_json"


def horns(change_deg: Float | None = None, model: HandModel = RIGHT) -> Float:
    """Index and little finger stretched, the others bent."""
    angles = posture(SMALL, change_deg, model)
    angles[[1, 4]] = posture(OPEN, change_deg, model)[[1, 4]]
    return angles


def variation(rng: np.random.Generator) -> Float:
    """(5, 3) [deg] by which nobody repeats a pose."""
    return np.array([1.0, 2.5, 4.0]) * rng.normal(size=(5, 3))


def frames(angles: Float, count: int = 8, start: int = 0) -> list[HandFeatures]:
    made = [FeatureExtractor(RIGHT).of(shown(angles, (start + k) * FRAME_NS)) for k in range(count)]
    return [one for one in made if one is not None]


def examples(count: int, seed: int = 1, model: HandModel = RIGHT) -> list[Example]:
    rng = np.random.default_rng(seed)
    return [Example.of(frames(horns(variation(rng), model))) for _ in range(count)]


@pytest.mark.parametrize("count", [3, 10])
def test_a_taught_pose_is_known_again_and_changes_no_other(count: int) -> None:
    settings = with_pose(SETTINGS, "horns", learn("horns", examples(count), SETTINGS), "a test")
    rng = np.random.default_rng(100)
    known = 0
    for _ in range(40):
        recogniser = PoseRecogniser(settings)
        for one in frames(horns(variation(rng)), 5):
            recogniser.push(one)
        known += recogniser.held == "horns"
    assert known >= 38
    for name in SETTINGS.poses:
        recogniser = PoseRecogniser(settings)
        for one in frames(posture(name), 5):
            recogniser.push(one)
        assert recogniser.held == name


def test_what_distinguishes_it_is_printed() -> None:
    stated = learn("horns", examples(4), SETTINGS).stated
    pointing = next(line for line in stated if line.startswith("from pointing"))
    assert "little_bend_deg" in pointing
    assert any(line.startswith("each example fits") for line in stated)


def test_a_pose_like_another_is_refused_and_named() -> None:
    rng = np.random.default_rng(2)
    same = [Example.of(frames(posture(POINT, variation(rng)))) for _ in range(4)]
    with pytest.raises(FitError, match=r"gun: too like 'pointing'.*--within pointing"):
        learn("gun", same, SETTINGS)
    templates = with_pose(SETTINGS, "horns", learn("horns", examples(4), SETTINGS), "a test")
    with pytest.raises(FitError, match="too like 'horns'"):
        learn("metal", examples(4, seed=9), templates)
    again = learn("horns", examples(4, seed=9), templates)  # the same name: it is taught anew
    assert again.shape != templates.poses["horns"]


def test_a_special_case_wins_over_its_general_one_and_leaves_it_the_rest() -> None:
    rng = np.random.default_rng(3)
    ok = np.array([[0, 0, 0], [8, 8, 8], *([[0, -16, -20]] * 3)], np.float64)  # a pinch, the others straight
    shown_ok = [Example.of(frames(posture(PINCH, ok + 0.5 * variation(rng)))) for _ in range(5)]
    settings = with_pose(SETTINGS, "ok", learn("ok", shown_ok, SETTINGS, within=PINCH), "a test")
    for angles, name in ((posture(PINCH, ok), "ok"), (posture(PINCH), PINCH)):
        recogniser = PoseRecogniser(settings)
        for one in frames(angles, 6):
            recogniser.push(one)
        assert recogniser.held == name
    with pytest.raises(FitError, match="no pose 'pinsh'"):
        learn("ok", shown_ok, SETTINGS, within="pinsh")


def test_examples_that_show_no_pose_are_refused() -> None:
    with pytest.raises(FitError, match="2 examples, 3 to 10"):
        learn("horns", examples(2), SETTINGS)
    mixed = [*examples(2), Example.of(frames(posture(SMALL)))]
    with pytest.raises(FitError, match=r"do not show one pose: index_(mcp|pip)_deg"):
        learn("mixed", mixed, SETTINGS)
    with pytest.raises(FitError, match="hold it longer"):
        Example.of(frames(horns(), 2))


def test_a_hidden_hand_cannot_teach() -> None:
    sigma_m, hidden = np.full(5, 0.1), np.zeros(5, np.bool_)
    made = [
        FeatureExtractor(RIGHT).of(shown(horns(), k * FRAME_NS, sigma_m=sigma_m, tracked=hidden))
        for k in range(8)
    ]
    unseen = Example.of([one for one in made if one is not None])
    with pytest.raises(FitError, match="cannot be seen"):
        learn("horns", [unseen] * 3, SETTINGS)


class Stage(Clock):
    """A person before the master, on a clock of frames: shows what `angles` has for the time."""

    def __init__(self, moving: bool = False, silent: bool = False) -> None:
        self.t_ns, self._moving, self._silent = 0, moving, silent

    def now_ns(self) -> int:
        """The time."""
        return self.t_ns

    def receive(self, _timeout_s: float) -> HandPose | None:
        """The next pose."""
        self.t_ns += FRAME_NS
        swing = 30.0 * np.sin(2e-9 * np.pi * self.t_ns) if self._moving else 0.0
        change = np.zeros((5, 3))
        change[1:, 2] = swing
        return None if self._silent else shown(horns(change), self.t_ns)


def test_the_lesson_counts_down_and_collects_holds() -> None:
    stage, stated = Stage(), list[str]()
    taken = template_session(stage.receive, RIGHT, "horns", 3, stage, stated.append)
    assert len(taken) == 3
    assert [line for line in stated if line[0].isdigit() and line.endswith("...")] == [
        "3 ...",
        "2 ...",
        "1 ...",
    ] * 3
    assert learn("horns", taken, SETTINGS).shape.ranges


@pytest.mark.parametrize(("stage", "why"), [(Stage(moving=True), "moved"), (Stage(silent=True), "no hand")])
def test_a_hand_that_moves_or_is_not_there_is_asked_again_and_then_given_up(stage: Stage, why: str) -> None:
    stated = list[str]()
    with pytest.raises(FitError, match="example 1: not seen at rest in 3 tries"):
        template_session(stage.receive, RIGHT, "horns", 3, stage, stated.append)
    assert sum(why in line for line in stated) == 3
    assert what_lacks([]) != ""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, HandModel]:
    """poses.npz of a hand that shows horns in each even second, and an open palm in each odd one."""
    model = HandModel.of(load(CALIB_JSON / "hands" / "default-right.json", HandProfile))
    path, rng = tmp_path_factory.mktemp("run") / "poses.npz", np.random.default_rng(4)
    sink = PosesFile(path, model.profile.name, 0)
    for second in range(8):
        change = variation(rng)
        angles = posture(OPEN, change, model) if second % 2 else horns(change, model)
        for k in range(60):
            sink.write(shown(angles, (60 * second + k) * FRAME_NS, model))
    sink.close()
    return path, model


def test_the_commands_teach_from_a_file_read_it_list_and_forget(
    run: tuple[Path, HandModel], tmp_path: Path
) -> None:
    mine = tmp_path / "mine.json"
    save(mine, msgspec.structs.replace(SETTINGS, name="mine"))
    given = ["--settings", str(mine), "--calibration", str(CALIB_JSON)]
    ranges = ["--range", "0.2-0.9", "--range", "2.2-2.9", "--range", "4.2-4.9", "--range", "6.2-6.9"]
    templates = invoke("gestures", "--teach", "horns", "--poses", run[0], *ranges, *given)
    assert templates.exit_code == 0, templates.output
    assert "from pointing" in templates.output
    written = load(mine, GestureSettings)
    assert written.provenance["horns"].residual["examples"] == 4.0
    read = invoke("gestures", "--poses", run[0], *given)
    assert read.exit_code == 0, read.output
    names = [line.split(" pose ")[1].split()[0] for line in read.output.splitlines() if " pose " in line]
    assert names == ["horns", "open_palm"] * 4
    listed = invoke("gestures", *given)
    assert "horns (template of" in listed.output
    gone = invoke("gestures", "--forget", "horns", *given)
    assert gone.exit_code == 0
    assert load(mine, GestureSettings).poses == SETTINGS.poses


def test_a_refused_pose_leaves_the_file_as_it_was(run: tuple[Path, HandModel], tmp_path: Path) -> None:
    mine = tmp_path / "mine.json"
    save(mine, SETTINGS)
    before = mine.read_bytes()
    ranges = [part for second in (1, 3, 5) for part in ("--range", f"{second}.2-{second}.9")]
    given = ["--settings", str(mine), "--calibration", str(CALIB_JSON), "--poses", str(run[0])]
    with pytest.raises(FitError, match="too like 'open_palm'"):
        invoke("gestures", "--teach", "palm", *ranges, *given)
    assert mine.read_bytes() == before


@pytest.mark.parametrize("text", ["1", "2-1", "a-b", "1-2-3"])
def test_a_range_is_two_rising_numbers(text: str) -> None:
    with pytest.raises(PhalanxError, match="--range"):
        seconds_of(text)
