"""The time between cameras from their tracks: lies are found, truths are believed, whatever the hand does."""

from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.arrays import Float
from common.geometry.camera_model import CameraModel
from common.messages import MarkerDetections
from common.sim.scenes import scene_by_name
from master.monitor.clocks import KEPT_BLOCKS, ResidualTiming
from master.monitor.timing_fit import CameraPair, TimeOffset, Track, carried
from master.rig.setup import load_setup
from tests import timing_scenes as scenes
from tests.timing_scenes import Motion, cameras, misplaced, recorded

SEED = 1  # of the motion and its noise, where each case is another one already
CALIBRATION = Path(__file__).parents[3] / "calib_json"


def run(models: dict[str, CameraModel], messages: list[MarkerDetections], rate_hz: float) -> ResidualTiming:
    machine = ResidualTiming(models, dict.fromkeys(models, rate_hz))
    for message in messages:
        machine.push(message)
    machine.flush()
    return machine


def measured(
    motion: Motion, rate_hz: float, late_ms: float, seed: int, seconds: float = 6.0, **more: float
) -> TimeOffset | None:
    models = cameras()
    truth = misplaced(models, seed)
    messages = recorded(truth, motion, rate_hz, seconds, {"right": late_ms}, seed, **more)
    return run(models, messages, rate_hz).offset_of("right")


def alarming(offset: TimeOffset | None) -> bool:
    return offset is not None and abs(offset.offset_ns) > max(1e6, 3.0 * offset.sigma_ns)


# -- a lie is found, and told right ------------------------------------------------------------------------------


@pytest.mark.parametrize("late_ms", [8.0, -8.0])
@pytest.mark.parametrize("rate_hz", [30.0, 60.0, 90.0])
def test_eight_milliseconds_are_found_in_motion_along_the_baseline(rate_hz: float, late_ms: float) -> None:
    found = measured(scenes.sideways(SEED), rate_hz, late_ms, SEED)
    assert found is not None
    assert abs(found.offset_ns - late_ms * 1e6) < 0.4e6  # first order: 8 ms are 3 % of a swing
    assert alarming(found)


@pytest.mark.parametrize("motion", [scenes.natural, scenes.circling, scenes.bending])
def test_eight_milliseconds_are_found_in_any_motion(motion: Callable[[int], Motion]) -> None:
    found = measured(motion(SEED), 60.0, 8.0, SEED, 8.0)
    assert found is not None
    assert abs(found.offset_ns - 8e6) < 1.2e6
    assert alarming(found)


def test_half_a_second_of_a_swing_is_enough() -> None:
    # As long as a recording of 18 pairs at 30 Hz.
    for late_ms in (0.0, 8.0, -8.0):
        for seed in range(4):
            found = measured(scenes.sideways(seed, 1.6), 30.0, late_ms, seed, 0.6, lost=0.0)
            if found is not None:
                assert abs(found.offset_ns - late_ms * 1e6) < max(1e6, 3.0 * found.sigma_ns)
    assert alarming(measured(scenes.sideways(0, 1.6), 30.0, 8.0, 0, 0.6, lost=0.0))


def test_wrong_detections_and_losses_do_not_hide_it() -> None:
    for seed in (0, 1):
        found = measured(scenes.natural(seed), 60.0, 8.0, seed, 8.0, wrong=0.02, lost=0.1)
        assert found is not None
        assert abs(found.offset_ns - 8e6) < 1e6


def test_each_of_four_cameras_has_its_own_offset() -> None:
    names = ("left", "right", "third", "fourth")
    late = {"right": 0.0, "third": 5.0, "fourth": -3.0}
    models = cameras(names)
    machine = run(models, recorded(models, scenes.natural(2), 60.0, 8.0, late, 2), 60.0)
    for name, late_ms in late.items():
        found = machine.offset_of(name)
        assert found is not None
        assert abs(found.offset_ns - late_ms * 1e6) < 0.5e6
    assert machine.offset_of("left") is None  # the reference


# -- a truth is believed -----------------------------------------------------------------------------------------

