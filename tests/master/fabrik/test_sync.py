"""Frame synchronisation: which epochs come out, when, in any order of messages, and where each marker was."""

from functools import cache

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.arrays import Float
from common.messages import MarkerDetections
from master.fabrik.settings import SYNC
from master.fabrik.sync import FrameSet, FrameSync
from tests.hand_helpers import camera_models, detections, rig_file

MS = 1_000_000
PERIOD = 16 * MS
RATES = {"left": 62.5, "right": 62.5, "top": 62.5}


def sync(
    row_time_us: float = 0.0, cameras: tuple[str, ...] = ("left", "right"), **options: object
) -> FrameSync:
    models = camera_models(rig_file(cameras), row_time_us)
    return FrameSync(models, {name: RATES[name] for name in cameras}, 2, **options)  # pyright: ignore[reportArgumentType]


def path(t_s: Float) -> Float:
    """Markers (..., 2, 2) [px] on two parabolas."""
    t = np.asarray(t_s)[..., None] % 1.0  # so that it stays near the picture
    return np.stack(
        [
            np.concatenate([300 + 400 * t - 2000 * t**2, 200 - 150 * t + 900 * t**2], -1),
            np.concatenate([100 - 250 * t + 1000 * t**2, 400 + 80 * t - 700 * t**2], -1),
        ],
        axis=-2,
    )


def frame(
    camera: str, seq: int, t_ns: int, shift: Float | None = None, row_time_us: float = 0.0
) -> MarkerDetections:
    """What a camera sees of the paths whose row 0 is exposed at t_ns; each row at its own time."""
    uv = path(np.array(t_ns * 1e-9))
    for _ in range(8):  # the row decides the time, the time the row
        times = t_ns * 1e-9 + row_time_us * 1e-6 * uv[:, 1]
        uv = np.stack([path(t)[m] for m, t in enumerate(times)])
    return detections(camera, seq, t_ns, uv if shift is None else uv + shift)


def push_all(machine: FrameSync, messages: list[MarkerDetections]) -> list[FrameSet]:
    out = [epoch for message in messages for epoch in machine.push(message)]
    return out + machine.flush()


def interleaved(*streams: list[MarkerDetections]) -> list[MarkerDetections]:
    return sorted((m for stream in streams for m in stream), key=lambda m: m.t_ns)


def stream(camera: str, count: int, late_ns: int = 0, row_time_us: float = 0.0) -> list[MarkerDetections]:
    return [frame(camera, k, k * PERIOD + late_ns, row_time_us=row_time_us) for k in range(count)]


# -- when an epoch comes out -----------------------------------------------------------------------------------


def test_an_epoch_waits_for_the_other_camera_and_no_longer() -> None:
    machine = sync()
    for k in range(2):
        machine.push(frame("left", k, k * PERIOD))
        machine.push(frame("right", k, k * PERIOD + 5 * MS))
    assert machine.push(frame("left", 2, 2 * PERIOD)) == []
    [epoch] = machine.push(frame("right", 2, 2 * PERIOD + 5 * MS))
    assert epoch.t_ns == 2 * PERIOD
    assert not epoch.missing.any()
    assert epoch.ready_t_ns == 2 * PERIOD + 5 * MS + 2 * MS


def test_the_deadline_emits_what_there_is() -> None:
    machine = sync()
    push_early = [frame("left", 0, 0), frame("right", 0, 5 * MS), frame("right", 1, PERIOD + 5 * MS)]
    for message in push_early:
        machine.push(message)
    assert machine.push(frame("left", 2, 4 * PERIOD)) == []
    assert machine.push(frame("left", 3, 5 * PERIOD)) == []
    [epoch] = machine.push(frame("left", 4, 6 * PERIOD))  # 1.25 periods are over for the first of the three
    assert epoch.t_ns == 4 * PERIOD
    assert list(epoch.missing) == [False, True]
    assert np.isfinite(epoch.uv[0]).all()
    assert np.isnan(epoch.uv[1]).all()


