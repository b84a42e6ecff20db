"""Command line `phalanx`: starts and orchestrates the processes of a rig; imports none of them."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from deploy.checks import keys_of_fleet
from deploy.demo import DemoSettings, run_demo, stop_on_signals
from deploy.deployment import Lines, deploy, make_keys, uninstall
from deploy.fleet import fleet_once, table, watch_fleet
from deploy.host_options import add_commands, ears_of, reached_of, rig_of, wish_of
from deploy.replay import ReplayError, ReplaySettings, run_replay
from deploy.sensors import DemoError, best_rigs
from deploy.summary import summary_lines
from deploy.targets import DeployError, Target, targets_of
from deploy.wheelhouse import Kind, export

_EXAMPLES = {
    "demo": """examples:
  phalanx demo                                  two simulated cameras and the master, in the Rerun viewer
  phalanx demo --console --seconds 600          the console in a browser instead: watch, tune and record the demo
  phalanx demo --headless --seconds 60          without a screen: a picture, an .rrd and the figures
  phalanx demo --wrist                          a simulated wrist device in their place: laser, LEDs, one camera, an IMU
  phalanx demo --scene grasp                    both at once, while a hand closes round a bar: cameras lose its fingers
  phalanx demo --scene grasp --rig desk-back3   the same without the wrist device, to compare
  phalanx demo --scene object                   a wand of painted beads travels before the cameras
  phalanx demo --scene grasp --rig desk-cube    the bar has a cube of tags: where it is, and which fingers touch it
  phalanx demo --scene gestures --seconds 80 --bus tcp/127.0.0.1:47802
                                                pinches, dials, taps and pointing, against what the hand really said
""",
    "replay": """examples:
  phalanx replay RECORDING --out out/replay     the same line on recorded frames, the same bytes on every run
  phalanx replay CURL --hand HAND.json --out out/curl       recorded frames of a wrist device
  phalanx replay GRASP --out out/grasp          cameras and wrist device of one hand, solved together
  phalanx replay GRASP --only markers --out out/grasp-markers    without what the wrist device tells, to compare
  phalanx replay CURL --hand HAND.json --level fk --out out/fk   its fingers from the laser alone, to compare
""",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return the exit code: 0 done, 1 something the user can mend, 2 wrong usage, 130 interrupted."""
    options = _parser().parse_args(arguments)
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
    summary = run_demo(settings, stop_on_signals(), _say)
    _finish(summary, options.json)
    print(
        f"\npicture {settings.out / 'hand.png'}\nRerun   {settings.out / 'run.rrd'}   (open with: rerun FILE)"
    )
    return 0


def _replay(options: argparse.Namespace) -> int:
    settings = ReplaySettings(
        options.recording, options.out, options.calibration, options.hand, options.level, options.only
    )
    _finish(run_replay(settings, _say), None)
    print(f"\nposes   {settings.out / 'poses.npz'}\nsummary {settings.out / 'summary.json'}")
    return 0


def _deploy(options: argparse.Namespace) -> int:
    rig = rig_of(options)
    targets = targets_of(options.hosts, rig)
    wish, ears, reached, say = wish_of(options, rig), ears_of(options), reached_of(options), Lines(_say)
    if not options.dry_run:
        make_keys(options.keys, [name for target in targets for name in target.names], say)
    return _told(deploy(targets, wish, reached, ears, say))


def _uninstall(options: argparse.Namespace) -> int:
    targets = [Target(host, ()) for host in dict.fromkeys(options.hosts)]
    return _told(uninstall(targets, reached_of(options), options.dry_run, Lines(_say)))


def _told(results: dict[str, str | None]) -> int:
    """Say which machines failed; the exit code."""
    failed = {host: why for host, why in results.items() if why is not None}
    for host, why in failed.items():
        print(f"{host}: FAILED: {why}", file=sys.stderr)
    return 1 if failed else 0


def _wheels(options: argparse.Namespace) -> int:
    kind = Kind(options.machine, options.python, tuple(options.more), ("wrist",))
    made = export(kind, options.folder, _say)
    _say(f"{options.folder}: {len(made.files)} wheels, {made.size_mb:.0f} MB, release {made.release}")
    return 0


def _fleet(options: argparse.Namespace) -> int:
    keys = keys_of_fleet(options)
    if options.watch:
        return watch_fleet(keys, options.bus, _say)
    devices = fleet_once(keys, options.bus)
    _say(json.dumps(devices) if options.json else "\n".join(table(devices)))
    return 0


def _finish(summary: dict[str, object], file: Path | None) -> None:
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(summary, indent=1) + "\n")
    print()
    for line in summary_lines(summary):
        print(f"  {line}")


