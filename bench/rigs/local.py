"""Processes of a rig on this machine: free ports, keys, logs, the bus, and the kernel's figures of a process."""

import os
import re
import secrets
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from bench.report import ROOT
from common.bus.bus import ANY, Subscription
from common.bus.keys import FOLDER, OPERATOR, access_of
from common.bus.zenoh_bus import ZenohBus
from common.errors import BusError, PhalanxError
from common.messages import Command, Health
from common.messages.streams import MASTER

UP_S = 90.0
_PORTS = range(15_000, 32_000)  # below those that Linux assigns by itself (32768 to 60999)
_TICKS = os.sysconf("SC_CLK_TCK")
_KB = re.compile(r"^(\w+):\s+(\d+)", re.MULTILINE)
_STEP_S = 0.02


class RigError(PhalanxError):
    """A process of a rig did not come up, or no pose came."""


def free_port(kind: int) -> int:
    """Return a free port of this machine, for `socket.SOCK_DGRAM` or `socket.SOCK_STREAM`; OSError: none is.

    It is none of those that a system assigns by itself: nobody else gets it before its own process has it.
    """
    tries = 100
    for _ in range(tries):
        port = _PORTS.start + secrets.randbelow(len(_PORTS))
        with socket.socket(socket.AF_INET, kind) as probe, suppress(OSError):
            probe.bind(("0.0.0.0", port))
            return port
    raise OSError(f"of {tries} ports from {_PORTS.start} to {_PORTS.stop - 1} none was free")


def join_bus(endpoint: str, patience_s: float, environment: Mapping[str, str] = os.environ) -> ZenohBus:
    """Join the bus of a master that is about to listen at `endpoint`; BusError: it did not within `patience_s`."""
    deadline = time.monotonic() + patience_s
    while True:
        try:
            access = access_of(environment, OPERATOR)
            return ZenohBus(None, endpoint, access, beyond=True)
        except BusError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.2)


def until(condition: Callable[[], bool], timeout_s: float) -> bool:
    """Wait until a condition holds; False if it never did."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(_STEP_S)
    return True


@dataclass(frozen=True, slots=True)
class Footprint:
    """A process at a moment (Linux, /proc)."""

    rss_mb: float  # resident memory [MB = 1e6 bytes], pages that it shares with others included
    anonymous_mb: float  # pages that are no file's: heap, stacks, arrays
    cpu_s: float  # processor time since it began, user and system


def footprint(pid: int) -> Footprint:
    """Read the footprint of a process; OSError: there is none, or it belongs to somebody else."""
    kb = dict(_KB.findall(Path(f"/proc/{pid}/smaps_rollup").read_text()))
    return Footprint(int(kb["Rss"]) * 1024e-6, int(kb["Anonymous"]) * 1024e-6, cpu_s(pid))


def cpu_s(pid: int, task: str = "") -> float:
    """Return the processor time of a process since it began [s], user and system; of one thread: `task/TID`."""
    fields = (Path(f"/proc/{pid}") / task / "stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS


class Reader:
    """Receives the messages of one stream on a thread of its own, and hands each to `keep`."""

    def __init__(self, inbox: Subscription, keep: Callable[[object], None]) -> None:
        """Listen from now on."""
        self.inbox, self._keep, self._closing = inbox, keep, threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Listen no more."""
        self._closing.set()
        self._thread.join()
        self.inbox.close()

    def _read(self) -> None:
        while not self._closing.is_set():
            if (message := self.inbox.get(0.05)) is not None:
                self._keep(message)


