"""Command line `phalanx`: starts and orchestrates the processes of a rig; imports none of them."""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from deploy.arguments import parser
from deploy.checks import keys_of_fleet
from deploy.demo import DemoSettings, run_demo, stop_on_signals
from deploy.deployment import Lines, deploy, roll_back, uninstall
from deploy.fleet import fleet_once, table, watch_fleet
from deploy.host_options import ears_of, reached_of, rig_of, wish_of
from deploy.keys import prepared_keys
from deploy.replay import ReplayError, ReplaySettings, run_replay
from deploy.sensors import DemoError, best_rigs
from deploy.summary import summary_lines
from deploy.targets import DeployError, Target, targets_of
from deploy.wheelhouse import Kind, export


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return the exit code: 0 done, 1 something the user can mend, 2 wrong usage, 130 interrupted."""
    options = parser().parse_args(arguments)
    try:
        return _COMMANDS[options.command](options)
    except (DemoError, DeployError, ReplayError) as error:
        print(f"phalanx: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:  # of a replay, or the second of a demo
        print("\nphalanx: interrupted", file=sys.stderr)
        return 130


def _demo(options: argparse.Namespace) -> int:
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
    summary = run_demo(settings, stop_on_signals(), _print)
    _finish(summary, options.json)
    print(
        f"\npicture {settings.out / 'hand.png'}\nRerun   {settings.out / 'run.rrd'}   (open with: rerun FILE)"
    )
    return 0


def _replay(options: argparse.Namespace) -> int:
    settings = ReplaySettings(
        options.paths,
        options.out,
        options.calibration,
        options.hand,
        solver_mode=options.solver_mode,
        solver=options.solver,
        only=options.only,
        cameras=options.camera,
        rig=options.rig,
        times=options.times,
    )
    _finish(run_replay(settings, _print), None)
    print(f"\nposes   {settings.out / 'poses.npz'}\nsummary {settings.out / 'summary.json'}")
    return 0


def _deploy(options: argparse.Namespace) -> int:
    rig = rig_of(options)
    targets = targets_of(options.hosts, rig)
    wish, ears, reached, notify = wish_of(options, rig), ears_of(options), reached_of(options), Lines(_print)
    names = [name for target in targets for name in target.names]
    with prepared_keys(options.keys, names, options.dry_run, notify) as keys:
        return _exit_code(deploy(targets, replace(wish, keys=keys), reached, ears, notify))


def _rollback(options: argparse.Namespace) -> int:
    return _exit_code(roll_back(_all(options.hosts), reached_of(options), options.dry_run, Lines(_print)))


def _uninstall(options: argparse.Namespace) -> int:
    return _exit_code(uninstall(_all(options.hosts), reached_of(options), options.dry_run, Lines(_print)))


def _all(hosts: Sequence[str]) -> list[Target]:
    """Machines, whatever they serve."""
    return [Target(host, ()) for host in dict.fromkeys(hosts)]


def _exit_code(results: dict[str, str | None]) -> int:
    """Say which machines failed; the exit code."""
    failed = {host: why for host, why in results.items() if why is not None}
    for host, why in failed.items():
        print(f"{host}: FAILED: {why}", file=sys.stderr)
    return 1 if failed else 0


def _wheels(options: argparse.Namespace) -> int:
    kind = Kind(options.machine, options.python, tuple(options.more), ("wrist",))
    made = export(kind, options.folder, _print)
    _print(f"{options.folder}: {len(made.files)} wheels, {made.size_mb:.0f} MB, release {made.release}")
    return 0


def _fleet(options: argparse.Namespace) -> int:
    keys = keys_of_fleet(options)
    if options.watch:
        return watch_fleet(keys, options.bus, _print)
    devices = fleet_once(keys, options.bus)
    _print(json.dumps(devices) if options.json else "\n".join(table(devices)))
    return 0


def _finish(summary: dict[str, object], file: Path | None) -> None:
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(summary, indent=1) + "\n")
    print()
    for line in summary_lines(summary):
        print(f"  {line}")


def _print(line: str) -> None:
    if line.startswith("\r"):
        end = "" if sys.stdout.isatty() else "\n"
        print(line if sys.stdout.isatty() else line[1:], end=end, flush=True)
    else:
        print(line, flush=True)


_COMMANDS = {
    "demo": _demo,
    "replay": _replay,
    "deploy": _deploy,
    "rollback": _rollback,
    "uninstall": _uninstall,
    "fleet": _fleet,
    "wheels": _wheels,
}


if __name__ == "__main__":
    sys.exit(main())