TRUTHFUL = [scenes.sideways, scenes.circling, scenes.natural, scenes.resting, scenes.bending]


@pytest.mark.parametrize("motion", TRUTHFUL)
@pytest.mark.parametrize("rate_hz", [30.0, 90.0])
def test_truthful_stamps_raise_no_alarm(motion: Callable[[int], Motion], rate_hz: float) -> None:
    assert not alarming(measured(motion(SEED), rate_hz, 0.0, SEED))


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_a_hand_that_circles_is_no_lie_in_either_sense(sense: float) -> None:
    # Its depth follows the velocity as a wrong time of several ms would make it: it keeps its size.
    for seed in (0, 1):
        found = measured(scenes.circling(seed, sense), 60.0, 0.0, seed, 8.0)
        assert found is not None
        assert abs(found.offset_ns) < 1e6


def test_sigma_is_honest_over_many_hands() -> None:
    found = [measured(scenes.natural(seed), 30.0, 0.0, seed, 8.0) for seed in range(20)]
    scores = np.array([each.offset_ns / each.sigma_ns for each in found if each is not None])
    assert len(scores) >= 18
    assert (np.abs(scores) < 1.96).sum() >= 0.9 * len(scores)
    assert (np.abs(scores) < 3.0).all()


def test_the_standard_scene_raises_no_alarm_and_shows_a_lie() -> None:
    setup = load_setup(CALIBRATION, "desk")
    scene = scene_by_name("standard", setup.rig, setup.cameras, setup.hand.profile, 7)
    grid = np.arange(0.0, 15.0, 1 / 240)
    truth_m = np.array([scene.truth(t).markers_m for t in grid])

    def motion(t_s: Float) -> Float:
        flat = [
            np.stack([np.interp(t_s[:, m], grid, truth_m[:, m, axis]) for axis in range(3)], axis=-1)
            for m in range(truth_m.shape[1])
        ]
        return np.stack(flat, axis=1)

    for late_ms in (0.0, 8.0):
        messages = recorded(setup.models, motion, 60.0, 13.0, {"right": late_ms}, 1)
        machine = ResidualTiming(setup.models, dict.fromkeys(setup.models, 60.0))
        for message in messages:
            machine.push(message)
        found = machine.offset_of("right")
        assert found is not None
        assert abs(found.offset_ns - late_ms * 1e6) < 0.6e6
        assert alarming(found) == (late_ms > 0.0)


# -- the edges ---------------------------------------------------------------------------------------------------


def test_what_is_not_seen_is_no_evidence() -> None:
    models = cameras()
    messages = recorded(models, scenes.sideways(1), 60.0, 4.0, {}, 1, lost=1.0)
    assert run(models, messages, 60.0).offset_of("right") is None
    alone = [
        message
        for message in recorded(models, scenes.sideways(1), 60.0, 4.0, {}, 1)
        if message.camera == "left"
    ]
    assert run(models, alone, 60.0).offset_of("right") is None


def test_a_marker_with_a_rival_is_not_used() -> None:
    models = cameras()
    messages = recorded(models, scenes.sideways(1), 60.0, 5.0, {}, 1, lost=0.0)
    ambiguous = [msgspec.structs.replace(message, alt_uv=message.uv + 9.0) for message in messages]
    assert run(models, messages, 60.0).offset_of("right") is not None
    assert run(models, ambiguous, 60.0).offset_of("right") is None


def test_a_restarted_slave_is_measured_afresh() -> None:
    models = cameras()
    before = recorded(models, scenes.natural(1), 60.0, 6.0, {"right": 8.0}, 1)
    after = recorded(models, scenes.natural(2), 60.0, 8.0, {"right": 0.0}, 2)
    shift_ns = 7_000_000_000
    again = [
        msgspec.structs.replace(
            message, t_ns=message.t_ns + shift_ns, session=1 + (message.camera == "right")
        )
        for message in after
    ]
    found = run(models, before + again, 60.0).offset_of("right")
    assert found is not None
    assert abs(found.offset_ns) < 0.6e6


