"""What it costs a master to be watched: processor time of its process per pose, with console, recording and four live
outputs, against the same process without them, in turns of one run.

Two cameras at 30 Hz, not drawn (`bench.detections_sender`), over sealed UDP. Watchers are processes of their
own and share the machine; what they cost themselves is a row of its own. Nothing may be lost.
"""

import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import median

import zenoh

from bench.local_rig import free_port, join_bus
from bench.row import Row
from common.bus.keys import new_key
from common.errors import BusError
from common.messages import Command, Health
from common.messages.streams import MASTER
from master.outputs.network.sender import NAME as SENDER

CALIBRATION = Path(__file__).resolve().parents[1] / "calib_json"
TURNS, SECONDS, SETTLE_S, READY_S, RATE_HZ = 6, 12.0, 6.0, 60.0, 30.0
OUTPUTS = ("osc", "vmc", "ros2", "web")
_TICKS = os.sysconf("SC_CLK_TCK")
_BROWSER = ("chromium", "chromium-browser", "google-chrome")


def rows() -> Iterator[Row]:
    """Cost of a pose without and with watchers, in turns; what was lost; what the watchers take."""
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        run = _Run(folder, stack)
        run.wait_for_poses()
        alone: list[float] = []
        watched: list[float] = []
        taken: list[float] = []
        for turn in range(TURNS):
            alone.append(run.cost_us(SECONDS))
            with run.watchers(folder / f"turn{turn}.mcap") as pids:
                time.sleep(SETTLE_S)
                before = sum(cpu_s(pid) for pid in pids)
                watched.append(run.cost_us(SECONDS))
                taken.append((sum(cpu_s(pid) for pid in pids) - before) / SECONDS)
            time.sleep(2.0)
        end = run.report()
    base = median(alone)
    yield Row(
        "a pose, nobody watches",
        base,
        "us",
        f"{min(alone):.0f} ... {max(alone):.0f}, {TURNS} turns; baseline",
    )
    yield Row("a pose, all watch", median(watched), "us", f"{min(watched):.0f} ... {max(watched):.0f}")
    ratios = [100.0 * (w / a - 1.0) for a, w in zip(alone, watched, strict=True)]
    yield Row("  more", median(ratios), "%", f"{min(ratios):.1f} ... {max(ratios):.1f}; goal 10")
    yield Row("messages that the outputs were too slow to take", float(sum(run.untaken)), "", "goal 0")
    lost = sum(end.counts.get(f"{camera}.lost", 0) for camera in ("left", "right"))
    yield Row("frames lost or dropped", float(lost + end.counts.get("queue.dropped", 0)), "", "goal 0")
    yield Row(
        "what the watchers take themselves", 100.0 * median(taken), "%", "of one core, without the browser"
    )


