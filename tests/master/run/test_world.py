"""Hands, objects, contact and gestures behind one push: in which order, for which hand, and what changes meanwhile."""

import threading
from collections import Counter
from dataclasses import replace as with_fields
from math import nan
from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.arrays import Float
from common.calibration import HandProfile, load
from common.hand.model import HandModel
from common.messages import (
    Contact,
    Detections,
    Gesture,
    HandPose,
    MarkerDetections,
    ObjectPose,
    ObjectSource,
    ResultMessage,
    TagDetections,
    TrackerPose,
)
from master.estimator.pipeline import SolvedPose
from master.evaluation.score import ObjectTruth, errors
from master.outputs.result_files import ObjectPoses
from master.rig.pipeline import pipeline_of
from master.rig.setup import RigSetup, load_setups, setups_of
from master.run.app import RunFigures, StageTimes, health, observed, run
from master.run.dispatcher import Dispatcher, TrackedObject
from tests.master.outputs.test_outputs_files import random_pose
from tests.master.run.test_app import Collector, ScriptedClock, ScriptedSource
from tests.object_run import (
    PERIOD_NS,
    START_NS,
    ObjectRun,
    Sent,
    object_run,
    tracker_pose,
    with_tracker,
)

FRAMES = 24


class Poses:
    """A line of a hand that makes a pose of every frame of the left camera, always the same hand."""

    def __init__(self, hand: str, markers: int) -> None:
        self.counts: Counter[str] = Counter()
        self._hand, self._markers = hand, markers

    def push(self, message: Detections) -> list[SolvedPose]:
        if message.camera != "left":
            return []
        pose = random_pose(3, self._markers, self._hand)
        pose = msgspec.structs.replace(pose, cov_m2=np.tile(1e-6 * np.eye(3), (26, 1, 1)))
        self.counts["poses"] += 1
        return [SolvedPose(msgspec.structs.replace(pose, t_ns=message.t_ns), message.ready_t_ns)]

    def push_orientation(self, t_ns: int, orientation_wxyz: Float, heading_sigma_rad: float = nan) -> None:
        raise AssertionError("there is no IMU")

    def flush(self) -> list[SolvedPose]:
        return []


def world_of(*setups: RigSetup) -> Dispatcher:
    """A world whose hands are not solved, which takes most of the time."""
    lines = [Poses(setup.hand.profile.name, len(setup.markers)) for setup in setups]
    return Dispatcher(setups, lines, StageTimes())


def results_of(dispatcher: Dispatcher, messages: list[Sent]) -> list[ResultMessage]:
    out = [one for message in messages for one in dispatcher.push(message)]
    return [one if isinstance(one, Contact | Gesture) else one.pose for one in (*out, *dispatcher.flush())]


@pytest.fixture(scope="module")
def wand(root: Path) -> ObjectRun:
    return object_run(root, "desk-wand", FRAMES, "grasp", 60)


@pytest.fixture(scope="module")
def cube(root: Path) -> ObjectRun:
    return object_run(root, "desk-cube", FRAMES, "grasp", 60)


def off(run: ObjectRun, pose: ObjectPose) -> tuple[float, float]:
    """Distance [mm] and angle [deg] from the truth."""
    T = run.pose(pose.object, pose.t_ns)
    mm, deg = errors(
        ObjectPoses.stacked([pose], object=pose.object), ObjectTruth(np.array([pose.t_ns]), T[None])
    )
    return float(mm[0]), float(deg[0])


@pytest.mark.parametrize("which", ["wand", "cube"])
def test_objects_of_markers_and_of_tags_are_found_where_they_are(
    which: str, request: pytest.FixtureRequest
) -> None:
    shown: ObjectRun = request.getfixturevalue(which)
    dispatcher = world_of(shown.setup)
    poses = [one for one in results_of(dispatcher, shown.messages) if isinstance(one, ObjectPose)]
    tracked = [one for one in poses if one.tracked]
    assert len(tracked) > 0.7 * FRAMES
    assert {one.object for one in poses} == {which}
    assert (np.diff([one.t_ns for one in poses]) > 0).all()
    mm, deg = np.median([off(shown, one) for one in tracked], axis=0)
    assert mm < 2.0
    assert deg < 1.5
    assert dispatcher.counts[f"object.{which}.poses"] == len(poses)
    assert dispatcher.counts[f"object.{which}.tracked"] == len(tracked)


