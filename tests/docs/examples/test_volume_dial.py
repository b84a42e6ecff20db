"""The volume dial of docs/examples: by itself, and as a process beside a bus."""

import itertools
import math
import os
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from msgspec.structs import replace

from common.bus.zenoh_bus import ZenohBus
from common.errors import PhalanxError
from common.messages import Gesture
from common.messages.streams import MASTER
from tests.docs.examples.loading import example, wait_for
from tests.memory_bus import LoopbackBus
from tests.network_helpers import until

STEP_NS = 16_666_667


@pytest.fixture(scope="module")
def app(root: Path) -> ModuleType:
    return example(root, "volume_dial")


def turn(degrees: list[float], began_ns: int = 10**9, hand: str = "right", end: bool = True) -> list[Gesture]:
    """A grip that goes through these angles, one a frame."""
    last = len(degrees) - 1
    return [
        Gesture(
            hand=hand,
            t_ns=began_ns + i * STEP_NS,
            kind="dial",
            name="dial",
            phase="begin" if i == 0 else "end" if end and i == last else "update",
            began_t_ns=began_ns,
            confidence=0.9,
            angle_rad=math.radians(angle),
        )
        for i, angle in enumerate(degrees)
    ]


def test_a_turn_is_as_many_detents_as_it_has_either_way(app: ModuleType) -> None:
    for way in (1, -1):
        dial = app.Dial(6.0)
        detents = [dial.push(one) for one in turn([way * a * 0.5 for a in range(0, 182)])]
        assert sum(detents) == way * 15  # 90.5 degrees
        assert set(detents) == {0, way}


def test_a_hand_that_trembles_on_an_edge_does_not_rattle(app: ModuleType) -> None:
    dial = app.Dial(6.0)
    tremble = [0.0, 3.0, *(6.0 + 2.5 * math.sin(i) for i in range(1, 200))]
    detents = [dial.push(one) for one in turn(tremble)]
    assert sum(map(abs, detents)) == 1


def test_each_grip_goes_on_where_the_volume_is_whatever_its_angle_is(app: ModuleType) -> None:
    dial = app.Dial(6.0)
    first = [dial.push(one) for one in turn([0.0, 13.0])]
    again = [dial.push(one) for one in turn([90.0, 90.0, 77.0], began_ns=2 * 10**9)]  # its angle goes on
    assert (sum(first), sum(again)) == (2, -2)


def test_only_the_dial_turns_it_and_what_is_not_known_turns_nothing(app: ModuleType) -> None:
    dial = app.Dial(6.0)
    messages = turn([0.0, 50.0, math.nan, 50.0], end=False)
    assert [dial.push(one) for one in messages] == [0, 8, 0, 0]
    others = [replace(one, kind="pinch", name="index") for one in turn([0.0, 90.0], began_ns=3 * 10**9)]
    assert [dial.push(one) for one in others] == [0, 0]


def test_a_second_hand_waits_until_the_first_lets_go_or_is_silent(app: ModuleType) -> None:
    dial = app.Dial(6.0)
    for one in turn([0.0, 6.5], end=False):
        dial.push(one)
    left = turn([0.0, 30.0, 60.0, 90.0], hand="left", began_ns=10**9)
    assert [dial.push(one) for one in left] == [0, 0, 0, 0]
    late = turn([0.0, 31.0], hand="left", began_ns=3 * 10**9)  # the first one's end was never heard
    assert [dial.push(one) for one in late] == [0, 5]


