"""Measure what others lose while stolen devices attack a running master with messages of their own sessions.

One hand before three cameras, of which two are honest; an object with a tracker; a second hand with a wrist device that
has a camera and an IMU. A phase without attack, then each stolen device in turn sends its share of hostile messages of
every kind (`tests.faults.fuzz`). Prints a table; ends with 1 where a limit is broken.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

from bench.report import ROOT
from bench.rigs.local import UP_S, Rig, RigError, end, until
from bench.rigs.rooms import ROOM, room
from common.errors import BusError
from common.messages import HandPose, Health
from common.messages.streams import MASTER

RATE_HZ = 30.0
HAND = "default-right"
HONEST, WRIST_RIG = ("cam00", "cam01"), "wrist-left"
STOLEN: Mapping[str, str] = {"cam02": ROOM, "wrist": WRIST_RIG, "imu": WRIST_RIG, "tracker": ROOM}  # -> rig
HEAD = (
    "| device | messages | poses lost | oldest report | undecodable | lines/s | memory | cores | refused, by reason |\n"
    "|---|--:|--:|--:|--:|--:|--:|--:|---|"
)


def scratch_tree(folder: Path) -> Path:
    """Write the calibration files of such a rig; return where they are."""
    tree = room(folder, 3, RATE_HZ)
    path = tree / "rigs" / f"{ROOM}.json"
    tracked = json.loads((tree / "rigs" / "desk-tracker.json").read_text())
    rig = json.loads(path.read_text()) | {name: tracked[name] for name in ("objects", "T_rig_tracking")}
    path.write_text(json.dumps(rig, indent=1) + "\n")
    return tree


@dataclass(frozen=True, slots=True)
class Phase:
    """What was measured from one moment to another."""

    seconds: float  # how long it was
    lost: float  # share of the honest cameras' periods without a pose
    reports: int  # how many reports of the master came
    silent_s: float  # the longest time without one
    undecodable: int  # messages of the master that a reader could not decode
    lines_per_s: float  # lines of its log
    grown_mb: float  # how much more memory it has that is no file's
    threads_ended: int  # how many of Python's threads fewer it has
    cpu: float  # cores that the master took
    waited: float  # cores that it would have taken besides, had the machine had them free


class HostileRig(Rig):
    """The master, the two honest cameras, and what came over the bus. Close it in any case."""

    def __init__(self, folder: Path) -> None:
        """Start it and wait until the honest hand is tracked; RigError: it is not in time."""
        super().__init__(folder)
        self.tree, self.log = scratch_tree(folder), folder / f"{MASTER}.log"
        self.newest: Health | None = None
        self._lock, self._poses_ns, self._reports_s = threading.Lock(), list[int](), list[float]()
        try:
            self.start_master(self.tree, [ROOM, WRIST_RIG], "--start-timeout-s", "1")
            place = [str(self.tree), ROOM, str(RATE_HZ), str(self.beacon_port), str(time.monotonic_ns())]
            self.start("cameras", "bench.rigs.sender", *place, "--cameras", *HONEST, ready="ready")
            self.join()
            streams = (("hand", HAND, 256), ("health", MASTER, 64), ("checklist", MASTER, 64))
            self._readers = [self.read(stream, self._keep, name, depth) for stream, name, depth in streams]
            tracked = until(lambda: len(self._poses_ns) > 3 * RATE_HZ or not self.alive(), UP_S)
            if not tracked or not self.alive():
                raise RigError(f"no poses: {self.log.read_text()[-2000:]}")
            self._phase_ns = self._poses_ns[-1] % (1e9 / RATE_HZ)
        except BaseException:
            self.close()
            raise

    def report(self, timeout_s: float = 10.0) -> Health | None:
        """Return the master's report, or None if it does not answer."""
        try:
            return self.ask(timeout_s=timeout_s)
        except BusError:
            return None

    def begin(self) -> Callable[[], Phase]:
        """Begin to measure; what is returned ends it."""
        began, log = time.monotonic(), len(self.log.read_bytes())
        before, threads = self.footprint(), self._threads()
        undecodable, waited_s = self._undecodable(), self._waited_s()

        def measured() -> Phase:
            ended = time.monotonic()
            lines = self.log.read_bytes()[log:].count(b"\n")
            after = self.footprint() if self.alive() else before
            with self._lock:
                came = [began, *(at for at in self._reports_s if began <= at < ended), ended]
            return Phase(
                ended - began,
                self.lost(began, ended),
                len(came) - 2,
                max(b - a for a, b in pairwise(came)),
                self._undecodable() - undecodable,
                lines / (ended - began),
                after.anonymous_mb - before.anonymous_mb,
                threads - self._threads(),
                (after.cpu_s - before.cpu_s) / (ended - began),
                (self._waited_s() - waited_s) / (ended - began),
            )

        return measured

    def lost(self, began_s: float, ended_s: float) -> float:
        """Return the share of the periods between two moments without the honest hand's pose."""
        period_ns, first, last = 1e9 / RATE_HZ, round(began_s * RATE_HZ) + 1, round(ended_s * RATE_HZ) - 8
        with self._lock:
            solved = {round((t_ns - self._phase_ns) / period_ns) for t_ns in self._poses_ns}
        periods = range(first, last)
        return sum(one not in solved for one in periods) / len(periods)

    def start_stolen(self, name: str, count: int, per_s: float, seed: int) -> subprocess.Popen[str]:
        """Start a stolen device; it sends when a line is written to it."""
        place = [name, str(self.tree), STOLEN[name], str(self.beacon_port), self.endpoint]
        attack = [str(count), str(per_s), str(seed)]
        return subprocess.Popen(
            [sys.executable, "-m", "tests.faults.hostile_sender", *place, *attack],
            cwd=ROOT, env=self.environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip

    def command(self, *arguments: str) -> tuple[int, bytes]:
        """Run a command of `phalanx` on this master's bus; return its exit code and what it wrote."""
        done = subprocess.run(
            [sys.executable, "-m", "master", *arguments, "--bus", self.endpoint],
            cwd=ROOT, env=self.environment, capture_output=True, timeout=UP_S, check=False,
        )  # fmt: skip
        return done.returncode, done.stdout + done.stderr

    def _tasks(self) -> list[Path]:
        try:
            return list(Path(f"/proc/{self.processes[MASTER].pid}/task").iterdir())
        except OSError:
            return []

    def _threads(self) -> int:
        """Return the number of the master's Python threads: unlike zenoh's, named as the process."""
        names = [(one / "comm").read_text() for one in self._tasks()]
        return names.count(names[0]) if names else 0

    def _waited_s(self) -> float:
        """Return how long the master's threads waited for a processor while they were ready to run [s]."""
        return 1e-9 * sum(int((one / "schedstat").read_text().split()[1]) for one in self._tasks())

    def _undecodable(self) -> int:
        return sum(reader.inbox.refused for reader in self._readers)

    def _keep(self, message: object) -> None:
        with self._lock:
            if isinstance(message, HandPose):
                self._poses_ns.append(message.t_ns)
            elif isinstance(message, Health):
                self.newest = message
                self._reports_s.append(time.monotonic())


@dataclass(frozen=True, slots=True)
class Limits:
    """The most that the others may lose by an attack."""

    lost: float = 0.01  # share of poses
    silent_s: float = 3.0  # without a report
    lines_per_s: float = 10.0
    grown_mb: float = 20.0  # memory


LIMITS = Limits()


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one stolen device brought about."""

    device: str  # its name
    sent: Mapping[str, float]  # by type; `unsent`: too long, or without a session
    calm: Phase  # before
    attack: Phase  # meanwhile
    refused: Mapping[str, int]  # counts of the master that rose, without what is no refusal
    broken: tuple[str, ...]  # limits that were broken, in words

    @property
    def messages(self) -> int:
        """How many it sent."""
        return round(sum(count for name, count in self.sent.items() if name not in ("unsent", "seconds")))


def attacked(
    rig: HostileRig, device: str, process: subprocess.Popen[str], calm: Phase, limits: Limits
) -> Outcome:
    """Have one device send its attacks; its session is over afterwards."""
    before, measured = rig.report(), rig.begin()
    assert process.stdin is not None
    process.stdin.write("\n")
    process.stdin.flush()
    sent = json.loads(_line(process) or "{}")
    phase = measured()
    after = rig.report()
    broken = tuple(_broken(rig, phase, calm, after, limits))
    return Outcome(device, sent, calm, phase, _rise(before, after), broken)


def _line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def _rise(before: Health | None, after: Health | None) -> dict[str, int]:
    """Return the counts of refusals, by how much they rose."""
    if before is None or after is None:
        return {}
    rise = {
        name: number - before.counts.get(name, 0)
        for name, number in after.counts.items()
        if name.startswith(("refused.", "fault.", "bus.")) or name in ("unsynchronised", "queue.dropped")
    }
    return {name.removeprefix("refused."): number for name, number in rise.items() if number}


def _broken(
    rig: HostileRig, phase: Phase, calm: Phase, after: Health | None, limits: Limits
) -> Iterator[str]:
    lost = phase.lost - calm.lost
    # Where a quarter of a core or more was not free for the master, so large a share of the poses may be lost to that.
    excused = phase.waited if phase.waited >= 0.25 and rig.alive() else 0.0
    checks = {
        "the master ended": not rig.alive(),
        "the master does not answer": after is None,
        f"{100.0 * lost:.1f} % of the poses lost": not lost <= limits.lost + excused,
        f"{phase.undecodable} messages that no reader decodes": phase.undecodable > 0,
        f"no report for {phase.silent_s:.1f} s": phase.silent_s > limits.silent_s,
        f"{phase.lines_per_s:.0f} log lines a second": phase.lines_per_s > limits.lines_per_s,
        f"{phase.grown_mb:.0f} MB more": phase.grown_mb > limits.grown_mb,
        f"{phase.threads_ended} threads fewer": phase.threads_ended > 0,
        "terminal sequences in the log": b"\x1b" in rig.log.read_bytes(),
    }
    return (what for what, holds in checks.items() if holds)


@contextmanager
def _asked_by_operators(rig: HostileRig) -> Generator[list[str]]:
    """Run `check` and `fleet` again and again until the block ends; what is wrong with their output is in the list."""
    failed: list[str] = []
    closing = threading.Event()

    def ask() -> None:
        while not closing.is_set() and rig.alive():
            status = "fleet status --seconds 1 --json"
            for command, exits in ((["check"], (0, 1)), (status.split(), (0,))):
                code, wrote = rig.command(*command)
                if code not in exits or b"Traceback" in wrote:
                    end = wrote.decode(errors="replace")[-200:]
                    failed.append(f"{command[0]} ended with {code}: {end!r}")
                if b"\x1b]" in wrote or b"\x07" in wrote:
                    failed.append(f"{command[0]} writes to the terminal")

    thread = threading.Thread(target=ask)
    thread.start()
    try:
        yield failed
    finally:
        closing.set()
        thread.join()


def row(outcome: Outcome) -> str:
    """Return a line of the table."""
    phase = outcome.attack
    refused = ", ".join(f"`{name}` {count}" for name, count in sorted(outcome.refused.items())) or "–"
    return (
        f"| {outcome.device} | {outcome.messages} | {100.0 * phase.lost:.2f} % (calm {100.0 * outcome.calm.lost:.2f} %)"
        f" | {phase.silent_s:.1f} s | {phase.undecodable} | {phase.lines_per_s:.1f} | {phase.grown_mb:+.1f} MB"
        f" | {phase.cpu:.2f} (calm {outcome.calm.cpu:.2f}), waited {phase.waited:.2f} | {refused} |"
        + (f" **{'; '.join(outcome.broken)}**" if outcome.broken else "")
    )


def all_attacked(
    rig: HostileRig,
    devices: Sequence[str],
    messages: int,
    per_s: float,
    seed: int,
    calm_s: float = 10.0,
    show: Callable[[str], None] = lambda _line: None,
    limits: Limits = LIMITS,
) -> list[Outcome]:
    """Let each device in turn send its share of the attack, after a calm phase; it stops when the master has ended."""
    share = messages // len(devices)
    stolen = {name: rig.start_stolen(name, share, per_s, seed + k) for k, name in enumerate(devices)}
    outcomes: list[Outcome] = []
    try:
        for process in stolen.values():
            _line(process)
        time.sleep(1.0)
        measured = rig.begin()
        time.sleep(calm_s)
        calm = measured()
        with _asked_by_operators(rig) as failed:
            for device, process in stolen.items():
                if not rig.alive():
                    break
                outcomes.append(attacked(rig, device, process, calm, limits))
                show(row(outcomes[-1]))
        if failed:
            outcomes[-1] = replace(outcomes[-1], broken=(*outcomes[-1].broken, *dict.fromkeys(failed)))
            show("; ".join(outcomes[-1].broken))
    finally:
        for process in stolen.values():
            end(process)
    return outcomes


def main(arguments: Sequence[str] | None = None) -> int:
    """Attack, print the table; 1 if a limit is broken."""
    parser = argparse.ArgumentParser("make hostile", description=__doc__)
    parser.add_argument("--messages", type=int, default=200_000, metavar="N", help="of all devices (200000)")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="phalanx-hostile-") as folder:
        rig = HostileRig(Path(folder) / "rig")
        try:
            print(HEAD, flush=True)
            flood = (options.messages, 2000.0, 1)
            outcomes = all_attacked(rig, list(STOLEN), *flood, show=lambda line: print(line, flush=True))
            if not rig.alive():
                print(rig.log.read_text(errors="replace")[-3000:])
        finally:
            rig.close()
    return int(len(outcomes) < len(STOLEN) or any(outcome.broken for outcome in outcomes))


if __name__ == "__main__":
    sys.exit(main())
