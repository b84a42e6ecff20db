"""Command line of the master: `phalanx-master run | view | console | camera | gestures | calibrate | ...`."""

import logging
import os
import sys
from pathlib import Path
from typing import Annotated, Literal

try:
    import typer
except ModuleNotFoundError as error:  # a slave's machine has the scripts of both, and the packages of one
    raise SystemExit(
        f"phalanx-master: {error.name} is missing: install the master's packages, pip install '.[master]'"
    ) from error

from common.errors import PhalanxError
from common.frame_recording import open_recording
from common.keys import ENVIRONMENT, keys_folder, rig_key
from common.sim.scenes import NAMES
from common.sim.wrist.scene import WRIST_NAMES
from master.calibrate.cli import calibrate_app
from master.camera_command import camera
from master.checklist.command import check
from master.export.command import export
from master.fleet import fleet
from master.gestures.command import gestures_app
from master.hear import hear
from master.key_options import program
from master.keys_command import keys_app
from master.live import LiveSettings, run_live
from master.master_bus import bus_of_master
from master.options import (
    CALIB_JSON,
    HERE_BEACON,
    HERE_BIND,
    HERE_BUS,
    Beacon,
    Bind,
    BusEnd,
    Calibration,
    KeyFile,
    Rigs,
    Site,
    address,
)
from master.outputs.files import path_of_hand
from master.recording.command import info, play, record
from master.rig import load_setups, setups_with_hands
from master.router_command import relay, router
from master.send.command import send
from master.solve import rigs_to_solve, solve_hands
from master.stopping import stop_on_signals
from master.study.command import evaluate_app
from master.summary import read_summary, write_summary
from master.tuning import RigFiles

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)

Hand = Annotated[Path | None, typer.Option(help="Hand profile; default: the one the rig names.")]
Level = Literal["fk", "ik", "auto"]
Kind = Literal["markers", "wrist"]


@app.callback()
def phalanx_master() -> None:
    """Turn the detections of several cameras, or of a wrist device, into one hand of 26 joints.

    `phalanx-master COMMAND --help` shows its examples.
    """


@app.command()
def run(
    rig: Rigs,
    calibration: Calibration = CALIB_JSON,
    hand: Hand = None,
    beacon: Beacon = HERE_BEACON,
    bind: Bind = HERE_BIND,
    bus: BusEnd = HERE_BUS,
    key_file: KeyFile = None,
    start_timeout_s: Annotated[
        float, typer.Option(help="How long the first camera waits for the others.")
    ] = 5.0,
    poses: Annotated[
        Path | None,
        typer.Option(
            help="Write every pose to this .npz; of a second hand beside it, with its name, and in the same folder"
            " object_NAME.npz, contact_HAND_NAME.npz and gestures.jsonl."
        ),
    ] = None,
    summary: Annotated[Path | None, typer.Option(help="Write the figures of the run to this .json.")] = None,
    record: Annotated[
        Path | None,
        typer.Option(
            help="Record all that is taken and told to this .mcap, from the first message on: `play` solves it again,"
            " bit for bit."
        ),
    ] = None,
) -> None:
    """Track live until Ctrl-C; hands, objects, contact and gestures go to the bus (phalanx/hand/<name>, .../object/...)
    and, if asked, to files.

    Several rigs of one hand are one hand: cameras that watch its markers and the device on its wrist are solved
    together. Rigs of two hands are two hands, each published under its own name. The files of rigs, cameras, hands,
    objects and gestures are followed: what changes there is used at once.

    Examples:

      phalanx-master run --rig desk

      phalanx-master run --rig desk --rig wrist

      phalanx-master run --rig desk --rig wrist-left

      phalanx-master run --rig desk-wand --poses out/poses.npz

      phalanx-master run --rig desk --record out/wave.mcap

      phalanx-master run --rig desk --keys DIR --beacon 192.168.1.255:47800 --bind 0.0.0.0:47801 --bus tls/0.0.0.0:47802
    """
    setups = load_setups(calibration, rig, hand)
    settings = LiveSettings(
        address(beacon, "--beacon"),
        address(bind, "--bind"),
        bus,
        start_timeout_s,
        poses,
        summary,
        RigFiles(calibration, tuple(rig), hand),
        record,
    )
    run_live(setups, rig_key(os.environ, key_file), settings, stop_on_signals(), _say)


