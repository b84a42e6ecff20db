"""The orbit of docs/examples: by itself, and beside a bus with its scene written to a file."""

import math
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import rerun as rr
from msgspec.structs import replace

from common.arrays import Float
from common.messages import Gesture
from common.messages.streams import MASTER
from tests.docs.examples.loading import example, wait_for
from tests.memory_bus import LoopbackBus

STEP_NS = 16_666_667


@pytest.fixture(scope="module")
def app(root: Path) -> ModuleType:
    return example(root, "orbit_model")


def pinch(
    at_m: Sequence[Sequence[float]] | Float,
    gap_m: Sequence[float] | Float,
    began_ns: int = 10**9,
    hand: str = "right",
) -> list[Gesture]:
    """A pinch whose middle and gap go this way, one step a frame, and then its end where it was last."""
    points = np.asarray(at_m, np.float64)
    messages = [
        Gesture(
            hand=hand,
            t_ns=began_ns + i * STEP_NS,
            kind="pinch",
            name="index",
            phase="begin" if i == 0 else "update",
            began_t_ns=began_ns,
            confidence=0.9,
            distance_m=float(gap),
            strength=1.0,
            origin_m=point,
        )
        for i, (point, gap) in enumerate(zip(points, gap_m, strict=True))
    ]
    return [*messages, replace(messages[-1], phase="end", t_ns=messages[-1].t_ns + STEP_NS)]


def still(frames: int) -> tuple[Float, Float]:
    return np.tile([0.02, 0.01, 0.4], (frames, 1)), np.full(frames, 0.002)


def path(to: Sequence[float], frames: int = 60) -> tuple[Float, Float]:
    """Held for half a second, moved by `to` (3,) in a second, held again."""
    at, gap = still(30 + frames + 30)
    at += np.interp(np.arange(len(at)), [30, 30 + frames], [0.0, 1.0])[:, None] * np.asarray(to)
    return at, gap


def shown(app: ModuleType, messages: Sequence[Gesture]) -> Float:
    """Yaw, pitch, log of the zoom when all is at rest again."""
    orbit = app.Orbit()
    for message in messages:
        orbit.push(message)
        orbit.glide(STEP_NS * 1e-9)
    orbit.glide(10.0)
    assert orbit.mode == ""
    return np.asarray(orbit.shown, np.float64)


def test_a_hand_that_moves_turns_the_model_its_way_and_leaves_its_size(app: ModuleType) -> None:
    yaw, pitch, zoom = shown(app, pinch(*path([0.13, 0.0, 0.0])))
    assert math.degrees(yaw) == pytest.approx(12.0 * math.degrees(0.13), rel=0.13)  # less what decided, 12 mm
    assert (pitch, zoom) == (0.0, 0.0)
    yaw, pitch, zoom = shown(app, pinch(*path([0.0, -0.05, 0.1])))
    assert pitch < -0.4  # up: its top comes forward
    assert (yaw, zoom) == (0.0, 0.0)


def test_before_a_camera_that_faces_the_hand_it_turns_the_other_way_about(app: ModuleType) -> None:
    ways = []
    for mirror in (False, True):
        orbit = app.Orbit(mirror=mirror)
        for message in pinch(*path([0.1, 0.05, 0.0])):
            orbit.push(message)
        orbit.glide(10.0)
        ways.append(orbit.shown)
    np.testing.assert_allclose(ways[1], ways[0] * [-1.0, 1.0, 1.0])


def test_a_gap_that_opens_makes_it_larger_and_turns_nothing(app: ModuleType) -> None:
    at, gap = still(150)
    gap[40:] = np.interp(np.arange(110), [0, 80], [0.002, 0.012])
    yaw, pitch, zoom = shown(app, pinch(at, gap))
    assert (yaw, pitch) == (0.0, 0.0)
    assert math.exp(zoom) == pytest.approx(2.0, abs=0.15)  # 10 mm, 3 of which decided
    assert shown(app, pinch(at, 0.014 - gap))[2] == pytest.approx(-zoom, abs=1e-9)


def test_nothing_moves_before_the_second_step(app: ModuleType) -> None:
    at, gap = path([0.2, 0.1, 0.0], 4)
    brief = pinch(at[26:36], gap[26:36])  # a wild move in the first fifth of a second
    assert shown(app, brief).tolist() == [0.0, 0.0, 0.0]
    rng = np.random.default_rng(3)
    at, gap = still(300)
    trembling = pinch(at + rng.normal(0.0, 0.0015, at.shape), gap + rng.normal(0.0, 0.0005, 300))
    assert shown(app, trembling).tolist() == [0.0, 0.0, 0.0]


def test_letting_go_undoes_what_it_moved(app: ModuleType) -> None:
    at, gap = path([0.1, 0.0, 0.0])
    whole = shown(app, pinch(at, gap))
    away = np.linspace(0.0, 1.0, 7)[1:, None]
    left = np.concatenate([at, at[-1] + away * [0.03, 0.02, 0.0]])  # within 0.1 s, while the fingers open
    assert shown(app, pinch(left, np.concatenate([gap, 0.002 + 0.012 * away[:, 0]]))) == pytest.approx(
        whole, abs=1e-9
    )


