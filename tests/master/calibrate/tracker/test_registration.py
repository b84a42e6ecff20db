"""A registration from simulated motions: right, sure of itself as it is right, and refused where it cannot be."""

from collections.abc import Callable

import numpy as np
import pytest
from msgspec.structs import replace

from common.arrays import Float
from common.errors import FitError
from common.geometry.transforms import rigid, rotation_vector_to_matrix
from common.messages import ObjectPose, ObjectSource, TrackerPose
from master.calibrate.tracker.fit import Placed, closed_form
from master.calibrate.tracker.registration import register
from master.calibrate.tracker.tracks import first_lag, object_track, tracker_track
from tests.master.calibrate.tracker.simulated import MIDDLE, ZERO_NS, Motion, errors_of

Measured = tuple[list[ObjectPose], list[TrackerPose]]


def test_without_noise_it_is_exact() -> None:
    motion = Motion(3, seconds=10.0, noise=1e-6, strays=0.0, lost_s=0.0)
    found = register(motion.objects(), motion.tracked())
    placed = found.fit.placed
    mm, deg = errors_of(motion, placed)
    assert mm < 0.03  # the way between two poses of the tracker is no straight line
    assert deg < 0.01
    assert abs(placed.late_s - motion.late_s) < 2e-5


def test_closed_form_of_three_poses_by_hand() -> None:
    # The device sits 10 cm along the object's x; the system's frame is the rig's, a quarter turned about z, 1 m aside.
    X = rigid(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 0, 0]))
    Y = rigid(np.eye(3), np.array([0.1, 0, 0]))
    rotations = rotation_vector_to_matrix(np.array([[0.0, 0, 0], [0.9, 0, 0], [0, 0.8, 0], [0, 0, 0.7]]))
    A = [rigid(R, np.array([0.0, 0.1 * k, 0.5])) for k, R in enumerate(rotations)]
    B = [np.linalg.inv(X) @ one @ Y for one in A]
    np.testing.assert_allclose(B[0][:3, 3], [0.0, 0.9, 0.5], atol=1e-12)  # inv(X): x - 1, then a quarter back
    RA, pA = np.array([one[:3, :3] for one in A]), np.array([one[:3, 3] for one in A])
    RB, pB = np.array([one[:3, :3] for one in B]), np.array([one[:3, 3] for one in B])
    found = closed_form(RA, pA, RB, pB)
    np.testing.assert_allclose(found[0], X, atol=1e-9)
    np.testing.assert_allclose(found[1], Y, atol=1e-9)


def test_over_seeds_it_is_right_and_as_sure_as_it_is_right() -> None:
    millimetres, degrees, late_ms, place_sigmas, rotation_sigmas = ([] for _ in range(5))
    for seed in (1, 2, 6):  # over ten motions: `bench/objects/tracker.py`
        motion = Motion(seed, late_s=0.06 * np.sin(5.0 * seed))
        found = register(motion.objects(), motion.tracked())
        mm, deg = errors_of(motion, found.fit.placed)
        millimetres.append(mm)
        degrees.append(deg)
        late_ms.append(1e3 * (found.fit.placed.late_s - motion.late_s) / found.figures["late_sigma_ms"])
        place_sigmas.append(mm / found.figures["position_sigma_mm"])
        rotation_sigmas.append(deg / found.figures["rotation_sigma_deg"])
        assert 0.03 < found.figures["outlier_share"] < 0.1
        assert 1.5 < found.figures["position_mm"] < 3.5  # the cameras' noise, nothing else
    assert max(millimetres) < 1.5
    assert max(degrees) < 0.25
    for ratios in (place_sigmas, rotation_sigmas):
        assert 0.3 < float(np.median(ratios)) < 1.5
        assert max(ratios) < 3.0
    assert np.abs(late_ms).max() < 4.0


def test_the_lag_is_found_from_nothing_however_far_it_is() -> None:
    for late_s in (-0.4, -0.05, 0.0, 0.31):
        motion = Motion(2, seconds=12.0, late_s=late_s)
        found = first_lag(object_track(motion.objects(), ZERO_NS), tracker_track(motion.tracked(), ZERO_NS))
        assert found is not None
        assert abs(found - late_s) < 0.01


def test_what_was_held_or_given_by_a_tracker_does_not_count() -> None:
    motion = Motion(4, seconds=10.0)
    objects = motion.objects()
    wrong = [
        replace(one, position_m=np.zeros(3), source=source, tracked=tracked, t_ns=one.t_ns + 3_000_000)
        for one in objects
        for source, tracked in ((ObjectSource.HELD, False), (ObjectSource.TRACKER, True))
    ]
    alone = register(objects, motion.tracked()).fit.placed
    among = register([*wrong, *objects], motion.tracked()).fit.placed
    np.testing.assert_array_equal(alone.T_rig_tracking, among.T_rig_tracking)