def test_a_time_far_ahead_does_not_silence_a_camera() -> None:
    models = cameras()
    messages = recorded(models, scenes.natural(2), 60.0, 6.0, {"right": 8.0}, 2)
    for camera in ("left", "right"):
        first = next(message for message in messages if message.camera == camera)
        ahead = msgspec.structs.replace(first, t_ns=first.t_ns + 3_600_000_000_000)
        found = run(models, [ahead, *messages], 60.0).offset_of("right")
        assert found is not None
        assert abs(found.offset_ns - 8e6) < 1e6


def test_what_it_holds_stays_bounded() -> None:
    models = cameras()
    machine = run(models, recorded(models, scenes.natural(3), 30.0, 2.0 * KEPT_BLOCKS, {}, 3), 30.0)
    assert len(machine._blocks[1]) == KEPT_BLOCKS
    assert all(len(frames) <= 200 for frames in machine._frames)
    assert not machine._work


def test_a_cubic_is_carried_exactly_and_a_jump_is_refused() -> None:
    t = np.arange(10) / 60.0
    times = np.tile(t[:, None], (1, 2))
    xy = np.stack([3.0 * times**3 - times, 1.0 - 2.0 * times**2], axis=-1)
    at = np.array([[0.061], [0.0], [0.101]])
    point, velocity = carried(Track(times, xy), at, 0.05, 1e3)
    np.testing.assert_allclose(
        point[0], np.tile([3 * 0.061**3 - 0.061, 1 - 2 * 0.061**2], (2, 1)), atol=1e-12
    )
    np.testing.assert_allclose(velocity[0], np.tile([9 * 0.061**2 - 1, -4 * 0.061], (2, 1)), atol=1e-12)
    assert np.isnan(point[1]).all()  # no two frames before it
    jumped = xy.copy()
    jumped[4, 0] += 0.1
    point, _ = carried(Track(times, jumped), at, 0.05, 1e3)
    assert np.isnan(point[0, 0]).all()
    assert np.isfinite(point[0, 1]).all()


def track(camera: CameraModel, motion: Motion, t_s: Float) -> Track:
    """What a camera without rolling shutter sees, by stamps that start at 1 s."""
    stamps = np.tile((1.0 + np.arange(len(t_s)) / 60.0)[:, None], (1, 6))
    return Track(stamps, camera.undistort(scenes.seen(camera, motion, t_s)))


def test_rigid_motion_changes_no_distance_and_no_residual_but_a_wrong_time_does() -> None:
    models = cameras(row_time_us=0.0)
    left, right = models["left"], models["right"]
    pair, motion = CameraPair.of(left, right), scenes.circling(0)
    t_s, rows = 1.0 + np.arange(40) / 60.0, np.arange(4, 36)
    reference = track(left, motion, t_s)
    evidence = pair.evidence(reference, track(right, motion, t_s), rows, 0.05)
    assert np.ptp(evidence.value[:, :6], axis=0).max() < 0.02  # px
    assert np.ptp(evidence.value[:, 6:], axis=0).max() < 0.1e-3  # m
    late = pair.evidence(reference, track(right, motion, t_s + 1e-3), rows, 0.05)
    for items in (slice(0, 6), slice(6, None)):
        changed, expected = (late.value - evidence.value)[:, items], 1e-3 * evidence.rate[:, items]
        np.testing.assert_allclose(changed, expected, atol=0.02 * np.abs(expected).max() + 1e-6)


def test_the_instrument_is_the_rate_without_its_noise() -> None:
    models = cameras(row_time_us=0.0)
    left, right = models["left"], models["right"]
    t_s = 1.0 + np.arange(40) / 60.0
    tracks = [track(camera, scenes.sideways(0), t_s) for camera in (left, right)]
    evidence = CameraPair.of(left, right).evidence(tracks[0], tracks[1], np.arange(4, 36), 0.05)
    size = np.abs(evidence.rate[:, 6:]).max()
    np.testing.assert_allclose(evidence.instrument[:, 6:], evidence.rate[:, 6:], atol=0.05 * size)
