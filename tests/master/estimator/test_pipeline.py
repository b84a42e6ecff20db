"""Tests of the straight line from detections to poses, on exact detections of a moving hand."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from common.arrays import Float
from common.calibration import AffineDisparityCalibration, PowerLawCalibration
from common.hand.model import CHAINS
from common.messages import HandPose, MarkerDetections, Source
from master.estimator.pipeline import MarkerPipeline
from master.estimator.settings import DEFAULT
from master.rig.pipeline import build_pipeline
from master.rig.setup import RigSetup
from master.run.app import StageTimes
from tests.hand_helpers import MARKERS, RIGHT, detections
from tests.synthetic_run import PERIOD_NS, SyntheticRun, hand_at, synthetic_run


@pytest.fixture(scope="module")
def exact_run() -> SyntheticRun:
    return synthetic_run(40)


def solve_all(pipeline: MarkerPipeline, messages: list[MarkerDetections]) -> list[HandPose]:
    solved = [one for message in messages for one in pipeline.push(message)]
    return [one.pose for one in solved + pipeline.flush()]


def marker_mm(pose: HandPose, raw: bool = True) -> Float:
    truth = RIGHT.marker_points(hand_at(pose.t_ns * 1e-9), MARKERS)
    return 1e3 * np.linalg.norm((pose.markers_raw_m if raw else pose.markers_m) - truth, axis=1)


def joint_mm(pose: HandPose) -> Float:
    return 1e3 * np.linalg.norm(pose.position_m - hand_at(pose.t_ns * 1e-9).position_m, axis=1)


# All but the thumb's metacarpal: the posture prior alone determines its turn, to 23 mm.
SURE = np.delete(np.arange(26), CHAINS[0, 0])


def changed(message: MarkerDetections, marker: int, uv: Float) -> MarkerDetections:
    new, sigma = message.uv.copy(), message.sigma_px.copy()
    new[marker] = uv
    sigma[marker] += 0.0 * uv[0]  # NaN where it is not seen
    return msgspec.structs.replace(message, uv=new, sigma_px=sigma)


def test_exact_detections_give_the_hand_back(exact_run: SyntheticRun) -> None:
    pipeline = build_pipeline(exact_run.setup, StageTimes())
    poses = solve_all(pipeline, exact_run.messages)
    assert len(poses) == 40
    assert [p.t_ns for p in poses[:2]] == [
        1_000_000_000 + k * PERIOD_NS + round(239.5 * 20.6e3) for k in range(2)
    ]
    settled = poses[3:]
    assert np.median([marker_mm(p) for p in settled]) < 0.5
    assert np.mean([joint_mm(p)[1:].mean() for p in settled]) < 4.0
    assert all(p.valid.all() and p.tracked[SURE].all() for p in settled)
    assert pipeline.counts["poses"] == 40
    assert pipeline.counts["epipolar_outliers"] == 0


@pytest.mark.parametrize(
    "law",
    [
        # Of parallel cameras: f B = 500 px * 75 mm, no offset.
        {"depth_model": "power_law", "power_law": PowerLawCalibration(k_m=37.5, z=-1.0)},
        {
            "depth_model": "affine_disparity",
            "affine_disparity": AffineDisparityCalibration(a_m_px=37.5, x0_px=0.0),
        },
    ],
)
def test_the_laws_of_a_parallel_pair_are_its_stereo_geometry(
    exact_run: SyntheticRun, law: dict[str, object]
) -> None:
    run = synthetic_run(12, **law)
    poses = solve_all(build_pipeline(run.setup, StageTimes()), run.messages)
    stereo = solve_all(build_pipeline(exact_run.setup, StageTimes()), exact_run.messages[:24])
    for one, other in zip(poses[3:], stereo[3:], strict=True):
        np.testing.assert_allclose(one.markers_raw_m, other.markers_raw_m, atol=5e-4)
        assert joint_mm(one)[1:].mean() < 5.0


def test_rays_that_pass_each_other_are_dropped_and_counted(exact_run: SyntheticRun) -> None:
    pipeline = build_pipeline(exact_run.setup, StageTimes())
    false = [
        changed(m, 1, m.uv[1] + [0.0, 40.0]) if m.camera == "right" and m.seq >= 20 else m
        for m in exact_run.messages
    ]
    poses = solve_all(pipeline, false)
    assert np.isfinite(poses[15].markers_raw_m[1]).all()
    assert all(np.isnan(p.markers_raw_m[1]).all() for p in poses[22:])
    assert all(np.isfinite(np.delete(p.markers_raw_m, 1, axis=0)).all() for p in poses[22:])
    assert pipeline.counts["epipolar_outliers"] >= 18
    assert not any(p.tracked[CHAINS[1]].any() for p in poses[22:])


def mistaken(
    run: SyntheticRun, thing_m: Float, cameras: tuple[str, ...], *, with_alternatives: bool
) -> list[MarkerDetections]:
    """From its 20th frame on these cameras take a thing at rest for the index marker; `with_alternatives`: both."""
    out: list[MarkerDetections] = []
    for m in run.messages:
        if m.camera not in cameras or m.seq < 20:
            out.append(m)
            continue
        new = changed(m, 1, run.setup.models[m.camera].project(thing_m))
        alternatives = np.full((6, 2), np.nan)
        alternatives[1] = m.uv[1]
        out.append(msgspec.structs.replace(new, alt_uv=alternatives) if with_alternatives else new)
    return out


THING = np.array([0.05, -0.05, 0.6])  # about 10 cm from the finger
OUT_OF_REACH = np.array([0.25, -0.12, 0.6])


def test_a_thing_that_one_slave_takes_for_a_marker_is_rejected_by_the_other_camera(
    exact_run: SyntheticRun,
) -> None:
    clear = solve_all(build_pipeline(exact_run.setup, StageTimes()), exact_run.messages)
    pipeline = build_pipeline(exact_run.setup, StageTimes())
    poses = solve_all(pipeline, mistaken(exact_run, THING, ("right",), with_alternatives=True))
    for pose, true in zip(poses, clear, strict=True):
        np.testing.assert_allclose(pose.markers_raw_m, true.markers_raw_m, atol=2e-3)
    assert all(pose.tracked[SURE].all() for pose in poses[3:])
    assert pipeline.counts["alternative.index"] >= 18
    assert pipeline.counts["epipolar_outliers"] == pipeline.counts["unclear.index"] == 0
    sure = build_pipeline(
        exact_run.setup, StageTimes()
    )  # without the slave's alternative nothing can be chosen
    lost = solve_all(sure, mistaken(exact_run, THING, ("right",), with_alternatives=False))
    assert all(np.isnan(p.markers_raw_m[1]).all() for p in lost[22:])
    assert sure.counts["apart.index"] >= 18


def test_a_law_of_disparity_rejects_a_thing_by_the_difference_of_rows() -> None:
    run = synthetic_run(30, depth_model="power_law", power_law=PowerLawCalibration(k_m=37.5, z=-1.0))
    pipeline = build_pipeline(run.setup, StageTimes())
    poses = solve_all(pipeline, mistaken(run, OUT_OF_REACH, ("right",), with_alternatives=True))
    assert all(marker_mm(p)[1] < 5.0 for p in poses[3:])
    sure = build_pipeline(run.setup, StageTimes())
    lost = solve_all(sure, mistaken(run, np.array([-0.03, 0.08, 0.5]), ("right",), with_alternatives=False))
    assert all(np.isnan(p.markers_raw_m[1]).all() for p in lost[22:])
    assert sure.counts["apart.index"] >= 8


def test_a_thing_that_both_slaves_take_for_a_marker_is_rejected_by_where_the_hand_is(
    exact_run: SyntheticRun,
) -> None:
    pipeline = build_pipeline(exact_run.setup, StageTimes())
    poses = solve_all(pipeline, mistaken(exact_run, OUT_OF_REACH, ("left", "right"), with_alternatives=True))
    assert all(marker_mm(p)[1] < 3.0 for p in poses[3:])
    assert pipeline.counts["alternative.index"] >= 18


def test_what_was_mistaken_long_ago_is_not_the_past_of_a_marker(exact_run: SyntheticRun) -> None:
    """Both slaves are sure of the thing for ten frames, then name both: the hand decides what is its finger."""
    sure = mistaken(exact_run, OUT_OF_REACH, ("left", "right"), with_alternatives=False)
    with_alternatives = mistaken(exact_run, OUT_OF_REACH, ("left", "right"), with_alternatives=True)
    pipeline = build_pipeline(exact_run.setup, StageTimes())
    poses = solve_all(
        pipeline, [d if d.seq >= 30 else s for s, d in zip(sure, with_alternatives, strict=True)]
    )
    assert all(marker_mm(p)[1] > 50.0 for p in poses[22:28])
    assert all(marker_mm(p)[1] < 5.0 for p in poses[34:])


def test_what_fits_no_camera_is_dropped_with_its_rays_and_counted_by_name(exact_run: SyntheticRun) -> None:
    other = np.array([-0.06, 0.12, 0.55])
    false = mistaken(exact_run, THING, ("left",), with_alternatives=True)
    false = [
        msgspec.structs.replace(
            changed(m, 1, exact_run.setup.models["right"].project(other)),
            alt_uv=np.full((6, 2), np.nan),
        )
        if m.camera == "right" and m.seq >= 20
        else m
        for m in false
    ]
    pipeline = build_pipeline(exact_run.setup, StageTimes())
    poses = solve_all(pipeline, false)
    assert all(np.isnan(p.markers_raw_m[1]).all() for p in poses[22:])
    assert not any(p.tracked[CHAINS[1]].any() for p in poses[22:])
    assert pipeline.counts["unclear.index"] >= 18
    assert all(np.isfinite(np.delete(p.markers_raw_m, 1, axis=0)).all() for p in poses[22:])


def test_sigma_reaches_the_covariance_of_the_hand(exact_run: SyntheticRun) -> None:
    vague = [
        msgspec.structs.replace(m, sigma_px=np.where(np.arange(6) == 1, 2.0, m.sigma_px))
        for m in exact_run.messages[:24]
    ]
    sharp = solve_all(build_pipeline(exact_run.setup, StageTimes()), exact_run.messages[:24])[-1]
    blunt = solve_all(build_pipeline(exact_run.setup, StageTimes()), vague)[-1]
    tips = CHAINS[:, -1]
    ratio = np.sqrt(
        np.trace(blunt.cov_m2[tips], axis1=1, axis2=2) / np.trace(sharp.cov_m2[tips], axis1=1, axis2=2)
    )
    assert ratio[1] > 2.0
    assert (np.delete(ratio, 1) < 1.3).all()


def test_a_marker_one_camera_loses_is_kept_on_the_ray_of_the_other(exact_run: SyntheticRun) -> None:
    nowhere = np.array([np.nan, np.nan])
    half = [changed(m, 1, nowhere) if m.camera == "right" and m.seq >= 15 else m for m in exact_run.messages]
    none = [changed(m, 1, nowhere) if m.seq >= 15 else m for m in exact_run.messages]
    seen, unseen = (solve_all(build_pipeline(exact_run.setup, StageTimes()), m) for m in (half, none))
    assert np.isnan(seen[30].markers_raw_m[1]).all()
    index = CHAINS[1]
    region_m = np.sqrt([7.815 * np.linalg.eigvalsh(p.cov_m2[index])[:, -1] for p in seen[18:]])
    assert (np.delete(region_m, 1, axis=1) < DEFAULT.tracked_m).all()
    assert not any(p.tracked[index].any() for p in unseen[18:])
    assert np.mean([joint_mm(p)[index[3]] for p in seen[18:]]) < 8.0
    # Sideways, where one camera measures, it is as good as two.
    sideways_mm = [
        1e3 * abs(p.position_m[index[3]] - hand_at(p.t_ns * 1e-9).position_m[index[3]])[0] for p in seen[18:]
    ]
    assert np.mean(sideways_mm) < 3.0


def test_a_silent_camera_leaves_poses_and_is_counted(exact_run: SyntheticRun) -> None:
    pipeline = build_pipeline(exact_run.setup, StageTimes())
    poses = solve_all(pipeline, [m for m in exact_run.messages if m.camera == "left" or m.seq < 10])
    assert len(poses) == 40
    assert pipeline.counts["instants_with_missing_camera"] >= 25
    # one eye goes on: the fingers are solved on its rays, no point is called measured, the depth stays in hand
    assert poses[-1].valid.all()
    assert np.isnan(poses[-1].markers_raw_m).all()
    assert not (poses[-1].source == Source.MEASURED).any()
    assert joint_mm(poses[-1]).mean() < 40.0


def test_nothing_seen_at_all_is_a_pose_that_is_not_valid(exact_run: SyntheticRun) -> None:
    no_observation = [
        detections(m.camera, m.seq, m.t_ns, np.full((6, 2), np.nan)) for m in exact_run.messages[:10]
    ]
    poses = solve_all(build_pipeline(exact_run.setup, StageTimes()), no_observation)
    assert len(poses) == 5
    for pose in poses:
        assert not pose.valid.any()
        assert (pose.source == Source.NONE).all()
        assert np.isnan(pose.position_m).all()
        assert np.isnan(pose.angles_rad).all()


def test_unrelated_frames_are_not_filtered(exact_run: SyntheticRun) -> None:
    simultaneous = [
        msgspec.structs.replace(m, t_ns=m.t_ns - (m.camera == "right") * 5_000_000)
        for m in exact_run.messages
    ]
    poses = solve_all(
        build_pipeline(exact_run.setup, StageTimes(), continuous=False),
        simultaneous[::20] + simultaneous[1::20],
    )
    for pose in poses:
        np.testing.assert_array_equal(pose.markers_m, pose.markers_raw_m)


def test_every_stage_is_measured(exact_run: SyntheticRun) -> None:
    stages = StageTimes()
    solve_all(build_pipeline(exact_run.setup, stages), exact_run.messages[:8])
    assert set(stages.mean_us()) == {"frame_sync", "triangulate", "filter", "fabrik", "hand"}
    assert all(value > 0 for value in stages.mean_us().values())


def test_when_the_last_frame_was_handed_over_is_passed_on(exact_run: SyntheticRun) -> None:
    pipeline = build_pipeline(exact_run.setup, StageTimes())
    solved = [one for m in exact_run.messages for one in pipeline.push(m)]
    for one in solved[2:]:
        k = (one.pose.t_ns - 1_000_000_000) // PERIOD_NS
        assert one.ready_t_ns == 1_000_000_000 + k * PERIOD_NS + 5_000_000 + 2_000_000


def test_stamps_that_lie_are_corrected_by_the_rig_file(exact_run: SyntheticRun) -> None:
    lying = [
        msgspec.structs.replace(message, t_ns=message.t_ns - 8_000_000)
        if message.camera == "right"
        else message
        for message in exact_run.messages
    ]
    lying.sort(key=lambda message: message.t_ns)

    def error_mm(setup: RigSetup) -> float:
        poses = solve_all(build_pipeline(setup, StageTimes()), lying)
        return float(np.nanmax([marker_mm(pose) for pose in poses[4:-4]]))

    rig = msgspec.structs.replace(exact_run.setup.rig, stamp_offset_us={"right": 8000.0})
    assert error_mm(exact_run.setup) > 10.0
    assert error_mm(replace(exact_run.setup, rig=rig)) < 2.0
