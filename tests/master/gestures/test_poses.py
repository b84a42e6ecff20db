"""The six study poses: of different hands and postures, between each other, in doubt, and none of them."""

from itertools import permutations
from pathlib import Path

import msgspec
import numpy as np
import pytest

from bench.study.trials import participant
from common.arrays import Bool, Float
from common.calibration import RigCalibration, load
from common.calibration.gesture_settings import GestureSettings, HoldSettings, default_gestures
from common.hand.model import HandModel
from common.messages import Gesture, HandPose
from common.sim.motion import POSES, REST, angles_of, smooth_step
from master.gestures.features import FeatureExtractor, HandFeatures
from master.gestures.poses import PoseRecogniser
from tests.hand_helpers import LEFT, RIGHT
from tests.master.gestures.shown_hands import FRAME_NS, LARGE, OPEN, PINCH, POINT, SMALL, TWO, posture, shown

SETTINGS = default_gestures()


def play(
    angles: list[Float],
    model: HandModel = RIGHT,
    settings: GestureSettings = SETTINGS,
    sigma_m: Float | None = None,
    tracked: Bool | None = None,
) -> tuple[list[str | None], list[Gesture]]:
    """What is held after each posture, and all that is said."""
    recogniser, held, said = PoseRecogniser(settings), list[str | None](), list[Gesture]()
    for k, one in enumerate(angles):
        features = FeatureExtractor(model).of(
            shown(one, k * FRAME_NS, model, sigma_m=sigma_m, tracked=tracked)
        )
        assert features is not None
        said += recogniser.push(features)
        held.append(recogniser.held)
    return held, said


@pytest.mark.parametrize("model", [RIGHT, LEFT])
@pytest.mark.parametrize("name", POSES)
def test_each_study_pose_is_recognised_from_the_third_frame_on(name: str, model: HandModel) -> None:
    held, said = play([posture(name, model=model)] * 6, model)
    assert held == [None, None, name, name, name, name]
    assert [one.phase for one in said] == ["begin", "update", "update", "update"]
    assert all(one.kind == "pose" and one.name == name and one.began_t_ns == 2 * FRAME_NS for one in said)
    assert said[0].confidence > 0.9


@pytest.mark.parametrize("name", POSES)
def test_different_people_make_it_differently(name: str) -> None:
    rng = np.random.default_rng(11)
    spread = np.array([1.0, 2.5, 4.0])  # the study's own variation from trial to trial
    wrong = 0
    for number in range(1, 13):
        own = HandModel.of(participant(5, number, _wrist_rig(), RIGHT.profile).hand)
        angles = posture(name, spread * rng.normal(size=(5, 3)), own)
        wrong += play([angles] * 4, own)[0][-1] != name
    assert wrong == 0


def test_a_relaxed_hand_and_other_shapes_are_none() -> None:
    relaxed = angles_of(RIGHT, np.array(REST, np.float64) + np.array([0.0, 4.0, 6.0]), np.zeros((5, 4)))
    horns, three, half = posture(SMALL), posture(TWO), posture(OPEN)
    horns[[1, 4]] = posture(OPEN)[[1, 4]]
    three[3] = posture(OPEN)[3]
    half[1:, 1:3] = np.radians([20.0, 20.0])
    for angles in (relaxed, horns, three, half):
        assert play([angles] * 30)[1] == []


@pytest.mark.parametrize(("before", "after"), list(permutations(POSES, 2)))
def test_nothing_else_is_said_on_the_way_from_one_to_another(before: str, after: str) -> None:
    a, b = posture(before), posture(after)
    moving = [a + smooth_step(k / 30.0) * (b - a) for k in range(31)]  # half a second
    held, said = play([a] * 8 + moving + [b] * 12)
    begun = [one.name for one in said if one.phase == "begin"]
    assert begun == [before, after]
    assert held[8 + 31 + 1] == after  # two frames after it has stopped
    assert held[-1] == after


def test_an_end_is_said_once_and_before_the_next_begin() -> None:
    _, said = play([posture(OPEN)] * 5 + [posture(POINT)] * 8)
    phases = [(one.name, one.phase) for one in said if one.phase != "update"]
    assert phases == [(OPEN, "begin"), (OPEN, "end"), (POINT, "begin")]


