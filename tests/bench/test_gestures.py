"""A dial through rendered frames, detectors and master; the truth that it is held against; what counts as false."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.gestures.actions import GestureTruth, Score, recognised, seen_poses
from bench.played import START_NS
from common.calibration.gesture_settings import default_gestures
from common.messages import Gesture
from common.sim.gestures import Gestures
from common.sim.scenes import scene_by_name
from master.rig.setup import RigSetup, load_setup

CALIBRATION = Path(__file__).parents[2] / "calib_json"
SETTINGS = default_gestures()
SEED, SECONDS = 7, 3.0  # a knob is gripped at 1.1 s and turned for a second


@pytest.fixture(scope="module")
def setup() -> RigSetup:
    return load_setup(CALIBRATION, "desk-back3")


@pytest.fixture(scope="module")
def truth(setup: RigSetup) -> GestureTruth:
    scene = scene_by_name("gestures", setup.rig, setup.cameras, setup.hand.profile, SEED)
    assert isinstance(scene.motion, Gestures)
    return GestureTruth.of(scene.motion, scene.model, SETTINGS, 14.0)


def test_a_dial_is_recognised_in_time_and_as_far_as_it_was_turned(
    setup: RigSetup, truth: GestureTruth
) -> None:
    scene = scene_by_name("gestures", setup.rig, setup.cameras, setup.hand.profile, SEED)
    poses = seen_poses(setup, "gestures", SEED, SECONDS)
    found = recognised(poses, scene.model, SETTINGS)
    assert {one.kind for one in found} == {"dial"}
    event = next(one for one in truth.events if one.kind == "dial")
    begins = [1e-9 * (one.t_ns - START_NS) for one in found if one.phase == "begin"]
    assert len(begins) == 1
    assert -3 / 60 <= begins[0] - event.begin_s <= 3 / 60
    score = Score()
    score._values(found, truth, SECONDS)
    assert np.degrees(abs(truth.motion.dial_rad(SECONDS))) > 20.0
    assert np.percentile(np.abs(score.dial_deg), 95) < 3.0


def test_every_gesture_made_is_in_the_truth_in_that_order(truth: GestureTruth) -> None:
    annotations = [one for one in truth.motion.annotations if one.stop_s < 13.0]
    assert [(one.kind, one.name) for one in truth.events] == [(one.kind, one.name) for one in annotations]
    for event, one in zip(truth.events, annotations, strict=True):
        assert one.start_s < event.begin_s < event.end_s <= one.stop_s + SETTINGS.dial.regrip_s
    pinched = next(one for one in truth.events if one.kind == "pinch")
    gap = truth.pinch_at(0.5 * (pinched.begin_s + pinched.end_s), pinched.name)
    assert gap == pytest.approx(-0.0005, abs=2e-3)  # skin on skin


def test_a_gesture_not_made_is_false_and_one_not_recognised_is_missed(truth: GestureTruth) -> None:
    event = next(one for one in truth.events if one.kind == "pinch")
    nan = np.full(3, np.nan)
    right = Gesture(
        hand="right",
        t_ns=START_NS + round((event.begin_s + 1 / 60) * 1e9),
        kind="pinch",
        name=event.name,
        phase="begin",
        began_t_ns=START_NS + round((event.begin_s + 1 / 60) * 1e9),
        confidence=1.0,
        distance_m=0.005,
        strength=1.0,
        angle_rad=float("nan"),
        origin_m=nan,
        direction=nan,
    )
    score = Score()
    score.add([right, _later(right, 0.05)], replace(truth, events=(event,)))
    assert score.missed["pinch"] == 0
    assert score.false["pinch"] == 1
    assert score.late["pinch begin"] == pytest.approx([1.0])
    unheard = Score()
    unheard.add([], truth)
    assert unheard.missed == unheard.made
    assert sum(unheard.made.values()) == len(truth.events) > 3


def _later(one: Gesture, seconds: float) -> Gesture:
    """The same of another finger a moment later, that nobody made."""
    shift = round(seconds * 1e9)
    return Gesture(
        hand=one.hand,
        t_ns=one.t_ns + shift,
        kind=one.kind,
        name="ring" if one.name != "ring" else "index",
        phase="begin",
        began_t_ns=one.t_ns + shift,
        confidence=one.confidence,
        distance_m=one.distance_m,
        strength=one.strength,
        angle_rad=one.angle_rad,
        origin_m=one.origin_m,
        direction=one.direction,
    )
