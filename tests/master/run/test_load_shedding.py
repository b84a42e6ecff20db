"""After a pause the newest instant is told next, at overload what is told is new; who keeps up leaves nothing out."""

import random
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pytest

from common.messages import HandPose, MarkerDetections
from master.rig.pipeline import build_pipeline
from master.rig.setup import RigSetup
from master.run.app import StageTimes
from master.run.ingest import CAPACITY, QUEUE, QUEUE_PER_CAMERA, MessageQueue, Span, capacity
from master.run.solver_supervisor import MOST, LoadShedding, Shedding
from tests.hand_helpers import MARKERS, RIGHT, camera_file, rig_file
from tests.network_helpers import cycle, detections
from tests.synthetic_run import hand_at, synthetic_run

MS = 1_000_000
PERIOD_NS = 16_666_667


def setup_of(left_hz: float = 60.0, right_hz: float = 60.0) -> RigSetup:
    rates = {"left": left_hz, "right": right_hz}
    return RigSetup.of(rig_file(), {name: camera_file(name, hz, 0.0) for name, hz in rates.items()}, RIGHT)


SETUP = setup_of()


class Came(NamedTuple):
    """A message, and when it arrived [ns]."""

    t_ns: int
    message: MarkerDetections


def arrivals(
    seconds: float, offset_ns: int, jitter_ns: int = 0, rates_hz: tuple[float, float] = (60.0, 60.0)
) -> list[Came]:
    """What two cameras send, the right one so much later, each with a delay of its own up to `jitter_ns`."""
    delay, out = random.Random(1), list[Came]()
    for name, hz, late_ns in zip(("left", "right"), rates_hz, (0, offset_ns), strict=True):
        for seq in range(round(seconds * hz)):
            t_ns = round(seq * 1e9 / hz) + late_ns
            out.append(Came(t_ns + delay.randrange(jitter_ns + 1), detections(name, 1, seq, t_ns)))
    return sorted(out, key=lambda one: one.t_ns)


class Paired:
    """An instant is a frame of the left camera; the right one's first frame that is not older completes it."""

    def __init__(self) -> None:
        self._left, self._right_ns = deque[int](), -1

    def push(self, message: MarkerDetections) -> Iterator[int]:
        if message.camera == "left":
            self._left.append(message.t_ns)
        else:
            self._right_ns = message.t_ns
        while self._left and self._left[0] <= self._right_ns:
            yield self._left.popleft()


@dataclass
class Lived:
    """Instants that were solved, when each was begun and told, and how many were left out."""

    epochs: list[int]
    begun: list[int]
    result_ns: list[int]
    dropped_epochs: int

    def ages_ms(self) -> list[float]:
        return [
            1e-6 * (result_ns - epoch) for result_ns, epoch in zip(self.result_ns, self.epochs, strict=True)
        ]


def lived(
    came: Sequence[Came],
    solve_ns: Callable[[int], int],
    setup: RigSetup = SETUP,
    pauses: Iterable[tuple[int, int]] = (),
) -> Lived:
    """A master whose solver takes so long for each instant, and that stands still in `pauses` (begin, end)."""
    queue, load_shedding, pairs, out = MessageQueue(2), LoadShedding([setup]), Paired(), Lived([], [], [], 0)
    load_shedding.waiting, dropped_epochs = queue.frame_spans, Shedding(load_shedding)
    waiting, now, still = deque(came), 0, deque(pauses)
    while waiting or queue.frames:
        if still and now >= still[0][0]:
            now = max(now, still.popleft()[1])
        while waiting and waiting[0].t_ns <= now:
            queue.put([waiting.popleft().message])
        message = queue.get(0.0)
        if message is None:
            now = waiting[0].t_ns
            continue
        assert isinstance(message, MarkerDetections)
        load_shedding.look(message)
        for epoch in pairs.push(message):
            if dropped_epochs():
                out.dropped_epochs += 1
                continue
            out.epochs.append(epoch)
            out.begun.append(now)
            now += solve_ns(epoch)
            out.result_ns.append(now)
    return out


