"""A recorder has the slaves keep raw frames, says which do not and why, and ends what it began."""

import threading
from collections.abc import Sequence
from pathlib import Path

import pytest

from common.errors import RecordingError
from common.messages import Command, Health
from common.messages.command_bodies import RawRequest
from common.recording.messages import open_messages
from master.recording import record, recorder
from master.recording.lines import raw_lines
from master.recording.record import RecordSettings, run_recorder
from master.recording.recorder import Progress, RawAsker
from master.rig.setup import RigFiles
from tests.master.recording.test_recorder import FakeMaster, recording
from tests.memory_bus import LoopbackBus
from tests.network_helpers import until


class FakeSlave:
    """A slave that keeps raw frames, or says why it does not."""

    def __init__(self, bus: LoopbackBus, name: str, why_not: str = "") -> None:
        self.why_not, self.name, self.ended = why_not, name, 0
        self.kept: list[str] = []
        self.on = False
        bus.serve(name, self.answer)

    def answer(self, command: Command) -> Health:
        if command.verb == "raw":
            request = RawRequest.of(command.body)
            assert request.lease_s > 0.0
            if self.why_not or (not self.on and request.name in self.kept):
                raise RecordingError(self.why_not or f"{request.name}: holds something already")
            self.kept += [] if self.on else [request.name]
            self.on = True
        elif command.verb == "raw_stop":
            self.on = False
        frames = 42 if self.kept else 0
        counts = {"raw.frames": frames, "raw.dropped": 3, "raw.ended": self.ended}
        return Health(self.name, 1, 1, counts, {"raw.on": float(self.on), "raw.megabytes": 12.3})


def asker(cameras: Sequence[str], output: list[str]) -> RawAsker:
    return RawAsker("wave", cameras, output.append, lambda _health: None, period_s=0.01)


def test_slaves_keep_raw_frames_for_as_long_as_messages_are_recorded(
    tmp_path: Path, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(record, "_PERIOD_NS", 20_000_000)
    hub = LoopbackBus()
    master, left = FakeMaster(hub.join()), FakeSlave(hub, "left")
    FakeSlave(hub, "right", "raw: this slave keeps no raw frames: start it with --raw-folder DIR")
    path, output = tmp_path / "wave.mcap", list[str]()
    settings = RecordSettings(path, RigFiles(root / "calib_json", ("desk",)), reserve_bytes=0, raw=True)
    stop, thread, out = recording(settings, lambda _stop: hub.join(), output)
    try:
        assert until(lambda: left.on and any("right" in line for line in output))
        assert until(lambda: len(output) == 3)
    finally:
        stop.set()
        thread.join(60.0)
        master.probe.close()
    assert isinstance(out[0], Progress), "a camera that refuses does not end it"
    assert not left.on
    assert left.kept == ["wave-left"]
    text = "\n".join(output)
    assert "camera left: raw frames into wave-left" in text
    assert "camera right: raw frames not recorded: 'right' refused 'raw': raw: this slave keeps no" in text
    assert output[-1] == "camera left: 42 raw frames, 3 dropped, in wave-left (12.3 MB)"
    kept = open_messages(path)
    assert kept.about["raw"] == '{"left": "wave-left", "right": "wave-right"}'
    assert raw_lines(kept) == ["raw frames of left: 42 in wave-left, 3 dropped", "raw frames of right: none"]


def test_a_name_that_is_no_folder_is_refused_before_anything_is_made(tmp_path: Path, root: Path) -> None:
    path, files = tmp_path / "my wave.mcap", RigFiles(root / "calib_json", ("desk",))
    with pytest.raises(
        RecordingError, match=r"'my wave-left': must be letters.*name the recording otherwise"
    ):
        run_recorder(
            RecordSettings(path, files, raw=True),
            lambda _: None,
            threading.Event(),
            [].append,
            lambda _now, _lost: None,
        )
    assert not path.exists()


def test_a_slave_that_was_away_begins_a_further_part_and_one_with_a_fault_does_not() -> None:
    bus, output = LoopbackBus(), list[str]()
    one = asker(("left",), output)
    one.attach(bus)
    assert until(lambda: output == ["camera left does not answer; its raw frames begin when it does"])
    left = FakeSlave(bus, "left")
    assert until(lambda: left.kept == ["wave-left"])
    one.detach()
    left.on = False  # nobody asked for too long
    one.attach(bus)
    assert until(lambda: left.kept == ["wave-left", "wave-left-2"])
    left.ended, left.why_not = 1, "the disk is full"
    assert until(lambda: len(output) == 4)
    one.end(bus)
    assert output[1:] == [
        "camera left: raw frames into wave-left",
        "camera left: raw frames into wave-left-2",
        "camera left: raw frames ended: 'left' refused 'raw': the disk is full",
        "camera left: 42 raw frames, 3 dropped, in wave-left-2 (12.3 MB)",
    ]


def test_a_slave_that_is_gone_at_the_end_ends_by_itself() -> None:
    bus, output = LoopbackBus(), list[str]()
    end = bus.join()
    FakeSlave(end, "left")
    one = asker(("left",), output)
    one.attach(bus)
    assert until(lambda: len(output) == 1)
    one.detach()
    end.close()
    one.end(bus)
    assert output[1].startswith(
        f"camera left: raw frames end within {recorder.LEASE_S:g} s by themselves: no answer"
    )
