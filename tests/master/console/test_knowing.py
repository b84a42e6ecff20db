"""What the console knows and tells, without a browser: tuning, looking, figures, gestures, files, its guard."""

import json
import socket
from pathlib import Path

import msgspec
import pytest

from common.calibration import CameraCalibration, HsvRange, RigCalibration, load, save
from common.calibration.output_settings import OutputSettings
from common.errors import BusError, CalibrationError, PhalanxError
from common.messages import Command, Gesture, Health
from master.console.controls import FilterTuner, Tuner, full_frame_uv, hand_line, update_copy
from master.console.link import PreviewLeases
from master.console.pages.outputs import change_output
from master.console.recording_panel import recording_path, start_playing
from master.console.serving import names_of, refusal
from master.console.state import KEPT, ConsoleSettings, ConsoleState, History, Newest, ReceivedGestures
from tests.master.console.fakes import FakeSlave, pose, tree
from tests.memory_bus import LoopbackBus
from tests.network_helpers import until


@pytest.fixture
def slave(tmp_path: Path) -> FakeSlave:
    return FakeSlave(LoopbackBus(), tree(tmp_path) / "cameras" / "left.json")


def test_a_tuner_goes_back_to_what_was_before_the_first_change_or_saved_last(slave: FakeSlave) -> None:
    tuner = Tuner("left", slave.answer)
    assert tuner.set({"exposure_us": 6500.0}).wanted["exposure_us"] == 6500.0
    tuner.pick("index", (159.5, 100.0), 123)
    assert slave.verbs("pick")[-1]["t_ns"] == 123
    assert tuner.refresh().markers["index"] == HsvRange(hsv_low=(44, 80, 60), hsv_high=(44, 250, 250))
    back = tuner.revert()
    assert back.wanted["exposure_us"] == 5000.0
    assert back.markers["index"] == HsvRange(hsv_low=(15, 90, 40), hsv_high=(25, 255, 255))
    assert back.markers["back"] == HsvRange(hsv_low=(170, 90, 40), hsv_high=(0, 255, 255)), (
        "a hue that wraps comes back as it was"
    )
    assert "ring" not in tuner.forget("ring").markers
    assert "ring" in tuner.revert().markers
    tuner.forget("ring")
    tuner.save()
    tuner.pick("ring", (300.0, 100.0))
    assert "ring" not in tuner.revert().markers, "what had no colour has none again"
    tuner.set({"exposure_us": 7000.0})
    tuner.save()
    tuner.set({"exposure_us": 8000.0})
    assert tuner.revert().wanted["exposure_us"] == 7000.0


def test_what_a_slave_elsewhere_saves_comes_to_the_copy_of_this_machine(
    slave: FakeSlave, tmp_path: Path
) -> None:
    copy = tmp_path / "copy" / "cameras" / "left.json"
    copy.parent.mkdir(parents=True)
    save(copy, slave.camera)
    tuner = Tuner("left", slave.answer)
    assert not update_copy(copy, tuner.save()), "the same: nothing is written"
    tuner.set({"exposure_us": 7001.5, "colour_gains": [1.25, 0.75], "roi_margin": 0.25})
    tuner.forget("ring")
    tuner.pick("index", (159.5, 100.0))
    assert update_copy(copy, tuner.save())
    made, there = load(copy, CameraCalibration), load(slave.path, CameraCalibration)
    assert (made.exposure_us, made.colour_gains, made.roi_margin) == (7001.5, (1.25, 0.75), 0.25)
    assert made.markers == there.markers
    assert made.intrinsics == there.intrinsics
    assert made.provenance["markers"].tool == "console"
    (kept,) = (tmp_path / "copy").glob("old/*/cameras/left.json")
    assert load(kept, CameraCalibration).exposure_us == 5000.0
    tuner = Tuner("left", slave.answer, copy)
    tuner.set({"exposure_us": 7002.5})
    tuner.save()
    assert load(copy, CameraCalibration).exposure_us == 7002.5


def test_a_tuner_passes_on_what_a_slave_refuses_and_has_nothing_to_revert_before_it_answered() -> None:
    def silent(command: Command) -> Health:
        raise BusError(f"no answer from {command.target!r}")

    tuner = Tuner("left", silent)
    with pytest.raises(BusError, match="no answer from 'left'"):
        tuner.set({"exposure_us": 1.0})
    with pytest.raises(BusError, match="nothing to go back to"):
        tuner.revert()


