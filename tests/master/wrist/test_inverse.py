"""The inverse model: the pose that was shown is found, twins are listed, tips that contradict do not win."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.arrays import Bool, Float
from common.hand_model import CHAINS, FINGERS, HandModel
from common.hand_profiles import generated_profile
from common.messages import HandPose, Level, Source, WristDetections
from master.wrist.finger_poses import UNKNOWNS, FingerPoses
from master.wrist.fingertip import Fingertips
from master.wrist.forward import ForwardTable
from master.wrist.inverse import InverseModel
from master.wrist.invert import Inverse
from master.wrist.laser_plane import PlaneAxes
from master.wrist.pipeline import WristPipeline
from master.wrist.setup import WristSetup
from tests.wrist_run import wrist_setup

TRIPLE_NS = 33_333_333


class Device:
    """A device with its tables, made once, and what it would see of a hand."""

    def __init__(self, root: Path) -> None:
        wrist = wrist_setup(root).wrist
        assert wrist is not None
        self.setup: WristSetup = wrist
        self.poses = FingerPoses(wrist)
        self.table, self.model = Inverse(ForwardTable.of(wrist)), InverseModel(wrist)

    def pipeline(self, level: str = "auto", continuous: bool = False) -> WristPipeline:
        assert level in ("fk", "ik", "auto")
        setup = replace(self.setup, level=level)
        return WristPipeline(setup, continuous=continuous, inverse=self.table, model=self.model)

    def seen(self, x: Float) -> tuple[Float, Float]:
        """Pixels (5, 2) of laser points and tips of unknowns (5, 3)."""
        seen = self.poses.views(x[None], np.ones((1, 5), np.bool_)).seen[0]
        laser = self.setup.optics.project(PlaneAxes.of(self.setup).space(seen[:, :2]))
        return laser, self.setup.optics.distort(seen[:, 2:])


@pytest.fixture(scope="module")
def device(root: Path) -> Device:
    return Device(root)


def bent(mcp_deg: float, pip_deg: float, aside_deg: float = 0.0) -> Float:
    x = np.tile(np.radians([aside_deg, mcp_deg, pip_deg]), (5, 1))
    x[2, 0] = 0.0  # the middle finger of this hand does not move aside
    x[0] = np.radians([5.0, 10.0, 20.0])
    return x


def pushed(
    pipeline: WristPipeline, laser: Float, tip: Float, sigma_px: float = 2.0, depth: Float | None = None
) -> HandPose:
    t_ns = max(pipeline.fingers._last_ns, 0) + TRIPLE_NS
    message = WristDetections(
        camera="wrist",
        session=1,
        seq=t_ns // TRIPLE_NS,
        t_ns=t_ns,
        ready_t_ns=t_ns + 1,
        laser_uv=laser,
        laser_sigma_px=np.where(np.isnan(laser).any(axis=1), np.nan, 0.2),
        laser_px=np.full(5, np.nan),
        tip_uv=tip,
        tip_sigma_px=np.where(np.isnan(tip).any(axis=1), np.nan, sigma_px),
        tip_depth=np.full(5, np.nan) if depth is None else depth,
    )
    (only,) = pipeline.push(message)
    return only.pose


def solved_by(pose: HandPose, level: Level) -> Bool:
    return pose.level == level


@pytest.mark.parametrize(
    ("mcp", "pip"), [(20.0, 85.0), (45.0, 62.0), (55.0, 50.0), (30.0, 75.0), (15.0, 80.0)]
)
def test_unnatural_fingers_are_found_to_a_tenth_of_a_degree(device: Device, mcp: float, pip: float) -> None:
    x = bent(mcp, pip, 4.0)
    seen = device.poses.views(x[None], np.ones((1, 5), np.bool_)).seen[0]
    found = device.model(seen, np.tile(np.diag([1e-6, 1e-6, 1e-4, 1e-4]), (5, 1, 1)))
    clear = ~(found.misfit[:, 1] < 3.84)
    assert clear.sum() >= 3
    np.testing.assert_allclose(np.degrees(found.x_rad[:, 0] - x)[clear], 0.0, atol=0.1)


def test_of_random_poses_every_one_that_is_alone_is_found(device: Device) -> None:
    rng = np.random.default_rng(23)
    cov = np.tile(np.diag([1e-6, 1e-6, 1e-4, 1e-4]), (5, 1, 1))
    asked = lost = 0
    for _ in range(12):
        limits = device.setup.model.limits_rad[:, :UNKNOWNS]
        x = rng.uniform(limits[..., 0], limits[..., 1])
        x = device.setup.model.clamp(device.poses.angles(x))[..., :UNKNOWNS]
        shown = device.poses.tips_shown(x[None])[0]
        views = device.poses.views(x[None], np.ones((1, 5), np.bool_))
        shown &= views.length_px[0] > 10.0
        found = device.model(np.where(shown[:, None], views.seen[0], np.nan), cov)
        off = np.degrees(np.abs(found.x_rad - x[:, None]).max(axis=-1))
        asked += int(shown.sum())
        lost += int((shown & ~(off < 0.1).any(axis=1)).sum())
    assert asked > 20
    assert lost == 0


def test_by_the_laser_alone_the_same_fingers_are_far_off(device: Device) -> None:
    x = bent(50.0, 55.0)
    laser, tip = device.seen(x)
    both, one = (pushed(device.pipeline(level), laser, tip) for level in ("ik", "fk"))
    assert (np.abs(both.angles_rad[1:, 2] - x[1:, 2]) < np.radians(1.0)).all()
    assert (np.abs(one.angles_rad[1:, 2] - x[1:, 2]) > np.radians(20.0)).all()
    assert solved_by(one, Level.FK).all()


def test_a_missing_tip_falls_back_or_is_left_out(device: Device) -> None:
    laser, tip = device.seen(bent(27.0, 60.0))
    tip[1] = np.nan
    auto, alone = pushed(device.pipeline("auto"), laser, tip), pushed(device.pipeline("ik"), laser, tip)
    np.testing.assert_array_equal(solved_by(auto, Level.IK), [True, False, True, True, True])
    assert auto.level[1] == Level.FK
    assert auto.valid[CHAINS[1]].all()
    assert not auto.tracked[CHAINS[1]].any()  # habit has its tip in sight, and the others show theirs
    unlit = pushed(device.pipeline("auto"), laser, np.full_like(tip, np.nan))
    assert unlit.tracked[CHAINS[1]].all()
    assert alone.level[1] == Level.NONE
    assert alone.source[CHAINS[1, 1]] == Source.NONE
    assert np.isnan(alone.angles_rad[1]).all()
    assert alone.tracked[CHAINS[2]].all()


def test_a_tip_without_a_laser_line_is_not_enough(device: Device) -> None:
    laser, tip = device.seen(bent(27.0, 60.0))
    laser[3] = np.nan
    pose = pushed(device.pipeline(), laser, tip)
    assert pose.level[3] == Level.NONE
    assert not pose.valid[CHAINS[3]].any()


def test_a_tip_that_contradicts_the_laser_is_refused_and_counted(device: Device) -> None:
    laser, tip = device.seen(bent(32.4, 60.0))
    tip[2] += [90.0, 0.0]  # beside the finger, 25 mm
    pipeline = device.pipeline()
    pose = pushed(pipeline, laser, tip)
    assert pose.level[2] == Level.FK
    assert pipeline.counts["tip_refused.middle"] == 1
    assert sum(pipeline.counts[f"tip_refused.{name}"] for name in FINGERS) == 1
    assert abs(np.degrees(pose.angles_rad[2, 2]) - 60.0) < 2.0  # what the laser says of a natural finger


def twins(device: Device) -> tuple[Float, Float, Float]:
    """A pose of which a little finger's tip also lies elsewhere, with its pixels: found by search, not by hand."""
    for mcp in (24.0, 27.0, 30.0):
        for pip in (20.0, 45.0, 50.0, 55.0):
            x = bent(mcp, pip)
            laser, tip = device.seen(x)
            if pushed(device.pipeline(), laser, tip).ambiguous[4]:
                return x, laser, tip
    raise AssertionError("no pose with a twin")


