"""The process of the live outputs, in this one: switches, faults of one that do not touch the others, its report."""

import threading
import time
from pathlib import Path

import pytest
from msgspec.structs import replace

from common.calibration import load, save
from common.calibration.output_settings import OscOutput, OutputSettings, VmcOutput, default_outputs
from common.errors import BusError, CalibrationError, PhalanxError
from common.messages import Command, Health, ResultMessage
from common.messages.streams import MASTER
from master.outputs.bus import BusSink
from master.outputs.network import outputs as registry
from master.outputs.network.conventions import MasterTimes
from master.outputs.network.outputs import DEPTH, OUTPUTS, Counters, Output, OutputLine
from master.outputs.network.sender import NAME, Housekeeping, Sender, run_sender, settings_of
from tests.master.outputs.network.hands import hand_pose
from tests.memory_bus import LoopbackBus
from tests.network_helpers import until

FILE = Path(__file__).parents[4] / "calib_json" / "outputs" / "default.json"
OSC_ON = replace(default_outputs(), osc=OscOutput(on=True, port=9001))


class Kept:
    """A sink that keeps what it is given; it may refuse to open, break, or wait for `gate` before each message."""

    def __init__(self, *, gate: threading.Event | None = None) -> None:
        self.messages: list[ResultMessage] = []
        self.broken, self.closed = False, 0
        self._gate = gate

    def write(self, message: ResultMessage) -> None:
        if self.broken:
            raise PhalanxError("the cable is out; put it in")
        if self._gate is not None:
            assert self._gate.wait(30.0)
        self.messages.append(message)

    def close(self) -> None:
        self.closed += 1


@pytest.fixture
def sinks(monkeypatch: pytest.MonkeyPatch) -> dict[str, Kept]:
    """OSC and VMC as sinks that keep; the others of the registry as they are."""
    made: dict[str, Kept] = {}

    def keeping(name: str) -> Output:
        def make(settings: OutputSettings, times: object) -> Kept:
            del settings, times
            made[name] = Kept()
            return made[name]

        old = OUTPUTS[name]
        return Output(old.takes, old.part, old.where, make)

    monkeypatch.setattr(registry, "OUTPUTS", {name: keeping(name) for name in ("osc", "vmc")}, raising=True)
    monkeypatch.setattr("master.outputs.network.sender.OUTPUTS", registry.OUTPUTS)
    return made


def sender(settings: OutputSettings, *only: str) -> tuple[Sender, list[str]]:
    output: list[str] = []
    return Sender(settings, only, output.append), output


def counts(one: Sender, name: str) -> tuple[int, int, int, bool]:
    """Sent, failed and dropped of an output, and whether it is on."""
    health = one.health()
    return (
        health.counts[f"sent.{name}"],
        health.counts[f"failed.{name}"],
        health.counts[f"dropped.{name}"],
        health.metrics[f"on.{name}"] == 1.0,
    )


def test_the_defaults_are_the_file_that_comes_with_the_project_and_all_are_off() -> None:
    settings = load(FILE, OutputSettings)
    assert settings == default_outputs()
    assert set(registry.switched_on(settings)) == set(OUTPUTS)
    assert not any(registry.switched_on(settings).values())


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ('"oscar": {}', "oscar"),
        ('"osc": {"port": 0}', "osc.port"),
        ('"vmc": {"hand": "arm"}', "vmc.hand"),
        ('"vmc": {"q_avatar_rig": [1, 1, 0, 0]}', "vmc.q_avatar_rig: length 1.414"),
        ('"lsl": {"name": ""}', "lsl.name"),
    ],
)
def test_a_file_that_says_something_else_is_refused_with_file_and_key(
    tmp_path: Path, change: str, key: str
) -> None:
    path = tmp_path / "default.json"
    path.write_text(f'{{"version": 1, "name": "default", {change}}}')
    with pytest.raises(CalibrationError) as refused:
        settings_of(path)
    assert str(path) in str(refused.value)
    assert key in str(refused.value)


def test_without_a_default_file_all_is_off_and_another_name_is_an_error(tmp_path: Path) -> None:
    assert settings_of(tmp_path / "default.json") == default_outputs()
    with pytest.raises(CalibrationError, match=r"stage\.json: cannot read"):
        settings_of(tmp_path / "stage.json")


