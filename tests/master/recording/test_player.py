"""A recording that is played tells what was told live, at any speed; jumps, stretches and restarts do as they say."""

import os
import threading
from pathlib import Path

import numpy as np
import pytest

from common.errors import BusError, PhalanxError, RecordingError
from common.messages import Backlog, Command, HandPose, ResultMessage
from common.messages.streams import MASTER
from common.recording.messages import open_messages
from master.outputs.poses import Poses
from master.recording.files import recorded_setups
from master.recording.lines import events_of, table
from master.recording.play import PlaySettings, run_play
from master.recording.player import Passed, Player, ReplayClock
from master.run.solver_supervisor import MOST
from tests.master.recording.recorded_run import MOST_FRAMES, RecordedRun, overloaded_run, recorded_run
from tests.memory_bus import LoopbackBus
from tests.network_helpers import until

FRAMES, SHORT = MOST_FRAMES, 8


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, root: Path) -> RecordedRun:
    return recorded_run(tmp_path_factory.mktemp("played") / "run.mcap", root / "calib_json", FRAMES)


@pytest.fixture(scope="module")
def twice(tmp_path_factory: pytest.TempPathFactory, root: Path) -> RecordedRun:
    """A short one, of a master that was started again in its midst."""
    return recorded_run(
        tmp_path_factory.mktemp("twice") / "run.mcap", root / "calib_json", SHORT, restart_at=SHORT
    )


class Kept:
    """A sink that keeps the poses."""

    def __init__(self) -> None:
        self.poses: list[HandPose] = []

    def write(self, message: ResultMessage) -> None:
        if isinstance(message, HandPose):
            self.poses.append(message)

    def close(self) -> None:
        """Nothing to finish."""


@pytest.fixture(scope="module")
def whole(run: RecordedRun) -> tuple[Passed, list[HandPose]]:
    """A pass over all of it, as fast as it goes, and its poses."""
    recording, kept = open_messages(run.path), Kept()
    return Player(recording, recorded_setups(recording), [kept], speed=0.0).run(), kept.poses


def test_every_speed_publishes_what_was_published_live(
    run: RecordedRun, whole: tuple[Passed, list[HandPose]]
) -> None:
    recording = open_messages(run.path)
    setups = recorded_setups(recording)
    for passed in (whole[0], Player(recording, setups, [], speed=1.0).run()):
        assert passed.whole
        assert passed.digest.counts == run.live.counts
        assert passed.digest.counts["poses"] == FRAMES
        assert passed.digest.lines() == run.live.lines()
    solved = Player(recording, setups, [], solved=True).run()
    assert solved.digest.lines() == run.live.lines()


def test_what_a_master_that_fell_behind_left_out_is_left_out_again(tmp_path: Path, root: Path) -> None:
    bursts = [*[2] * 6, 16, 4, 4, 4, *[2] * 4]
    (path, live), dropped_epochs = overloaded_run(tmp_path / "run.mcap", root / "calib_json", bursts)
    recording = open_messages(path)
    output = [one.message for one in recording.read(["taken"]) if isinstance(one.message, Backlog)]
    assert [one.skip for one in output] == 4 * [MOST, 0]
    assert (dropped_epochs, live.counts["poses"]) == (10, FRAMES - 10)
    setups = recorded_setups(recording)
    for passed in (Player(recording, setups, []).run(), Player(recording, setups, [], speed=2.0).run()):
        assert passed.digest.counts == live.counts
        assert passed.digest.lines() == live.lines()


def test_a_message_less_is_another_sum(twice: RecordedRun) -> None:
    recording = open_messages(twice.path)
    passed = Player(recording, recorded_setups(recording), [], to_ns=recording.end_t_ns - 20_000_000).run()
    assert passed.digest.counts["poses"] > 3
    assert passed.digest.hex() != twice.live.hex()


def test_a_stretch_begins_settled(run: RecordedRun, whole: tuple[Passed, list[HandPose]]) -> None:
    recording, part = open_messages(run.path), Kept()
    setups = recorded_setups(recording)
    first = recording.begin_t_ns + 200_000_000
    passed = Player(recording, setups, [part], from_ns=first).run()
    assert not passed.whole
    assert 5 < len(part.poses) < 18
    known = {pose.t_ns: pose for pose in whole[1]}
    for pose in part.poses:
        np.testing.assert_allclose(pose.position_m, known[pose.t_ns].position_m, atol=1e-3)


def test_a_master_that_was_started_again_is_so_in_the_replay(twice: RecordedRun) -> None:
    recording = open_messages(twice.path)
    output: list[str] = []
    passed = Player(recording, recorded_setups(recording), [], notify=output.append).run()
    assert passed.digest.lines() == twice.live.lines()
    assert output == events_of(recording)
    assert len(output) == 1
    assert "started again" in output[0]


def played(
    settings: PlaySettings, bus: LoopbackBus, stop: threading.Event
) -> tuple[threading.Thread, list[Passed]]:
    out: list[Passed] = []
    thread = threading.Thread(target=lambda: out.append(run_play(settings, bus, stop, lambda _line: None)))
    thread.start()
    return thread, out