@pytest.mark.parametrize(
    ("motion", "text"),
    [
        (
            Motion(1, rotations=(1.0, 0.0, 0.0)),
            r"poses would be known to .*about its y and its z axis as well",
        ),
        (Motion(1, rotations=(0.02, 0.02, 0.02)), "axis as well"),
        (Motion(1, seconds=0.8), "at least 60 of each are needed"),
        (Motion(1, lost_s=6.0), "the tracker 0; at least 60"),
        (Motion(1, late_s=1.7), "hardly saw|no registration explains"),
        (Motion(1, strays=1.0), "hardly saw|no registration explains"),
    ],
)
def test_what_does_not_determine_it_is_refused_with_what_to_do(motion: Motion, text: str) -> None:
    with pytest.raises(FitError, match=text):
        register(motion.objects(), motion.tracked())


class Line(Motion):
    """Carried to and fro along one line, and never turned."""

    def truth(self, t_s: Float) -> tuple[Float, Float]:
        rotation, place = super().truth(t_s)
        return np.broadcast_to(rotation[0], rotation.shape), MIDDLE + (place - MIDDLE) * [1.0, 0.0, 0.0]


def test_a_motion_along_one_line_is_refused_with_what_to_do() -> None:
    line = Line(1)
    with pytest.raises(FitError, match="about its x and its y and its z axis as well"):
        register(line.objects(), line.tracked())


def test_numbers_that_are_none_count_as_not_seen() -> None:
    motion = Motion(4, seconds=10.0)
    hole = [replace(one, position_m=np.full(3, np.nan)) for one in motion.tracked()[200:300]]
    tracked = [*motion.tracked()[:200], *hole, *motion.tracked()[300:]]
    placed = register(motion.objects(), tracked).fit.placed
    assert errors_of(motion, placed)[0] < 2.0


def slipped() -> Measured:
    before, after = Motion(6), Motion(6)
    by = rigid(rotation_vector_to_matrix(np.array([0.5, 0.0, 0.0])), np.array([0.04, 0.0, 0.0]))
    object.__setattr__(after, "Y", after.Y @ by)
    first, then = before.tracked(), after.tracked()
    half = len(first) // 2
    return before.objects(), [*first[:half], *then[half:]]


def with_cameras(change: Callable[[int, Float], Float]) -> Measured:
    """The motion with the places of the cameras changed, by number of the pose."""
    motion = Motion(6)
    objects = [replace(one, position_m=change(k, one.position_m)) for k, one in enumerate(motion.objects())]
    return objects, motion.tracked()


def mirrored() -> Measured:
    motion = Motion(6)
    turn, place = np.array([1.0, 1.0, -1.0, -1.0]), np.array([-1.0, 1.0, 1.0])
    return motion.objects(), [
        replace(one, position_m=place * one.position_m, orientation_wxyz=turn * one.orientation_wxyz)
        for one in motion.tracked()
    ]


@pytest.mark.parametrize(
    ("measured", "cause"),
    [
        (slipped, "disagree by .* mm from 10 s on: a camera, a base station or the tracker"),
        (
            lambda: with_cameras(lambda k, p: p + np.array([0.01 * (k > 600), 0.0, 0.0])),
            "from 10 s on: a camera, a base",
        ),
        (lambda: with_cameras(lambda _, p: 0.97 * p), r"ways are 0\.97\d times as long .* board .* tags"),
        (lambda: with_cameras(lambda _, p: 1.1 * p), r"ways are 1\.0\d+ times as long .* board .* tags"),
        (mirrored, "axes right-handed, and pictures not mirrored"),
        (
            lambda: (Motion(6).objects()[:50], Motion(6).tracked()),
            "gave 50 poses, the tracker .* at least 60",
        ),
        (
            lambda: with_cameras(lambda _, p: np.full_like(p, np.nan)),
            "gave 0 poses, the tracker .* at least 60",
        ),
    ],
    ids=["slipped", "camera moved", "too small", "too large", "mirrored", "few", "NaN"],
)
def test_a_fault_of_the_session_is_refused_by_name(measured: Callable[[], Measured], cause: str) -> None:
    register(Motion(6).objects(), Motion(6).tracked())
    with pytest.raises(FitError, match=cause):
        register(*measured())


def test_the_other_systems_frame_is_found_as_well() -> None:
    """Lighthouse by SteamVR is y up, by libsurvive z up: a fixed turn of the frame, which X takes up."""
    motion = Motion(5)
    other = rigid(rotation_vector_to_matrix(np.array([np.pi / 2, 0.0, 0.0])), np.array([0.3, -1.0, 2.0]))
    placed = register(motion.objects(), motion.tracked()).fit.placed
    object.__setattr__(motion, "X", motion.X @ np.linalg.inv(other))
    rotated = register(motion.objects(), motion.tracked()).fit.placed
    same = Placed(rotated.T_rig_tracking @ other, rotated.T_object_tracker, rotated.late_s)
    np.testing.assert_allclose(same.T_rig_tracking, placed.T_rig_tracking, atol=2e-3)
    np.testing.assert_allclose(same.T_object_tracker, placed.T_object_tracker, atol=2e-3)


def test_nothing_at_all_is_refused() -> None:
    motion = Motion(1, seconds=3.0)
    with pytest.raises(FitError, match="the tracker reported nothing"):
        register(motion.objects(), [])
    with pytest.raises(FitError, match="the cameras reported nothing"):
        register([], motion.tracked())