def test_what_is_on_gets_what_it_is_for_and_what_is_off_nothing(sinks: dict[str, Kept]) -> None:
    one, _ = sender(OSC_ON)
    pose = hand_pose("left")
    assert until(lambda: one.health().metrics["open.osc"] == 1.0)
    one.push(pose)
    one.switch("vmc", on=True)
    assert until(lambda: one.health().metrics["open.vmc"] == 1.0)
    one.push(pose)
    one.close()
    assert [len(sink.messages) for sink in sinks.values()] == [2, 1]
    assert (counts(one, "osc")[:3], counts(one, "vmc")[:3]) == ((2, 0, 0), (1, 0, 0))
    assert [sink.closed for sink in sinks.values()] == [1, 1]


def test_what_is_named_is_on_whatever_the_file_says(sinks: dict[str, Kept]) -> None:
    one, output = sender(OSC_ON, "vmc")
    assert one.on == ("vmc",)
    one.use(replace(default_outputs(), osc=OscOutput(on=True, port=9009), vmc=VmcOutput(port=9010)))
    assert one.on == ("vmc",)
    assert output == ["osc: off", "vmc: udp 127.0.0.1:9010"]
    one.close()
    with pytest.raises(PhalanxError, match=r"output 'osk': unknown; there are osc, vmc"):
        sender(OSC_ON, "osk")
    assert sinks.keys() == {"vmc"}


