"""One camera, two users: `record`, `colours` and `doctor` as programs beside a slave that has the camera."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Generator
from itertools import pairwise
from pathlib import Path
from shutil import copytree

import cv2
import numpy as np
import pytest

from bench.rigs.local import Rig, until
from common.recording.frame_recording import open_recording
from tests.common.recording.test_frame_writing import check_whole

ROOT = Path(__file__).resolve().parents[2]
UP_S = 60.0
FAKE = "tests.slave.shared_program"


class SharedRig(Rig):
    """A rig whose slaves and readers find each other in its folder, and no service of this machine."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.tree = copytree(ROOT / "calib_json", folder / "calib_json")
        for name in ("left", "right"):
            self.edit(name, frame_rate_hz=30.0)
        self.environment |= {"XDG_RUNTIME_DIR": str(folder), "PHALANX_SYSTEM_ROOT": str(folder)}
        self.place = ["--name", "left", "--rig", "desk", "--calibration", str(self.tree)]

    def edit(self, camera: str, **changes: object) -> None:
        path = self.tree / "cameras" / f"{camera}.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))

    def slave(self, *camera: str, program: tuple[str, ...] = ("slave",)) -> None:
        """Start the slave `left`, and wait until it has its camera."""
        link = ["--bind", "127.0.0.1", "--beacon-port", str(self.beacon_port)]
        self.start("left", *program, "run", *self.place, *link, "--camera", *camera, ready="ready, waiting")

    def program(self, *words: str) -> "subprocess.Popen[str]":
        """Start a program beside it."""
        return subprocess.Popen(
            [sys.executable, "-m", *words],
            cwd=ROOT,
            env=self.environment,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )

    def run(self, *words: str) -> tuple[int, str]:
        """Run one to its end: exit code and output."""
        program = self.program(*words)
        output, _ = program.communicate(timeout=UP_S)
        return program.returncode, output

    @property
    def log(self) -> str:
        return (self.folder / "left.log").read_text()


@pytest.fixture
def rig(tmp_path: Path) -> Generator[SharedRig, None, None]:
    made = SharedRig(tmp_path)
    yield made
    made.close()


def pictures(folder: Path) -> list[np.ndarray]:
    """The left camera's pictures as they are in their files."""
    found = [
        cv2.imread(str(folder / row.file), cv2.IMREAD_UNCHANGED)
        for row in open_recording(folder).frames_of("left")
    ]
    return [np.asarray(one) for one in found]


def test_a_replayed_camera_is_recorded_to_the_last_bit_and_coloured(rig: SharedRig, tmp_path: Path) -> None:
    scene = ["--camera", "synthetic", "--every-frame", "--scene-epoch-ns", "0", "--frames", "40"]
    place = [*rig.place, "-o"]
    assert rig.run("slave", "record", *scene, *place, str(tmp_path / "source"))[0] == 0
    rig.slave(f"replay:{tmp_path / 'source'}")
    words = ["--name", "left", "--camera", "service", "--note", "shared", "--frames", "40"]
    code, output = rig.run("slave", "record", *words, "-o", str(tmp_path / "wave"))
    assert code == 0, output
    assert "40 frames in" in output
    assert "0 dropped, 0 lost by the camera" in output
    source, wave = open_recording(tmp_path / "source"), open_recording(tmp_path / "wave")
    for one, other in zip(pictures(source.folder), pictures(wave.folder), strict=True):
        np.testing.assert_array_equal(one, other)
    for key in ("seq", "illumination"):
        assert [getattr(row, key) for row in source.rows] == [getattr(row, key) for row in wave.rows]
    # as a direct recording has them: one shift, of the replay, for all times
    assert len({other.t_ns - one.t_ns for one, other in zip(source.rows, wave.rows, strict=True)}) == 1
    assert wave.manifest.cameras == source.manifest.cameras
    assert (wave.manifest.rig, wave.manifest.objects) == (source.manifest.rig, source.manifest.objects)
    assert (wave.manifest.note, wave.manifest.kind) == ("shared", "markers")
    assert wave.manifest.clock is not None
    boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    assert wave.manifest.clock.id == boot
    code, output = rig.run(
        "slave", "colours", str(tmp_path / "wave"), "--camera", "left", "--like", str(rig.tree / "cameras/left.json"),
        "-o", str(tmp_path / "left.json"),
    )  # fmt: skip
    assert "reading 40 of 40 frames" in output, output


def test_a_wrist_camera_keeps_its_light(rig: SharedRig, tmp_path: Path) -> None:
    rig.place = ["--name", "wrist", "--rig", "wrist", "--calibration", str(rig.tree)]
    rig.slave("synthetic")
    code, output = rig.run(
        "slave", "record", "--name", "wrist", "--camera", "service", "--frames", "60", "-o", str(tmp_path / "wave")
    )  # fmt: skip
    assert code == 0, output
    rows = open_recording(tmp_path / "wave").rows
    assert {row.illumination.value for row in rows} >= {"laser", "led", "ambient"}
    assert np.asarray(cv2.imread(str(tmp_path / "wave" / rows[0].file), cv2.IMREAD_UNCHANGED)).ndim == 2
    assert open_recording(tmp_path / "wave").manifest.kind == "wrist"


