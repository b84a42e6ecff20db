"""What a pose costs the master, stage by stage: processor time of one thread, no socket.

A pose is all that the master does from sealed datagrams to the bytes that it publishes, gestures among it; what senders
do for it is not counted. The figures come as a line of JSON at the end.
"""

import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace

from bench.both.scene import shown
from bench.report import ROOT, Row
from bench.rigs.rooms import ROOM, detections, in_order, room
from common.clock import Clock
from common.messages import ImuSample, encode
from master.rig.setup import RigSetup, load_setups
from master.run.app import StageTimes, result_at
from master.run.dispatcher import Dispatcher
from master.run.link import MasterLink
from master.run.tuning import LivePipeline
from slave.link import SlaveLink

RIGS = {
    "desk": "two cameras at 60 Hz",
    "room": "16 cameras at 90 Hz",
    "fused": "two cameras and a wrist device with its IMU",
    "wrist": "a wrist device with its IMU, a triple each",
}
COLD, WARM = "kernels, compiled", "kernels, from the cache"
FIGURES = {
    "desk_ms": "desk",
    "desk_estimator_ms": "desk: hand",
    "desk_gestures_ms": "desk: gestures",
    "room_ms": "room",
    "fused_ms": "fused",
    "wrist_triple_ms": "wrist",
    "compile_cold_s": COLD,
    "start_warm_s": WARM,
}
_TURN = 10  # the first turn warms up
_SCENE, _SEED = "grasp", 7
_KEY, _MASTER, _BROADCAST = bytes(range(32)), ("10.0.0.1", 47801), ("10.0.0.255", 47800)
# numba takes part of its time when it is imported, the rest where kernels are first called.
_START = """
from time import process_time
import numpy
began_s = process_time()
import numba
spent_s = process_time() - began_s
from pathlib import Path
from master.rig.setup import load_setup
from master.run.dispatcher import new_dispatcher
setup, began_s = load_setup(Path("calib_json"), "desk"), process_time()
new_dispatcher([setup])
print(spent_s + process_time() - began_s)
"""


class StillClock(Clock):
    """A clock that shows what it is set to, so that a run ends no session."""

    t_ns = 1_000_000_000_000

    def now_ns(self) -> int:
        """Return what it is set to."""
        return self.t_ns


class Played:
    """The master of a rig and its senders, all in one thread. Holds them, and the time on their clock."""

    def __init__(self, setups: Sequence[RigSetup], stages: StageTimes) -> None:
        """Join them, and let them find each other."""
        self._clock, source = StillClock(), random.Random(_SEED).randbytes
        cameras = tuple(dict.fromkeys(name for setup in setups for name in setup.camera_names))
        imus = tuple(name for setup in setups for name in setup.imus)
        wrists = tuple(name for setup in setups for name in setup.wrist_cameras)
        self.senders = (*cameras, *imus)
        self._master = MasterLink(cameras, _KEY, self._clock, _BROADCAST, "", 0, source, imus, wrists)
        self._slaves = {name: SlaveLink(name, _KEY, self._clock, source) for name in self.senders}
        self._address = {name: (f"10.0.1.{k}", 5) for k, name in enumerate(self._slaves)}
        self._world = Dispatcher(setups, [LivePipeline(setup, stages) for setup in setups], stages)
        while not all(slave.started for slave in self._slaves.values()):
            if self._clock.t_ns > StillClock.t_ns + 2 * 10**9:
                raise RuntimeError("the master's start did not come within two simulated seconds")
            self._clock.t_ns += 5_000_000
            self._keep()
        self._since_ns = self._clock.t_ns

    def sent(self, message: Any) -> tuple[bytes, tuple[str, int]]:
        """What the sender of a message sends of it, and its address; times of messages are since the start."""
        name = message.source if isinstance(message, ImuSample) else message.camera
        slave, times = self._slaves[name], {"t_ns": self._since_ns + message.t_ns}
        if not isinstance(message, ImuSample):
            times["ready_t_ns"] = self._since_ns + message.ready_t_ns
        self._clock.t_ns = max(self._clock.t_ns, max(times.values()) + 2_000_000)
        self._keep()
        sealed = slave.seal(replace(message, session=slave.process, **times))
        if sealed is None:
            raise RuntimeError(f"{name}: the session has ended")
        return sealed[0], self._address[name]

    def take(self, datagram: bytes, address: tuple[str, int]) -> int:
        """Let the master take a datagram; return how many poses it published."""
        message, poses = self._master.receive(datagram, address, self._clock.t_ns), 0
        if message is None:
            return 0
        for solved in self._world.push(message):
            encode(result_at(solved, self._clock.t_ns))
            poses += hasattr(solved, "ready_t_ns")
        return poses

    def _keep(self) -> None:
        """Carry what the links send each other by themselves."""
        t_ns = self._clock.t_ns
        for datagram, to in self._master.due():
            for name, slave in self._slaves.items():
                if to == _BROADCAST:
                    slave.receive_beacon(datagram, _MASTER, t_ns)
                elif to == self._address[name]:
                    slave.receive(datagram, _MASTER, t_ns)
        for name, slave in self._slaves.items():
            for datagram, _ in slave.due():
                self._master.receive(datagram, self._address[name], t_ns)


