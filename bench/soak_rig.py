"""The rig of the soak: a master, two marker cameras, a wrist camera and an IMU, each a real process of this machine.

All that a real rig runs is run: drawn frames are detected, sealed and sent by UDP, clocks differ and drift, the wrist
device strobes, one master makes one hand of both, the bus is encrypted by keys of this run. Only the rate is chosen, so
that a small machine keeps up.
"""

import json
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from bench.local_rig import free_port
from common.bus.keys import FOLDER
from deploy.process import Process

CALIBRATION = Path(__file__).resolve().parents[1] / "calib_json"
RIGS = ("desk", "wrist")
CAMERAS = {"left": "desk", "right": "desk", "wrist": "wrist"}
SCENE = "both-poses"  # closed: it can go on for ever; slow enough for three frames of a triple at a low rate
DRIFT_PPM = {"left": 20.0, "right": -35.0, "wrist": 50.0, "imu": 8.0}
MASTER = "master"
_LEAD_S = 6.0  # until the hand begins to move


@dataclass(frozen=True, slots=True)
class SoakSettings:
    """How a soak is run.

    Attributes:
        minutes: How long.
        out: Folder for figures, plot, logs and the files of the rig.
        marker_hz: Rate of both marker cameras.
        wrist_hz: Frames of the wrist camera in a second; three make a triple.
        every_s: How often the memory of the processes is read.
        nice: By how many steps of the scheduler it gives way to others; below 0 it goes before them.
    """

    minutes: float
    out: Path
    marker_hz: float
    wrist_hz: float
    every_s: float
    nice: int


@dataclass(frozen=True, slots=True)
class SoakRig:
    """What runs: its processes, and where its bus listens."""

    processes: tuple[Process, ...]
    bus: str


@contextmanager
def running(settings: SoakSettings) -> Generator[SoakRig]:
    """Start all of it; end all of it on leaving.

    Raises:
        OSError: The folder cannot be written.
        subprocess.CalledProcessError: No keys can be made; why has been printed.
    """
    settings.out.mkdir(parents=True, exist_ok=True)
    tree = settings.out / "calib_json"
    shutil.rmtree(tree, ignore_errors=True)
    shutil.copytree(CALIBRATION, tree)
    for name in CAMERAS:
        _set_rate(
            tree / "cameras" / f"{name}.json", settings.wrist_hz if name == "wrist" else settings.marker_hz
        )
    os.environ[FOLDER] = str(
        _keys(settings.out / "keys")
    )  # for this process, which joins the bus, and all it starts
    bus = f"tls/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    beacon, data = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_DGRAM)
    environment = {"PYTHONUNBUFFERED": "1", "OPENBLAS_NUM_THREADS": "1"}
    place = ["--calibration", str(tree)]
    link = ["--bind", "127.0.0.1", "--beacon-port", str(beacon)]
    rigs = [word for rig in RIGS for word in ("--rig", rig)]
    ends = ["--beacon", f"127.255.255.255:{beacon}", "--bind", f"127.0.0.1:{data}", "--bus", bus]
    commands = {MASTER: ["master", "run", *rigs, *place, *ends]}
    for name, rig in CAMERAS.items():
        commands[name] = [
            "slave",
            "run",
            "--camera",
            "synthetic",
            "--name",
            name,
            "--rig",
            rig,
            *place,
            *link,
        ]
    commands["imu"] = ["slave", "run", "--imu", "synthetic", "--name", "imu", "--rig", "wrist", *place, *link]
    epoch_ns = time.monotonic_ns() + round(1e9 * _LEAD_S)
    with ExitStack() as stack:
        processes: list[Process] = []
        for name, command in commands.items():
            if name != MASTER:
                command += ["--scene", SCENE, "--scene-epoch-ns", str(epoch_ns)]
                command += ["--clock-ppm", str(DRIFT_PPM[name])]
            log = settings.out / f"{name}.log"
            full = [sys.executable, "-m", *command]
            process = Process(name, full, environment, log, lambda _name, _line: None, settings.nice)
            stack.callback(process.stop)
            processes.append(process)
        yield SoakRig(tuple(processes), bus)


def _keys(folder: Path) -> Path:
    """A keys folder of this run.

    Raises:
        subprocess.CalledProcessError: It cannot be made; why has been printed.
    """
    shutil.rmtree(folder, ignore_errors=True)
    devices = [word for name in (*CAMERAS, "imu") for word in ("--device", name)]
    make = [sys.executable, "-m", "master", "fleet", "keys", str(folder), "--make", *devices]
    subprocess.run(make, check=True, stdout=subprocess.DEVNULL)
    return folder


def _set_rate(camera: Path, rate_hz: float) -> None:
    """Write another frame rate into a camera file."""
    settings = json.loads(camera.read_text())
    settings["frame_rate_hz"] = rate_hz
    camera.write_text(json.dumps(settings, indent=1) + "\n")