@app.command(name="solve")
def solve_command(
    recording: Annotated[Path, typer.Argument(help="Folder of a raw-frame recording.")],
    detections: Annotated[Path, typer.Option(help="Folder with detections_<camera>.npz, tags_<camera>.npz.")],
    out: Annotated[
        Path, typer.Option(help="Folder for poses.npz, summary.json, and what else there is: see below.")
    ],
    calibration: Annotated[
        Path | None,
        typer.Option(help="Folder with hands/, gestures/, and objects/ that the recording does not carry."),
    ] = None,
    hand: Hand = None,
    rig_names: Annotated[
        list[str] | None,
        typer.Option("--rig", help="Rig of the recording; once for each that is to be solved; default: all."),
    ] = None,
    only: Annotated[
        Kind | None,
        typer.Option(
            help="Of a recording of both kinds: what the cameras, or what the wrist device tells alone."
        ),
    ] = None,
    level: Annotated[
        Level | None,
        typer.Option(
            help="Of a wrist device: fingers from the laser alone (fk), from laser and fingertip (ik), or from what "
            "there is (auto); default: what the rig says."
        ),
    ] = None,
) -> None:
    """Solve recorded detections offline and deterministically: no clock, no network.

    Cameras and wrist device of one hand make one poses.npz together. Of a second hand there is poses-HAND.npz. Beside
    them stand object_NAME.npz and contact_HAND_NAME.npz of tracked objects, and gestures.jsonl, a Gesture a line.

    Examples:

      phalanx-master solve RECORDING --detections DIR --out DIR

      phalanx-master solve GRASP --detections DIR --out DIR/markers --only markers

      phalanx-master solve CURL --detections DIR --out DIR --hand HAND.json --level fk
    """
    opened = open_recording(recording)
    rigs = rigs_to_solve(opened.manifest, rig_names or [], only, level)
    setups = setups_with_hands(rigs, opened.manifest.cameras, calibration, hand, opened.manifest.objects)
    out.mkdir(parents=True, exist_ok=True)
    solve_hands(opened, setups, detections, out, lambda done, total: _progress("solving", done, total))
    _say(f"wrote {out / 'poses.npz'} and {out / 'summary.json'}")


@app.command()
def view(
    rig: Rigs,
    calibration: Calibration = CALIB_JSON,
    hand: Hand = None,
    bus: BusEnd = HERE_BUS,
    site: Site = None,
    web: Annotated[
        bool, typer.Option(help="Serve the viewer to a browser on 127.0.0.1 instead of a window.")
    ] = False,
    web_port: Annotated[int, typer.Option(min=1, max=65535, help="TCP port of that page.")] = 9090,
    save: Annotated[Path | None, typer.Option(help="Write an .rrd instead of showing anything.")] = None,
) -> None:
    """Show a running master in Rerun. A process of its own, which may come and go; it waits for the master.

    Examples:

      phalanx-master view --rig desk

      phalanx-master view --rig desk --rig wrist

      phalanx-master view --rig desk --rig wrist

      phalanx-master view --rig desk --keys DIR --bus tls/192.168.1.2:47802 --web

      phalanx-master view --rig desk --keys DIR --bus tls/192.168.2.1:47810 --site room-a
    """
    from master.outputs.rerun import run_viewer

    setups = load_setups(calibration, rig, hand)
    stop = stop_on_signals()
    connection = bus_of_master(bus, stop, lambda error: _say(f"waiting for a master: {error}"), site)
    if connection is None:
        return
    try:
        mode = "save" if save is not None else "web" if web else "spawn"
        run_viewer(
            connection,
            setups,
            mode=mode,
            path=save,
            stop=stop,
            web_port=web_port,
            on_ready=_say,
        )
    finally:
        connection.close()


