"""The demo runs simulated sensors and a master as processes of this machine.

A slave for each camera, IMU and tracker of its rigs, all synthetic, the master and the viewer. Real sealed UDP on
127.0.0.1, real zenoh over TLS, with keys that are made for this run and gone after it. The slaves' clocks have
different zeros and rates, and each camera runs 5 ms after the one before.
"""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, cast

from deploy.deployment import make_keys
from deploy.payload import RigFile, read_rig
from deploy.process import Process
from deploy.remote import DeployError

SensorKind = Literal["camera", "imu", "tracker"]

# seen by both kinds of rig alike
TWO_RIG_SCENES = ("grasp", "both-poses", "both-curl", "both-travel", "both-moves", "gestures")
# Scene -> its rigs, where it is no other than `desk`.
_BEST = {
    **dict.fromkeys(TWO_RIG_SCENES, ("desk-back3", "wrist-back3")),
    "object": ("desk-wand",),
    "hands": ("desk-both",),
    "gestures": ("desk4",),  # fingers that bend towards one pair are seen by the other
}


@dataclass(frozen=True, slots=True)
class Sensor:
    """A camera, an IMU or a tracker of a rig, and the scene that it senses."""

    name: str
    rig: str
    scene: str
    kind: SensorKind = "camera"


def best_rigs(scene: str) -> tuple[str, ...]:
    """The rigs that a scene is played before, if the user chooses none."""
    return _BEST.get(scene.partition("@")[0], ("desk",))


def sensors_of(calibration: Path, rigs: tuple[str, ...], scene: str) -> list[Sensor]:
    """Return cameras of all rigs, then placed IMUs, then trackers on objects.

    Raises:
        DeployError: A rig cannot be read, two have a sensor of the same name, or rigs of one hand would each
            see another.
    """
    read = {name: read_rig(calibration, name) for name in rigs}
    if len(read) < len(rigs):
        raise DeployError(f"--rig {' --rig '.join(rigs)}: a rig stands twice")
    moves, _, light = scene.partition("@")
    hands = [rig.hand for rig in read.values()]
    if len(set(hands)) < len(hands) and moves not in TWO_RIG_SCENES:
        raise DeployError(
            f"--scene {scene}: rigs {', '.join(read)} see one hand together only in {', '.join(TWO_RIG_SCENES)}"
        )
    if moves == "object" and not any(rig.objects for rig in read.values()):
        raise DeployError(
            f"--scene object: rig {', '.join(read)} tracks no object; --rig desk-wand or desk-cube does"
        )
    has_wrist_rig = any(rig.kind == "wrist" for rig in read.values())
    found: dict[SensorKind, list[Sensor]] = {"camera": [], "imu": [], "tracker": []}
    for name, rig in read.items():
        # The light behind the @ is that of a wrist device; cameras that watch markers have their own.
        own = moves if light and has_wrist_rig and rig.kind == "markers" else scene
        found["camera"] += [Sensor(one, name, own) for one in rig.cameras]
        if rig.imu is not None and rig.imu_placed:
            found["imu"].append(Sensor(rig.imu, name, own, "imu"))
        found["tracker"] += [Sensor(one, name, own, "tracker") for one in _trackers(calibration, rig)]
    sensors = [*found["camera"], *found["imu"], *found["tracker"]]
    names = [sensor.name for sensor in sensors]
    if twice := [name for name in names if names.count(name) > 1]:
        raise DeployError(
            f"rigs {', '.join(read)}: {twice[0]!r} stands twice; every sensor has a name of its own"
        )
    return sensors


def rig_options(rigs: tuple[str, ...]) -> list[str]:
    """`--rig` for each."""
    return [word for rig in rigs for word in ("--rig", rig)]


def _trackers(calibration: Path, rig: RigFile) -> list[str]:
    """The trackers on the objects of a rig."""
    files = [calibration / "objects" / f"{one}.json" for one in rig.objects]
    try:
        return [str(tracker) for file in files if (tracker := json.loads(file.read_text()).get("tracker"))]
    except (AttributeError, OSError, ValueError, RecursionError) as error:
        raise DeployError(f"{calibration}: cannot read the objects of rig {rig.name!r} ({error})") from error