class _Run:
    """A master that tracks. Holds its process, its bus and what its watchers need.

    Attributes:
        untaken: How many messages the outputs of each turn lost on the way to them.
    """

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.untaken: list[int] = []
        self._folder, self._key = folder, new_key()
        beacon, data = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_DGRAM)
        self._end = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        self._router = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        self._tree = folder / "calib_json"
        shutil.copytree(CALIBRATION, self._tree)
        self._set_outputs(stack)
        place = ["--beacon", f"127.255.255.255:{beacon}", "--bind", f"127.0.0.1:{data}", "--bus", self._end]
        self._master = self._start("master", ["-m", "master", "run", "--rig", "desk", *place])
        stack.callback(end, self._master)
        sender = self._start("sender", ["-m", "bench.detections_sender", str(beacon), "3600", str(RATE_HZ)])
        stack.callback(end, sender)
        self._bus = join_bus(self._end, READY_S)
        stack.callback(self._bus.close)

    def report(self) -> Health:
        """How the master is."""
        return self._bus.ask(Command(MASTER, "report"), 5.0)

    def wait_for_poses(self) -> None:
        """Until it tracks."""
        until = time.monotonic() + READY_S
        while self.report().counts["poses"] < 300:
            if time.monotonic() > until:
                raise RuntimeError(f"no poses: {(self._folder / 'master.log').read_text()[-500:]}")
            time.sleep(0.5)

    def cost_us(self, seconds: float) -> float:
        """Processor time of the master's process for each pose of the next seconds [us]."""
        poses, cpu = self.report().counts["poses"], cpu_s(self._master.pid)
        time.sleep(seconds)
        spent = cpu_s(self._master.pid) - cpu
        return 1e6 * spent / (self.report().counts["poses"] - poses)

    @contextmanager
    def watchers(self, recording: Path) -> Generator[list[int]]:
        """Console with a browser that looks, recorder and outputs run; their process ids, without the browser's."""
        port = free_port(socket.SOCK_STREAM)
        tree, bus = ["--calibration", str(self._tree)], ["--bus", self._end]
        commands = {
            "record": ["-m", "master", "record", str(recording), "--rig", "desk", *tree, *bus],
            "send": ["-m", "master", "send", "--only", ",".join(OUTPUTS), *tree, *bus],
            "console": ["-m", "master", "console", "--rig", "desk", *tree, *bus, "--port", str(port)],
        }
        with ExitStack() as stack:
            started = [self._start(name, command) for name, command in commands.items()]
            for one in started:
                stack.callback(end, one)
            wait_for_port(port)
            browser = look(f"http://127.0.0.1:{port}/", self._folder)
            stack.callback(end, browser)
            self._wait_for_outputs()
            yield [one.pid for one in started]
            for name, one in zip(commands, started, strict=True):
                if one.poll() is not None:
                    raise RuntimeError(f"{name} ended: {(self._folder / f'{name}.log').read_text()[-500:]}")
            if browser.poll() is not None:
                raise RuntimeError(f"the browser ended with {browser.returncode}: nobody looked")
            self.untaken.append(self._bus.ask(Command(SENDER, "report"), 5.0).counts["lost"])

    def _wait_for_outputs(self) -> None:
        """Until all of them are open: one that is not costs nobody anything."""
        until = time.monotonic() + READY_S
        while True:
            try:
                metrics = self._bus.ask(Command(SENDER, "report"), 5.0).metrics
                if all(metrics[f"open.{name}"] for name in OUTPUTS):
                    return
            except BusError:  # it is not there yet
                pass
            if time.monotonic() > until:
                raise RuntimeError(f"outputs: {(self._folder / 'send.log').read_text()[-500:]}")
            time.sleep(0.3)

    def _set_outputs(self, stack: ExitStack) -> None:
        """Outputs go to sockets of ours and to a router of ours."""
        sink = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        sink.bind(("127.0.0.1", 0))
        quiet = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
        router = {"mode": "router", "listen": {"endpoints": [self._router]}, "scouting": quiet}
        stack.enter_context(zenoh.open(zenoh.Config.from_json5(json.dumps(router))))
        file = self._tree / "outputs" / "default.json"
        settings = json.loads(file.read_text())
        for name, port in (("osc", sink.getsockname()[1]), ("vmc", sink.getsockname()[1])):
            settings[name]["port"] = port
        settings["web"]["port"] = free_port(socket.SOCK_STREAM)
        settings["ros2"]["router"] = self._router
        file.write_text(json.dumps(settings))

    def _start(self, name: str, command: list[str]) -> subprocess.Popen[bytes]:
        with (self._folder / f"{name}.log").open("wb") as log:
            environment = os.environ | {"PHALANX_RIG_KEY": self._key}
            return subprocess.Popen([sys.executable, *command], env=environment, stdout=log, stderr=log)


def cpu_s(pid: int) -> float:
    """Processor time of a process and all its threads since it began [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS


def look(url: str, folder: Path) -> subprocess.Popen[bytes]:
    """A browser that shows the page, and gives way to all that is measured."""
    program = next((found for name in _BROWSER if (found := shutil.which(name)) is not None), None)
    if program is None:
        raise RuntimeError("no Chromium: `make browser`")
    options = ["--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    profile = [f"--user-data-dir={folder / 'browser'}", "--remote-debugging-port=0"]
    command = ["nice", "-n", "15", program, *options, *profile, url]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def end(process: subprocess.Popen[bytes]) -> None:
    """Stop a process, kindly first."""
    process.send_signal(2)
    killer = threading.Timer(10.0, process.kill)
    killer.start()
    process.wait()
    killer.cancel()


def wait_for_port(port: int) -> None:
    """Until somebody listens there."""
    until = time.monotonic() + READY_S
    while True:
        try:
            socket.create_connection(("127.0.0.1", port), 1.0).close()
            return
        except OSError:
            if time.monotonic() > until:
                raise
            time.sleep(0.2)
