"""Measure what others lose while stolen devices attack a running master.

The stolen devices send what they like, in their own sessions.

`python -m bench.hostile [--messages 200000] [--per-s 2000] [--devices NAME ...]`: a phase without attack, then each
device in turn sends its share of hostile messages of every kind (`bench.hostile_messages`). It prints a table and a
line of JSON, and ends with 1 where a limit is broken.
"""

import argparse
import json
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from bench.hostile_rig import STOLEN, HostileRig, Phase
from common.messages import Health

CALM_S, SETTLE_S = 10.0, 1.0
BUSY = 0.25  # cores that were not free for the master: from then on so large a share of the poses may be lost to that
HEAD = (
    "| device | messages | poses lost | oldest report | undecodable | lines/s | memory | cores | refused, by reason |\n"
    "|---|--:|--:|--:|--:|--:|--:|--:|---|"
)


@dataclass(frozen=True, slots=True)
class Limits:
    """The most that the others may lose by an attack.

    Share of poses, time without a report [s], lines of the log per second, memory [MB].
    """

    lost: float = 0.01
    silent_s: float = 3.0
    lines_per_s: float = 10.0
    grown_mb: float = 20.0


LIMITS = Limits()


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one stolen device brought about.

    Attributes:
        device: Its name.
        sent: Messages that it sent, by type; `unsent`: too long for a datagram, or without a session.
        calm, attack: What was measured before and meanwhile.
        refused: Counts of the master that rose, without what is no refusal.
        broken: Limits that were broken, in words.
    """

    device: str
    sent: Mapping[str, float]
    calm: Phase
    attack: Phase
    refused: Mapping[str, int]
    broken: tuple[str, ...]

    @property
    def messages(self) -> int:
        """How many it sent."""
        return round(sum(count for name, count in self.sent.items() if name not in ("unsent", "seconds")))


def attacked(
    rig: HostileRig, device: str, process: subprocess.Popen[str], calm: Phase, limits: Limits
) -> Outcome:
    """Have one device send what it has made; its session is over afterwards."""
    before = rig.ask()
    end = rig.begin()
    assert process.stdin is not None
    process.stdin.write("\n")
    process.stdin.flush()
    sent = json.loads(_line(process) or "{}")
    phase = end()
    after = rig.ask()
    return Outcome(
        device, sent, calm, phase, _rise(before, after), tuple(_broken(rig, phase, calm, after, limits))
    )


def _line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def _rise(before: Health | None, after: Health | None) -> dict[str, int]:
    """Counts that say what was refused, by how much they rose."""
    if before is None or after is None:
        return {}
    said = {
        name: number - before.counts.get(name, 0)
        for name, number in after.counts.items()
        if name.startswith(("refused.", "fault.", "bus.")) or name in ("unsynchronised", "queue.dropped")
    }
    return {name.removeprefix("refused."): number for name, number in said.items() if number}


def _broken(
    rig: HostileRig, phase: Phase, calm: Phase, after: Health | None, limits: Limits
) -> Iterator[str]:
    lost = phase.lost - calm.lost
    excused = phase.waited if phase.waited >= BUSY and rig.alive() else 0.0
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
    """Run `check` and `fleet` again and again until the block ends.

    What is wrong with what they print is added to the list that the block is given.
    """
    failed: list[str] = []
    closing = threading.Event()

    def ask() -> None:
        while not closing.is_set() and rig.alive():
            for command, exits in (
                (("check",), (0, 1)),
                (("fleet", "status", "--seconds", "1", "--json"), (0,)),
            ):
                code, said = rig.command(*command)
                if code not in exits or b"Traceback" in said:
                    failed.append(f"{command[0]} ended with {code}: {said.decode(errors='replace')[-200:]!r}")
                if b"\x1b]" in said or b"\x07" in said:
                    failed.append(f"{command[0]} writes to the terminal")

    thread = threading.Thread(target=ask)
    thread.start()
    try:
        yield failed
    finally:
        closing.set()
        thread.join()


def row(outcome: Outcome) -> str:
    """A line of the table."""
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
    calm_s: float = CALM_S,
    notify: Callable[[str], None] = lambda _line: None,
    limits: Limits = LIMITS,
) -> list[Outcome]:
    """Let each device in turn send its share of the attack.

    A calm phase with all of them connected comes before. It stops when the master has ended.
    """
    share = messages // len(devices)
    stolen = {name: rig.start_stolen(name, share, per_s, seed + k) for k, name in enumerate(devices)}
    outcomes: list[Outcome] = []
    try:
        for process in stolen.values():
            _line(process)
        time.sleep(SETTLE_S)
        end = rig.begin()
        time.sleep(calm_s)
        calm = end()
        with _asked_by_operators(rig) as failed:
            for device, process in stolen.items():
                if not rig.alive():
                    break
                outcomes.append(attacked(rig, device, process, calm, limits))
                notify(row(outcomes[-1]))
        if failed:
            outcomes[-1] = replace(outcomes[-1], broken=(*outcomes[-1].broken, *dict.fromkeys(failed)))
            notify("; ".join(outcomes[-1].broken))
    finally:
        for process in stolen.values():
            process.kill()
            process.wait()
    return outcomes


def main(arguments: Sequence[str] | None = None) -> int:
    """Attack, print the table; 1 if a limit is broken."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--messages", type=int, default=200_000, metavar="N", help="of all devices (default: 200000)"
    )
    parser.add_argument(
        "--per-s", type=float, default=2000.0, metavar="N", help="messages a second (default: 2000)"
    )
    parser.add_argument("--devices", nargs="+", choices=list(STOLEN), default=list(STOLEN))
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="phalanx-hostile-") as folder:
        rig = HostileRig(Path(folder) / "rig")
        try:
            print(HEAD, flush=True)
            place = (options.devices, options.messages, options.per_s, options.seed)
            outcomes = all_attacked(rig, *place, notify=lambda line: print(line, flush=True))
            if not rig.alive():
                print(rig.log.read_text(errors="replace")[-3000:])
        finally:
            rig.close()
    print(json.dumps([asdict(outcome) for outcome in outcomes]))
    return int(len(outcomes) < len(options.devices) or any(outcome.broken for outcome in outcomes))


if __name__ == "__main__":
    raise SystemExit(main())