def test_a_camera_that_the_slave_has_is_recorded_and_looked_at_through_it(
    rig: SharedRig, tmp_path: Path
) -> None:
    fake = (FAKE, str(tmp_path / "camera.lock"))
    rig.slave("picamera2", program=fake)
    pi = [*rig.place, "--camera", "picamera2"]
    code, output = rig.run(*fake, "record", *pi, "--frames", "20", "-o", str(tmp_path / "wave"))
    assert code == 0, output
    assert "a running slave has the camera, and gives its frames" in output
    assert check_whole(tmp_path / "wave") == 20
    rows, seen = open_recording(tmp_path / "wave").rows, pictures(tmp_path / "wave")
    numbers = [int(picture[0, 0, 2]) for picture in seen]  # the stand-in's
    assert all((one == (200, 100, number)).all() for one, number in zip(seen, numbers, strict=True))
    assert len({(number - row.seq) % 256 for number, row in zip(numbers, rows, strict=True)}) == 1
    code, output = rig.run(*fake, "doctor", *pi, "--beacon-port", str(rig.beacon_port))
    assert "the running service has it, and gave 10 frames of it" in output
    # files of other settings than the slave's: refused, and the slave goes on
    rig.edit("left", exposure_us=4000.0)
    code, output = rig.run(*fake, "record", *pi, "--frames", "20", "-o", str(tmp_path / "other"))
    assert code == 1
    assert (
        "'left' is the camera of a running slave, with exposure_us 5000.0, not 4000.0: give the same"
        in output
    )
    assert not (tmp_path / "other").exists()
    # another place of the same kind is another camera
    code, output = rig.run(
        *fake, "record", *rig.place, "--camera", "picamera2:1", "-o", str(tmp_path / "other")
    )
    assert code == 1
    assert "picamera2:1: no such camera" in output
    # without the socket it is as with any other program that has it
    (tmp_path / "phalanx/left/frames").unlink()
    code, output = rig.run(*fake, "record", *pi, "-o", str(tmp_path / "other"))
    assert code == 1
    assert "cannot be opened" in output
    assert "another program may have it: `sudo fuser -v /dev/media*` names it" in output
    assert rig.alive("left")


def test_a_reader_that_stops_or_dies_costs_the_slave_nothing(rig: SharedRig, tmp_path: Path) -> None:
    rig.slave("synthetic")
    words = ("slave", "record", "--name", "left", "--camera", "service", "-o")
    slow, killed = (rig.program(*words, str(tmp_path / name)) for name in ("slow", "killed"))
    assert until(
        lambda: all((tmp_path / f"{one}/left/000005.png").exists() for one in ("slow", "killed")), UP_S
    )
    slow.send_signal(signal.SIGSTOP)  # for less than what a reader is given up after
    before = len(list((tmp_path / "killed/left").glob("*.png")))
    assert until(lambda: (tmp_path / f"killed/left/{before + 60:06d}.png").exists(), UP_S)
    slow.send_signal(signal.SIGCONT)
    killed.kill()
    killed.communicate()
    # while one stood still, the other had every frame that the slave drew
    assert until(
        lambda: f"frames read by process {killed.pid} of user {os.geteuid()}, 0 dropped" in rig.log, UP_S
    ), rig.log
    time.sleep(1.0)
    slow.send_signal(signal.SIGINT)
    output, _ = slow.communicate(timeout=UP_S)
    assert slow.returncode == 0, output
    assert "frames dropped: this program was too slow" in output
    rows = open_recording(tmp_path / "slow").rows
    gaps = [b.seq - a.seq for a, b in pairwise(rows)]
    assert max(gaps) > 10
    assert rig.alive("left")
    assert rig.run(*words, str(tmp_path / "again"), "--frames", "5")[0] == 0


def test_a_slave_that_is_killed_and_comes_back_leaves_a_gap(rig: SharedRig, tmp_path: Path) -> None:
    rig.slave("synthetic")
    reader = rig.program(
        "slave", "record", "--name", "left", "--camera", "service", "-o", str(tmp_path / "wave")
    )
    assert until(lambda: (tmp_path / "wave/left/000010.png").exists(), UP_S)
    rig.kill("left")
    time.sleep(1.0)
    rig.slave("synthetic")
    count = len(list((tmp_path / "wave/left").glob("*.png")))
    assert until(lambda: (tmp_path / f"wave/left/{count + 20:06d}.png").exists(), UP_S)
    reader.send_signal(signal.SIGINT)
    output, _ = reader.communicate(timeout=UP_S)
    assert reader.returncode == 0, output
    assert "slave left: lost: slave 'left' has ended" in output
    assert "slave left: back after loss number 1" in output
    rows = list(csv.DictReader((tmp_path / "wave/frames.csv").open()))
    seqs, times = ([int(row[key]) for row in rows] for key in ("seq", "t_ns"))
    assert seqs == sorted(set(seqs))
    assert times == sorted(set(times))
    away = max(range(1, len(seqs)), key=lambda k: times[k] - times[k - 1])
    assert seqs[away] - seqs[away - 1] == round((times[away] - times[away - 1]) * 30e-9)
    check_whole(tmp_path / "wave")


def test_ctrl_c_ends_a_recording_whose_slave_is_away(rig: SharedRig, tmp_path: Path) -> None:
    rig.slave("synthetic")
    reader = rig.program(
        "slave", "record", "--name", "left", "--camera", "service", "-o", str(tmp_path / "wave")
    )
    assert until(lambda: (tmp_path / "wave/left/000010.png").exists(), UP_S)
    os.kill(rig.processes["left"].pid, signal.SIGTERM)
    rig.processes["left"].wait(UP_S)
    time.sleep(0.5)
    reader.send_signal(signal.SIGINT)
    output, _ = reader.communicate(timeout=5.0)
    assert reader.returncode == 0, output
    assert check_whole(tmp_path / "wave") >= 10