_STALE = ("summary.json", "live.json", "poses.npz", "hand.png", "run.rrd", "object_*.npz", "contact_*.npz",
          "gestures.jsonl")  # fmt: skip
_KNOWN_S = 1.0
# What draws pictures gives way to what is measured: a real camera costs no processor its time.
_GIVES_WAY = 4
_LATE_MS, _APART_PPM = 5.0, 50.0


@dataclass(frozen=True, slots=True)
class DemoSettings:
    """What the user chose.

    Attributes:
        seconds: Length of the tracked run.
        headless: No viewer. A picture and an .rrd are written in any case.
        out: Folder for logs and results.
        calibration: calib_json tree.
        rigs: Rigs to simulate, which one master runs.
        scene: What moves, by the names of `common.sim.scenes`.
        web: The viewer is a page on 127.0.0.1 instead of a window.
        bus: Endpoint of the master's bus; None: encrypted, on a port that is free.
        console: The console, a page as well, takes the viewer's place.
    """

    seconds: float
    headless: bool
    out: Path
    calibration: Path
    rigs: tuple[str, ...]
    seed: int
    scene: str = "standard"
    web: bool = False
    bus: str | None = None
    console: bool = False

    def sensors(self) -> list[Sensor]:
        """What is simulated; see `sensors_of`."""
        return sensors_of(self.calibration, self.rigs, self.scene)


@dataclass(slots=True)
class _State:
    """State that the processes have reported so far."""

    tracking: threading.Event = field(default_factory=threading.Event)
    rate: float = 0.0
    viewer: str | None = None
    viewer_ended: bool = False
    printed: set[str] = field(default_factory=set[str])

    def on_line(self, name: str, line: str) -> None:
        """Take a line of a process."""
        if name == "master":
            if line.endswith("tracking"):
                self.tracking.set()
            elif match := re.search(r"rate (\d+) poses/s", line):
                self.rate = float(match[1])
        elif name == "viewer" and line.startswith("master: ") and "waiting" not in line:
            self.viewer = line.removeprefix("master: ")