def test_on_the_bus_it_follows_a_hand_and_stops_at_the_end(
    app: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    bus, stop, output = LoopbackBus(), threading.Event(), app.Printed()
    bus.announce(MASTER)
    thread = threading.Thread(target=app.run, args=(bus, app.Dial(6.0), output, 2, stop))
    thread.start()
    try:
        wait_for(lambda: "waiting for a dial grip" in capsys.readouterr().err)
        for one in turn([0.0, *(float(a) for a in range(1, 200))]):
            bus.publish("gesture", one.hand, one)
        wait_for(lambda: output.percent == 100)
    finally:
        stop.set()
        thread.join(60.0)
    assert not thread.is_alive()
    assert "100 %, the end" in capsys.readouterr().out
    bus.close()


PACTL = """#!/bin/sh
case "$1" in
get-sink-volume) echo "Volume: front-left: 26214 / $(cat {folder}/volume)% / -23.88 dB" ;;
set-sink-volume) echo "${{3%\\%}}" > {folder}/volume ;;
esac
"""


def fake(folder: Path, name: str, text: str) -> None:
    (folder / name).write_text(text)
    (folder / name).chmod(0o755)


def test_a_program_is_asked_and_set_and_something_clicks(
    app: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "volume").write_text("37\n")
    fake(tmp_path, "pactl", PACTL.format(folder=tmp_path))
    fake(tmp_path, "paplay", f"#!/bin/sh\ncat > {tmp_path}/sound\n")
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    output = app.Program("pactl")
    assert output.read() == 37
    output.write(41, at_end=False)
    assert (tmp_path / "volume").read_text().strip() == "41"
    assert len((tmp_path / "sound").read_bytes()) == 2 * 1440  # 30 ms of 16 bit at 48 kHz


def test_the_click_rises_with_the_volume_and_is_short(app: ModuleType) -> None:
    def crossings(data: bytes) -> int:
        samples = np.frombuffer(data, "<i2").astype(float)
        return int((np.diff(np.sign(samples[:1000])) != 0).sum())

    low, high = app.click(440.0), app.click(1760.0)
    assert 3 * crossings(low) < crossings(high)
    assert abs(np.frombuffer(low, "<i2")[-48:].astype(int)).max() < 200


def test_a_program_that_is_not_there_is_said_and_nothing_else_takes_its_place(
    root: Path, tmp_path: Path
) -> None:
    done = run_app(root, "--output", "wpctl", path=str(tmp_path))
    assert done.returncode == 1
    assert "wpctl is not installed" in done.stderr
    assert done.stdout == ""


def test_a_program_without_a_volume_is_said(
    app: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake(tmp_path, "wpctl", "#!/bin/sh\necho no sink\n")
    fake(tmp_path, "aplay", "#!/bin/sh\n")
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    with pytest.raises(PhalanxError, match="tells no volume: no sink"):
        app.Program("wpctl")


@pytest.mark.parametrize(
    ("program", "output", "percent"),
    [
        ("wpctl", "Volume: 0.40 [MUTED]", 40),
        ("wpctl", "Volume: 1.25", 125),
        ("amixer", "Mono: 87 [69%] [on]", 69),
    ],
)
def test_what_the_programs_say_is_understood(
    app: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: str, output: str, percent: int
) -> None:
    fake(tmp_path, program, f"#!/bin/sh\necho '{output}'\n")
    fake(tmp_path, "aplay", "#!/bin/sh\n")
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    assert app.Program(program).read() == percent


def test_as_a_process_it_waits_for_the_master_and_follows_it(root: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    command = [
        sys.executable,
        str(root / "docs/examples/volume_dial.py"),
        "--output",
        "print",
        "--bus",
        endpoint,
    ]
    app = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert app.stdout is not None
    assert app.stderr is not None
    try:
        assert app.stderr.readline() == "waiting for a master ...\n"
        master = ZenohBus(endpoint, None)
        master.announce(MASTER)
        assert app.stderr.readline() == "waiting for a dial grip ...\n"
        lines, output = list[str](), app.stdout
        reader = threading.Thread(target=lambda: lines.extend(output), daemon=True)
        reader.start()
        grips = itertools.count(1)

        def followed() -> bool:  # what is told before the master has heard of who listens is told to nobody
            for one in turn([0.0, 5.0, 13.0, 19.0], next(grips) * 10**9):
                master.publish("gesture", one.hand, one)
            return until(lambda: any("56 %" in line for line in lines), 5.0)

        assert until(followed)
        app.send_signal(signal.SIGINT)
        assert app.wait(60.0) == 0
        reader.join(60.0)
        master.close()
    finally:
        app.kill()
        app.communicate()


def run_app(root: Path, *words: str, path: str | None = None) -> subprocess.CompletedProcess[str]:
    environment = os.environ | ({} if path is None else {"PATH": path})
    command = [sys.executable, str(root / "docs/examples/volume_dial.py"), *words]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=120)


def test_its_help_says_what_it_is_and_the_output_must_be_chosen(root: Path) -> None:
    output = run_app(root, "--help").stdout
    assert "eyes-free" in output
    assert "--output" in output
    assert run_app(root).returncode == 2


def test_it_is_short(root: Path) -> None:
    assert len((root / "docs/examples/volume_dial.py").read_text().splitlines()) < 150
