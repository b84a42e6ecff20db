"""`phalanx-master gestures teach | read | list | forget`: the poses of a settings file, and what recorded hands say."""

from pathlib import Path
from typing import Annotated

import msgspec
import typer

from common.calibration import HandProfile, load, save
from common.clock import SystemClock
from common.errors import CalibrationError, FitError, PhalanxError
from common.gesture_settings import GestureSettings, default_gestures
from common.hand_model import HandModel
from common.messages import HandPose
from master.calibrate.tree_files import provenance
from master.gestures.reading import lines_of, read_gestures, spans_of
from master.gestures.template_session import held, template_session, what_lacks
from master.gestures.templates import FEWEST, MOST, Example, PoseTemplate, learn
from master.master_bus import join_bus
from master.options import CALIB_JSON, HERE_BUS, BusEnd, Calibration
from master.outputs.files import load_poses

Settings = Annotated[
    Path | None,
    typer.Option(
        "--settings", help="Gestures file; default: CALIBRATION/gestures/default.json.", show_default=False
    ),
]
Hand = Annotated[
    Path | None,
    typer.Option(help="Hand profile; default: the one that the poses name, in CALIBRATION/hands."),
]
PosesFile = Annotated[Path, typer.Argument(help="poses.npz of a run.")]
_DEPTH = 256  # poses that may wait while a line is printed
_FIRST_S = 10.0  # until the first pose of a running master must have come
_TOOL = "gestures teach"


def gestures_app() -> typer.Typer:
    """The commands as one program, to be put under a name."""
    app = typer.Typer(no_args_is_help=True, add_completion=False, callback=_about)
    for command in (make_template, read, forget):
        app.command(command.__name__)(command)
    app.command("list")(show)
    return app


def _about() -> None:
    """The poses that a hand is known by: teach one, forget one, and read what recorded hands say."""


def make_template(
    name: Annotated[str, typer.Argument(help="Name of the pose; one of that name is replaced.")],
    examples: Annotated[
        int, typer.Option(min=FEWEST, max=MOST, help="How many, before a running master.")
    ] = 5,
    poses: Annotated[
        Path | None, typer.Option(help="Take the examples from this poses.npz, each from a --range.")
    ] = None,
    ranges: Annotated[
        list[str] | None,
        typer.Option(
            "--range", metavar="FROM-TO", help="Seconds after its first pose; once for each example."
        ),
    ] = None,
    within: Annotated[
        str | None, typer.Option(help="The pose is a special case of this one, and wins where both fit.")
    ] = None,
    settings: Settings = None,
    out: Annotated[
        Path | None, typer.Option(help="Gestures file to write; default: the one that was read.")
    ] = None,
    hand: Hand = None,
    hand_name: Annotated[
        str | None, typer.Option(help="Of two hands before a running master, the one that shows it.")
    ] = None,
    calibration: Calibration = CALIB_JSON,
    bus: BusEnd = HERE_BUS,
) -> None:
    """Teach a pose: show it a few times before a running master, or say where it is in a recorded run.

    The hand is known by it at once: a running master follows the file. A pose that cannot be told from another is
    refused, and the file stays as it was.

    Examples:

      phalanx-master gestures teach thumbs_up

      phalanx-master gestures teach vulcan --within open_palm --examples 8

      phalanx-master gestures teach horns --poses out/poses.npz --range 1.0-1.8 --range 4.2-5 --range 7.5-8.1
    """
    path = _settings_path(calibration, settings)
    known = _settings(path)
    if poses is not None:
        shown, source = _recorded(poses, ranges or [], hand, calibration), str(poses)
    elif ranges:
        raise PhalanxError("--range: belongs to a recorded run, name it with --poses")
    else:
        shown, source = _live(name, examples, bus, hand, hand_name, calibration), "shown before the sensors"
    templates = learn(name, shown, known, within)
    target = path if out is None else out
    target.parent.mkdir(parents=True, exist_ok=True)
    save(target, with_pose(known, name, templates, source))
    for line in (*templates.stated, f"wrote {target}"):
        typer.echo(line)


def read(
    poses: PosesFile,
    settings: Settings = None,
    hand: Hand = None,
    calibration: Calibration = CALIB_JSON,
    every: Annotated[bool, typer.Option(help="Every message as a line of JSON, too.")] = False,
) -> None:
    """Say what a recorded hand says: its gestures, from when to when.

    Examples:

      phalanx-master gestures read out/demo/poses.npz

      phalanx-master gestures read out/poses.npz --settings mine.json --hand me.json
    """
    path = _settings_path(calibration, settings)
    known = load(path, GestureSettings) if settings is not None else _settings(path)
    rows = load_poses(poses)
    stated = read_gestures(rows, known, _model(hand, rows.hand, calibration))
    if every:
        for gesture in stated:
            typer.echo(lines_of(gesture))
    begin_ns = int(rows.t_ns[0]) if len(rows) else 0
    for span in spans_of(stated):
        typer.echo(span.line(begin_ns))