def test_flush_emits_the_rest_once() -> None:
    machine = sync()
    machine.push(frame("left", 0, 0))
    assert [i.t_ns for i in machine.flush()] == [0]
    assert machine.flush() == []


@pytest.mark.parametrize(("late_ms", "waits"), [(5, True), (7, True), (9, False), (15, False)])
def test_predict_waits_only_for_a_frame_that_is_nearer_than_the_last(late_ms: int, waits: bool) -> None:
    machine = sync(policy="predict")
    messages = interleaved(stream("left", 6), stream("right", 6, late_ms * MS))
    emitted = {i.t_ns: m.t_ns for m in messages for i in machine.push(m)}
    # From the third frame on: with the leader's own message, or with the other's that comes within half a period.
    assert all(emitted[k * PERIOD] == k * PERIOD + waits * late_ms * MS for k in range(2, 6))


def test_predicted_tracks_follow_the_motion() -> None:
    machine = sync(policy="predict")
    epochs = push_all(machine, interleaved(stream("left", 8), stream("right", 8, 12 * MS)))
    last = epochs[-1]
    np.testing.assert_allclose(last.uv[1], path(np.array(last.t_ns * 1e-9)), atol=0.1)
    waited = push_all(sync(), interleaved(stream("left", 8), stream("right", 8, 12 * MS)))[-1]
    assert (last.sigma_px[1] > waited.sigma_px[1]).all()  # and is less sure than an interpolated one


@cache
def in_order(policy: str, late_ms: int) -> tuple[list[list[MarkerDetections]], list[FrameSet]]:
    """Twenty messages of each of two cameras, and the epochs of them in their order."""
    streams = [stream("left", 20, row_time_us=20.0), stream("right", 20, late_ms * MS, row_time_us=20.0)]
    return streams, push_all(sync(20.0, policy=policy), interleaved(*streams))


@pytest.mark.parametrize(("policy", "late_ms"), [("interpolate", 5), ("predict", 5)])
@given(st.lists(st.booleans(), min_size=60, max_size=60))
@settings(max_examples=30)
def test_any_order_of_the_two_cameras_messages_gives_the_same_epochs(
    policy: str, late_ms: int, choices: list[bool]
) -> None:
    streams, expected = in_order(policy, late_ms)
    sent, order = [0, 0], [streams[0][0]]
    sent[0] = 1
    for left in choices:
        ahead = sent[0] - sent[1]
        # A camera may fall behind by a frame and run ahead by three: nothing is due before it is complete.
        c = 0 if (left and ahead < 1) or ahead <= -3 else 1
        c = c if sent[c] < 20 else 1 - c
        if sent[c] < 20:
            order.append(streams[c][sent[c]])
            sent[c] += 1
    found = push_all(sync(20.0, policy=policy), order)
    complete = min(sent[0], sent[1] - 1)
    assert [i.t_ns for i in found[:complete]] == [i.t_ns for i in expected[:complete]]
    # The very first may be due before its cameras have tracks.
    for one, other in zip(found[1:complete], expected[1:complete], strict=True):
        np.testing.assert_array_equal(one.uv, other.uv)
        np.testing.assert_array_equal(one.sigma_px, other.sigma_px)
        np.testing.assert_array_equal(one.missing, other.missing)
        assert one.ready_t_ns == other.ready_t_ns


# -- where the markers were --------------------------------------------------------------------------------------


@pytest.mark.parametrize("row_time_us", [0.0, 20.6])
@pytest.mark.parametrize("late_ms", [0.0, 3.0, 8.0, 15.0])
def test_a_parabola_is_met_exactly_whatever_the_capture_times(late_ms: float, row_time_us: float) -> None:
    streams = [
        stream(c, 10, late, row_time_us=row_time_us)
        for c, late in (("left", 0), ("right", int(late_ms * MS)))
    ]
    epochs = push_all(sync(row_time_us), interleaved(*streams))
    assert len(epochs) == 10
    for k, epoch in enumerate(epochs):
        assert epoch.t_ns == k * PERIOD + round(239.5 * row_time_us * 1e3)  # the centre row of the leader
        if k < 2:
            continue  # the first two have no three observations
        truth = path(np.array(epoch.t_ns * 1e-9))
        np.testing.assert_allclose(epoch.uv, [truth, truth], atol=0.05)  # half of a centroid's noise


