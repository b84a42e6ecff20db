"""At overload instants are left out, evenly, and counted; no message is lost for it; offline nothing is left out."""

import numpy as np
import pytest

from master.hurry import BEGIN_FRAMES, BEGIN_S, HARD_FRAMES, Hurry, Shedding
from master.ingest import QUEUE, QUEUE_PER_CAMERA, ROOM, room
from master.rig import build_pipeline
from master.stages import StageTimes
from tests.hand_helpers import MARKERS, RIGHT
from tests.synthetic_run import hand_at, synthetic_run

SLOW_HZ = 15.0


def behind(frames: float, cameras: int = 4, frame_rate_hz: float = SLOW_HZ) -> Hurry:
    hurry = Hurry(cameras, frame_rate_hz)
    hurry.waiting = lambda: round(frames * cameras)
    hurry.look()
    return hurry


@pytest.mark.parametrize(
    ("frames", "expected"),
    [
        (0, [False] * 6),
        (BEGIN_FRAMES, [False] * 6),
        (BEGIN_FRAMES + 1, [True, False] * 3),
        (HARD_FRAMES + 1, [True, True, True, False, True, True]),
    ],
)
def test_the_farther_behind_the_more_is_left_out_and_never_all(frames: float, expected: list[bool]) -> None:
    shedding = Shedding(behind(frames))
    assert [shedding() for _ in expected] == expected


def test_who_has_begun_to_leave_out_goes_on_until_the_queue_is_worked_off() -> None:
    hurry = behind(BEGIN_FRAMES + 1)
    shedding = Shedding(hurry)
    assert shedding()
    hurry.waiting = lambda: 8  # two frames of each of four cameras: less than where it began
    hurry.look()
    assert [shedding() for _ in range(4)] == [False, True, False, True]
    hurry.waiting = lambda: 4
    assert [shedding() for _ in range(2)] == [False, True], (
        "what a message was taken with holds until the next"
    )
    hurry.look()
    assert not any(shedding() for _ in range(4))


@pytest.mark.parametrize("frame_rate_hz", [SLOW_HZ, 60.0, 90.0, 200.0])
def test_a_short_pause_costs_no_pose(frame_rate_hz: float) -> None:
    pause = BEGIN_S * frame_rate_hz  # frames of each camera
    assert behind(int(pause), 2, frame_rate_hz).leave_out == 0
    assert behind(max(pause, BEGIN_FRAMES) + 1, 2, frame_rate_hz).leave_out > 0


def test_what_is_solved_beside_what_is_left_out_is_as_right_as_ever() -> None:
    run = synthetic_run(24)
    shedding = Shedding(behind(BEGIN_FRAMES + 1, 2))
    pipeline = build_pipeline(run.setup, StageTimes(), shed=shedding)
    poses = [one.pose for message in run.messages for one in pipeline.push(message)]
    assert pipeline.counts["instants_shed"] == 12
    assert len(poses) == pipeline.counts["poses"] == 12
    off_mm = [
        1e3
        * np.linalg.norm(one.markers_raw_m - RIGHT.marker_points(hand_at(one.t_ns * 1e-9), MARKERS), axis=1)
        for one in poses[2:]
    ]
    assert np.median(off_mm) < 0.5


@pytest.mark.parametrize(("cameras", "frames"), [(1, QUEUE), (2, QUEUE), (16, 16 * QUEUE_PER_CAMERA)])
def test_many_cameras_have_more_room_and_samples_as_much(cameras: int, frames: int) -> None:
    assert room(cameras) == ROOM | {"frame": frames, "tags": frames}