def test_uncertainty_at_the_border_flickers_neither_on_nor_off() -> None:
    rng = np.random.default_rng(7)
    border = np.zeros((5, 3))
    border[1:, 1:] = [4.0, 4.5]  # all fingers a little bent: between open palm and none
    angles = [posture(OPEN, border + rng.normal(0.0, 1.0, (5, 3))) for _ in range(240)]
    _, said = play(angles)
    assert sum(one.phase == "begin" for one in said) <= 2


def test_hidden_fingers_do_not_stop_a_pose_but_an_unknown_hand_begins_none() -> None:
    sigma_m, nothing = np.full(5, 0.2), np.zeros(5, np.bool_)
    assert play([posture(POINT)] * 60, sigma_m=sigma_m, tracked=nothing)[1] == []
    recogniser = PoseRecogniser(SETTINGS)
    for k in range(5):
        recogniser.push(_features(shown(posture(POINT), k * FRAME_NS)))
    assert recogniser.held == POINT
    said: list[Gesture] = []
    for k in range(5, 240):
        hidden = shown(posture(POINT), k * FRAME_NS, sigma_m=sigma_m, tracked=nothing)
        said += recogniser.push(_features(hidden))
    assert [one.phase for one in said].count("end") == 1
    kept_s = 1e-9 * (said[-1].t_ns - 4 * FRAME_NS)
    assert abs(kept_s - SETTINGS.hold.hidden_s) < 0.02
    confidence = [one.confidence for one in said]
    assert confidence == sorted(confidence, reverse=True)


def test_a_pose_of_known_fingers_begins_where_no_sensor_sees_a_tip_just_now() -> None:
    nothing = np.zeros(5, np.bool_)
    for sigma_m, said in ((0.005, [POINT]), (0.2, [])):
        begun = play([posture(POINT)] * 30, sigma_m=np.full(5, sigma_m), tracked=nothing)[1]
        assert [one.name for one in begun if one.phase == "begin"] == said


def test_pointing_is_recognised_with_the_three_bent_fingers_hidden() -> None:
    # What cameras see from behind a pointing hand: thumb and index.
    sigma_m = np.array([1e-3, 1e-3, 0.05, 0.05, 0.05])
    assert play([posture(POINT)] * 30, sigma_m=sigma_m, tracked=np.arange(5) < 2)[0][-1] == POINT


def test_an_open_palm_is_recognised_without_its_thumb() -> None:
    # A device at the wrist does not see it.
    sigma_m = np.array([0.05, 2e-3, 2e-3, 2e-3, 2e-3])
    assert play([posture(OPEN)] * 4, sigma_m=sigma_m, tracked=np.arange(5) > 0)[0][-1] == OPEN


def test_a_lost_hand_ends_its_pose_in_time() -> None:
    recogniser = PoseRecogniser(SETTINGS)
    for k in range(4):
        recogniser.push(_features(shown(posture(LARGE), k * FRAME_NS)))
    said = [one for k in range(4, 60) for one in recogniser.lose("made-right", k * FRAME_NS)]
    assert [one.phase for one in said].count("end") == 1
    assert recogniser.held is None
    assert recogniser.lose("made-right", 61 * FRAME_NS) == []


def test_a_hand_that_passes_slowly_is_said_to_hold_what_it_passes() -> None:
    # Three seconds from open to closed: half a second of it the hand is as around something large.
    a, b = posture(OPEN), posture(SMALL)
    held, _ = play([a + k / 180.0 * (b - a) for k in range(181)])
    assert LARGE in held


def test_thresholds_of_the_file_are_what_counts() -> None:
    strict = msgspec.structs.replace(SETTINGS, hold=HoldSettings(begin=1.0, begin_s=0.1))
    held, _ = play([posture(PINCH)] * 10, settings=strict)
    assert held[:6] == [None] * 6
    without = {name: pose for name, pose in SETTINGS.poses.items() if name != PINCH}
    assert play([posture(PINCH)] * 30, settings=msgspec.structs.replace(SETTINGS, poses=without))[1] == []
    assert play([posture(PINCH)] * 5, settings=msgspec.structs.replace(SETTINGS, poses={}))[1] == []


def _features(pose: HandPose) -> HandFeatures:
    features = FeatureExtractor(RIGHT).of(pose)
    assert features is not None
    return features


def _wrist_rig() -> RigCalibration:
    return load(Path(__file__).parents[3] / "calib_json" / "rigs" / "wrist.json", RigCalibration)