def test_a_single_observation_is_held_and_its_sigma_is_a_hand_speed_times_the_time() -> None:
    machine = sync()
    machine.push(frame("left", 0, 0))
    machine.push(frame("right", 0, 4 * MS))
    [epoch] = machine.flush()
    np.testing.assert_allclose(epoch.uv[1], path(np.array(0.004)))
    np.testing.assert_allclose(epoch.sigma_px[0], 0.1)  # the floor: a whole marker at its own time
    held_px_s = 500.0 / 0.5 * np.sqrt((2 * 1.0**2 + 0.01**2) / 3)  # of a 500 px lens at half a metre
    np.testing.assert_allclose(epoch.sigma_px[1], np.hypot(0.1, held_px_s * 0.004), rtol=1e-3)


def test_a_marker_is_as_sure_as_its_slave_says() -> None:
    machine = sync()
    machine.push(msgspec.structs.replace(frame("left", 0, 0), sigma_px=np.array([0.04, 0.7])))
    np.testing.assert_allclose(machine.flush()[0].sigma_px[0], [0.04, 0.7])


def test_a_lost_marker_stays_lost_and_leaves_the_other_alone() -> None:
    lost = np.array([[np.nan, np.nan], [0.0, 0.0]])
    left, right = stream("left", 10), stream("right", 10, 5 * MS)
    whole = push_all(sync(), interleaved(left, right))
    right = [frame("right", k, k * PERIOD + 5 * MS, lost if 4 <= k < 7 else None) for k in range(10)]
    found = push_all(sync(), interleaved(left, right))
    for k in range(10):
        np.testing.assert_array_equal(found[k].uv[:, 1], whole[k].uv[:, 1])
        np.testing.assert_array_equal(found[k].uv[0], whole[k].uv[0])
    # Nearest to an epoch is the right frame 5 ms after it; where that has no marker there is none.
    assert [bool(np.isnan(i.uv[1, 0]).all()) for i in found] == [4 <= k < 7 for k in range(10)]


def test_an_alternative_is_carried_at_the_time_of_its_own_row() -> None:
    """The second marker's path is the alternative of the first; the right slave names them crosswise now and then."""
    alone = np.array([[0.0, 0.0], [np.nan, np.nan]])
    streams: list[list[MarkerDetections]] = []
    for camera, late in (("left", 0), ("right", 5 * MS)):
        frames = stream(camera, 10, late, row_time_us=20.6)
        crossed = [camera == "right" and k in (4, 7) for k in range(10)]
        alternatives = [np.where(np.isnan(alone), np.nan, m.uv[[1, 1]]) for m in frames]
        streams.append(
            [
                msgspec.structs.replace(
                    m,
                    uv=np.where(alone[:, ::-1] == 0, alternative, alone) if cross else m.uv + alone,
                    alt_uv=m.uv + alone if cross else alternative,
                    sigma_px=np.array([0.1, np.nan]),
                )
                for m, alternative, cross in zip(frames, alternatives, crossed, strict=True)
            ]
        )
    epochs = push_all(sync(20.6), interleaved(*streams))
    for epoch in epochs[3:]:
        assert epoch.alt_uv is not None
        truth = path(np.array(epoch.t_ns * 1e-9))
        for c in range(2):
            places = np.stack([epoch.uv[c, 0], epoch.alt_uv[c, 0]])
            if np.linalg.norm(places[0] - truth[0]) > 1.0:
                places = places[::-1]
            np.testing.assert_allclose(places, truth, atol=0.1)
        assert np.isnan(epoch.alt_uv[:, 1]).all()


