"""The examples behind the real recogniser: a simulated hand moves, and what it says reaches them over a bus."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from common.arrays import Float
from common.calibration.gesture_settings import default_gestures
from common.geometry.transforms import matrix_to_quaternion
from common.hand.model import HandModel
from common.messages import Gesture, HandPose, Source
from common.sim.gesture_postures import pinch_posture
from common.sim.gestures import Gestures
from common.sim.motion import REST, HandState, angles_of, smooth_step
from common.sim.scene import view_centre
from master.gestures.poses import GestureRecogniser
from master.outputs.bus import BusSink
from master.rig.setup import RigSetup, load_setup
from tests.docs.examples.loading import example
from tests.memory_bus import LoopbackBus

HZ = 60.0
START_NS = 10**9


@pytest.fixture(scope="module")
def setup(root: Path) -> RigSetup:
    return load_setup(root / "calib_json", "desk")


def pose_of(model: HandModel, state: HandState, t_s: float) -> HandPose:
    """What a master without error would publish."""
    joints = model.forward(state.T_rig_palm, state.angles_rad)
    unseen = np.full((6, 3), np.nan)
    return HandPose(
        hand=model.profile.name,
        t_ns=START_NS + round(t_s * 1e9),
        position_m=joints.position_m,
        orientation_wxyz=matrix_to_quaternion(joints.rotation),
        radius_m=model.radius_m,
        valid=np.ones(26, np.bool_),
        tracked=np.ones(26, np.bool_),
        cov_m2=np.tile(1e-6 * np.eye(3), (26, 1, 1)),
        source=np.full(26, Source.SOLVED, np.uint8),
        angles_rad=state.angles_rad,
        markers_m=unseen,
        markers_raw_m=unseen,
        markers_cov_m2=np.full((6, 3, 3), np.nan),
        inside_volume=np.ones(26, np.bool_),
    )


def received(
    model: HandModel, at: Callable[[float], HandState], start_s: float, stop_s: float
) -> Iterator[Gesture]:
    """What comes out of the bus while the hand moves."""
    recogniser, bus = GestureRecogniser(default_gestures(), model), LoopbackBus()
    sink, feed = BusSink(bus), bus.subscribe("gesture")
    for t_s in np.arange(start_s, stop_s, 1.0 / HZ).tolist():
        for gesture in recogniser.push(pose_of(model, at(t_s), t_s)):
            sink.write(gesture)
        while (message := feed.get(0.0)) is not None:
            assert isinstance(message, Gesture)
            yield message
    bus.close()


def test_a_knob_in_the_air_sets_the_volume_and_nothing_else_does(root: Path, setup: RigSetup) -> None:
    app = example(root, "volume_dial")
    motion = Gestures(setup.hand, view_centre(setup.rig), 7)
    made = [one for one in motion.annotations if one.kind == "dial"]
    first = next(one for one in made if one.stop_s - one.start_s < 5.0)  # one grip, to and fro
    dial, detents, outside = app.Dial(6.0), 0, 0
    end_s = first.stop_s + 4.0
    for one in received(setup.hand, motion.at, first.start_s - 3.0, end_s):
        count, t_s = dial.push(one), (one.t_ns - START_NS) * 1e-9
        detents += count
        outside += abs(count) * (not first.start_s <= t_s <= first.stop_s + 0.5)
    rotated = np.degrees(motion.dial_rad(first.stop_s) - motion.dial_rad(first.start_s))
    assert abs(rotated) > 10.0
    assert abs(6.0 * detents - rotated) <= 6.0 + 3.0  # a detent, and what the dial may be off
    assert outside == 0


def test_a_pinch_that_is_moved_turns_the_model_and_letting_go_leaves_it(root: Path, setup: RigSetup) -> None:
    app, model = example(root, "orbit_model"), setup.hand
    rest, pinched = np.array(REST), pinch_posture(model, 1, np.zeros((5, 4)))
    start = Gestures(model, view_centre(setup.rig), 7).at(0.0).T_rig_palm

    def at(t_s: float) -> HandState:
        closed = smooth_step((t_s - 0.5) / 0.4) - smooth_step((t_s - 3.4) / 0.3)
        moved = np.eye(4)
        moved[0, 3] = 0.10 * smooth_step((t_s - 1.6) / 1.0)
        posture: Float = rest + closed * (pinched - rest)
        return HandState(moved @ start, angles_of(model, posture, np.zeros((5, 4))))

    orbit, seen, modes = app.Orbit(), [], set[str]()
    for one in received(model, at, 0.0, 4.5):
        orbit.push(one)
        orbit.glide(1.0 / HZ)
        modes.add(orbit.mode)
        seen.append(float(orbit.shown[0]))
    orbit.glide(5.0)
    assert {"taken", "orbit"} <= modes
    assert "zoom" not in modes
    assert orbit.shown[0] == pytest.approx(12.0 * 0.10, abs=12.0 * 0.016)  # less the 12 mm that decided
    assert orbit.shown[2] == 0.0
    assert np.abs(np.diff(seen)).max() < 0.06  # no leap in any frame