class Rig:
    """Processes of one rig with its own key, ports and logs. Close it in any case.

    Attributes:
        key: Rig key, hexadecimal.
        processes: Name -> process, alive or not.
        closing: Called by `close`, the last first.
    """

    bus: ZenohBus

    def __init__(self, folder: Path, devices: Sequence[str] = ()) -> None:
        """Choose ports and make keys: a rig key, or with `devices` a keys folder and an encrypted bus."""
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self.key = folder, secrets.token_hex(32)
        self.beacon_port, self.master_port = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_DGRAM)
        self.bus_port = free_port(socket.SOCK_STREAM)
        self.endpoint = f"{'tls' if devices else 'tcp'}/127.0.0.1:{self.bus_port}"
        self.environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}
        if devices:
            words = [word for name in devices for word in ("--device", name)]
            make = [sys.executable, "-m", "master", "fleet", "keys", str(folder / "keys"), "--make", *words]
            subprocess.run(make, check=True, stdout=subprocess.DEVNULL, cwd=ROOT)
            self.environment[FOLDER] = str(folder / "keys")
        else:
            self.environment["PHALANX_RIG_KEY"] = self.key
        self.processes: dict[str, subprocess.Popen[str]] = {}
        self.closing: list[Callable[[], None]] = []

    def start(self, name: str, *words: str, ready: str = "", **environment: str) -> None:
        """Start `python -m WORDS`, in place of an earlier process of that name; wait until its log has `ready` again.

        RigError: it ended at once, or is not ready in time.
        """
        if (old := self.processes.get(name)) is not None:
            end(old)
        log = self.folder / f"{name}.log"
        before = log.read_text().count(ready) if ready and log.exists() else 0
        with log.open("ab") as file:
            process = self.processes[name] = subprocess.Popen(
                [sys.executable, "-m", *words], cwd=ROOT, env=self.environment | environment, text=True,
                stdin=subprocess.PIPE, stdout=file, stderr=subprocess.STDOUT, start_new_session=True,
            )  # fmt: skip

        def up() -> bool:
            return log.read_text().count(ready) > before or process.poll() is not None

        if ready and not until(up, UP_S):
            raise RigError(f"{name} does not come up: {log}")

    def start_master(
        self, tree: Path, rigs: Sequence[str], *options: str, beacon: str = "", **env: str
    ) -> None:
        """Start the master, with beacons to `beacon` (default: to slaves of this machine); wait until it listens."""
        place = [*(word for rig in rigs for word in ("--rig", rig)), "--calibration", str(tree)]
        link = ["--beacon", beacon or f"127.255.255.255:{self.beacon_port}"]
        link += ["--bind", f"127.0.0.1:{self.master_port}", "--bus", self.endpoint]
        self.start(MASTER, "master", "run", *place, *link, *options, ready="listening on", **env)

    def join(self) -> None:
        """Join the master's bus; BusError: it does not come up."""
        self.bus = join_bus(self.endpoint, UP_S, self.environment)
        self.closing.append(self.bus.close)

    def ask(
        self, target: str = MASTER, verb: str = "report", body: str = "", timeout_s: float = 20.0
    ) -> Health:
        """Command a process; BusError: it refuses, or does not answer."""
        return self.bus.ask(Command(target, verb, body), timeout_s)

    def counts(self) -> dict[str, int]:
        """Return the master's counts since it began."""
        return dict(self.ask().counts)

    def read(self, stream: str, keep: Callable[[object], None], name: str = ANY, depth: int = 256) -> Reader:
        """Hand the messages of a stream to `keep` from now on."""
        reader = Reader(self.bus.subscribe(stream, name, depth=depth), keep)
        self.closing.append(reader.close)
        return reader

    def footprint(self, name: str = MASTER) -> Footprint:
        """Read the footprint of a process."""
        return footprint(self.processes[name].pid)

    def alive(self, name: str = MASTER) -> bool:
        """Return whether a process is."""
        return self.processes[name].poll() is None

    def kill(self, name: str) -> None:
        """End a process as the kernel does it."""
        self.processes[name].kill()
        self.processes[name].wait()

    def close(self) -> None:
        """End everything."""
        while self.closing:
            self.closing.pop()()
        for process in self.processes.values():
            end(process)


def end(process: subprocess.Popen[str]) -> None:
    """End a process that may stand still, or be gone."""
    if process.stdin is not None:
        with suppress(BrokenPipeError):
            process.stdin.close()
    process.kill()
    process.wait()


def losses(health: Mapping[str, Health]) -> dict[str, int]:
    """Sum the reported losses of a rig (process -> its report) since it began.

    lost: sent and never came. skipped: never sent, for a camera or a slave had no time. dropped: came, and the master
    had no time. refused: came, and was not accepted. blocked: not sent by a full socket.
    """
    master = health[MASTER].counts if MASTER in health else {}
    ending = ("lost", "skipped")
    out = {name: sum(n for key, n in master.items() if key.endswith(f".{name}")) for name in ending}
    out["dropped"] = master.get("queue.dropped", 0)
    out["refused"] = sum(n for key, n in master.items() if key.startswith("refused."))
    sockets = ("would_block", "send_failed")
    out["blocked"] = sum(one.counts.get(key, 0) for one in health.values() for key in sockets)
    return out