def test_no_alternative_costs_nothing_and_makes_none() -> None:
    epochs = push_all(sync(), interleaved(stream("left", 4), stream("right", 4, 5 * MS)))
    assert all(epoch.alt_uv is None and epoch.alt_sigma_px is None for epoch in epochs)


# -- cameras that come and go -------------------------------------------------------------------------------------


def test_when_the_leader_falls_silent_the_next_camera_leads() -> None:
    machine = sync()
    left, right = stream("left", 10), stream("right", 80, 5 * MS)
    epochs = push_all(machine, interleaved(left, right))
    times = np.array([i.t_ns for i in epochs])
    assert (np.diff(times) > 0).all()
    after = [i for i in epochs if i.t_ns > 10 * PERIOD]
    assert len(after) >= 80 - 10 - 2 * SYNC.silent_frames - 1
    assert all(i.missing[0] and not i.missing[1] for i in after)
    assert all(i.t_ns % PERIOD == 5 * MS for i in after)


def test_when_the_other_camera_falls_silent_poses_go_on() -> None:
    machine = sync()
    epochs = push_all(machine, interleaved(stream("left", 60), stream("right", 10, 5 * MS)))
    assert [i.t_ns for i in epochs] == [k * PERIOD for k in range(60)]
    assert all(i.missing[1] for i in epochs[13:])


def test_after_the_silence_an_epoch_no_longer_waits_for_the_deadline() -> None:
    machine = sync()
    for message in interleaved(stream("left", 60), stream("right", 2, 5 * MS)):
        machine.push(message)
    assert [i.t_ns for i in machine.push(frame("left", 60, 60 * PERIOD))] == [60 * PERIOD]


def test_a_leader_that_returns_leads_again_and_time_never_steps_back() -> None:
    machine = sync()
    left = stream("left", 10) + [frame("left", k, k * PERIOD) for k in range(60, 80)]
    messages = interleaved(left, stream("right", 80, 5 * MS))
    # Its first frame comes behind one of the other camera that was exposed later.
    first = next(i for i, m in enumerate(messages) if m.camera == "left" and m.seq == 60)
    messages[first], messages[first + 1] = messages[first + 1], messages[first]
    epochs = push_all(machine, messages)
    times = np.array([i.t_ns for i in epochs])
    assert (np.diff(times) > 0).all()
    assert (times[-15:] % PERIOD == 0).all()
    assert not np.array([i.missing for i in epochs[-15:]]).any()


def test_a_clock_that_steps_back_is_ignored_until_time_goes_on() -> None:
    machine = sync()
    for message in interleaved(stream("left", 5), stream("right", 5, 5 * MS)):
        machine.push(message)
    assert machine.push(frame("left", 5, 2 * PERIOD)) == []
    assert machine.push(frame("left", 6, 4 * PERIOD)) == []
    machine.push(frame("left", 7, 5 * PERIOD))
    assert [i.t_ns for i in machine.push(frame("right", 5, 5 * PERIOD + 5 * MS))] == [5 * PERIOD]


@pytest.mark.parametrize("first", ["left", "right"])
@pytest.mark.parametrize(
    ("pause", "kept"), [(SYNC.silent_frames - 2, True), (SYNC.silent_frames + 2, False), (300, False)]
)
def test_what_waited_for_a_partner_while_nothing_came_is_left_out(pause: int, kept: bool, first: str) -> None:
    """A cable is out between the leader's frame and its partner's: the pose would be as old as the cut."""
    machine = sync()
    for message in interleaved(stream("left", 6), stream("right", 5, 5 * MS)):
        machine.push(message)
    back = 5 + pause
    late = [
        frame(c, k, k * PERIOD + at) for k in (back, back + 1) for c, at in (("left", 0), ("right", 5 * MS))
    ]
    if first == "right":
        late[:2] = late[1::-1]
    found = [epoch.t_ns for message in late for epoch in machine.push(message)]
    assert found == [5 * PERIOD] * kept + [back * PERIOD, (back + 1) * PERIOD]
    assert machine.stale == (not kept)


