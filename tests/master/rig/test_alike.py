"""Which marker of a paint is whose: predicted hands, ambiguity, begin by side, refusals, and a planted swap."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.arrays import Float
from common.calibration import load
from common.calibration.rig import RigCalibration
from common.errors import CalibrationError
from common.hand.model import HandJoints
from common.messages import HandPose, MarkerDetections
from common.sim.scene import view_centre
from common.sim.two_rigs import TwoHands
from master.rig.alike import AlikeHands
from master.rig.setup import RigSetup, load_setups, setups_of

CALIBRATION = Path(__file__).parents[3] / "calib_json"
BOTH = load_setups(CALIBRATION, ["desk-both"])
NAMES = tuple(one.hand.profile.name for one in BOTH)
PERIOD_NS = round(1e9 / 60.0)


def points_of(hand: int, t_s: float, seed: int = 7) -> tuple[HandJoints, Float]:
    """A hand of the simulated motion, and its markers (6, 3) [m]."""
    setup = BOTH[hand]
    state = TwoHands(setup.hand, view_centre(setup.rig), seed).at(t_s)
    joints = setup.hand.forward(state.T_rig_palm, state.angles_rad)
    return joints, setup.hand.marker_points(joints, setup.rig.markers)


def seen_by(
    camera: str, t_s: float, hands: Sequence[int] = (0, 1), swapped: Sequence[int] = ()
) -> MarkerDetections:
    """What a camera sees at a time [s], of which hands, with the rows of some paints exchanged."""
    uv = np.full((12, 2), np.nan)
    for hand in hands:
        uv[6 * hand : 6 * hand + 6] = BOTH[hand].models[camera].project(points_of(hand, t_s)[1])
    for m in swapped:
        uv[[m, m + 6]] = uv[[m + 6, m]]
    there = np.where(np.isfinite(uv[:, 0]), 1.0, np.nan)
    t_ns = round(1e9 * (t_s + 1.0))
    return MarkerDetections(
        camera,
        1,
        round(60 * t_s),
        t_ns,
        t_ns,
        uv,
        150.0 * there,
        there,
        0.3 * there,
        np.full((12, 2), np.nan),
    )


def pose_of(hand: int, t_s: float) -> HandPose:
    """The exact pose of a hand as its line publishes it."""
    joints, points = points_of(hand, t_s)
    from common.geometry.transforms import matrix_to_quaternion

    ones = np.ones(26, np.bool_)
    return HandPose.known_good(
        NAMES[hand],
        round(1e9 * (t_s + 1.0)),
        position_m=joints.position_m,
        orientation_wxyz=np.array([matrix_to_quaternion(R) for R in joints.rotation]),
        radius_m=np.full(26, 0.01),
        valid=ones,
        tracked=ones,
        cov_m2=np.tile(4e-6 * np.eye(3), (26, 1, 1)),
        source=np.ones(26, np.uint8),
        angles_rad=np.zeros((5, 4)),
        markers_m=points,
        markers_raw_m=points,
        markers_cov_m2=np.tile(1e-6 * np.eye(3), (6, 1, 1)),
        inside_volume=ones,
    )


def knowing(t_s: float) -> AlikeHands:
    """Both hands known until just before a time."""
    alike = AlikeHands.of(BOTH, Counter())
    assert alike is not None
    for ago in (2, 1):
        for hand in (0, 1):
            alike.take(pose_of(hand, t_s - ago / 60.0))
    return alike


def assert_rows(out: MarkerDetections, truth: MarkerDetections, unclear: int = 0) -> None:
    """Each row is its own, or not given to anybody."""
    nobody = np.isnan(out.uv[:, 0]) & np.isfinite(truth.uv[:, 0])
    assert nobody.sum() <= unclear
    np.testing.assert_array_equal(out.uv[~nobody], truth.uv[~nobody])
    np.testing.assert_array_equal(np.isnan(out.area), np.isnan(out.uv[:, 0]))


@settings(max_examples=30, deadline=None)
@given(st.sampled_from([0.5, 1.9, 3.4, 5.2, 8.3, 12.0, 16.5]), st.sets(st.integers(0, 5)))
def test_rows_that_a_slave_exchanged_are_put_right(t_s: float, swapped: set[int]) -> None:
    alike, exact = knowing(t_s), seen_by("left", t_s)
    assert_rows(alike.push(seen_by("left", t_s, swapped=sorted(swapped))), exact, unclear=2)
    later = seen_by("right", t_s + 0.005, swapped=sorted(swapped))
    assert_rows(alike.push(later), seen_by("right", t_s + 0.005), unclear=2)


def test_a_planted_swap_of_the_hands_is_seen_by_these_tests() -> None:
    alike = AlikeHands.of(BOTH, Counter())
    assert alike is not None
    for hand in (0, 1):  # each is said to be where the other is
        alike.take(msgspec.structs.replace(pose_of(hand, 0.5), hand=NAMES[1 - hand]))
    with pytest.raises(AssertionError):
        assert_rows(alike.push(seen_by("left", 0.5)), seen_by("left", 0.5))


def test_one_blob_between_two_markers_is_nobodys() -> None:
    alike, message = knowing(0.5), seen_by("left", 0.5)
    uv = message.uv.copy()
    uv[0], uv[6] = 0.5 * (uv[0] + uv[6]), np.nan
    fields = {name: getattr(message, name).copy() for name in ("area", "quality", "sigma_px")}
    for array in fields.values():
        array[6] = np.nan
    out = alike.push(msgspec.structs.replace(message, uv=uv, **fields))
    assert np.isnan(out.uv[[0, 6]]).all()
    np.testing.assert_array_equal(out.uv[[1, 7]], message.uv[[1, 7]])


def test_hands_begin_by_their_sides_whatever_the_rows_say() -> None:
    counts = Counter[str]()
    alike, t_s = AlikeHands.of(BOTH, counts), 0.3
    assert alike is not None
    left = right = seen_by("left", t_s)
    for t_s in (0.3 + np.arange(6) / 60.0).tolist():
        left = alike.push(seen_by("left", t_s, swapped=(0, 3, 5)))
        right = alike.push(seen_by("right", t_s + 0.005, swapped=(1, 3)))
    assert_rows(left, seen_by("left", t_s))
    assert_rows(right, seen_by("right", t_s + 0.005))
    assert counts["alike.begun.default-right"] == counts["alike.begun.default-left"] == 1


@pytest.mark.parametrize("hand", [0, 1])
@pytest.mark.parametrize("rows", [(), tuple(range(6))])
def test_a_lone_hand_is_named_by_its_side(hand: int, rows: tuple[int, ...]) -> None:
    alike = AlikeHands.of(BOTH, Counter())
    assert alike is not None
    first = alike.push(seen_by("left", 0.3, [hand], rows))
    assert np.isnan(first.uv).all(), "of one camera nothing is known"
    out = first
    for k in range(1, 6):
        alike.push(seen_by("right", 0.3 + k / 60.0 - 0.01, [hand], rows))
        out = alike.push(seen_by("left", 0.3 + k / 60.0, [hand], rows))
    assert_rows(out, seen_by("left", 0.3 + 5 / 60.0, [hand]))


def test_a_hand_that_enters_takes_no_marker_of_the_other() -> None:
    alike = AlikeHands.of(BOTH, Counter())
    assert alike is not None
    out = exact = seen_by("left", 0.3)
    for k in range(8):
        t_s = 0.3 + k / 60.0
        hands = [1] if k < 3 else [0, 1]
        for camera, late_s in (("left", 0.0), ("right", 0.005)):
            out = alike.push(seen_by(camera, t_s + late_s, hands, range(6)))
            assert np.isnan(out.uv[:6, 0]).all() or k >= 3
        alike.take(pose_of(1, t_s))
        if k >= 3:
            exact = seen_by("right", t_s + 0.005, hands)
            np.testing.assert_array_equal(out.uv[6:], exact.uv[6:])
    assert_rows(out, exact)


def changed(**changes: object) -> RigCalibration:
    return msgspec.structs.replace(load(CALIBRATION / "rigs" / "desk-both.json", RigCalibration), **changes)


def test_hands_in_other_colours_need_no_association() -> None:
    cameras = {
        name: msgspec.structs.replace(
            one,
            markers={
                m: msgspec.structs.replace(c, hsv_low=(c.hsv_low[0], 70 + m.startswith("left"), 70))
                for m, c in (one.markers or {}).items()
            },
        )
        for name, one in BOTH[0].cameras.items()
    }
    hands = {one.rig.hand: one.hand for one in BOTH}
    assert AlikeHands.of(setups_of([changed()], cameras, hands.__getitem__), Counter()) is None
    assert AlikeHands.of(load_setups(CALIBRATION, ["desk"]), Counter()) is None


def test_two_hands_of_one_side_painted_alike_are_refused() -> None:
    right = BOTH[0].hand
    profile = msgspec.structs.replace(
        right.profile, name="second", markers={f"b_{m}": v for m, v in right.profile.markers.items()}
    )
    hands = {"default-right": right, "second": type(right).of(profile)}
    markers = (*right.profile.markers, *profile.markers)
    cameras = {
        name: msgspec.structs.replace(
            one, markers={m: (one.markers or {})[m.removeprefix("b_")] for m in markers}
        )
        for name, one in BOTH[0].cameras.items()
    }
    rig = changed(markers=markers, other_hands=("second",))
    setups: tuple[RigSetup, ...] = setups_of([rig], cameras, hands.__getitem__)
    with pytest.raises(
        CalibrationError, match="two right hands are painted alike: paint one in other colours"
    ):
        AlikeHands.of(setups, Counter())
