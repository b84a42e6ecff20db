"""The tap shows all messages in their order, while somebody asks; the recorder keeps them, or ends with a reason."""

import errno
import io
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import cast

import pytest

from common.bus.bus import Bus
from common.bus.zenoh_bus import ZenohBus
from common.clock import now_ns
from common.errors import BusError, CalibrationError, RecordingError
from common.messages import Backlog, Command, Health, MarkerDetections, Message, Preview, Still
from common.messages.streams import MASTER
from common.recording.messages import MessageWriter, open_messages
from master.recording import record
from master.recording.lines import ProgressLine, events_of, progress_text
from master.recording.probe import LEASE_NS, Probe, Tapped, came_ns
from master.recording.record import NAME, MasterClock, RecordSettings, run_recorder
from master.recording.recorder import MessageRecorder, Progress
from master.rig.setup import RigFiles
from master.run.solver_supervisor import LoadShedding
from tests.memory_bus import LoopbackBus
from tests.network_helpers import ManualClock, detections, free_endpoint, until
from tests.picture_helpers import TINY


class Listed:
    """A source with a few messages."""

    def __init__(self, messages: list[Message]) -> None:
        self.messages = messages

    def get(self, timeout_s: float) -> Message | None:
        del timeout_s
        return self.messages.pop(0) if self.messages else None


def frames(count: int, first: int = 0) -> list[Message]:
    return [detections("left", 1, seq, 1000 * seq) for seq in range(first, first + count)]


def test_the_tap_shows_only_while_somebody_asks_and_all_of_it_in_order() -> None:
    bus, clock = LoopbackBus(), ManualClock(10)
    shown = bus.subscribe("taken", depth=100)
    probe = Probe(bus, clock)
    source = Tapped(Listed(frames(9)).get, probe, LoadShedding())
    assert probe.counts == {}
    assert source.get(0.0) is not None
    assert source.get(0.0) is not None
    assert probe.counts == {}, "nobody asked"
    probe.lease()
    for _ in range(3):
        source.get(0.0)
    clock.t_ns += LEASE_NS
    for _ in range(3):
        source.get(0.0)
    probe.lease()
    source.get(0.0)
    source.flush()
    source.flush()
    probe.drain()
    seqs = [message.seq for message in iter(lambda: cast(MarkerDetections | None, shown.get(0.01)), None)]
    assert seqs == [1, 2, 3, 7, 8]
    assert probe.counts == {"tap.shown": 5, "tap.dropped": 0}
    probe.close()


def test_a_tap_from_the_beginning_shows_everything_until_its_recorder_is_gone() -> None:
    bus = LoopbackBus()
    shown = bus.subscribe("taken", depth=100)
    probe = Probe(bus, ManualClock(), always=True)
    for message in frames(4):
        probe.show(message)
    probe.end_always()
    probe.show(detections("left", 1, 9))
    probe.drain()
    assert len(list(iter(lambda: shown.get(0.01), None))) == 4
    bus.close()
    probe.close()


class Behind(LoadShedding):
    """So far behind, message by message."""

    def __init__(self, skip: list[int]) -> None:
        super().__init__()
        self._next = skip

    def look(self, message: Message) -> None:
        self.skip = self._next.pop(0)


def test_how_far_behind_the_master_is_comes_before_the_message_it_holds_for() -> None:
    bus, load_shedding = LoopbackBus(), Behind([0, 3, 3, 3, 0, 0])
    shown = bus.subscribe("taken", depth=100)
    probe = Probe(bus, ManualClock(10))
    source = Tapped(Listed(frames(6)).get, probe, load_shedding)
    probe.lease()
    for number in range(7):
        if number == 3:
            probe.lease()  # of a second reader, who knows nothing yet
        source.get(0.0)
    probe.drain()
    expected = [
        (one.skip, one.t_ns) if isinstance(one, Backlog) else cast(MarkerDetections, one).seq
        for one in iter(lambda: shown.get(0.01), None)
    ]
    at = [came_ns(one, 0) for one in frames(6)]
    assert expected == [0, (3, at[1]), 1, (3, at[2]), 2, 3, (0, at[4]), 4, 5]
    assert probe.counts == {"tap.shown": 9, "tap.dropped": 0}
    probe.close()


class Stuck:
    """A disk that takes nothing until it is let."""

    def __init__(self) -> None:
        self.go = threading.Event()
        self.fail = False

    def write(self, data: bytes, /) -> int:
        self.go.wait(20.0)
        if self.fail:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return len(data)

    def close(self) -> None:
        """Nothing to give back."""


def test_a_disk_that_is_too_slow_costs_counted_messages(tmp_path: Path) -> None:
    disk = Stuck()
    disk.go.set()
    writer = MessageWriter(tmp_path / "a.mcap", {}, open_disk=lambda _path: cast(io.FileIO, disk))
    disk.go.clear()
    recorder = MessageRecorder(writer, tmp_path, 0, depth=5)
    for number, message in enumerate(frames(50)):
        recorder.offer("taken", message, number * 1_000_000_000)
    assert recorder.progress().dropped["taken"] >= 40
    disk.go.set()
    recorder.close()
    now = recorder.progress()
    assert recorder.failure is None
    assert now.counts["taken"] + now.dropped["taken"] == 50