def test_the_corners_of_a_picture_are_the_edges_of_the_frames_corner_pixels() -> None:
    assert full_frame_uv(0.0, 0.0, 640, 480) == (-0.5, -0.5)
    assert full_frame_uv(1.0, 1.0, 640, 480) == (639.5, 479.5)


def test_a_filter_is_tried_by_command_and_saved_with_its_source(tmp_path: Path) -> None:
    commands: list[Command] = []

    def ask(command: Command) -> Health:
        commands.append(command)
        return Health("master", 1, 2, {}, {})

    path = tree(tmp_path) / "rigs" / "desk.json"
    before = load(path, RigCalibration)
    tuner = FilterTuner("desk", path, ask)
    tuner.set({"beta": 80.0})
    assert json.loads(commands[0].body) == {"rig": "desk", "filter": {"beta": 80.0}}
    tuner.save()
    after = load(path, RigCalibration)
    assert (after.filter.beta, after.filter.min_cutoff_hz) == (80.0, before.filter.min_cutoff_hz)
    assert after.provenance["filter"].tool == "console"
    tuner.set({"min_cutoff_hz": -1.0})
    with pytest.raises(CalibrationError, match="min_cutoff_hz"):
        tuner.save()
    assert load(path, RigCalibration) == after, "a value out of range changes nothing"
    tuner.revert()
    assert json.loads(commands[-1].body)["filter"] == msgspec.to_builtins(after.filter)


def test_a_filter_can_be_saved_while_no_master_runs(tmp_path: Path) -> None:
    def ask(command: Command) -> Health:
        raise BusError(f"no answer from {command.target!r}")

    path = tree(tmp_path) / "rigs" / "desk.json"
    tuner = FilterTuner("desk", path, ask)
    tuner.refresh()
    with pytest.raises(BusError):
        tuner.set({"beta": 80.0})
    assert tuner.now.wanted["beta"] == 80.0
    assert tuner.save().wanted["beta"] == 80.0


def test_looking_asks_for_all_that_anybody_wants_tinted_and_ends() -> None:
    asked: list[Command] = []

    def ask(command: Command, timeout_s: float) -> Health:
        asked.append(command)
        raise BusError("nobody there")

    preview_leases = PreviewLeases(ask)
    preview_leases.look("left")
    preview_leases.look("left", ("index",))
    assert until(lambda: any("index" in one.body for one in asked))
    assert preview_leases.error("left") == "nobody there"
    assert preview_leases.looked_at == {"left"}
    assert until(lambda: not preview_leases.looked_at), "no thread is left when nobody looks"
    assert not preview_leases.error("left")


def test_history_keeps_a_minute_and_parts_what_masters_and_senders_say() -> None:
    history = History()
    for k in range(300):
        metrics = {"camera_hz.left": 90.0, "left.clock_offset_us": 1500.0, "left.clock_sigma_us": 30.0}
        counts = {"left.received": 45 * k} | ({"left.lost": 2 * (k - 100)} if k > 100 else {})
        master = Health("master", 1, k * 500_000_000, counts, metrics)
        slave = Health("left", 1, k, {}, {"sensor_celsius": 50.0})
        history.push(0.5 * k, [5.0, 7.0, 100.0], {"master": master, "left": slave})
    assert history.latest("latency_p50_ms") == 7.0
    assert history.latest("poses_per_s") == 6.0
    assert history.latest("lost_per_s.left") == pytest.approx(4.0)
    assert history.latest("offset_ms.left") == 1.5
    assert history.latest("celsius.left") == 50.0
    rates = history.series("rate_hz.left")
    assert len(rates) == 120
    assert rates[0] == (-59.5, 90.0), "what arrives, not what the camera takes"
    assert history.series("lost_per_s.left")[0][1] == pytest.approx(4.0)
    assert history.latest("celsius.right") is None


