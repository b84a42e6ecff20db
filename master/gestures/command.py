"""`phalanx gestures` teaches poses and reads gestures of recorded hands."""

from argparse import Namespace
from collections.abc import Iterable
from pathlib import Path

import msgspec
import numpy as np

from common.bus.bus import ANY
from common.calibration import HandProfile, load, save
from common.calibration.gesture_settings import GestureSettings, default_gestures
from common.clock import SystemClock
from common.command_line import UsageError, echo
from common.errors import CalibrationError, FitError, PhalanxError
from common.hand.model import HandModel
from common.messages import Gesture, HandPose
from master.calibrate.tree_files import provenance
from master.gestures.poses import GestureRecogniser
from master.gestures.templates import Example, PoseTemplate, held, learn, template_session, what_lacks
from master.outputs.poses import Poses
from master.run.process import join_bus


def spans_of(gestures: Iterable[Gesture], since_ns: int) -> list[str]:
    """Return a line for each gesture, in order of their begins, since an epoch [ns].

    From when to when (where the poses end before it, its last message), which one, its highest confidence, and what
    it reported last: a distance, an angle; nothing for a pose.
    """
    last: dict[tuple[int, str, str], Gesture] = {}
    most: dict[tuple[int, str, str], float] = {}
    for one in gestures:
        key = (one.began_t_ns, one.kind, one.name)
        most[key] = max(most.get(key, 0.0), one.confidence)
        last[key] = one
    lines: list[str] = []
    for key, one in sorted(last.items(), key=lambda item: item[0][0]):
        began, ended = (1e-9 * (t_ns - since_ns) for t_ns in (one.began_t_ns, one.t_ns))
        who = one.kind if one.name == one.kind else f"{one.kind} {one.name}"
        values = [f"{1e3 * one.distance_m:.1f} mm"] if np.isfinite(one.distance_m) else []
        values += [f"{np.degrees(one.angle_rad):.1f} deg"] if np.isfinite(one.angle_rad) else []
        text = f"{began:9.3f} s to {ended:9.3f} s  {who:24s} {most[key]:.2f}  {', '.join(values)}"
        lines.append(text.rstrip())
    return lines


def lines_of(gesture: Gesture) -> str:
    """Return a message as a line of JSON: arrays are lists, missing values null."""
    plain = {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in msgspec.structs.asdict(gesture).items()
    }
    return msgspec.json.encode(plain).decode()


_TOOL = "gestures teach"


def gestures(options: Namespace) -> None:
    """Teach a pose, forget one, read a recorded run, or list the poses.

    Raises:
        UsageError: An option has no meaning with what is asked for.
    """
    if options.teach is None:
        for given, option in (
            (options.ranges, "--range"),
            (options.within, "--within"),
            (options.out, "--out"),
            (options.hand_name, "--hand-name"),
        ):
            if given:
                raise UsageError(f"{option} is for --teach")
    if options.teach is not None:
        _teach(options)
    elif options.forget is not None:
        _forget(options)
    elif options.poses is not None:
        _read(options)
    else:
        _list(_settings(_settings_path(options)))


def _teach(options: Namespace) -> None:
    """Teach a pose from examples; a pose of that name is replaced."""
    path = _settings_path(options)
    known = _settings(path)
    if options.poses is not None:
        shown, source = _recorded(options), str(options.poses)
    elif options.ranges:
        raise PhalanxError("--range: belongs to a recorded run, name it with --poses")
    else:
        shown, source = _live(options), "shown before the sensors"
    templates = learn(options.teach, shown, known, options.within)
    target: Path = options.out or path
    target.parent.mkdir(parents=True, exist_ok=True)
    save(target, with_pose(known, options.teach, templates, source))
    for line in (*templates.stated, f"wrote {target}"):
        echo(line)


def _read(options: Namespace) -> None:
    """Notify which gestures a recorded hand makes, from when to when."""
    path = _settings_path(options)
    known = load(path, GestureSettings) if options.settings is not None else _settings(path)
    rows = Poses.load(options.poses)
    recogniser = GestureRecogniser(known, _model(options.hand, rows.hand, options.calibration))
    stated = [gesture for pose in rows.messages() for gesture in recogniser.push(pose)]
    if options.every:
        for gesture in stated:
            echo(lines_of(gesture))
    for line in spans_of(stated, int(rows.t_ns[0]) if len(rows) else 0):
        echo(line)


def _list(known: GestureSettings) -> None:
    """The poses, and what is asked of each."""
    for name, shape in known.poses.items():
        templates = known.provenance.get(name)
        echo(f"{name}{'' if templates is None else f' (template of {templates.date})'}")
        for quantity, span in shape.ranges.items():
            echo(f"  {quantity:24s} {span.low:8.4g} to {span.high:8.4g}, border {span.soft:.3g}")


def _forget(options: Namespace) -> None:
    """Take a pose out of the file."""
    path, name = _settings_path(options), options.forget
    known = _settings(path)
    if name not in known.poses:
        raise PhalanxError(f"{path}: poses: no {name!r}; there are {', '.join(known.poses)}")
    left = {other: shape for other, shape in known.poses.items() if other != name}
    sources = {other: source for other, source in known.provenance.items() if other != name}
    save(path, msgspec.structs.replace(known, poses=left, provenance=sources))
    echo(f"wrote {path}")


def with_pose(settings: GestureSettings, name: str, templates: PoseTemplate, source: str) -> GestureSettings:
    """Return the settings with a template pose added, and its origin."""
    made = provenance(_TOOL, (source,), templates.residual)
    return msgspec.structs.replace(
        settings,
        poses=settings.poses | {name: templates.shape},
        provenance=settings.provenance | {name: made},
    )


def _recorded(options: Namespace) -> list[Example]:
    """Examples of a recorded run."""
    rows = Poses.load(options.poses)
    model = _model(options.hand, rows.hand, options.calibration)
    out: list[Example] = []
    for text in options.ranges:
        low, high = seconds_of(text)
        t_s = 1e-9 * (rows.t_ns - rows.t_ns[0])
        chosen = rows.where((t_s >= low) & (t_s <= high)).messages()
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


def _live(options: Namespace) -> list[Example]:
    """Examples that are shown before a running master."""
    link = join_bus(options.bus)
    try:
        depth = 256  # poses that may wait while a line is printed
        queue = link.subscribe("hand", options.hand_name or ANY, depth)
        first_s = 10.0  # until the first pose of a running master must have come
        first = queue.get(first_s)
        if not isinstance(first, HandPose):
            raise FitError(
                f"no hand came within {first_s:g} s; is `phalanx run` running, on --bus {options.bus}"
            )

        def receive(timeout_s: float) -> HandPose | None:
            message = queue.get(timeout_s)
            return message if isinstance(message, HandPose) and message.hand == first.hand else None

        model = _model(options.hand, first.hand, options.calibration)
        return template_session(receive, model, options.teach, options.examples, SystemClock(), echo)
    finally:
        link.close()


def _settings_path(options: Namespace) -> Path:
    return options.settings or options.calibration / "gestures" / "default.json"


def _settings(path: Path) -> GestureSettings:
    """Read the settings file; where there is none the defaults, named as the path is."""
    if path.exists():
        return load(path, GestureSettings)
    return msgspec.structs.replace(default_gestures(), name=path.stem)


def _model(hand: Path | None, name: str, calibration: Path) -> HandModel:
    path = calibration / "hands" / f"{name}.json" if hand is None else hand
    profile = load(path, HandProfile)
    if profile.name != name:
        raise CalibrationError(f"{path}: name: it is the hand {profile.name!r}, the poses are of {name!r}")
    return HandModel.of(profile)