def test_a_disk_that_fails_or_fills_ends_the_recording_with_the_reason(tmp_path: Path) -> None:
    disk = Stuck()
    disk.go.set()
    recorder = MessageRecorder(
        MessageWriter(tmp_path / "a", {}, open_disk=lambda _path: cast(io.FileIO, disk)), tmp_path, 0
    )
    disk.fail = True
    recorder.offer("taken", frames(1)[0], 0)
    assert until(lambda: recorder.failure is not None)
    recorder.offer("taken", frames(1)[0], 1)
    recorder.close()
    assert "Input/output error" in str(recorder.failure)
    assert recorder.progress().dropped == {"taken": 1}

    free = [10_000_000]
    recorder = MessageRecorder(
        MessageWriter(tmp_path / "b.mcap", {}), tmp_path, 5_000_000, free_bytes=lambda _folder: free[0]
    )
    recorder.offer("taken", frames(1)[0], 0)
    assert until(lambda: recorder.progress().counts.get("taken") == 1)
    free[0] = 4_000_000
    assert until(lambda: recorder.failure is not None)
    recorder.close()
    assert "4 MB are free on the disk and 5 MB stay free (--reserve-mb)" in str(recorder.failure)
    assert not open_messages(tmp_path / "b.mcap").cut, "there was room for the end"


class FakeMaster:
    """What a recorder asks of a master."""

    def __init__(self, bus: Bus, session: int = 5) -> None:
        self.bus, self.session, self.reloads, self.clock = bus, session, 0, ManualClock(1)
        self.probe = Probe(bus, self.clock)
        bus.announce(MASTER)
        bus.serve(MASTER, self.answer)

    def answer(self, command: Command) -> Health:
        assert command.verb == "tap"
        self.probe.lease()
        return Health(
            MASTER, self.session, now_ns(), {"reload.applied": self.reloads} | self.probe.counts, {}
        )


def recording(
    settings: RecordSettings, connect: Callable[[threading.Event], Bus | None], output: list[str]
) -> tuple[threading.Event, threading.Thread, list[Progress | RecordingError]]:
    stop, out = threading.Event(), list[Progress | RecordingError]()

    def work() -> None:
        try:
            out.append(run_recorder(settings, connect, stop, output.append, lambda _now, _lost: None))
        except RecordingError as error:
            out.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    return stop, thread, out


def seqs_of(path: Path) -> list[int]:
    return [cast(MarkerDetections, one.message).seq for one in open_messages(path).read(["taken"])]