def test_gestures_last_until_they_end_or_are_not_heard_and_events_are_bounded() -> None:
    received = ReceivedGestures()

    def publish(phase: str, now_s: float, kind: str = "pinch") -> None:
        received.push(Gesture("me", 0, kind, "index", phase, 0, 1.0), now_s)  # pyright: ignore[reportArgumentType]

    publish("begin", 1.0)
    publish("update", 1.2)
    assert set(received.held(1.4)) == {("me", "pinch")}
    assert not received.held(1.8), "not repeated: over"
    publish("end", 2.0)
    assert not received.held(2.0)
    for k in range(100):
        publish("end", 3.0 + k, "tap")
    assert len(received.events()) == KEPT
    assert received.events()[0][0] == 102.0


def test_the_bus_cannot_fill_the_memory_with_names() -> None:
    newest: Newest[str, Health] = Newest()
    for k in range(1000):
        newest.put(f"p{k}", Health(f"p{k}", 1, 1, {}, {}))
    assert len(newest.present()) == 64
    assert newest.get("p0") is not None
    assert newest.get("p0", within_s=0.0) is None, "what is old is not present"


@pytest.mark.parametrize(
    ("host", "origin", "passes"),
    [
        ("127.0.0.1:8080", None, True),
        ("localhost:8080", "http://localhost:8080", True),
        ("127.0.0.1:8080", "http://evil.example", False),
        ("127.0.0.1:8080", "http://127.0.0.1:9999", False),
        ("127.0.0.1:8080", "null", False),
        ("evil.example:8080", "http://evil.example:8080", False),  # a name that was made to point here
        (None, None, False),
    ],
)
def test_only_own_pages_are_answered(host: str | None, origin: str | None, passes: bool) -> None:
    assert (refusal(host, origin, names_of("127.0.0.1")) is None) == passes


@pytest.mark.parametrize(
    ("host", "passes"),
    [
        ("192.168.1.2:8080", True),
        ("[2001:db8::1]:8080", True),
        ("localhost:8080", True),
        (f"{socket.gethostname()}:8080", True),
        ("evil.example:8080", False),
    ],
)
def test_a_console_that_listens_everywhere_has_its_addresses_and_its_own_name(
    host: str, passes: bool
) -> None:
    assert (refusal(host, None, names_of("0.0.0.0")) is None) == passes


@pytest.mark.parametrize(
    ("site", "mode", "passes"),
    [
        ("same-origin", "cors", True),
        ("none", "navigate", True),
        ("cross-site", "navigate", True),  # a link on somebody's page
        ("cross-site", "no-cors", False),
        ("same-site", "no-cors", False),  # another port of this machine
    ],
)
def test_pages_of_other_servers_may_link_here_and_no_more(site: str, mode: str, passes: bool) -> None:
    assert (refusal("127.0.0.1:8080", None, names_of("127.0.0.1"), site, mode) is None) == passes


def test_a_hand_is_described_in_words() -> None:
    assert hand_line(pose(1)) == "22 of 26 joints seen now: 4 measured, 18 solved, 4 held"


def test_state_reads_the_bus_and_files_and_refuses_paths(tmp_path: Path) -> None:
    bus = LoopbackBus()
    calibration = tree(tmp_path)
    state = ConsoleState(ConsoleSettings(calibration), bus.join)
    try:
        assert state.rig_names == ("desk",)
        assert state.cameras() == ("left", "right")
        bus.announce("master")
        assert until(lambda: state.alive == {"master"})
        assert until(lambda: (bus.publish("hand", "default-right", pose(1)), bool(state.poses))[1])
        assert not state.checklist
        for bad in ("../x", "a/b", "", ".hidden", "x" * 80):
            with pytest.raises(PhalanxError, match="is called by letters"):
                recording_path(state, bad)
        with pytest.raises(PhalanxError, match="choose a recording"):
            start_playing(state, "../../etc/passwd")
        with pytest.raises(CalibrationError, match="port"):
            change_output(state, "osc", {"port": 70_000})
        change_output(state, "osc", {"port": 9001})
        assert load(calibration / "outputs" / "default.json", OutputSettings).osc.port == 9001
        assert not state.local.running(), "nothing is on: nothing runs"
        with pytest.raises(BusError, match="not on the bus"):
            state.link.ask(Command("left", "settings"))
    finally:
        state.close()
    (calibration / "rigs" / "desk.json").unlink()
    assert state.rig_names == (), "an empty tree is nothing to fail about"
