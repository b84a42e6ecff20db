"""The whole line of a wrist camera: frames in, laser points and tips out, and nothing from a wrong-kind triple."""

from dataclasses import replace

import numpy as np
import pytest

from common.recording.frame_recording import Illumination
from slave.sources import Frame
from slave.wrist.detector import WristDetector, WristFound, prepared
from tests.slave.wrist.wrist_frames import CAMERA, FIRST_NS, PERIOD_NS, VIEW, scene, spoiled, strobed

SHARE = 0.05


def detector() -> WristDetector:
    return WristDetector(VIEW, CAMERA.frame_rate_hz)


def found_in(frames: list[Frame] | tuple[Frame, ...]) -> list[WristFound]:
    machine = detector()
    return [found for frame in frames if (found := machine.push(frame)) is not None]


def illuminations(found: WristFound) -> tuple[Illumination, ...]:
    """What really lit the three frames: the label of the simulation, which nothing that senses has read."""
    cycle = found.cycle
    return cycle.ambient.illumination, cycle.laser.illumination, cycle.led.illumination


RIGHT_ILLUMINATIONS = (Illumination.AMBIENT, Illumination.LASER, Illumination.LED)


def test_laser_points_lie_where_the_laser_meets_the_fingers() -> None:
    frames = strobed("curl", 20)
    found = found_in(frames)
    assert len(found) >= 18  # to get into step may take a triple or two
    errors: list[np.ndarray] = []
    for one in found:
        truth = scene("curl").truth((one.cycle.laser.t_ns - FIRST_NS) * 1e-9)
        seen = truth.laser_len_vis[1:6] > 0.002
        errors.append(np.linalg.norm(one.laser.uv - truth.laser_uv[1:6], axis=1)[seen])
    error = np.concatenate(errors)
    assert np.isfinite(error).mean() > 0.9
    assert np.nanmedian(error) < 2.0  # px; 1 px is 0.3 mm at 12 cm


def test_the_message_says_when_the_laser_was_on_and_how_well_that_is_known() -> None:
    one = found_in(strobed("curl", 6))[-1]
    message = one.message("wrist", 77)
    laser = one.cycle.laser
    assert (message.camera, message.session, message.seq, message.t_ns) == (
        "wrist",
        77,
        laser.seq,
        laser.t_ns,
    )
    assert laser.seq % 3 == 1
    assert message.ready_t_ns == one.cycle.led.ready_t_ns
    assert message.t_sigma_ns == 1000.0
    np.testing.assert_array_equal(message.laser_uv, one.laser.uv)
    np.testing.assert_array_equal(message.tip_uv, one.tips.uv)
    assert np.isfinite(message.laser_uv).all(axis=1).sum() >= 4


def test_no_row_comes_of_a_wrong_kind_of_frame() -> None:
    frames = strobed("curl@bright", 36)
    rng = np.random.default_rng(7)
    right = whole = 0
    for _ in range(3):
        given = spoiled(frames, rng, SHARE)
        found = found_in(given)
        assert [illuminations(one) for one in found if illuminations(one) != RIGHT_ILLUMINATIONS] == []
        right += len(found)
        whole += sum(
            tuple(frame.illumination for frame in given[k : k + 3]) == RIGHT_ILLUMINATIONS
            for k in range(len(given) - 2)
        )
    assert right > 0.8 * whole  # and it is not refused altogether


@pytest.mark.parametrize("what", ["black", "saturated", "noise", "flicker"])
def test_frames_that_show_no_hand_raise_nothing_and_find_little(what: str) -> None:
    rng = np.random.default_rng(3)
    shape = (CAMERA.height_px, CAMERA.width_px)
    images = {
        "black": [np.zeros(shape, np.uint8)] * 3,
        "saturated": [np.full(shape, 255, np.uint8)] * 3,
        "noise": [rng.integers(0, 12, shape).astype(np.uint8) for _ in range(3)],
        "flicker": [np.full(shape, level, np.uint8) for level in (3, 90, 200)],
    }[what]
    times_ns = [FIRST_NS + round(k * PERIOD_NS) for k in range(24)]
    frames = [Frame(k, t_ns, t_ns, images[k % 3]) for k, t_ns in enumerate(times_ns)]
    found = found_in(frames)
    for one in found:
        one.message("wrist", 1)  # is whole
    if found:
        seen = np.mean([np.isfinite(one.laser.uv[:, 0]) for one in found])
        assert seen < 0.05


def test_another_view_is_used_from_the_next_cycle_on() -> None:
    frames = strobed("curl", 8)
    plain = found_in(frames)
    machine = detector()
    before = [found for frame in frames[:12] if (found := machine.push(frame)) is not None]
    moved = VIEW.T_camera_palm.copy()
    moved[0, 3] += 0.03
    machine.replace(prepared(replace(VIEW, T_camera_palm=moved)))
    after = [found for frame in frames[12:] if (found := machine.push(frame)) is not None]
    np.testing.assert_array_equal(before[-1].laser.uv, plain[len(before) - 1].laser.uv)
    same = np.isclose(after[-1].laser.uv, plain[-1].laser.uv, equal_nan=True).all(axis=1)
    assert not same.all()