def test_a_pose_of_the_hand_is_out_before_what_it_does_is_worked_out(wand: ObjectRun) -> None:
    dispatcher, order = world_of(wand.setup), list[str]()
    asked = dispatcher._now.contacts["default-right"].push

    def watched(pose: HandPose) -> list[Contact]:
        order.append("asked for contact")
        return asked(pose)

    dispatcher._now.contacts["default-right"].push = watched
    for message in wand.messages:
        for one in dispatcher.push(message):
            kind = type(one).__name__
            order.append(
                {"SolvedPose": "hand", "SolvedObject": "object", "Contact": "contact"}.get(kind, kind)
            )
    assert "asked for contact" in order
    for place, what in enumerate(order):
        if what == "asked for contact":
            before = order[:place]
            assert before[::-1].index("hand") <= 1, "only poses of objects may come between"
            assert order[place + 1] == "contact"


def test_contact_is_made_for_every_hand_of_cameras_and_every_object(wand: ObjectRun, root: Path) -> None:
    (device,) = load_setups(root / "calib_json", ("wrist-left",))
    second = with_fields(wand.setup, objects=())
    profile = msgspec.structs.replace(second.hand.profile, name="another")
    second = with_fields(second, hand=HandModel.of(profile))
    other = msgspec.structs.replace(wand.setup.objects[0], name="twin")
    first = with_fields(wand.setup, objects=(*wand.setup.objects, other))
    dispatcher = world_of(first, second, device)
    assert set(dispatcher._now.contacts) == {"default-right", "another"}, (
        "a wrist device has a frame of its own"
    )
    contacts = [one for one in results_of(dispatcher, wand.messages) if isinstance(one, Contact)]
    assert Counter((one.hand, one.object) for one in contacts) == {
        (hand, name): FRAMES for hand in ("default-right", "another") for name in ("wand", "twin")
    }
    assert any(np.isfinite(one.distance_m).all() for one in contacts)


def test_a_rig_without_objects_has_neither_objects_nor_contact(root: Path, wand: ObjectRun) -> None:
    (bare,) = load_setups(root / "calib_json", ("desk",))
    dispatcher = world_of(bare)
    frames = [one for one in wand.messages if isinstance(one, MarkerDetections)]
    tags = TagDetections("left", 1, 0, 0, 0, np.array([3], np.uint16), np.ones((1, 4, 2)), np.ones(1))
    puck = tracker_pose("puck", np.eye(4), 0, 0)
    assert {type(one) for one in results_of(dispatcher, [*frames, tags, puck])} <= {HandPose, Gesture}
    assert not dispatcher._now.shown
    assert not dispatcher._now.contacts


def test_the_loop_says_how_long_an_object_took_and_counts_it(wand: ObjectRun) -> None:
    stop, clock, figures, sink = threading.Event(), ScriptedClock(), RunFigures(), Collector()
    clock.t_ns = wand.messages[-1].t_ns + 3_000_000
    watched: list[MarkerDetections] = []
    run(
        ScriptedSource([*wand.messages], stop).get,
        observed(world_of(wand.setup).push, figures.rates, watched.append),
        [sink],
        clock,
        figures,
        stop,
    )
    poses = [one for one in sink.others if isinstance(one, ObjectPose)]
    assert all(one.latency_ns > 0 for one in poses)
    assert poses[-1].latency_ns < poses[0].latency_ns
    figured = figures.summary()
    tracked_ms = [one.latency_ns * 1e-6 for one in poses if one.tracked]
    assert figured["object_latency_p50_ms"] == pytest.approx(np.percentile(tracked_ms, 50), abs=1e-3)
    report = health(1, clock, figures, {})
    assert report.counts["objects"] == len(tracked_ms)
    assert report.counts["contacts"] == report.counts["poses"] == len(sink.poses)
    assert report.metrics["object_latency_p99_ms"] >= report.metrics["object_latency_p50_ms"]
    assert watched == [one for one in wand.messages if isinstance(one, MarkerDetections)]


def test_tags_and_poses_of_trackers_are_no_frames(cube: ObjectRun) -> None:
    stop, figures = threading.Event(), RunFigures()
    setup = with_tracker(cube.setup)
    script = [*cube.messages, tracker_pose("puck", cube.pose("cube", START_NS), 0, START_NS)]
    dispatcher = world_of(setup)
    push = observed(dispatcher.push, figures.rates, lambda _frame: None)
    run(ScriptedSource([*script], stop).get, push, [], ScriptedClock(), figures, stop)
    assert figures.rates.camera_hz == pytest.approx({"left": 60.0, "right": 60.0}, rel=1e-3)