def test_of_twins_the_doubt_holds_both(device: Device) -> None:
    x, laser, tip = twins(device)
    alone = device.pipeline()
    first = pushed(alone, laser, tip)
    assert alone.counts["ambiguous.little"] == 1
    assert first.tracked[CHAINS[4]].all()
    exact = device.setup.model.forward(
        device.setup.T_camera_palm, device.setup.model.clamp(device.poses.angles(x))
    )
    joints = CHAINS[4, 1:]
    off = (first.position_m - exact.position_m)[joints]
    surprise = np.vecdot(off, np.linalg.solve(first.cov_m2[joints], off[..., None])[..., 0])
    assert (surprise < 7.815).all()


def test_tips_lie_a_radius_beyond_the_last_joint_or_as_far_as_a_hand_of_this_size_has_them(
    device: Device,
) -> None:
    model = device.setup.model
    chains = model.chains(np.zeros((5, 4)))
    beyond = Fingertips.of(model).points(chains) - chains.position_m[:, 3]
    np.testing.assert_allclose(np.linalg.norm(beyond, axis=1), model.radius_m[CHAINS[:, 3]])
    bare = msgspec.structs.replace(generated_profile("bare", "right"), radius_m=None)
    tips_m = Fingertips.of(HandModel.of(bare)).beyond_m
    assert ((tips_m > 7e-3) & (tips_m < 14e-3)).all()


def test_the_left_hand_is_solved_as_the_right_one(root: Path) -> None:
    wrist = wrist_setup(root, "wrist-left").wrist
    assert wrist is not None
    poses = FingerPoses(wrist)
    x = bent(15.0, 75.0, 3.0)
    seen = poses.views(x[None], np.ones((1, 5), np.bool_)).seen[0]
    cov = np.tile(np.diag([1e-6, 1e-6, 1e-4, 1e-4]), (5, 1, 1))
    found = InverseModel(wrist)(seen, cov)
    np.testing.assert_allclose(np.degrees(found.x_rad[:, 0] - x), 0.0, atol=0.1)
    assert (found.misfit[:, 0] < 1e-2).all()


def test_nobody_seen_and_points_that_fit_nothing_make_no_minimum_of_note(device: Device) -> None:
    cov = np.tile(np.diag([1e-6, 1e-6, 1e-4, 1e-4]), (5, 1, 1))
    nothing = device.model(np.full((5, 4), np.nan), cov)
    assert np.isinf(nothing.misfit).all()
    elsewhere = device.model(np.tile([3.0, -2.0, 5.0, 5.0], (5, 1)), cov)
    assert (elsewhere.misfit > 100.0).all()