def show(settings: Settings = None, calibration: Calibration = CALIB_JSON) -> None:
    """The poses of a gestures file, and what is asked of each."""
    known = _settings(_settings_path(calibration, settings))
    for name, shape in known.poses.items():
        templates = known.provenance.get(name)
        typer.echo(f"{name}{'' if templates is None else f' (template of {templates.date})'}")
        for quantity, span in shape.ranges.items():
            typer.echo(f"  {quantity:24s} {span.low:8.4g} to {span.high:8.4g}, border {span.soft:.3g}")


def forget(
    name: Annotated[str, typer.Argument(help="Name of the pose.")],
    settings: Settings = None,
    calibration: Calibration = CALIB_JSON,
) -> None:
    """Take a pose out of a gestures file."""
    path = _settings_path(calibration, settings)
    known = _settings(path)
    if name not in known.poses:
        raise PhalanxError(f"{path}: poses: no {name!r}; there are {', '.join(known.poses)}")
    left = {other: shape for other, shape in known.poses.items() if other != name}
    sources = {other: source for other, source in known.provenance.items() if other != name}
    save(path, msgspec.structs.replace(known, poses=left, provenance=sources))
    typer.echo(f"wrote {path}")


def with_pose(settings: GestureSettings, name: str, templates: PoseTemplate, source: str) -> GestureSettings:
    """The settings with a taught pose, and where it comes from."""
    made = provenance(_TOOL, (source,), templates.residual)
    return msgspec.structs.replace(
        settings,
        poses=settings.poses | {name: templates.shape},
        provenance=settings.provenance | {name: made},
    )


def _recorded(path: Path, ranges: list[str], hand: Path | None, calibration: Path) -> list[Example]:
    """Examples of a recorded run."""
    rows = load_poses(path)
    model = _model(hand, rows.hand, calibration)
    out: list[Example] = []
    for text in ranges:
        low, high = seconds_of(text)
        t_s = 1e-9 * (rows.t_ns - rows.t_ns[0])
        chosen = [rows.pose(k) for k in ((t_s >= low) & (t_s <= high)).nonzero()[0].tolist()]
        frames = held(chosen, model)
        if lacking := what_lacks(frames):
            raise FitError(f"--range {text}: {lacking if frames else 'no hand in it'}")
        out.append(Example.of(frames))
    return out


def seconds_of(text: str) -> tuple[float, float]:
    """FROM-TO as two numbers.

    Raises:
        PhalanxError: It is something else.
    """
    try:
        low, high = (float(part) for part in text.split("-"))
    except ValueError as error:
        raise PhalanxError(f"--range {text}: write FROM-TO in seconds, for example 1.0-1.8") from error
    if not 0.0 <= low < high:
        raise PhalanxError(f"--range {text}: FROM must be below TO")
    return low, high


def _live(
    name: str, examples: int, bus: str, hand: Path | None, hand_name: str | None, calibration: Path
) -> list[Example]:
    """Examples that are shown before a running master."""
    link = join_bus(bus)
    try:
        queue = (
            link.subscribe("hand", depth=_DEPTH)
            if hand_name is None
            else link.subscribe("hand", hand_name, _DEPTH)
        )
        first = queue.get(_FIRST_S)
        if not isinstance(first, HandPose):
            raise FitError(
                f"no hand came within {_FIRST_S:g} s; is `phalanx-master run` running, on --bus {bus}"
            )

        def receive(timeout_s: float) -> HandPose | None:
            message = queue.get(timeout_s)
            return message if isinstance(message, HandPose) and message.hand == first.hand else None

        model = _model(hand, first.hand, calibration)
        return template_session(receive, model, name, examples, SystemClock(), typer.echo)
    finally:
        link.close()


def _settings_path(calibration: Path, settings: Path | None) -> Path:
    return calibration / "gestures" / "default.json" if settings is None else settings


def _settings(path: Path) -> GestureSettings:
    """The file, or the defaults where there is none yet; a new file is called as the path says."""
    if path.exists():
        return load(path, GestureSettings)
    return msgspec.structs.replace(default_gestures(), name=path.stem)


def _model(hand: Path | None, name: str, calibration: Path) -> HandModel:
    path = calibration / "hands" / f"{name}.json" if hand is None else hand
    profile = load(path, HandProfile)
    if profile.name != name:
        raise CalibrationError(f"{path}: name: it is the hand {profile.name!r}, the poses are of {name!r}")
    return HandModel.of(profile)