def test_an_output_that_breaks_says_so_once_is_opened_again_and_the_others_go_on(
    sinks: dict[str, Kept], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("master.outputs.network.outputs.FIRST_RETRY_S", 0.01)
    one, output = sender(OSC_ON, "osc", "vmc")
    assert until(lambda: sinks.keys() == {"osc", "vmc"})
    assert until(lambda: all(one.health().metrics[f"open.{name}"] for name in sinks))
    sinks["osc"].broken = True
    first = sinks["osc"]
    one.push(hand_pose("left"))
    assert until(lambda: sinks["osc"] is not first and one.health().metrics["open.osc"] == 1.0)
    one.push(hand_pose("left"))
    one.close()
    assert output == ["osc: the cable is out; put it in; tried again", "osc: open again"]
    assert first.closed == 1
    assert (counts(one, "osc")[:3], counts(one, "vmc")[:3]) == ((1, 1, 1), (2, 0, 0))


def test_an_output_that_cannot_open_costs_its_messages_and_says_why_once() -> None:
    output: list[str] = []
    counters = Counters()

    def refuse() -> Kept:
        raise OSError("no such device")

    line = OutputLine("lsl", refuse, counters, output.append)
    assert until(lambda: counters.failed == 1)
    line.offer(hand_pose("left"))
    line.close()
    assert output == ["lsl: no such device; tried again"]
    assert (counters.sent, counters.dropped) == (0, 1)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_an_output_that_ends_by_an_error_nobody_foresaw_is_closed_and_not_called_open() -> None:
    class Faulty(Kept):
        def write(self, message: ResultMessage) -> None:
            raise KeyError(message.t_ns)

    sink, counters = Faulty(), Counters()
    line = OutputLine("lsl", lambda: sink, counters, print)
    assert until(lambda: line.open)
    line.offer(hand_pose("left"))
    assert until(lambda: not line.open)
    line.offer(hand_pose("left"))
    assert (sink.closed, counters.sent, counters.dropped) == (1, 0, 1)
    line.close()


def test_a_slow_output_loses_its_oldest_and_counts_them() -> None:
    gate, counters = threading.Event(), Counters()
    sink = Kept(gate=gate)
    line = OutputLine("web", lambda: sink, counters, print)
    assert until(lambda: line.open)
    poses = [hand_pose("left", t_ns=number) for number in range(3 * DEPTH)]
    line.offer(poses[0])
    assert until(lambda: line.waiting == 0)  # its thread holds the first, and waits
    for pose in poses[1:]:
        line.offer(pose)
    assert line.waiting == DEPTH
    gate.set()
    line.close()
    kept = [message.t_ns for message in sink.messages]
    assert kept == [0, *range(2 * DEPTH, 3 * DEPTH)]
    assert (counters.sent, counters.dropped) == (DEPTH + 1, 2 * DEPTH - 1)


def test_the_process_obeys_follows_its_file_and_reports(sinks: dict[str, Kept], tmp_path: Path) -> None:
    path = tmp_path / "default.json"
    save(path, default_outputs())
    bus = LoopbackBus()
    master, asker, stop = bus.join(), bus.join(), threading.Event()
    master.serve(MASTER, lambda command: Health(MASTER, 1, time.monotonic_ns() + 10**12, {}, {}))
    reports = asker.subscribe("health", NAME, depth=64)
    output: list[str] = []
    thread = threading.Thread(target=run_sender, args=(bus, default_outputs(), path, (), stop, output.append))
    thread.start()
    try:
        assert until(lambda: NAME in asker.alive())
        assert output == [f"all outputs are off; switch them on in {path}, or name them: --only osc,vmc"]
        answer = asker.ask(Command(NAME, "on", '{"output": "osc"}'), 1.0)
        assert answer.metrics["on.osc"] == 1.0
        assert until(lambda: asker.ask(Command(NAME, "report"), 1.0).metrics["open.osc"] == 1.0)
        sink = BusSink(master)
        for number in range(20):
            sink.write(hand_pose("right", t_ns=number))
        assert until(lambda: len(sinks["osc"].messages) == 20)
        save(path, replace(default_outputs(), vmc=VmcOutput(on=True)))
        assert until(lambda: "vmc" in sinks)
        assert asker.ask(Command(NAME, "off", '{"output": "osc"}'), 1.0).metrics["on.osc"] == 0.0
        path.write_text("{")
        assert until(lambda: any("the settings stay as they were" in line for line in output))
        report = reports.get(60.0)
        assert isinstance(report, Health)
        assert report.source == NAME
        health = asker.ask(Command(NAME, "report"), 1.0)
        assert (health.counts["received"], health.counts["sent.osc"], health.counts["lost"]) == (20, 20, 0)
        for verb, body, why in (
            ("on", '{"output": "x"}', "output 'x': unknown"),
            ("on", "osc", 'write {"output": "osc"}'),
            ("sing", "", "there are on, off, report, stop"),
        ):
            with pytest.raises(BusError, match=why):
                asker.ask(Command(NAME, verb, body), 1.0)
        asker.ask(Command(NAME, "stop"), 1.0)
        thread.join(30.0)
        assert not thread.is_alive()
    finally:
        stop.set()
        thread.join(30.0)
    assert "vmc: udp 127.0.0.1:39539" in output
    assert sinks["vmc"].closed == 1


def test_the_clock_of_a_master_on_another_machine_is_learned(tmp_path: Path) -> None:
    bus = LoopbackBus()
    ahead_ns = 3_600 * 10**9
    bus.serve(MASTER, lambda command: Health(MASTER, 1, time.monotonic_ns() + ahead_ns, {}, {}))
    one, _ = sender(default_outputs())
    housekeeping = Housekeeping(one, bus, tmp_path / "default.json", [])
    assert one.times.offset_ns == 0
    for _ in range(8):
        housekeeping.step(print)
    assert one.times.offset_ns == pytest.approx(ahead_ns, abs=1_000_000)
    now = time.monotonic_ns()
    assert one.times.local_ns(now + ahead_ns) == pytest.approx(now, abs=1_000_000)
    assert one.times.wall_ns(now + ahead_ns) == pytest.approx(time.time_ns(), abs=100_000_000)
    assert all(isinstance(name, str) for name in one.health().counts)


def test_a_recording_is_stamped_as_it_is_played_and_keeps_its_distances() -> None:
    now_s = 1000.0
    times = MasterTimes(lambda: round(now_s * 1e9), lambda: 10**18 + round(now_s * 1e9))

    def stamp_s(recorded_s: float) -> float:
        return 1e-9 * times.local_ns(round(recorded_s * 1e9)) - now_s

    assert stamp_s(999.99) == pytest.approx(-0.01)  # live
    for made_s in (5.0, 1_000_000.0):  # before this machine was started, and by another clock that is ahead
        assert stamp_s(made_s) == pytest.approx(0.0)
        now_s += 1.0
        assert stamp_s(made_s + 0.99) == pytest.approx(-0.01)  # a message that took 10 ms more
        assert stamp_s(made_s + 60.0) == pytest.approx(0.0)  # it was sought
    assert times.wall_ns(round(now_s * 1e9)) == 10**18 + round(now_s * 1e9)
