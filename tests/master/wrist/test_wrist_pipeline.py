"""The wrist device's line: poses within limits whatever comes, bits that are true, memory where frames follow."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.arrays import Float
from common.calibration import CameraCalibration, HandProfile, RigCalibration, Volume, load
from common.errors import CalibrationError
from common.hand_model import CHAINS, FINGERS, METACARPALS, HandModel
from common.messages import HandPose, Source, WristDetections
from master.estimator.settings import DEFAULT
from master.rig_setup import RigSetup
from master.wrist.forward import ForwardTable, LaserCut
from master.wrist.invert import Inverse
from master.wrist.laser_plane import PlaneAxes
from master.wrist.pipeline import WristPipeline
from master.wrist.setup import WristSetup
from master.wrist.skin import SPREAD, Skin
from tests.wrist_run import wrist_setup

TRIPLE_NS = 33_333_333


@pytest.fixture(scope="module")
def rig(root: Path) -> RigSetup:
    return wrist_setup(root)


@pytest.fixture(scope="module")
def setup(rig: RigSetup) -> WristSetup:
    """Of the level of laser points alone, of which these tests are."""
    assert rig.wrist is not None
    return replace(rig.wrist, level="fk")


@pytest.fixture(scope="module")
def alone(setup: WristSetup) -> WristPipeline:
    """Remembers nothing but the time of its last message."""
    return WristPipeline(setup, continuous=False)


def message(uv: Float, t_ns: int, sigma_px: float = 0.2) -> WristDetections:
    nan = np.full(5, np.nan)
    return WristDetections(
        camera="wrist",
        session=1,
        seq=t_ns // TRIPLE_NS,
        t_ns=t_ns,
        ready_t_ns=t_ns + 1,
        laser_uv=uv,
        laser_sigma_px=np.where(np.isnan(uv).any(axis=1), np.nan, sigma_px),
        laser_px=nan,
        tip_uv=np.full((5, 2), np.nan),
        tip_sigma_px=nan,
        tip_depth=nan,
    )


def solved(pipeline: WristPipeline, uv: Float, t_ns: int | None = None) -> HandPose:
    at_ns = pipeline.fingers._last_ns + TRIPLE_NS if t_ns is None else t_ns
    (only,) = pipeline.push(message(uv, max(at_ns, TRIPLE_NS)))
    return only.pose


def shown(setup: WristSetup, angles_rad: Float, skin: float = 1.0) -> Float:
    """Pixels (5, 2) of the laser points of a hand with angles (5, 4) and skin of another thickness."""
    cut = LaserCut(setup)
    thick = Skin.of(setup.model)
    cut._skin = Skin(skin * thick.palmar_m, skin * thick.radius_m)
    flat = cut(angles_rad[None, None])[0][:, 0, 0]
    return setup.optics.project(PlaneAxes.of(setup).space(flat))


def natural(setup: WristSetup, pip_deg: float, abduction_deg: float = 0.0) -> Float:
    pip = np.radians(pip_deg)
    angles = np.zeros((5, 4))
    angles[1:] = np.radians(abduction_deg), 0.54 * pip, pip, 0.84 * pip
    angles[0] = np.radians([0.0, 15.0, 20.0, 30.0])
    return angles


def test_a_natural_hand_is_found(alone: WristPipeline, setup: WristSetup) -> None:
    for pip in (5.0, 25.0, 50.0, 75.0):
        angles = natural(setup, pip, 3.0)
        pose = solved(alone, shown(setup, angles))
        np.testing.assert_allclose(np.degrees((pose.angles_rad - angles)[1:, 2]), 0.0, atol=1.5)
        exact = setup.model.forward(setup.T_camera_palm, setup.model.clamp(angles)).position_m
        off = 1e3 * np.linalg.norm(pose.position_m - exact, axis=1)
        assert off[CHAINS[1:]].max() < 4.0
        assert pose.tracked.all()
        assert pose.valid.all()
        assert (pose.source == Source.WRIST).all()


def test_what_fingers_are_seen_to_do_is_said(alone: WristPipeline, setup: WristSetup) -> None:
    uv = shown(setup, natural(setup, 40.0))
    uv[2] = np.nan
    uv[3] = shown(setup, natural(setup, 110.0))[3]
    before = alone.counts.copy()
    pose = solved(alone, uv)
    assert not pose.valid[CHAINS[2]].any()
    assert np.isnan(pose.position_m[CHAINS[2]]).all()
    assert np.isnan(pose.angles_rad[2]).all()
    assert (pose.source[CHAINS[2]] == Source.NONE).all()
    assert pose.valid[CHAINS[3]].all()
    assert not pose.tracked[CHAINS[3]].any()
    assert pose.tracked[CHAINS[[0, 1, 4]]].all()
    assert pose.tracked[[0, 1, *METACARPALS]].all()
    assert alone.counts["unseen.middle"] == before["unseen.middle"] + 1
    assert alone.counts["past.ring"] == before["past.ring"] + 1
    # The middle of what is left above the branch, and no more than that.
    assert 90.0 < np.degrees(pose.angles_rad[3, 2]) <= np.degrees(setup.model.limits_rad[3, 2, 1])


def test_a_hand_that_nobody_sees_is_a_palm_and_no_fingers(alone: WristPipeline) -> None:
    pose = solved(alone, np.full((5, 2), np.nan))
    assert not pose.valid[CHAINS].any()
    assert not pose.tracked.any()
    assert pose.valid[[0, 1, *METACARPALS]].all()
    assert np.isnan(pose.laser_m).all()


@settings(max_examples=60)
@given(st.integers(0, 2**31), st.floats(0.01, 50.0))
def test_angles_stay_within_limits_whatever_is_reported(
    alone: WristPipeline, setup: WristSetup, seed: int, sigma_px: float
) -> None:
    rng = np.random.default_rng(seed)
    uv = rng.uniform([-200.0, -200.0], [900.0, 700.0], (5, 2))
    uv[rng.random(5) < 0.2] = np.nan
    (only,) = alone.push(
        message(uv, alone.fingers._last_ns + TRIPLE_NS if alone.fingers._last_ns > 0 else 1, sigma_px)
    )
    pose, known = only.pose, np.isfinite(only.pose.angles_rad[:, 0])
    assert (setup.model.within_limits(pose.angles_rad)[known]).all()
    np.testing.assert_array_equal(pose.valid[CHAINS].all(axis=1), known)
    assert np.isfinite(pose.position_m[pose.valid]).all()
    assert (np.linalg.eigvalsh(pose.cov_m2[pose.valid]) > 0.0).all()
    assert (pose.tracked <= pose.valid).all()


def test_what_no_camera_can_have_seen_is_counted_and_not_seen(
    alone: WristPipeline, setup: WristSetup
) -> None:
    uv = shown(setup, natural(setup, 40.0))
    uv[1], uv[2], uv[3] = [3e4, 240.0], [320.0, -1.6e4], [-1.0, 240.0]
    before = alone.counts.copy()
    with np.errstate(all="raise"):
        pose = solved(alone, uv)
        for sigma in (1.6e4, 700.0):
            alone.push(message(uv, alone.fingers._last_ns + TRIPLE_NS, sigma))
    for f, times in enumerate((2, 3, 3, 3, 2)):
        assert alone.counts[f"outside.{FINGERS[f]}"] == before[f"outside.{FINGERS[f]}"] + times
    assert not pose.valid[CHAINS[1:4]].any()
    assert pose.tracked[CHAINS[[0, 4]]].all()


def test_a_line_of_impossible_length_is_a_whole_one(alone: WristPipeline, setup: WristSetup) -> None:
    uv = shown(setup, natural(setup, 40.0))
    poses: list[HandPose] = []
    for length in (3.2e4, 1e4):
        whole = msgspec.structs.replace(
            message(uv, alone.fingers._last_ns + TRIPLE_NS), laser_px=np.full(5, length)
        )
        with np.errstate(all="raise"):
            poses += [found.pose for found in alone.push(whole)]
    np.testing.assert_array_equal(poses[0].position_m, poses[1].position_m)
    assert poses[0].tracked.all()


def test_a_finger_that_the_laser_cannot_meet_is_not_made_up(setup: WristSetup) -> None:
    table = ForwardTable.of(setup)
    none = table.length_px.copy()
    none[1] = 0.0
    inverse = Inverse(replace(table, length_px=none))
    pipeline = WristPipeline(setup, continuous=False, inverse=inverse)
    pose = solved(pipeline, shown(setup, natural(setup, 40.0)))
    assert not pose.valid[CHAINS[1]].any()
    assert np.isnan(pose.angles_rad[1]).all()
    assert pose.tracked[CHAINS[[0, 2, 3, 4]]].all()


def test_a_palm_that_the_laser_passes_by_is_refused(setup: WristSetup) -> None:
    above = setup.T_camera_palm.copy()
    above[1, 3] -= 0.1
    with pytest.raises(CalibrationError, match="the laser meets no finger"):
        ForwardTable.of(replace(setup, T_camera_palm=above))


def test_a_finger_that_is_lost_is_held_for_half_a_second_with_growing_doubt(
    alone: WristPipeline, setup: WristSetup
) -> None:
    pipeline = WristPipeline(setup, inverse=alone.fingers.inverse)
    uv = shown(setup, natural(setup, 40.0))
    first = solved(pipeline, uv, TRIPLE_NS)
    uv[1] = np.nan
    held = [solved(pipeline, uv) for _ in range(15)]
    for pose in held:
        np.testing.assert_array_equal(pose.angles_rad[1], first.angles_rad[1])
        assert pose.valid[CHAINS[1]].all()
        assert not pose.tracked[CHAINS[1]].any()
        assert (pose.source[CHAINS[1]] == Source.HELD).all()
    doubt = np.array([pose.cov_m2[10].trace() for pose in (first, *held)])
    assert (np.diff(doubt) > 0.0).all()
    gone = solved(pipeline, uv)
    assert not gone.valid[CHAINS[1]].any()
    assert gone.tracked[CHAINS[2]].all()


def test_unrelated_poses_remember_nothing(alone: WristPipeline, setup: WristSetup) -> None:
    uv = shown(setup, natural(setup, 40.0))
    again = solved(alone, uv)
    solved(alone, shown(setup, natural(setup, 70.0)))
    pose = solved(alone, uv)
    np.testing.assert_array_equal(pose.angles_rad, again.angles_rad)
    uv[1] = np.nan
    assert not solved(alone, uv).valid[CHAINS[1]].any()


def test_late_and_doubled_messages_are_counted_and_change_nothing(
    alone: WristPipeline, setup: WristSetup
) -> None:
    plain, troubled = (WristPipeline(setup, inverse=alone.fingers.inverse) for _ in range(2))
    rng = np.random.default_rng(3)
    sent = [
        message(shown(setup, natural(setup, 30.0 + k)) + 0.2 * rng.normal(size=(5, 2)), (k + 1) * TRIPLE_NS)
        for k in range(6)
    ]
    expected = [pose for one in sent for pose in plain.push(one)]
    got = [
        pose
        for k, one in enumerate(sent)
        for late in (one, one, sent[k // 2])
        for pose in troubled.push(late)
    ]
    assert len(got) == len(expected) == 6
    for a, b in zip(expected, got, strict=True):
        np.testing.assert_array_equal(a.pose.angles_rad, b.pose.angles_rad)
        assert a.ready_t_ns == b.ready_t_ns
    assert troubled.counts["late"] == 12
    assert troubled.flush() == []


def test_a_finger_at_rest_trembles_less_where_frames_follow_each_other(
    alone: WristPipeline, setup: WristSetup
) -> None:
    uv = shown(setup, natural(setup, 70.0))
    rng = np.random.default_rng(8)
    noise = 0.5 * rng.normal(size=(60, 5, 2))
    spread: list[Float] = []
    for continuous in (True, False):
        pipeline = WristPipeline(setup, continuous=continuous, inverse=alone.fingers.inverse)
        angles = [
            solved(pipeline, uv + off, (k + 1) * TRIPLE_NS).angles_rad[1:, 2] for k, off in enumerate(noise)
        ]
        spread.append(np.std(angles[10:], axis=0))
    assert (spread[0] < 0.8 * spread[1]).all()


def test_nineteen_of_twenty_joints_lie_in_their_regions(alone: WristPipeline, setup: WristSetup) -> None:
    """Of hands that stray from habits and whose skin differs as much as is believed: between 90 and 99 of 100."""
    pipeline = WristPipeline(setup, continuous=False, inverse=alone.fingers.inverse)
    rng = np.random.default_rng(12)
    inside: list[bool] = []
    for _ in range(150):
        angles = natural(setup, 0.0)
        pip = np.radians(rng.uniform(15.0, 70.0, 4))
        angles[1:, 0] = np.radians(rng.uniform(-8.0, 8.0, 4)) * (np.arange(4) != 1)
        angles[1:, 1] = 0.54 * pip + DEFAULT.natural_flexion_rad * rng.normal(size=4)
        angles[1:, 2] = pip
        angles[1:, 3] = 0.84 * pip + DEFAULT.loose_dip_rad * rng.normal(size=4)
        angles = setup.model.clamp(angles)
        uv = shown(setup, angles, 1.0 + SPREAD * rng.normal()) + 0.2 * rng.normal(size=(5, 2))
        pose = solved(pipeline, uv)
        exact = setup.model.forward(setup.T_camera_palm, angles).position_m
        for f in range(1, 5):
            if pose.tracked[CHAINS[f, 1]]:
                joints = CHAINS[f, 1:]
                off = (pose.position_m - exact)[joints]
                surprise = np.vecdot(off, np.linalg.solve(pose.cov_m2[joints], off[..., None])[..., 0])
                inside += (surprise < 7.815).tolist()
    assert len(inside) > 1000
    assert 0.90 < np.mean(inside) < 0.995


def test_the_cubic_is_a_preset(alone: WristPipeline, setup: WristSetup) -> None:
    pipeline = WristPipeline(replace(setup, cubic=True), continuous=False, inverse=alone.fingers.inverse)
    flexed: list[Float] = []
    for pip in (10.0, 40.0, 70.0):
        pose = solved(pipeline, shown(setup, natural(setup, pip)))
        flexed.append(np.degrees(pose.angles_rad[1:, 2]))
    assert (np.diff(flexed, axis=0) > 2.0).all()  # it rises
    assert np.abs(np.array(flexed) - np.array([[10.0], [40.0], [70.0]])).max() > 5.0  # but is of no hand


def test_what_the_rig_says_of_stamps_and_volume_holds(
    alone: WristPipeline, rig: RigSetup, setup: WristSetup
) -> None:
    stated = msgspec.structs.replace(
        rig.rig,
        level="fk",
        stamp_offset_us={"wrist": 1500.0},
        volume=Volume(low_m=(-1, -1, 0.15), high_m=(1, 1, 1)),
    )
    pipeline = WristPipeline(
        WristSetup.of(stated, rig.cameras["wrist"], rig.hand), continuous=False, inverse=alone.fingers.inverse
    )
    pose = solved(pipeline, shown(setup, natural(setup, 20.0)), TRIPLE_NS)
    assert pose.t_ns == TRIPLE_NS + 1_500_000
    np.testing.assert_array_equal(pose.inside_volume, pose.position_m[:, 2] >= 0.15)
    assert 0 < pose.inside_volume.sum() < 26


def test_an_unknown_laser_is_put_at_the_foot_of_the_camera(rig: RigSetup, setup: WristSetup) -> None:
    bare = WristSetup.of(msgspec.structs.replace(rig.rig, laser=None), rig.cameras["wrist"], rig.hand)
    np.testing.assert_allclose(bare.laser_m, setup.offset_m * setup.normal)
    assert setup.laser_m @ setup.normal == pytest.approx(setup.offset_m, abs=1e-12)


def test_a_rendered_curl_from_exact_points(datasets: Path) -> None:
    """The goal for the flexion of a natural curl: 2 degrees RMS up to a PIP of 85; beyond the branch it says so."""
    folder = datasets / "wrist" / "curl"
    manifest = msgspec.json.decode((folder / "recording.json").read_bytes())
    recorded = WristSetup.of(
        msgspec.convert(manifest["rig"], RigCalibration),
        msgspec.convert(manifest["cameras"]["wrist"], CameraCalibration),
        HandModel.of(load(datasets / "hands" / "webxr-right.json", HandProfile)),
    )
    truth = np.load(folder / "truth.npz")
    pipeline = WristPipeline(recorded, continuous=False)
    pixels = recorded.optics.project(truth["laser_pt"][:, 1:6])
    poses = [solved(pipeline, uv, (k + 1) * TRIPLE_NS) for k, uv in enumerate(pixels)]
    pip = np.degrees(truth["angles"][:, [7, 11, 15, 19]])
    found = np.degrees([pose.angles_rad[1:, 2] for pose in poses])
    tracked = np.array([pose.tracked[CHAINS[1:, 1]] for pose in poses])
    # At 80 and 85 degrees the last phalanx hides most of the little finger's line from the camera.
    usual = (pip < 85.1) & tracked & (truth["laser_len_vis"][:, 2:6] > 0.015)
    rms = [np.sqrt(np.mean((found - pip)[usual[:, f], f] ** 2)) for f in range(4)]
    assert usual.sum() > 60
    assert max(rms) < 2.0, dict(zip(FINGERS[1:], rms, strict=True))
    assert not tracked[pip > 101.0].any()


def test_a_line_cut_short_by_the_folding_phalanx_is_nearer_to_the_end_of_the_branch(
    alone: WristPipeline, setup: WristSetup
) -> None:
    bent = solved_with_share(alone, setup, 80.0, 1.0), solved_with_share(alone, setup, 80.0, 0.3)
    far = solved_with_share(alone, setup, 45.0, 1.0), solved_with_share(alone, setup, 45.0, 0.3)
    moved = bent[1].angles_rad[1:, 2] - bent[0].angles_rad[1:, 2]
    assert (moved > np.radians(2.0)).any()
    assert (moved < np.radians(20.0)).all()
    assert not bent[1].tracked[CHAINS[1:, 3]].any()  # what hides a line may be another finger as well
    assert np.allclose(far[0].angles_rad, far[1].angles_rad)


def solved_with_share(pipeline: WristPipeline, setup: WristSetup, pip_deg: float, share: float) -> HandPose:
    """The pose of a natural hand of which only that share of each line is seen, about its centre."""
    angles = natural(setup, pip_deg)
    length_px = LaserCut(setup)(angles[None, None])[1][:, 0, 0]
    whole = message(shown(setup, angles), pipeline.fingers._last_ns + TRIPLE_NS)
    (only,) = pipeline.push(msgspec.structs.replace(whole, laser_px=share * length_px))
    return only.pose