def test_pinches_add_up_and_the_pitch_ends_short_of_the_pole(app: ModuleType) -> None:
    one = shown(app, pinch(*path([0.05, 0.03, 0.0])))
    both = shown(
        app, [*pinch(*path([0.05, 0.03, 0.0])), *pinch(*path([0.05, 0.03, 0.0]), began_ns=9 * 10**9)]
    )
    assert both == pytest.approx(2 * one, abs=1e-9)
    assert math.degrees(shown(app, pinch(*path([0.0, 0.5, 0.0])))[1]) == pytest.approx(85.0)


def test_what_is_not_known_moves_nothing_and_other_gestures_neither(app: ModuleType) -> None:
    messages = pinch(*path([0.1, 0.0, 0.0]))
    gaps = [replace(m, distance_m=math.nan) if 40 < i < 60 else m for i, m in enumerate(messages)]
    assert shown(app, gaps) == pytest.approx(shown(app, messages), abs=1e-9)
    unknown = [replace(m, origin_m=np.full(3, np.nan)) for m in messages]
    assert shown(app, unknown).tolist() == [0.0, 0.0, 0.0]
    assert shown(app, [replace(m, kind="dial") for m in messages]).tolist() == [0.0, 0.0, 0.0]


def test_a_second_hand_does_not_take_what_the_first_has(app: ModuleType) -> None:
    first, second = pinch(*path([0.1, 0.0, 0.0])), pinch(*path([-0.3, 0.3, 0.0]), hand="left")
    mixed = [one for pair in zip(first, second, strict=True) for one in pair][:-1]  # its end would follow
    assert shown(app, mixed) == pytest.approx(shown(app, first), abs=1e-9)


def test_a_step_of_the_hand_is_shown_without_a_leap(app: ModuleType) -> None:
    orbit, seen = app.Orbit(), [0.0]
    at, gap = path([0.1, 0.0, 0.0], 1)
    for message in pinch(at, gap):
        orbit.push(message)
        orbit.glide(STEP_NS * 1e-9)
        seen.append(float(orbit.shown[0]))
    steps = np.diff(seen)
    assert (steps >= 0.0).all()
    assert steps.max() < 0.3 * seen[-1] or seen[-1] == 0.0


def test_on_a_bus_the_scene_says_what_it_waits_for_and_follows(
    app: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "orbit.rrd"
    show = rr.RecordingStream("test")
    show.save(file)
    app.show_model(show, app.chair(), 1.0)
    bus, orbit, stop = LoopbackBus(), app.Orbit(), threading.Event()
    thread = threading.Thread(target=app.run, args=(bus, orbit, show, lambda: not stop.is_set()))
    thread.start()
    try:
        wait_for(lambda: "waiting for a master" in capsys.readouterr().err)
        for message in pinch(*path([0.1, 0.0, 0.0])):
            bus.publish("gesture", message.hand, message)
        wait_for(lambda: abs(float(orbit.shown[0])) > 1.0)
    finally:
        stop.set()
        thread.join(60.0)
    assert not thread.is_alive()
    show.flush(timeout_sec=5.0)
    show.disconnect()
    bus.close()
    annotations, rotations = (
        texts(file),
        [c for c in rr.chunk.RrdReader(file).stream() if c.entity_path == "/model"],
    )
    assert annotations[0] == "waiting for a master ..."
    assert sum(chunk.num_rows for chunk in rotations) > 3


def texts(file: Path) -> list[str]:
    """What the line below the model said."""
    annotations: list[str] = []
    for chunk in rr.chunk.RrdReader(file).stream():
        if chunk.entity_path == "/said" and not chunk.is_static:
            table = chunk.to_record_batch()
            name = next(key for key in table.schema.names if key.endswith(":text"))
            annotations += [row[0] for row in table.column(name).to_pylist()]
    return annotations


def test_with_a_master_it_asks_for_a_pinch(app: ModuleType, tmp_path: Path) -> None:
    show = rr.RecordingStream("test")
    show.save(tmp_path / "orbit.rrd")
    bus, stop = LoopbackBus(), iter([True, True, False])
    bus.announce(MASTER)
    app.run(bus, app.Orbit(), show, lambda: next(stop))
    show.disconnect()
    assert texts(tmp_path / "orbit.rrd") == ["pinch to take the model"]


def test_its_help_its_errors_and_its_length(root: Path) -> None:
    program = root / "docs/examples/orbit_model.py"
    command = [sys.executable, str(program)]
    done = subprocess.run([*command, "--help"], capture_output=True, text=True, check=True)
    assert "--model" in done.stdout
    done = subprocess.run([*command, "--model", "no.glb"], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("orbit_model: ")
    assert "no.glb" in done.stderr
    assert len(program.read_text().splitlines()) < 150