def test_the_playing_master_obeys(run: RecordedRun) -> None:
    bus, stop = LoopbackBus(), threading.Event()
    asker, hands = bus.join(), bus.subscribe("hand", depth=1000)
    thread, out = played(PlaySettings(run.path, speed=0.05), bus, stop)
    try:
        assert until(lambda: MASTER in asker.alive(), 30.0)
        asker.ask(Command(MASTER, "pause"), 1.0)
        paused = asker.ask(Command(MASTER, "report"), 1.0).metrics
        assert paused["play.paused"] == 1.0
        assert paused["play.length_s"] == pytest.approx(0.392, abs=0.01)
        with pytest.raises(BusError, match=r"t_s 99: must be 0\.000 to 0\.3"):
            asker.ask(Command(MASTER, "seek", '{"t_s": 99}'), 1.0)
        for body in (
            "",
            "{}",
            '{"t_s": "x"}',
            '{"factor": NaN}',
            '{"factor": -1}',
            '{"factor": 1, "more": 2}',
        ):
            with pytest.raises(BusError, match="refused 'speed'"):
                asker.ask(Command(MASTER, "speed", body), 1.0)
        with pytest.raises(BusError, match="there are report, pause, resume, seek, speed"):
            asker.ask(Command(MASTER, "dance"), 1.0)
        asker.ask(Command(MASTER, "seek", '{"t_s": 0.3}'), 1.0)
        asker.ask(Command(MASTER, "speed", '{"factor": 0}'), 1.0)
        assert asker.ask(Command(MASTER, "resume"), 1.0).metrics["play.paused"] == 0.0
        thread.join(60.0)
    finally:
        stop.set()
        thread.join(60.0)
    (passed,) = out
    assert not passed.whole
    begin = open_messages(run.path).begin_t_ns
    times: list[int] = []
    while (pose := hands.get(0.01)) is not None:
        assert isinstance(pose, HandPose)
        times.append(pose.t_ns - begin)
    assert sum(t_ns > 300_000_000 for t_ns in times) >= 4, "it went on behind the jump"
    assert not [t_ns for t_ns in times if 100_000_000 < t_ns < 250_000_000], "what was jumped over is silent"


def test_files_of_a_run_are_written_and_a_stop_ends_it(
    run: RecordedRun, twice: RecordedRun, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    run_play(PlaySettings(twice.path, 0.0, out=out), None, threading.Event(), lambda _line: None)
    assert len(Poses.load(out / "poses.npz")) == twice.live.counts["poses"] > 3
    stop = threading.Event()
    thread, passes = played(PlaySettings(run.path, speed=0.001, loop=True), LoopbackBus(), stop)
    stop.set()
    thread.join(60.0)
    assert not passes[0].whole


def test_what_cannot_be_played_is_refused(run: RecordedRun, tmp_path: Path, root: Path) -> None:
    def play(path: Path, **more: object) -> None:
        settings = PlaySettings(path, **more)  # pyright: ignore[reportArgumentType]
        run_play(settings, None, threading.Event(), lambda _line: None)

    with pytest.raises(PhalanxError, match="nothing of the recording lies between"):
        play(run.path, from_s=5.0)
    with pytest.raises(PhalanxError, match="--loop and --out"):
        play(run.path, loop=True, out=tmp_path)
    empty = recorded_run(tmp_path / "empty.mcap", root / "calib_json", 0 + 1).path
    os.truncate(empty, empty.stat().st_size // 2)
    with pytest.raises(RecordingError, match="nothing to play"):
        play(empty)


def test_the_table_shows_streams_rates_and_files(run: RecordedRun) -> None:
    text = "\n".join(table(open_messages(run.path), ["at 3 s it rained"]))
    for part in ("whole", "taken", "left", str(FRAMES), "rigs/desk.json", 'rigs ["desk"]', "it rained"):
        assert part in text


def test_the_clock_pauses_jumps_and_changes_its_speed() -> None:
    s = 1_000_000_000
    clock = ReplayClock(100 * s, 2.0, now_ns=0)
    assert clock.wait_s(104 * s, 1 * s) == pytest.approx(1.0)
    assert clock.wait_s(101 * s, 1 * s) == 0.0
    clock.pause(1 * s)
    assert clock.wait_s(104 * s, 9 * s) is None
    assert clock.position_ns(9 * s) == 102 * s
    clock.resume(9 * s)
    assert clock.position_ns(10 * s) == 104 * s
    clock.set_speed(0.5, 10 * s)
    assert clock.wait_s(105 * s, 10 * s) == pytest.approx(2.0)
    clock.seek(200 * s, 10 * s)
    assert clock.position_ns(12 * s) == 201 * s
    clock.set_speed(0.0, 12 * s)
    assert clock.wait_s(999 * s, 12 * s) == 0.0
    assert clock.position_ns(13 * s) == 999 * s
    for wrong in (-1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="must be 0"):
            clock.set_speed(wrong, 0)
