"""Commands `phalanx demo` and those of `phalanx fleet status` for other machines.

The latter are the commands that reach other machines.
"""

import functools
import json
import sys
from argparse import Namespace
from collections.abc import Callable, Sequence
from dataclasses import replace

from deploy.demo import DemoSettings, run_demo, stop_on_signals
from deploy.deployment import Lines, deploy, roll_back, uninstall
from deploy.host_options import ears_of, reached_of, rig_of, wish_of
from deploy.keys import prepared_keys
from deploy.sensors import DemoError, best_rigs
from deploy.targets import DeployError, Target, targets_of
from deploy.wheelhouse import Kind, export

Work = Callable[[Namespace], int]


def plainly(work: Work) -> Work:
    """Make `work` end with one line and exit code 1 on errors the user can fix."""

    @functools.wraps(work)
    def run(options: Namespace) -> int:
        try:
            return work(options)
        except (DemoError, DeployError) as error:
            sys.stderr.write(f"phalanx: {error}\n")
            return 1

    return run


@plainly
def demo(options: Namespace) -> int:
    """Run the demo; the exit code."""
    rigs = options.rigs or best_rigs(options.scene)
    settings = DemoSettings(
        options.seconds,
        options.headless,
        options.out,
        options.calibration,
        tuple(rigs),
        options.seed,
        options.scene,
        options.web,
        bus=options.bus,
        console=options.console,
    )
    summary = run_demo(settings, stop_on_signals(), _notify)
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(summary, indent=1) + "\n")
    _notify(
        f"\npicture {settings.out / 'hand.png'}\nRerun   {settings.out / 'run.rrd'}   (open with: rerun FILE)"
    )
    return 0


@plainly
def deploy_slaves(options: Namespace) -> int:
    """Bring slaves to their machines; the exit code."""
    rig = rig_of(options)
    targets = targets_of(options.hosts, rig)
    wish, ears, reached, notify = wish_of(options, rig), ears_of(options), reached_of(options), Lines(_notify)
    names = [name for target in targets for name in target.names]
    with prepared_keys(options.keys, names, options.dry_run, notify) as keys:
        return _judge(deploy(targets, replace(wish, keys=keys), reached, ears, notify))


@plainly
def rollback(options: Namespace) -> int:
    """Bring machines back to what they had; the exit code."""
    return _judge(roll_back(_all(options.hosts), reached_of(options), options.dry_run, Lines(_notify)))


@plainly
def uninstall_slaves(options: Namespace) -> int:
    """Take slaves from their machines; the exit code."""
    return _judge(uninstall(_all(options.hosts), reached_of(options), options.dry_run, Lines(_notify)))


@plainly
def wheels(options: Namespace) -> int:
    """Gather wheels in a folder; the exit code."""
    kind = Kind(options.machine, options.python, tuple(options.more), ("wrist",))
    made = export(kind, options.folder, _notify)
    _notify(f"{options.folder}: {len(made.files)} wheels, {made.size_mb:.0f} MB, release {made.release}")
    return 0


def _all(hosts: Sequence[str]) -> list[Target]:
    """Machines, whatever they serve."""
    return [Target(host, ()) for host in dict.fromkeys(hosts)]


def _judge(results: dict[str, str | None]) -> int:
    """Notify which machines failed; the exit code."""
    failed = {host: why for host, why in results.items() if why is not None}
    for host, why in failed.items():
        sys.stderr.write(f"{host}: FAILED: {why}\n")
    return 1 if failed else 0


def _notify(line: str) -> None:
    end = "\n"
    if line.startswith("\r"):  # written over by the next
        end, line = ("", line) if sys.stdout.isatty() else ("\n", line[1:])
    sys.stdout.write(line + end)
    sys.stdout.flush()