def test_a_recorder_keeps_what_a_master_receives_and_publishes(
    tmp_path: Path, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(record, "_PERIOD_NS", 20_000_000)
    hub = LoopbackBus()
    master, asker = FakeMaster(hub.join()), hub.join()
    asked = set[str]()

    def camera(command: Command) -> Health:
        asked.add(f"{command.target} {command.verb}")
        return Health(command.target, 1, 1, {}, {})

    for name in ("left", "right"):
        asker.serve(name, camera)
    path, output = tmp_path / "a.mcap", list[str]()
    files = RigFiles(root / "calib_json", ("desk",))
    settings = RecordSettings(path, files, frames_hz=20.0, previews=True, reserve_bytes=0)
    stop, thread, out = recording(settings, lambda _stop: hub.join(), output)
    try:
        assert until(lambda: NAME in asker.alive() and len(asked) == 4 and bool(output))
        for message in frames(30):
            master.probe.show(message)
        asker.publish("preview", "left", Preview("left", 5, TINY))
        asker.publish("still", "left", Still("left", 1, 5, TINY))
        assert until(lambda: asker.ask(Command(NAME, "report"), 1.0).counts.get("taken") == 30)
        expected = asker.ask(Command(NAME, "report"), 1.0)
        assert expected.counts["dropped"] == expected.counts["lost"] == 0
        assert expected.metrics.keys() >= {"recorder.seconds", "recorder.megabytes", "recorder.free_gb"}
        with pytest.raises(BusError, match="there are report, stop"):
            asker.ask(Command(NAME, "dance"), 1.0)
        asker.ask(Command(NAME, "stop"), 1.0)
        thread.join(60.0)
    finally:
        stop.set()
        thread.join(60.0)
        master.probe.close()
    assert isinstance(out[0], Progress)
    assert asked == {"left preview", "left still", "right preview", "right still"}
    kept = open_messages(path)
    assert not kept.cut
    assert {"rigs/desk.json", "cameras/left.json", "hands/default-right.json"} <= kept.files.keys()
    assert seqs_of(path) == list(range(30))
    assert kept.counts["preview"] == kept.counts["still"] == 1
    assert kept.senders["health"].keys() == {"master", "recorder"}


def test_a_recorder_outlives_its_master_and_reports_what_a_replay_cannot_repeat(
    tmp_path: Path, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(record, "_PERIOD_NS", 20_000_000)
    hub = LoopbackBus()
    first = FakeMaster(hub.join())
    path, output = tmp_path / "a.mcap", list[str]()
    settings = RecordSettings(path, RigFiles(root / "calib_json", ("desk",)), reserve_bytes=0)
    stop, thread, _ = recording(settings, lambda _stop: hub.join(), output)
    try:
        assert until(lambda: len(output) == 1)
        first.probe.show(frames(1)[0])
        first.reloads = 1
        hub.publish("health", MASTER, first.answer(Command(MASTER, "tap")))
        assert until(lambda: len(output) == 2)
        first.probe.drain()
        first.bus.close()
        assert until(lambda: len(output) == 3)
        second = FakeMaster(hub.join(), session=6)
        assert until(lambda: len(output) == 4)
        second.probe.show(frames(1, 7)[0])
        second.probe.drain()
    finally:
        stop.set()
        thread.join(60.0)
    assert [
        word for line, word in zip(output, ("into", "changed", "gone", "again"), strict=True) if word in line
    ] == [
        "into",
        "changed",
        "gone",
        "again",
    ]
    assert seqs_of(path) == [0, 7]
    events = "\n".join(events_of(open_messages(path)))
    assert "files of the rig were changed" in events
    assert "the master was started again" in events


def test_a_connection_that_is_dead_is_opened_anew(
    tmp_path: Path, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(record, "_PERIOD_NS", 20_000_000)
    monkeypatch.setattr(record, "_ASK_S", 0.3)
    end, opened = free_endpoint(), list[Bus]()
    first = FakeMaster(ZenohBus(end, None))

    def connect(stop: threading.Event) -> Bus | None:
        while not stop.is_set():
            try:
                opened.append(ZenohBus(None, end, beyond=True))
            except BusError:
                stop.wait(0.05)
            else:
                return opened[-1]
        return None

    path, output = tmp_path / "a.mcap", list[str]()
    settings = RecordSettings(path, RigFiles(root / "calib_json", ("desk",)), reserve_bytes=0)
    stop, thread, out = recording(settings, connect, output)
    try:
        assert until(lambda: len(output) == 1)
        first.probe.show(frames(1)[0])
        first.probe.drain()
        assert until(lambda: first.bus.ask(Command(NAME, "report"), 5.0).counts.get("taken") == 1)
        first.bus.close()
        assert until(lambda: any("is gone" in line for line in output))
        second = FakeMaster(ZenohBus(end, None), session=6)
        assert until(lambda: any("started again" in line for line in output))
        second.probe.show(frames(1, 7)[0])
        second.probe.drain()
        assert until(lambda: second.bus.ask(Command(NAME, "report"), 5.0).counts.get("taken") == 2)
        second.bus.close()
    finally:
        stop.set()
        thread.join(30.0)
        first.bus.close()
    assert isinstance(out[0], Progress)
    assert len(opened) >= 2
    assert seqs_of(path) == [0, 7]


def test_a_length_ends_it_and_a_broken_tree_is_refused(tmp_path: Path, root: Path) -> None:
    hub = LoopbackBus()
    master = FakeMaster(hub.join())
    path, files = tmp_path / "a.mcap", RigFiles(root / "calib_json", ("desk",))
    stop, thread, out = recording(RecordSettings(path, files, 0.3, reserve_bytes=0), lambda _: hub.join(), [])
    for seq in range(400):
        master.probe.show(frames(1, seq)[0])
        if not thread.is_alive():
            break
        stop.wait(0.05)
    thread.join(60.0)
    assert not stop.is_set()
    assert isinstance(out[0], Progress)
    assert out[0].seconds >= 0.3
    with pytest.raises(RecordingError, match="is there already"):
        run_recorder(RecordSettings(path, files), lambda _: None, stop, [].append, lambda _now, _lost: None)
    with pytest.raises(CalibrationError, match=r"none\.json"):
        run_recorder(
            RecordSettings(tmp_path / "b.mcap", RigFiles(root / "calib_json", ("none",))),
            lambda _: None,
            stop,
            [].append,
            lambda _now, _lost: None,
        )
    assert not (tmp_path / "b.mcap").exists()


def test_one_clock_is_known_as_such_and_another_is_measured() -> None:
    same, other = MasterClock(), MasterClock()
    same.push(1000, 3000, 2400)
    assert abs(same.now_ns() - now_ns()) < 10_000_000_000
    assert same.ahead_ns == 0
    other.push(1000, 3000, 9_000_002_000)
    other.push(1000, 901_000, 9_900_000_000)  # a slow answer tells less
    assert other.ahead_ns == 9_000_000_000


def test_the_line_says_how_it_is() -> None:
    now = Progress(12.4, 3_400_000, 250_000.0, 74_200_000_000, 200, {"taken": 700, "hand": 44}, {"taken": 2})
    text = progress_text(now, 3, 60.0)
    assert text == (
        "12 of 60 s, 744 messages, 3.4 MB, 0.25 MB/s, 2 dropped, 3 never came, 200 waiting, 74.2 GB free"
    )
    out = io.StringIO()
    line = ProgressLine(out, "recorder")
    for _ in range(5):
        line.show("x")
    line.end("y")
    assert out.getvalue() == "recorder: x\nrecorder: y\n"