OFFSETS = pytest.mark.parametrize("offset_ns", [0, 1 * MS, PERIOD_NS // 2, PERIOD_NS - MS, PERIOD_NS])


@OFFSETS
def test_who_keeps_up_leaves_nothing_out(offset_ns: int) -> None:
    for load, jitter_ns in ((0.6, 4 * MS), (0.9, 0), (0.9, 1 * MS), (0.9, 4 * MS)):
        out = lived(arrivals(5.0, offset_ns, jitter_ns), lambda _t, load=load: round(load * PERIOD_NS))
        assert out.dropped_epochs == 0
        assert len(out.epochs) >= 299


@pytest.mark.parametrize("rates_hz", [(90.0, 30.0), (30.0, 90.0), (60.0, 50.0)])
def test_cameras_of_different_rates_leave_nothing_out_either(rates_hz: tuple[float, float]) -> None:
    setup = setup_of(*rates_hz)
    out = lived(arrivals(5.0, 3 * MS, 3 * MS, rates_hz), lambda _t: round(0.8e9 / rates_hz[0]), setup)
    assert out.dropped_epochs == 0


@OFFSETS
def test_after_a_pause_the_newest_instant_is_solved_next(offset_ns: int) -> None:
    begin, end = 1000 * MS + 3 * MS, 1103 * MS
    came = arrivals(3.0, offset_ns, 2 * MS)
    out = lived(came, lambda _t: round(0.75 * PERIOD_NS), pauses=[(begin, end)])
    pairs = Paired()
    newest = [t for one in came if one.t_ns <= end for t in pairs.push(one.message)][-1]
    assert next(t for t, begun in zip(out.epochs, out.begun, strict=True) if begun >= end) == newest
    assert 4 <= out.dropped_epochs <= 6, "what came in 100 ms, once; it is not behind any more"
    assert max(out.ages_ms()[-60:]) < 40.0


def test_a_pause_of_a_few_ms_leaves_nothing_out() -> None:
    pauses = [(k * 500 * MS, k * 500 * MS + 8 * MS) for k in range(1, 10)]
    assert (
        lived(arrivals(5.0, 0, 1 * MS), lambda _t: round(0.75 * PERIOD_NS), pauses=pauses).dropped_epochs == 0
    )


@OFFSETS
@pytest.mark.parametrize("load", [1.2, 1.7, 3.3])
def test_at_overload_what_is_published_is_new(load: float, offset_ns: int) -> None:
    solve_ns = round(load * PERIOD_NS)
    out = lived(arrivals(5.0, offset_ns, 1 * MS), lambda _t: solve_ns)
    assert len(out.result_ns) == pytest.approx(5e9 / solve_ns, rel=0.1), "the solver never waits for long"
    assert max(out.ages_ms()) < 1e-6 * (solve_ns + 2 * PERIOD_NS + offset_ns) + 2.0


def waits(**spans: tuple[int, int]) -> dict[str, Span]:
    return {name: Span(*(k * PERIOD_NS for k in span)) for name, span in spans.items()}


@pytest.mark.parametrize(
    ("waiting", "behind"),
    [
        ({}, False),
        (waits(left=(1, 1)), False),
        (waits(right=(1, 1)), False),
        (waits(left=(1, 4)), False),  # the right one is not silent yet: no instant of these is complete
        (waits(left=(1, 1), right=(1, 1)), True),
        (waits(left=(2, 2), right=(1, 1)), False),
        (waits(left=(1, 2), right=(0, 1)), True),
    ],
)
def test_instants_are_left_out_while_a_newer_one_waits(waiting: dict[str, Span], behind: bool) -> None:
    load_shedding = LoadShedding([SETUP])
    load_shedding.look(detections("left", 1, 0, 0))
    load_shedding.waiting = lambda: waiting
    load_shedding.look(detections("right", 1, 0, 0))
    assert load_shedding.skip == (MOST if behind else 0)


def test_nobody_waits_for_a_camera_that_is_silent() -> None:
    load_shedding = LoadShedding([SETUP])
    load_shedding.look(detections("right", 1, 0, 0))
    load_shedding.waiting = lambda: waits(left=(21, 23))
    load_shedding.look(detections("left", 1, 11, 11 * PERIOD_NS))
    assert load_shedding.skip == 0
    load_shedding.look(detections("left", 1, 13, 13 * PERIOD_NS))
    assert load_shedding.skip == MOST


def test_what_is_no_frame_and_who_is_not_known_change_nothing() -> None:
    load_shedding = LoadShedding([SETUP])
    load_shedding.waiting = lambda: waits(left=(1, 1), right=(1, 1))
    load_shedding.look(detections("third", 1, 0, 0))
    load_shedding.look(cycle("wrist", 1, 0, 0))
    assert load_shedding.skip == 0
    load_shedding.look(detections("left", 1, 0, 0))
    assert load_shedding.skip == MOST


def test_a_master_that_has_time_only_for_messages_solves_some_epochs() -> None:
    load_shedding = LoadShedding()
    load_shedding.skip, shedding = MOST, Shedding(load_shedding)
    assert [shedding() for _ in range(2 * MOST + 2)] == 2 * [*[True] * MOST, False]


def test_what_is_solved_next_to_rejected_frames_is_as_right_as_ever() -> None:
    run, queue = synthetic_run(24), MessageQueue(2)
    load_shedding = LoadShedding([run.setup])
    load_shedding.waiting, dropped_epochs = queue.frame_spans, Shedding(load_shedding)
    pipeline = build_pipeline(run.setup, StageTimes(), dropped_epochs=dropped_epochs)
    poses: list[HandPose] = []
    for k in range(0, len(run.messages), 4):  # two instants come together, always
        queue.put(run.messages[k : k + 4])
        while (message := queue.get(0.0)) is not None:
            assert isinstance(message, MarkerDetections)
            load_shedding.look(message)
            poses += [one.pose for one in pipeline.push(message)]
    assert pipeline.counts["instants_shed"] == 11, "tracks begin with two frames, and so with two instants"
    assert len(poses) == pipeline.counts["poses"] == 13
    off_mm = [
        1e3
        * np.linalg.norm(one.markers_raw_m - RIGHT.marker_points(hand_at(one.t_ns * 1e-9), MARKERS), axis=1)
        for one in poses[2:]
    ]
    assert np.median(off_mm) < 0.51


@pytest.mark.parametrize(("cameras", "frames"), [(1, QUEUE), (2, QUEUE), (16, 16 * QUEUE_PER_CAMERA)])
def test_many_cameras_have_more_room_and_samples_as_much(cameras: int, frames: int) -> None:
    assert capacity(cameras) == CAPACITY | {"frame": frames, "tags": frames}
