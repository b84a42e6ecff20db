"""Rigs with other numbers of markers than six: fewer on the hand, and up to 24 of which most sit on no hand."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from common.arrays import Float
from common.calibration import RigCalibration, parse
from common.calibration.hand import MarkerMount
from common.errors import CalibrationError
from common.hand.model import TIPS, HandModel
from common.messages import HandPose, MarkerDetections, decode, encode
from master.replay.offline import fingers_of
from master.rig.pipeline import build_pipeline
from master.rig.setup import RigSetup
from master.run.app import StageTimes
from tests.hand_helpers import (
    MARKERS,
    RIGHT,
    camera_file,
    cap_views,
    detections,
    natural_angles,
    palm,
    rig_file,
)
from tests.synthetic_run import SyntheticRun, hand_at, setup_of, synthetic_run

FREE = tuple(f"cube-{k}" for k in range(18))
# Six markers of a hand among eighteen others, not in one block.
ALL = (*FREE[:7], *MARKERS[:2], *FREE[7:12], *MARKERS[2:], *FREE[12:])
PLACES: Float = np.random.default_rng(4).uniform([-0.15, -0.12, 0.45], [0.2, 0.15, 0.65], (18, 3))


@pytest.fixture(scope="module", params=["estimator", "fabrik"])
def six(request: pytest.FixtureRequest) -> SyntheticRun:
    return synthetic_run(12, solver=request.param)


@pytest.fixture(scope="module")
def many(six: SyntheticRun) -> SyntheticRun:
    """The same hand among 18 markers at rest."""
    setup = setup_of(rig_file(markers=ALL, free_markers=FREE, solver=six.setup.rig.solver))
    return SyntheticRun(setup, [among(six, m) for m in six.messages])


def among(run: SyntheticRun, message: MarkerDetections) -> MarkerDetections:
    own = {name: row for row, name in enumerate(MARKERS)}
    still = run.setup.models[message.camera].project(PLACES)
    uv = np.array([message.uv[own[n]] if n in own else still[FREE.index(n)] for n in ALL])
    ones = np.ones(len(ALL))
    return msgspec.structs.replace(
        message,
        uv=uv,
        area=400 * ones,
        quality=ones,
        sigma_px=0.1 * ones,
        alt_uv=np.full((24, 2), np.nan),
    )


def solve(
    run: SyntheticRun, messages: list[MarkerDetections] | None = None
) -> tuple[list[HandPose], dict[str, int]]:
    pipeline = build_pipeline(run.setup, StageTimes())
    # over the wire and back: what the master gets
    sent = [decode(encode(m)) for m in (run.messages if messages is None else messages)]
    solved = [one.pose for m in sent if isinstance(m, MarkerDetections) for one in pipeline.push(m)]
    return solved + [one.pose for one in pipeline.flush()], dict(pipeline.counts)


def test_a_hand_among_eighteen_other_markers_is_the_hand_alone(six: SyntheticRun, many: SyntheticRun) -> None:
    alone, _ = solve(six)
    poses, counts = solve(many)
    assert counts["poses"] == 12
    rows = [ALL.index(name) for name in MARKERS]
    free = [ALL.index(name) for name in FREE]
    for pose, other in zip(poses, alone, strict=True):
        np.testing.assert_allclose(pose.markers_raw_m[rows], other.markers_raw_m, atol=1e-9)
        np.testing.assert_allclose(pose.position_m, other.position_m, atol=1e-9)
        np.testing.assert_array_equal(pose.source, other.source)
        np.testing.assert_allclose(pose.markers_raw_m[free], PLACES, atol=1e-5)
        assert np.isfinite(pose.markers_m).all()
    assert fingers_of(many.setup) == tuple(MARKERS.index(n) if n in MARKERS[:5] else -1 for n in ALL)


def test_a_free_markers_alternative_is_rejected_by_the_other_camera_and_by_its_own_past(
    many: SyntheticRun,
) -> None:
    row, thing = ALL.index("cube-3"), np.array([0.1, -0.1, 0.5])
    messages: list[MarkerDetections] = []
    for m in many.messages:
        if m.seq < 6 or m.camera == "left":
            messages.append(m)
            continue
        uv, alternative = m.uv.copy(), m.alt_uv.copy()
        uv[row], alternative[row] = many.setup.models[m.camera].project(thing), m.uv[row]
        messages.append(msgspec.structs.replace(m, uv=uv, alt_uv=alternative))
    poses, counts = solve(many, messages)
    for pose in poses:
        np.testing.assert_allclose(pose.markers_raw_m[row], PLACES[FREE.index("cube-3")], atol=2e-3)
    assert counts["alternative.cube-3"] >= 5


@pytest.mark.parametrize("names", [("back",), ("index",), ("thumb", "index"), ("index", "middle", "back")])
def test_fewer_markers_are_placed_and_a_hand_is_solved_where_they_determine_one(
    six: SyntheticRun, names: tuple[str, ...]
) -> None:
    setup = setup_of(rig_file(markers=names))
    rows = [MARKERS.index(name) for name in names]
    some = [
        msgspec.structs.replace(
            m,
            **{field: getattr(m, field)[rows] for field in ("uv", "area", "quality", "sigma_px", "alt_uv")},
        )
        for m in six.messages
    ]
    poses, _ = solve(SyntheticRun(setup, some))
    assert len(poses) == 12
    for pose in poses[3:]:
        truth = RIGHT.marker_points(hand_at(pose.t_ns * 1e-9), names)
        # Where no hand is solved the caps' tilt is not known: seen and true centroid differ by millimetres.
        assert (np.linalg.norm(pose.markers_raw_m - truth, axis=1) < 6e-3).all()
        assert bool(pose.valid.any()) == (len(names) == 3)


def test_a_marker_on_no_hand_must_be_said_to_be_free() -> None:
    cameras = {name: camera_file(name) for name in ("left", "right")}
    with pytest.raises(CalibrationError, match="no marker 'cube-0'"):
        RigSetup.of(rig_file(markers=ALL), cameras, RIGHT)
    setup = RigSetup.of(rig_file(markers=ALL, free_markers=FREE), cameras, RIGHT)
    assert setup.hand_markers == MARKERS
    assert replace(setup, rig=rig_file()).hand_markers == MARKERS
    raw = msgspec.json.encode(rig_file(free_markers=("cube",)))
    with pytest.raises(CalibrationError, match=r"desk\.json: free_markers: 'cube' is not one of markers"):
        parse(raw, RigCalibration, "desk.json")


@pytest.mark.parametrize("solver", ["estimator", "fabrik"])
def test_a_marker_on_a_bone_next_to_that_of_the_finger_tip_counts_for_the_hand(solver: str) -> None:
    bone = MarkerMount("index-finger-phalanx-intermediate", (0.0, 0.009, -0.01), 0.012)
    knuckle = MarkerMount("middle-finger-metacarpal", (0.0, 0.01, -0.02), 0.012)
    profile = msgspec.structs.replace(
        RIGHT.profile, markers=RIGHT.profile.markers | {"bone": bone, "knuckle": knuckle}
    )
    model, names = HandModel.of(profile), (*MARKERS, "bone", "knuckle")
    rig = rig_file(markers=names, solver=solver)
    setup = RigSetup.of(rig, {name: camera_file(name) for name in rig.cameras}, model)
    truth, cameras = (
        model.forward(palm(), natural_angles(np.random.default_rng(2))),
        tuple(setup.models.values()),
    )
    points = model.marker_points(truth, names)
    bias = cap_views(model, names, truth, points, cameras)[0]
    messages = [
        detections(name, k, 1_000_000_000 + k * 16_666_667, setup.models[name].project(points) + bias[c])
        for k in range(8)
        for c, name in enumerate(rig.cameras)
    ]
    poses, _ = solve(SyntheticRun(setup, messages))
    assert poses[-1].valid.all()
    assert poses[-1].tracked[TIPS].all()
    assert 1e3 * np.linalg.norm(poses[-1].position_m - truth.position_m, axis=1).mean() < 3.0