def _say(line: str) -> None:
    if line.startswith("\r"):
        end = "" if sys.stdout.isatty() else "\n"
        print(line if sys.stdout.isatty() else line[1:], end=end, flush=True)
    else:
        print(line, flush=True)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="phalanx",
        description="Hand tracking from cameras that anyone can buy.",
        epilog="`phalanx COMMAND --help` shows its examples.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    demo = commands.add_parser(
        "demo",
        help="everything on this machine, without hardware",
        description="Starts a slave with a synthetic camera for each camera of the rigs, one for each IMU and tracker, "
        "one master for all of them and the viewer.",
        epilog=_EXAMPLES["demo"],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    view = demo.add_mutually_exclusive_group()
    view.add_argument(
        "--headless", action="store_true", help="no viewer; hand.png and run.rrd are always written"
    )
    view.add_argument("--web", action="store_true", help="the viewer as a page on 127.0.0.1, not a window")
    view.add_argument(
        "--console",
        action="store_true",
        help="the console in the viewer's place: its address is printed, open it in a browser",
    )
    demo.add_argument(
        "--seconds", type=_positive, default=30.0, metavar="N", help="length (default: %(default)s)"
    )
    demo.add_argument("--json", type=Path, metavar="FILE", help="write the summary to FILE as well")
    demo.add_argument(
        "--out", type=Path, default=Path("out/demo"), metavar="DIR", help="default: %(default)s"
    )
    demo.add_argument(
        "--calibration", type=Path, default=_calibration(), metavar="DIR", help="default: %(default)s"
    )
    rig = demo.add_mutually_exclusive_group()
    rig.add_argument(
        "--rig",
        dest="rigs",
        action="append",
        metavar="NAME",
        help="once for each that runs; default: desk, for scenes of both kinds desk-back3 (three markers on the back "
        "tell how the palm lies) and wrist-back3 of the same hand, for object desk-wand, for gestures desk4; desk-cube "
        "and desk-tracker track objects, too; --rig desk --rig wrist has one hand",
    )
    rig.add_argument(
        "--wrist", dest="rigs", action="store_const", const=["wrist"], help="the wrist device: --rig wrist"
    )
    demo.add_argument(
        "--bus",
        metavar="ENDPOINT",
        help="where other programs of this machine can read along, as tcp/127.0.0.1:47802 (default: any free port, "
        "encrypted)",
    )
    demo.add_argument("--seed", type=int, default=7, help="of the scene (default: %(default)s)")
    demo.add_argument(
        "--scene",
        default="standard",
        help="standard, lights (it changes), poses, hand-routine (of calibrate hand), object (that is tracked, on its "
        "way), or leap:FILE.npz; of a wrist device "
        "standard, curl, wearer, poses or spread; of both kinds of rig at once grasp, gestures, both-poses, both-curl, "
        "both-travel or both-moves; the last two kinds each with @dark, @indoor, @bright or @sun",
    )
    replay = commands.add_parser(
        "replay",
        help="a recording of raw frames, offline",
        description="Detects markers, or fingers before a wrist device, in every camera's frames, solves the hand of "
        "what all of them tell, scores it where there is a truth.",
        epilog=_EXAMPLES["replay"],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    replay.add_argument("recording", type=Path, metavar="RECORDING", help="folder with recording.json")
    replay.add_argument("--out", type=Path, required=True, metavar="DIR")
    replay.add_argument(
        "--calibration", type=Path, metavar="DIR", help="calib_json tree: marker colours, hands"
    )
    replay.add_argument(
        "--hand", type=Path, metavar="FILE", help="hand profile; default: DIR/hands/<rig's hand>.json"
    )
    replay.add_argument(
        "--only",
        choices=("markers", "wrist"),
        help="of a recording of both: what the cameras, or what the wrist device tells alone",
    )
    replay.add_argument(
        "--level",
        choices=("fk", "ik", "auto"),
        help="fingers before a wrist device from the laser alone (fk), from laser and fingertip (ik), or from what "
        "there is (auto); default: what its rig says",
    )
    add_commands(commands.add_parser, _calibration())
    return parser


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError as error:  # argparse would tell the name of the function
        raise argparse.ArgumentTypeError(f"{text}: must be a number") from error
    if not 0.0 < value < 1e6:
        raise argparse.ArgumentTypeError("seconds must be positive")
    return value


def _calibration() -> Path:
    """The calib_json of the working directory, else the one beside the source."""
    here = Path("calib_json")
    return here if here.is_dir() else Path(__file__).resolve().parent.parent / "calib_json"


_COMMANDS = {
    "demo": _demo,
    "replay": _replay,
    "deploy": _deploy,
    "uninstall": _uninstall,
    "fleet": _fleet,
    "wheels": _wheels,
}


if __name__ == "__main__":
    sys.exit(main())