def played(rig: str, stages: StageTimes) -> tuple[Played, Sequence[Any]]:
    """The master of a rig with its senders, and the messages of some hundred poses."""
    poses = 320
    if rig in ("fused", "wrist"):
        rate_hz = 60.0 if rig == "fused" else 30.0
        both = shown(_SCENE, poses / rate_hz, _SEED)
        one = Played([both.both.fused if rig == "fused" else both.both.wrist], stages)
        first_ns = both.messages[0].t_ns
        messages = [m for m in both.messages if getattr(m, "source", getattr(m, "camera", "")) in one.senders]
        return one, [_since(message, first_ns) for message in messages]
    cameras, rate_hz = (16, 90.0) if rig == "room" else (2, 60.0)
    with tempfile.TemporaryDirectory() as name:
        setups = load_setups(room(Path(name), cameras, rate_hz), [ROOM])
    return Played(setups, stages), in_order(detections(setups[0], rate_hz))[: cameras * poses]


def _since(message: Any, first_ns: int) -> Any:
    """The message with times since the first one."""
    if isinstance(message, ImuSample):
        return replace(message, t_ns=message.t_ns - first_ns)
    return replace(message, t_ns=message.t_ns - first_ns, ready_t_ns=message.ready_t_ns - first_ns)


def turns(one: Played, messages: Sequence[Any]) -> Iterator[tuple[int, float]]:
    """Poses of a turn and the master's processor time [ms], turn by turn."""
    count, spent_ns = 0, 0
    for message in messages:
        sent = one.sent(message)
        begun_ns = time.thread_time_ns()
        count += one.take(*sent)
        spent_ns += time.thread_time_ns() - begun_ns
        if count >= _TURN:
            yield count, 1e-6 * spent_ns
            count, spent_ns = 0, 0


def rows() -> Iterator[Row]:
    """Each rig and its stages, then what kernels cost a process that starts."""
    for rig, what in RIGS.items():
        stages = StageTimes(time.thread_time_ns)
        each = np.array([spent / poses for poses, spent in turns(*played(rig, stages))][1:])
        low, middle, high = np.percentile(each, [25, 50, 75])
        yield Row(rig, float(middle), "ms", f"{what}; middle half of turns {low:.2f} to {high:.2f}")
        for stage, total_us in stages.total_us().items():
            yield Row(f"{rig}: {stage}", 1e-3 * total_us / (_TURN * (len(each) + 1)), "ms", "mean")
    with tempfile.TemporaryDirectory() as cache:
        yield Row(COLD, _started_s(cache), "s", "of the processor, goal 30")
        yield Row(WARM, _started_s(cache), "s", "of the processor, goal 0.8")


def _started_s(cache: str) -> float:
    """Processor time [s] of numba and the kernels of rig desk in a new process; `cache`: its folder of machine code."""
    environment = os.environ | {"NUMBA_CACHE_DIR": cache}
    command = [sys.executable, "-c", _START]
    run = subprocess.run(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return float(run.stdout)