@app.command()
def console(
    calibration: Calibration = CALIB_JSON,
    rig: Annotated[
        list[str] | None,
        typer.Option("--rig", help="Rig that runs, once for each; default: desk, once its file is there."),
    ] = None,
    bus: BusEnd = HERE_BUS,
    beacon: Beacon = HERE_BEACON,
    bind: Bind = HERE_BIND,
    key_file: KeyFile = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port of the page; 0: a free one.")] = 8080,
    host: Annotated[
        str,
        typer.Option(
            help="Address to serve on. Elsewhere than on this machine the page asks for a password."
        ),
    ] = "127.0.0.1",
    password_file: Annotated[
        Path | None,
        typer.Option(
            help="Ask for the password in the first line of this file; default: one is made and said once."
        ),
    ] = None,
) -> None:
    """Serve the console: watch, tune, record and set up in a browser. A process of its own, which may come and go.

    Needs no master and no file: the page sets a rig up from nothing. BEACON, BIND and the key are those of the
    processes that the page starts.

    Examples:

      phalanx-master console

      phalanx-master console --rig desk --rig wrist --port 8081

      phalanx-master console --keys DIR --bus tls/192.168.1.2:47802

      phalanx-master console --host 0.0.0.0
    """
    from master.console.app import run_console
    from master.console.state import ConsoleSettings
    from master.listening import is_open

    address(beacon, "--beacon")
    address(bind, "--bind")
    known = key_file is not None or ENVIRONMENT in os.environ or keys_folder(os.environ) is not None
    key = rig_key(os.environ, key_file) if known else None
    settings = ConsoleSettings(
        calibration,
        tuple(rig or ()),
        bus,
        beacon,
        bind,
        key,
        port,
        host,
        password_file,
        is_open(os.environ),
    )
    run_console(settings, stop_on_signals(), _say)


@app.command()
def report(
    poses: Annotated[Path, typer.Option(help="poses.npz of the run.")],
    scene_epoch_ns: Annotated[
        int, typer.Option(help="Scene time 0 on this machine's monotonic clock, in ns.")
    ],
    out: Annotated[Path, typer.Option(help="Folder for hand.png, run.rrd and summary.json.")],
    rig: Rigs,
    scene: Annotated[str, typer.Option(help=f"Scene: {NAMES}; of a wrist rig: {WRIST_NAMES}.")] = "standard",
    seed: Annotated[int, typer.Option(help="Seed of the scene.")] = 7,
    calibration: Calibration = CALIB_JSON,
    summary: Annotated[Path | None, typer.Option(help="summary.json of the run, to be completed.")] = None,
) -> None:
    """Compare a simulated run with the exact truth of its scene; write figures, a picture and a Rerun file.

    `phalanx demo` calls it at the end. Of a second hand the results are in a folder of its name below OUT.

    Examples:

      phalanx-master report --poses out/demo/poses.npz --scene-epoch-ns 123456789 --out out/demo
    """
    from master.report import Played, report_scene

    setups = load_setups(calibration, rig)
    figures = {} if summary is None else read_summary(summary)
    for number, setup in enumerate(setups):
        hand = setup.hand.profile.name
        file, folder = (path_of_hand(poses, hand), out / hand) if number else (poses, out)
        folder.mkdir(parents=True, exist_ok=True)
        played = Played.of(setup, scene, seed)
        full = report_scene(file, setup, played, scene_epoch_ns, folder, figures, _progress)
        write_summary(folder / "summary.json", full)


def main() -> None:
    """Entry point `phalanx-master`."""
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    logging.getLogger("matplotlib").setLevel(logging.WARNING)  # it tells of its font cache on the first run
    app.add_typer(calibrate_app(), name="calibrate")
    app.add_typer(evaluate_app(), name="evaluate")
    app.add_typer(gestures_app(), name="gestures")
    app.add_typer(keys_app(), name="keys")
    app.command()(camera)
    app.command()(check)
    app.command()(export)
    app.command()(fleet)
    app.command()(hear)
    for command in (record, play, info, router, relay):
        app.command()(command)
    app.command()(send)
    try:
        program(app)()
    except PhalanxError as error:
        print(f"phalanx-master: {error}", file=sys.stderr)
        sys.exit(1)


def _say(line: str) -> None:
    print(f"master: {line}", flush=True)


def _progress(what: str, done: int, total: int) -> None:
    if sys.stderr.isatty():
        print(f"\r{what}: {100 * done // max(total, 1)} %   ", end="", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
