"""survive-cli as a program: it speaks, falls silent, dies and comes back, is missing; and recorded files."""

import gzip
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from common.clock import SystemClock
from common.errors import TrackerChoiceError, TrackerError
from common.messages import TrackerPose
from slave.objects.survive import OPTIONS, SurviveFile, SurviveTracker
from slave.reconnect import ReconnectingTracker
from tests.network_helpers import until
from tests.slave.objects.recorded import HEAD, pose, program


def opened(command: str, wanted: str | None = None) -> SurviveTracker:
    return SurviveTracker("tracker", wanted, SystemClock(), threading.Event(), command)


def read(source: SurviveTracker | SurviveFile | ReconnectingTracker, count: int) -> list[TrackerPose]:
    poses = [source.read() for _ in range(count)]
    return [one for one in poses if one is not None]


def known(source: SurviveTracker) -> list[TrackerPose]:
    """Poses until one that is known; those of NaN come first, as long as a busy machine takes."""
    poses: list[TrackerPose] = []
    while not poses or np.isnan(poses[-1].position_m).any():
        poses += read(source, 1)
        assert len(poses) < 200
    return poses


def output(folder: Path, *parts: bytes) -> str:
    (folder / "lines").write_bytes(b"".join(parts))
    return f"cat {folder / 'lines'}"


def test_it_is_asked_to_write_poses_alone_and_they_come_at_once(tmp_path: Path) -> None:
    command = program(
        tmp_path,
        f'echo "$@" > {tmp_path}/arguments; {output(tmp_path, HEAD, pose(8.0), pose(8.01))}; sleep 60',
    )
    source = opened(command)
    begin_ns = SystemClock().now_ns()
    poses = [known(source)[-1], *read(source, 1)]
    source.close()
    source.close()
    assert source.read() is None
    assert (tmp_path / "arguments").read_text().split() == list(OPTIONS)
    assert poses[1].seq == poses[0].seq + 1
    assert poses[1].t_ns - poses[0].t_ns == 10_000_000
    assert 0 < poses[1].t_ns - begin_ns < 10_000_000_000
    np.testing.assert_allclose(poses[0].position_m, [-0.28408, 0.936063, 0.374069])
    np.testing.assert_allclose(poses[0].orientation_wxyz, [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-6)


def test_a_device_that_vanishes_is_nowhere_and_comes_back(tmp_path: Path) -> None:
    first, then = output(tmp_path, HEAD, pose(8.0), b"8.1 WM0 DISCONNECT\r\n"), tmp_path / "then"
    then.write_bytes(pose(9.0))
    source = opened(program(tmp_path, f"{first}; sleep 0.7; cat {then}; sleep 60"))
    poses = [known(source)[-1], *known(source)]
    source.close()
    assert len(poses) > 2, "nowhere in between"
    assert (np.diff([one.t_ns for one in poses]) > 0).all()
    assert source.counts()["gone"] == 1


def test_a_program_that_ends_is_an_error_and_is_started_again(tmp_path: Path) -> None:
    command = program(tmp_path, f"{output(tmp_path, HEAD, pose(8.0))}; exit 3")
    source = opened(command)
    assert len(read(source, 1)) == 1
    with pytest.raises(TrackerError, match="survive-cli ended with code 3"):
        source.read()
    source.close()
    clock, stop = SystemClock(), threading.Event()
    again = ReconnectingTracker("tracker", lambda: opened(command), clock, stop)
    poses = read(again, 6)
    stop.set()
    again.close()
    assert [one.seq for one in poses] == list(range(6))
    assert (np.diff([one.t_ns for one in poses]) > 0).all()
    finite = [bool(np.isfinite(one.position_m).all()) for one in poses]
    assert finite.count(True) >= 2
    assert False in finite
    assert again.counts()["lost"] >= 1
    assert again.counts()["back"] >= 1


def test_a_slave_that_is_killed_leaves_no_program_behind(tmp_path: Path) -> None:
    command = program(tmp_path, f"echo $$ > {tmp_path}/number; exec sleep 300")
    script = (
        "import threading, time\n"
        "from common.clock import SystemClock\n"
        "from slave.objects.survive import SurviveTracker\n"
        f"SurviveTracker('tracker', None, SystemClock(), threading.Event(), {command!r})\n"
        "time.sleep(300)\n"
    )
    slave = subprocess.Popen([sys.executable, "-c", script], cwd=Path(__file__).resolve().parents[3])
    number_file = tmp_path / "number"
    try:
        assert until(lambda: number_file.exists() and number_file.read_text().strip().isdecimal())
        number = int(number_file.read_text())
        assert alive(number)
    finally:
        slave.kill()
        slave.wait()
    assert until(lambda: not alive(number))


def alive(number: int) -> bool:
    """Whether a process runs; one that has ended and is not yet fetched does not."""
    try:
        return Path(f"/proc/{number}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def test_two_devices_and_no_choice_end_it_though_it_would_be_reopened(tmp_path: Path) -> None:
    command = program(tmp_path, f"{output(tmp_path, HEAD, pose(8.0), pose(8.0, 'T20'))}; sleep 60")
    again = ReconnectingTracker("tracker", lambda: opened(command), SystemClock(), threading.Event())
    with pytest.raises(TrackerChoiceError, match="--serial"):
        read(again, 9)
    again.close()


def test_a_missing_program_is_refused_with_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(TrackerError, match=r"cannot start .*survive-cli.*build libsurvive"):
        opened(str(tmp_path / "survive-cli"))


@pytest.mark.parametrize("packed", [False, True])
def test_a_recording_is_played_at_its_pace(tmp_path: Path, packed: bool) -> None:
    path = tmp_path / "walk.rec"
    data = HEAD + pose(8.0) + pose(8.02) + b"8.03 WM0 POSE 1 2\r\n" + pose(8.01) + pose(8.05)
    path.write_bytes(gzip.compress(data) if packed else data)
    clock = SystemClock()
    source = SurviveFile("tracker", "LHR-1A2B3C4D", path, clock, threading.Event())
    poses = read(source, 9)
    assert [one.t_ns - poses[0].t_ns for one in poses] == [0, 20_000_000, 50_000_000]
    assert clock.now_ns() >= poses[-1].t_ns
    assert source.read() is None


def test_a_recording_without_the_device_is_refused(tmp_path: Path) -> None:
    path, clock, stop = tmp_path / "walk.rec", SystemClock(), threading.Event()
    with pytest.raises(TrackerError, match=r"walk\.rec: cannot read"):
        SurviveFile("tracker", None, path, clock, stop)
    path.write_bytes(HEAD)
    with pytest.raises(TrackerError, match=r"no pose of a device; there is WM0 \(serial LHR-1A2B3C4D\)"):
        SurviveFile("tracker", None, path, clock, stop)
    path.write_bytes(HEAD + pose(8.0) + pose(8.1, "T20"))
    with pytest.raises(TrackerChoiceError):
        SurviveFile("tracker", None, path, clock, stop)
    with pytest.raises(TrackerError, match="no pose of LHR-7"):
        SurviveFile("tracker", "LHR-7", path, clock, stop)
    assert len(read(SurviveFile("tracker", "T20", path, clock, stop), 3)) == 1