def run_demo(
    settings: DemoSettings, stop: threading.Event, notify: Callable[[str], None]
) -> dict[str, object]:
    """Run the demo and return its summary.

    When `stop` is set, by Ctrl-C, the run ends early, cleanly, and is summed up all the same.

    Raises:
        DeployError: A process does not come up, or the results cannot be made.
    """
    with demo_keys(settings) as keys:
        epoch_ns = time.monotonic_ns() + round(1e9 * lead_s(len(settings.sensors()) + 1, os.getloadavg()[0]))
        restarts = play(settings, keys, epoch_ns, stop, notify)
    summary = _report(settings, epoch_ns, notify)
    if restarts:
        summary["restarts"] = restarts
        (settings.out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    return summary


@contextmanager
def demo_keys(settings: DemoSettings) -> Generator[Path, None, None]:
    """Provide a private keys folder for one run, gone at the end of the block."""
    with tempfile.TemporaryDirectory(prefix="phalanx-demo-") as private:
        folder = Path(private) / "keys"
        make_keys(folder, [sensor.name for sensor in settings.sensors()], lambda _line: None)
        yield folder


def lead_s(processes: int, load: float) -> float:
    """Return how long after process start [s] the scene begins, with others' `load`."""
    # Until the scene begins: two seconds of a core's time for each process to be ready, shared with whatever else
    # runs, and one in which cameras already look at the hand, which does not move yet, so that the light is known
    # and a hand found.
    # Poses before the scene are not judged. An IMU begins with it: its filter settles while the hand still rests.
    ready_s = 2.0 * (processes + load) / (os.cpu_count() or 1)
    return min(max(ready_s + _KNOWN_S, 4.0), 20.0)


def play(
    settings: DemoSettings, keys: Path, epoch_ns: int, stop: threading.Event, notify: Callable[[str], None]
) -> dict[str, int]:
    """Run the processes for as long as wanted; return who was restarted how often.

    The master leaves live.json and poses.npz. The scene begins at `epoch_ns` on this machine's monotonic
    clock; `stop` ends the run early.

    Raises:
        DeployError: A process does not come up.
    """
    out = settings.out
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DeployError(f"--out {out}: cannot make the folder: {error.strerror}") from error
    for stale in _STALE:
        for file in out.glob(stale):
            file.unlink()
    state = _State()
    processes: list[Process] = []
    try:
        drawn = {sensor.name for sensor in settings.sensors() if sensor.kind == "camera"}
        for name, command, environment in _table(settings, keys, epoch_ns):
            nice = _GIVES_WAY if name in drawn else 0
            processes.append(Process(name, command, environment, out / f"{name}.log", state.on_line, nice))
        if settings.bus is not None and not settings.bus.startswith("tcp/"):
            notify(f"programs that read along at {settings.bus} need PHALANX_KEYS={keys}")
        notify(f"started {', '.join(f'{p.name} (pid {p.pid})' for p in processes)}; logs in {out}")
        _wait_until_tracking(state, processes, stop, notify)
        _until_end(settings, state, processes, epoch_ns, stop, notify)
    finally:
        _stop(processes)
    return {p.name: p.restarts for p in processes if p.restarts}


def _stop(processes: list[Process]) -> None:
    """End all processes, also where somebody presses Ctrl-C again meanwhile."""
    try:
        # The master first: slaves that end under it would look like lost frames.
        for process in sorted(processes, key=lambda p: p.name not in ("master", "viewer")):
            process.stop()
    except KeyboardInterrupt:
        for process in processes:
            process.kill()
        raise


def _table(settings: DemoSettings, keys: Path, epoch_ns: int) -> list[tuple[str, list[str], dict[str, str]]]:
    """The process table: name, command line, environment."""
    key = {"PHALANX_KEYS": str(keys), "PYTHONUNBUFFERED": "1"}
    beacon, data = _free_port(socket.SOCK_DGRAM), _free_port(socket.SOCK_DGRAM)
    bus = settings.bus or f"tls/127.0.0.1:{_free_port(socket.SOCK_STREAM)}"
    tree = ["--calibration", str(settings.calibration)]
    rows: list[tuple[str, list[str], dict[str, str]]] = []
    link = ["--bind", "127.0.0.1", "--beacon-port", str(beacon)]
    played = ["--seed", str(settings.seed), "--scene-epoch-ns", str(epoch_ns)]
    for index, sensor in enumerate(settings.sensors()):
        command = [
            sys.executable,
            "-m",
            "slave",
            "run",
            f"--{sensor.kind}",
            "synthetic",
            "--name",
            sensor.name,
        ]
        command += ["--rig", sensor.rig, *tree, "--scene", sensor.scene, *played, *link]
        command += ["--clock-offset-ms", str(1234.5 * (index + 1)), "--clock-ppm", str(_APART_PPM * index)]
        if sensor.kind == "camera":
            command += ["--start-offset-ms", str(_LATE_MS * index - 1e3 * _KNOWN_S)]
        rows.append((sensor.name, command, key))
    files = ["--poses", str(settings.out / "poses.npz"), "--summary", str(settings.out / "live.json")]
    address = ["--beacon", f"127.255.255.255:{beacon}", "--bind", f"127.0.0.1:{data}"]
    shared = [*rig_options(settings.rigs), *tree, "--bus", bus]
    rows.append(("master", [sys.executable, "-m", "master", "run", *shared, *address, *files], key))
    if settings.console or not settings.headless:
        page = ["--port", "0"] if settings.console else []
        if settings.web and not settings.console:
            page = ["--web", "--web-port", str(_free_port(socket.SOCK_STREAM))]
        viewer = "console" if settings.console else "view"
        rows.append(("viewer", [sys.executable, "-m", "master", viewer, *shared, *page], key))
    return rows


def _free_port(kind: int) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _wait_until_tracking(
    state: _State, processes: list[Process], stop: threading.Event, notify: Callable[[str], None]
) -> None:
    notify("waiting until every camera is there and the first pose is out ...")
    ready_s = 90.0  # on a machine that has other things to do; an ended process is reported at once
    deadline = time.monotonic() + ready_s
    while not state.tracking.wait(0.1):
        if stop.is_set():
            return
        _look_at_viewer(state, processes, notify)
        failed = next((p for p in processes if p.name != "viewer" and p.ended() is not None), None)
        if failed is not None or time.monotonic() > deadline:
            late = failed or next(p for p in processes if p.name == "master")
            what = "ended" if failed else f"no pose after {ready_s:.0f} s"
            raise DeployError(f"{late.name}: {what}; its last lines:\n  " + "\n  ".join(late.tail))


def _look_at_viewer(state: _State, processes: list[Process], notify: Callable[[str], None]) -> None:
    """Report the viewer's address once, and once its end; the run goes on."""
    viewer = next((p for p in processes if p.name == "viewer"), None)
    if viewer is None:
        return
    line = f"viewer: {state.viewer}" if state.viewer else ""
    if (code := viewer.ended()) is not None:
        if not state.viewer_ended:  # its last words come a moment later
            state.viewer_ended = True
            return
        reason = viewer.tail[-1].removeprefix("phalanx: ") if viewer.tail else f"exit code {code}"
        line = f"no viewer: {reason}; the run goes on" if code else "the viewer was closed; the run goes on"
    if line and line not in state.printed:
        state.printed.add(line)
        notify(line)


def _until_end(
    settings: DemoSettings,
    state: _State,
    processes: list[Process],
    epoch_ns: int,
    stop: threading.Event,
    notify: Callable[[str], None],
) -> None:
    """Run for the wanted time, reporting the rate and any restarted process."""
    end = max(time.monotonic(), epoch_ns * 1e-9) + settings.seconds
    next_line = 0.0
    while not stop.is_set() and (left := end - time.monotonic()) > 0:
        stop.wait(min(0.05, left))
        _look_at_viewer(state, processes, notify)
        for process in processes:
            if process.name == "viewer":
                continue
            if (code := process.check()) is not None:
                reason = f" ({process.tail[-1]})" if code > 0 and process.tail else ""
                notify(f"{process.name} ended with code {code}{reason}: started again")
        if time.monotonic() >= next_line:
            next_line = time.monotonic() + 1.0
            done = min(settings.seconds, max(0.0, settings.seconds - left))
            notify(f"\r{done:4.0f} of {settings.seconds:.0f} s   {state.rate:3.0f} poses/s")


def _report(settings: DemoSettings, epoch_ns: int, notify: Callable[[str], None]) -> dict[str, object]:
    out = settings.out
    if not (out / "live.json").exists():
        log = out / "master.log"
        last = (log.read_text(errors="replace").splitlines() or ["nothing"])[-1].partition(" ")[2]
        raise DeployError(f"the master wrote no summary; its last line in {log}: {last}")
    notify("comparing with the exact truth, drawing the hand ...")
    scene = ["--scene", settings.scene, "--seed", str(settings.seed)]
    place = [*rig_options(settings.rigs), "--calibration", str(settings.calibration), *scene]
    files = ["--poses", str(out / "poses.npz"), "--summary", str(out / "live.json"), "--out", str(out)]
    command = [sys.executable, "-m", "master.commands.report", *place, *files]
    command += ["--scene-epoch-ns", str(epoch_ns)]
    # A session of its own: the first Ctrl-C must not reach the report; the second ends it through `run`.
    done = subprocess.run(command, env=dict(os.environ), start_new_session=True, check=False)
    if done.returncode != 0:
        raise DeployError("the report failed, see above")
    return cast(dict[str, object], json.loads((out / "summary.json").read_text()))


def stop_on_signals() -> threading.Event:
    """Return an event that Ctrl-C, SIGTERM or a closed terminal sets.

    The second one is a KeyboardInterrupt.
    """
    stop = threading.Event()

    def on_signal(number: int, _frame: object) -> None:
        stop.set()
        signal.signal(number, signal.default_int_handler)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, on_signal)
    return stop
