"""The synthetic camera of a wrist device: lit in turn, and a slow process loses whole cycles of the strobe."""

from functools import cache

import numpy as np
import pytest

from common.recording.frame_recording import Illumination
from common.sim.board import BoardScene
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import WristScene
from slave.cameras.synthetic import SyntheticCamera
from slave.commands.simulated import scene_of
from slave.sources import Frame
from tests.slave.lights.stage import StageClock
from tests.slave.wrist.wrist_frames import CAMERA, PERIOD_NS, RIG, ROOT

pytestmark = pytest.mark.usefixtures("drawn_once")
EPOCH_NS = 5_000_000_000_000


def camera(clock: StageClock, scene: WristScene | BoardScene) -> SyntheticCamera:
    return SyntheticCamera(scene, "wrist", EPOCH_NS, clock, 0, clock, clock.sleep)


def read(source: SyntheticCamera) -> Frame:
    frame = source.read()
    assert frame is not None
    return frame


@cache
def wrist_scene() -> WristScene:
    scene = scene_of(ROOT / "calib_json", RIG, "standard", 7)
    assert isinstance(scene, WristScene)
    return scene


def test_frames_are_lit_in_turn_and_grey() -> None:
    scene, clock = wrist_scene(), StageClock(EPOCH_NS - 1)
    source = camera(clock, scene)
    frames = [read(source) for _ in range(4)]
    ambient, laser, led = Illumination.AMBIENT, Illumination.LASER, Illumination.LED
    assert [(frame.seq, frame.illumination) for frame in frames] == [
        (0, ambient),
        (1, laser),
        (2, led),
        (3, ambient),
    ]
    renderer = WristRenderer(scene, "wrist")
    for frame in frames:
        drawn = renderer.render((frame.t_ns - EPOCH_NS) * 1e-9, frame.illumination)
        np.testing.assert_array_equal(frame.image, drawn)
        assert frame.image.shape == (400, 640)
    assert source.skipped == 0


def test_a_slow_process_loses_whole_cycles_and_ends_the_one_it_has_begun() -> None:
    clock = StageClock(EPOCH_NS - 1)
    source = camera(clock, wrist_scene())
    assert read(source).seq == 0
    clock.t_ns += round(4.2 * PERIOD_NS)  # the caller was busy in the middle of a cycle
    numbers = [read(source).seq for _ in range(5)]
    assert numbers[:2] == [1, 2]
    assert numbers[2] % 3 == 0
    assert numbers[2] > 3
    assert numbers[3:] == [numbers[2] + 1, numbers[2] + 2]
    assert source.skipped == numbers[2] - 3


def test_it_joins_with_the_first_frame_of_a_cycle() -> None:
    source = camera(StageClock(EPOCH_NS + 1_000_000_000), wrist_scene())
    frame = read(source)
    assert frame.seq % 3 == 0
    assert frame.illumination is Illumination.AMBIENT
    assert source.skipped == 0


def test_a_board_before_it_is_grey_too() -> None:
    source = camera(StageClock(EPOCH_NS - 1), BoardScene(RIG, {"wrist": CAMERA}, 7))
    frame = read(source)
    assert frame.image.shape == (400, 640)
    assert frame.image.std() > 10.0