def test_a_whole_pair_before_a_pause_is_solved_whenever_it_is_complete() -> None:
    machine = sync()
    times = [0, 1, 400, 401, 800]
    found = push_all(
        machine, [frame(c, k, t * PERIOD) for k, t in enumerate(times) for c in ("left", "right")]
    )
    assert [epoch.t_ns for epoch in found] == [t * PERIOD for t in times]
    assert machine.stale == 0


def test_three_cameras_meet_at_the_epoch_of_the_first() -> None:
    cameras = ("left", "right", "top")
    streams = [stream(camera, 10, late * MS) for camera, late in zip(cameras, (0, 5, 11), strict=True)]
    epochs = push_all(sync(cameras=cameras), interleaved(*streams))
    assert len(epochs) == 10
    for epoch in epochs[2:]:
        assert epoch.uv.shape == (3, 2, 2)
        np.testing.assert_allclose(epoch.uv, [path(np.array(epoch.t_ns * 1e-9))] * 3, atol=0.05)


def test_unrelated_frames_are_never_mixed() -> None:
    machine = sync(continuous=False)
    messages = [
        detections(camera, k, k * 1_000 * MS + late, np.full((2, 2), 100.0 * k))
        for k in range(3)
        for camera, late in (("left", 0), ("right", 5 * MS))
    ]
    epochs = push_all(machine, messages)
    assert len(epochs) == 3
    for k, epoch in enumerate(epochs):
        np.testing.assert_array_equal(epoch.uv, np.full((2, 2, 2), 100.0 * k))
    lonely = push_all(sync(continuous=False), [messages[0], messages[3]])
    assert list(lonely[0].missing) == [False, True]


def test_an_unknown_camera_is_a_mistake_of_the_caller() -> None:
    with pytest.raises(ValueError, match="unknown"):
        sync().push(frame("unknown", 0, 0))
    with pytest.raises(ValueError, match="'left': 1 markers, not 2"):
        sync().push(detections("left", 0, 0, np.full((1, 2), 100.0)))


def test_what_was_emitted_stays_as_it_was() -> None:
    machine = sync()
    messages = interleaved(stream("left", 4), stream("right", 4, 5 * MS))
    kept = push_all(machine, messages)
    before = [(one.uv.copy(), one.sigma_px.copy(), one.area.copy(), one.missing.copy()) for one in kept]
    push_all(
        machine, interleaved(*([frame(c, k, k * PERIOD) for k in range(9, 30)] for c in ("left", "right")))
    )
    for one, was in zip(kept, before, strict=True):
        for array, copy in zip((one.uv, one.sigma_px, one.area, one.missing), was, strict=True):
            np.testing.assert_array_equal(array, copy)


def test_an_epoch_older_than_all_that_is_held_has_no_frame() -> None:
    machine = sync()
    for k in range(2 * SYNC.history):
        machine.push(frame("left", k, k * PERIOD))
    found = machine.at(0)
    assert found.missing.all()
    assert np.isnan(found.uv).all()
    assert found.ready_t_ns == 0
    assert sync().at(0).missing.all()


@pytest.mark.parametrize("what", ["seldom", "old"])
def test_a_leader_that_hardly_delivers_or_only_what_is_old_leads_no_more(what: str) -> None:
    """One frame in fifteen, or stamps nearly a second old: the hand is as often there as the other camera's frames."""
    machine, found = sync(), list[int]()
    for k in range(300):
        left_ns = k * PERIOD - (59 * PERIOD if what == "old" and k > 60 else 0)
        if what == "old" or k < 60 or k % 15 == 0:
            found += [epoch.t_ns for epoch in machine.push(frame("left", k, left_ns))]
        found += [epoch.t_ns for epoch in machine.push(frame("right", k, k * PERIOD + 5 * MS))]
    late = [t_ns for t_ns in found if t_ns > 150 * PERIOD]
    assert len(late) >= 0.95 * 150
    assert (np.diff(found) > 0).all()