def test_a_tracker_is_used_where_cameras_see_nothing_and_not_where_they_do(wand: ObjectRun) -> None:
    setup = with_tracker(wand.setup)
    middle = wand.messages[len(wand.messages) // 2].t_ns
    frames: list[Sent] = [one if one.t_ns < middle else blind(one) for one in wand.messages]
    device: list[Sent] = [
        tracker_pose("puck", wand.pose("wand", t_ns), k, t_ns)
        for k, t_ns in enumerate(range(wand.messages[0].t_ns, wand.messages[-1].t_ns, 4_000_000))
    ]
    both = sorted([*frames, *device], key=lambda one: one.t_ns)
    poses = [one for one in results_of(world_of(setup), both) if isinstance(one, ObjectPose)]
    assert (np.diff([one.t_ns for one in poses]) > 0).all()
    sources = [ObjectSource(one.source) for one in poses]
    changed = sources.index(ObjectSource.TRACKER, sources.index(ObjectSource.MARKERS))
    assert set(sources[changed:]) == {ObjectSource.TRACKER}, "nothing that is held comes between"
    assert poses[changed].t_ns - middle < 250_000_000
    for pose in poses[changed:]:
        assert max(off(wand, pose)) < 0.01


def blind(message: Sent) -> Sent:
    """The frame in which no marker is seen."""
    if not isinstance(message, MarkerDetections):
        return message
    gone = np.full(len(message.area), nan)
    both = np.full((len(message.area), 2), nan)
    return msgspec.structs.replace(message, uv=both, area=gone, quality=gone, sigma_px=gone)


def test_an_object_with_a_tracker_alone_needs_no_camera(wand: ObjectRun) -> None:
    setup = with_tracker(wand.setup, only=True)
    dispatcher = world_of(setup)
    sent: list[Sent] = [
        tracker_pose("puck", wand.pose("wand", START_NS + k * PERIOD_NS), k, START_NS + k * PERIOD_NS)
        for k in range(5)
    ]
    lost = TrackerPose("puck", 1, 5, START_NS + 5 * PERIOD_NS, np.full(3, nan), np.full(4, nan))
    poses = [one for one in results_of(dispatcher, [*sent, lost]) if isinstance(one, ObjectPose)]
    assert [one.tracked for one in poses] == [True] * 5 + [False]
    assert dispatcher.counts["tracker.puck.lost"] == 1
    assert results_of(dispatcher, [tracker_pose("another", np.eye(4), 0, 0)]) == []


def test_a_tracker_that_is_not_registered_is_counted_and_said(wand: ObjectRun) -> None:
    setup = with_tracker(wand.setup, registered=False)
    dispatcher = world_of(setup)
    assert [(one.name, one.tracker) for one in dispatcher.unplaced] == [("wand", "puck")]
    assert results_of(dispatcher, [tracker_pose("puck", np.eye(4), k, k) for k in range(3)]) == []
    assert dispatcher.counts == {"tracker.puck.unplaced": 3}


def test_markers_of_objects_are_found_in_a_rig_of_two_hands(wand: ObjectRun, root: Path) -> None:
    right = load(root / "calib_json/hands/default-right.json", HandProfile)
    left = load(root / "calib_json/hands/default-left.json", HandProfile)
    left = msgspec.structs.replace(left, markers={f"l-{name}": one for name, one in left.markers.items()})
    hands = {"default-right": HandModel.of(right), "default-left": HandModel.of(left)}
    own = wand.setup.rig
    theirs = tuple(left.markers)[:2]
    rig = msgspec.structs.replace(own, markers=(*theirs, *own.markers), other_hands=("default-left",))
    objects = {one.name: one for one in wand.setup.objects}
    both = setups_of([rig], wand.setup.cameras, hands.__getitem__, objects)
    assert [len(one.objects) for one in both] == [1, 0]
    frames = [with_more(one, len(theirs)) for one in wand.messages if isinstance(one, MarkerDetections)]
    poses = [one for one in results_of(world_of(*both), [*frames]) if isinstance(one, ObjectPose)]
    assert np.median([off(wand, one)[0] for one in poses if one.tracked]) < 2.0


def with_more(message: MarkerDetections, count: int) -> MarkerDetections:
    """The frame with so many markers of another hand before its own."""
    names = ("uv", "area", "quality", "sigma_px", "alt_uv")
    more = {name: np.full((count, *getattr(message, name).shape[1:]), nan) for name in names}
    return msgspec.structs.replace(
        message, **{name: np.concatenate([more[name], getattr(message, name)]) for name in names}
    )


def test_other_files_take_over_between_two_messages_and_what_had_begun_ends(wand: ObjectRun) -> None:
    dispatcher = world_of(wand.setup)
    half = len(wand.messages) // 2
    before = results_with(dispatcher, wand.messages[:half])
    begun = Gesture("default-right", 7, "pinch", "index", "update", 5, 0.5)
    dispatcher._remember(begun)
    moved = tuple(
        msgspec.structs.replace(
            one, position_m=(one.position_m[0], one.position_m[1], one.position_m[2] + 0.03)
        )
        for one in wand.setup.objects[0].markers.values()
    )
    markers = dict(zip(wand.setup.objects[0].markers, moved, strict=True))
    other = with_fields(
        wand.setup, objects=(msgspec.structs.replace(wand.setup.objects[0], markers=markers),)
    )
    dispatcher.prepare([other])()
    after = results_with(dispatcher, wand.messages[half:])
    assert isinstance(after[0], Gesture)
    assert (after[0].phase, after[0].kind, after[0].began_t_ns) == ("end", "pinch", 5)
    for poses, away_mm in ((before, 0.0), (after, 30.0)):
        seen = [one for one in poses if isinstance(one, ObjectPose) and one.tracked]
        assert np.median([off(wand, one)[0] for one in seen]) == pytest.approx(away_mm, abs=2.0)
    assert dispatcher._begun == {} or all(one.t_ns > 7 for one in dispatcher._begun.values())


def results_with(dispatcher: Dispatcher, messages: list[Sent]) -> list[ResultMessage]:
    """As `results_of`, and more messages come."""
    out = [one for message in messages for one in dispatcher.push(message)]
    return [one if isinstance(one, Contact | Gesture) else one.pose for one in out]


def test_single_pictures_have_no_gestures(wand: ObjectRun) -> None:
    lines = [Poses("default-right", len(wand.setup.markers))]
    dispatcher = Dispatcher([wand.setup], lines, StageTimes(), gestures=False)
    assert not dispatcher._now.gestures
    assert not [one for one in results_of(dispatcher, wand.messages) if isinstance(one, Gesture)]


def test_the_same_messages_give_the_same_results(cube: ObjectRun) -> None:
    first, second = (results_of(world_of(cube.setup), cube.messages) for _ in range(2))
    assert [type(one) for one in first] == [type(one) for one in second]
    for one, other in zip(first, second, strict=True):
        if isinstance(one, ObjectPose) and isinstance(other, ObjectPose):
            np.testing.assert_array_equal(one.position_m, other.position_m)
            np.testing.assert_array_equal(one.cov, other.cov)


def test_an_object_whose_time_would_go_back_is_not_published(wand: ObjectRun) -> None:
    counts: Counter[str] = Counter()
    one = TrackedObject(with_tracker(wand.setup, only=True), "wand", counts)
    T = wand.pose("wand", START_NS)
    assert len(one.push_tracker(tracker_pose("puck", T, 0, START_NS))) == 1
    again = msgspec.structs.replace(tracker_pose("puck", T, 1, START_NS - 1), session=2)
    assert one.push_tracker(again) == []
    assert counts["object.wand.poses"] == 1


def test_a_hand_is_solved_as_without_objects(wand: ObjectRun) -> None:
    bare = with_fields(wand.setup, objects=())
    frames = [one for one in wand.messages if isinstance(one, MarkerDetections)][:16]
    poses: list[list[HandPose]] = []
    for setup in (bare, wand.setup):
        dispatcher = Dispatcher([setup], [pipeline_of(setup, StageTimes())], StageTimes())
        poses.append([one for one in results_with(dispatcher, [*frames]) if isinstance(one, HandPose)])
    assert len(poses[0]) == len(poses[1]) > 3
    for one, other in zip(*poses, strict=True):
        np.testing.assert_array_equal(one.position_m, other.position_m)


@pytest.mark.parametrize("which", ["wand", "cube"])
def test_nonsense_that_is_sealed_rightly_ends_nothing(which: str, request: pytest.FixtureRequest) -> None:
    shown: ObjectRun = request.getfixturevalue(which)
    dispatcher, rng = world_of(with_tracker(shown.setup)), np.random.default_rng(7)
    for k in range(60):
        base = shown.messages[int(rng.integers(len(shown.messages)))]
        t_ns = int(base.t_ns + rng.integers(-(10**9), 10**9))
        count, far = int(rng.integers(0, 6)), 10.0 ** rng.integers(-300, 5)
        ids = np.sort(rng.choice(8, count, replace=False)).astype(np.uint16)
        uv, sigma = rng.normal(size=(count, 4, 2)) * far, 10.0 ** rng.uniform(-5.0, 4.0, count)
        uv, place = np.clip(uv, -16384.0, 32768.0), np.clip(rng.normal(size=3) * far, -1e3, 1e3)
        quaternion = rng.normal(size=4)
        quaternion *= rng.uniform(0.95, 1.04) / np.linalg.norm(quaternion)
        quaternion = np.clip(quaternion, -1.0, 1.0)
        for message in (
            TagDetections("left", 1, k, t_ns, t_ns, ids, uv, sigma),
            TrackerPose("puck", 1, k, t_ns, place, quaternion),
            msgspec.structs.replace(base, t_ns=int(rng.integers(-(2**61), 2**61))),
            base,
        ):
            for one in dispatcher.push(message):
                assert isinstance(one, Contact | Gesture) or one.pose.t_ns is not None
