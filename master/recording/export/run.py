"""Export of a source: which files are written, and the messages to the user."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal

from common.calibration import HandProfile, load
from common.errors import CalibrationError, PhalanxError, RecordingError
from common.hand.model import JOINTS, HandModel
from common.messages import Detections, ResultMessage
from master.outputs.poses import Poses
from master.outputs.rerun import write_rrd
from master.outputs.result_files import cannot_write
from master.recording.export.bvh import Axes, write_bvh
from master.recording.export.gltf import write_gltf
from master.recording.export.motion import Motion, Skeleton, complete, resample
from master.recording.export.table import (
    Column,
    TableKind,
    contact_columns,
    gesture_columns,
    hand_columns,
    object_columns,
    write_table,
)
from master.recording.export.take import Take, Window, open_take
from master.rig.setup import RigSetup, load_setups

Kind = Literal["csv", "parquet", "bvh", "gltf", "rrd"]
SUFFIXES: dict[Kind, tuple[str, ...]] = {
    "csv": (".csv",),
    "parquet": (".parquet",),
    "bvh": (".bvh",),
    "gltf": (".glb", ".gltf"),
    "rrd": (".rrd",),
}
ProgressCallback = Callable[[str, int, int], None]
_FRAME = "rig: that of the reference camera, x right, y down, z into the scene; metres"


@dataclass(frozen=True, slots=True)
class Wanted:
    """What is to be exported, and as what."""

    kind: Kind
    out: Path | None = None  # file or folder; None: beside the source
    only: tuple[str, ...] = ()  # hands; none: all
    profiles: tuple[Path, ...] = ()  # files of hands that go before those of the calibration
    calibration: Path = Path("calib_json")  # tree for what the source does not carry itself
    rigs: tuple[str, ...] = ()  # that the source was made with; none: those that it carries
    window: Window = field(default_factory=Window)
    rate_hz: float | None = None  # of a motion; None: that of the poses
    axes: Axes = field(default_factory=Axes)  # of a motion


def export(
    source: Path, wanted: Wanted, notify: Callable[[str], None], progress: ProgressCallback
) -> tuple[Path, ...]:
    """Export a source; return the files, in the order of writing.

    Args:
        source: poses.npz of a run, or an .mcap recording.
        notify: Called with each file that is there, and what is to be known of it.
        progress: Called with what is being done, and how much of how much.

    Raises:
        RecordingError: The source cannot be read, has nothing of the kind, or a file cannot be written.
        CalibrationError: The profile of a hand, or a rig, is missing or broken.
        PhalanxError: The name of the file does not fit the format.
    """
    take = open_take(source, wanted.window)
    for remark in take.remarks:
        notify(remark)
    hands = _chosen(take, wanted.only, source)
    target = _target(source, wanted)
    if wanted.kind in ("csv", "parquet"):
        written = _tables(take, hands, target, wanted.kind, notify, progress)
    elif wanted.kind == "rrd":
        written = _viewed(take, hands, target, wanted, notify, progress)
    else:
        written = _motions(take, hands, target, wanted, notify, progress)
    if not written:
        part = "" if wanted.window == Window() else " in this part of time"
        raise RecordingError(f"{source}: holds no poses of a hand{part}, nothing to export as {wanted.kind}")
    return written


def _chosen(take: Take, only: tuple[str, ...], source: Path) -> tuple[str, ...]:
    """The wanted hands; RecordingError: one is not there, or its name is none."""
    for hand in take.hands:
        _refuse_path(hand, source)
    for hand in only:
        if hand not in take.hands:
            there = ", ".join(take.hands) or "no hand"
            raise RecordingError(f"{source}: --only {hand}: it has {there}")
    return only or take.hands


def _refuse_path(name: str, source: Path) -> None:
    """A name of a foreign file must not control where files are read and written."""
    if not name or Path(name).name != name:
        raise RecordingError(
            f"{source}: {name!r} is no name of a hand or an object: it is not a file of ours"
        )


def _target(source: Path, wanted: Wanted) -> Path:
    """The file of the first hand; errors as of `export`."""
    suffixes, out = SUFFIXES[wanted.kind], wanted.out
    if out is None:
        return source.with_suffix(suffixes[0])
    if out.suffix and not out.is_dir():
        if out.suffix not in suffixes:
            raise PhalanxError(f"-o {out}: --to {wanted.kind} writes {' or '.join(suffixes)}")
        folder, name = out.parent, out.name
    else:
        folder, name = out, source.with_suffix(suffixes[0]).name
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from error
    return folder / name


def _sibling(target: Path, what: str) -> Path:
    return target.with_name(f"{target.stem}-{what}{target.suffix}")


def _of_hand(target: Path, hands: tuple[str, ...], hand: str) -> Path:
    return target if hand == hands[0] else _sibling(target, hand)


def _tables(
    take: Take,
    hands: tuple[str, ...],
    target: Path,
    kind: TableKind,
    notify: Callable[[str], None],
    progress: ProgressCallback,
) -> tuple[Path, ...]:
    """Write a table for each hand, object, pair of both, and for gestures if any."""
    begin, written = take.begin_t_ns, list[Path]()

    def write(path: Path, what: str, empty: list[Column], rows: Iterable[list[Column]]) -> None:
        about = {"table": what, "frame": _FRAME, "begin_t_ns": str(begin), "program": "Phalanx"}
        try:
            count = write_table(path, kind, empty, rows, about)
        except OSError as error:
            raise cannot_write(path, error) from error
        notify(f"wrote {path}: {what}, {count} rows of {len(empty)} columns")
        written.append(path)

    for hand in hands:
        batches = (hand_columns(one, begin) for one in _counted(take, hand, progress))
        write(
            _of_hand(target, hands, hand),
            f"hand {hand}",
            hand_columns(Poses.stacked((), hand=hand), begin),
            batches,
        )
    for thing in take.objects():
        _refuse_path(thing.object, target)
        columns = object_columns(thing, begin)
        write(_sibling(target, f"object_{thing.object}"), f"object {thing.object}", columns, [columns])
    for near in take.contacts():
        columns, name = contact_columns(near, begin), f"{near.hand}_{near.object}"
        _refuse_path(name, target)
        if near.hand in hands:
            what = f"contact of {near.hand} and {near.object}"
            write(_sibling(target, f"contact_{name}"), what, columns, [columns])
    if gestures := [one for one in take.gestures() if one.hand in hands]:
        columns = gesture_columns(gestures, begin)
        write(_sibling(target, "gestures"), "gestures", columns, [columns])
    return tuple(written)


def _counted(take: Take, hand: str, progress: ProgressCallback) -> Iterator[Poses]:
    """Yield the poses of a hand and report how many were read."""
    done, total = 0, take.count(hand)
    for batch in take.batches(hand):
        yield batch
        done += len(batch)
        progress(f"hand {hand}", done, total)


def _motions(
    take: Take,
    hands: tuple[str, ...],
    target: Path,
    wanted: Wanted,
    notify: Callable[[str], None],
    progress: ProgressCallback,
) -> tuple[Path, ...]:
    """A file for each hand that has a valid pose."""
    written: list[Path] = []
    with take.tree(wanted.calibration) as tree:
        skeletons = {hand: skeleton_of(hand, tree, wanted.profiles) for hand in hands}
    for hand in hands:
        try:
            motion = complete(_counted(take, hand, progress), skeletons[hand])
        except RecordingError as error:
            if len(hands) == 1:
                raise
            notify(f"{error}: no file of it")
            continue
        path = _of_hand(target, hands, hand)
        try:
            notify(_motion(path, motion, skeletons[hand], wanted, progress))
        except OSError as error:
            raise cannot_write(path, error) from error
        written.append(path)
    return tuple(written)


def _motion(
    path: Path, motion: Motion, skeleton: Skeleton, wanted: Wanted, progress: ProgressCallback
) -> str:
    """Write one motion file and return the message about it."""
    rate_hz = wanted.rate_hz
    if wanted.kind == "bvh":
        rate_hz = rate_hz or motion.rate_hz
        motion = resample(motion, rate_hz)
        free = write_bvh(path, motion, skeleton, rate_hz, wanted.axes, partial(progress, path.name))
    else:
        motion = motion if rate_hz is None else resample(motion, rate_hz)
        free = write_gltf(path, motion, skeleton, wanted.axes.up)
    text = f"wrote {path}: hand {skeleton.hand}, {len(motion)} {'frames' if rate_hz else 'keys'}"
    text += f" at {rate_hz:g} Hz" if rate_hz else ""
    if held := motion.held_frames:
        text += f"; in {held} of them something was not observed and stands still"
    if free:
        named = JOINTS[free[0]] if len(free) == 1 else f"{len(free)} joints"
        text += f"; {named} moved on {'its' if len(free) == 1 else 'their'} bone and has position keys"
    return text


def skeleton_of(hand: str, tree: Path, profiles: tuple[Path, ...]) -> Skeleton:
    """Hand at rest, of a given file or else the tree's hands/; CalibrationError."""
    given = {path: load(path, HandProfile) for path in profiles}
    for path, profile in given.items():
        if profile.name == hand:
            return _skeleton(path, profile)
    path = tree / "hands" / f"{hand}.json"
    if path.exists():
        return _skeleton(path, load(path, HandProfile))
    for path in sorted((tree / "hands").glob("*.json")):
        profile = load(path, HandProfile)
        if profile.name == hand:
            return _skeleton(path, profile)
    text = "".join(f"; {path} is of {profile.name!r}" for path, profile in given.items())
    raise CalibrationError(
        f"{tree / 'hands'}: no profile of hand {hand!r}{text}: give --hand FILE or --calibration DIR"
    )


def _skeleton(path: Path, profile: HandProfile) -> Skeleton:
    try:
        return Skeleton.of(HandModel.of(profile))
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error


def _viewed(
    take: Take,
    hands: tuple[str, ...],
    target: Path,
    wanted: Wanted,
    notify: Callable[[str], None],
    progress: ProgressCallback,
) -> tuple[Path, ...]:
    """An .rrd for each hand that has poses."""
    written: list[Path] = []
    rigs = wanted.rigs or take.rigs
    if not rigs:
        raise PhalanxError("--to rrd draws cameras too: say with --rig which rigs the poses were made with")
    with take.tree(wanted.calibration) as tree:
        for hand in hands:
            poses = list(_counted(take, hand, progress))
            if not poses:
                notify(f"hand {hand}: no poses: no file of it")
                continue
            path = _of_hand(target, hands, hand)
            setup = _setup_of(hand, tree, rigs, wanted.profiles)
            _write_rrd(path, take, poses, setup, partial(progress, path.name))
            notify(f"wrote {path}: hand {hand}, {sum(map(len, poses))} poses (open with: rerun {path})")
            written.append(path)
    return tuple(written)


def _setup_of(hand: str, tree: Path, rigs: Sequence[str], profiles: Sequence[Path]) -> RigSetup:
    """Return the setup that watched a hand, of several rigs in a calibration tree.

    `profiles`: a file of the hand in place of that which the rigs name; at most one.

    Raises:
        CalibrationError: A file is missing or broken, or none of the rigs watches this hand.
        PhalanxError: Several profiles.
    """
    if len(profiles) > 1:
        raise PhalanxError("--to rrd takes one --hand FILE at most: the hands are those that the rigs name")
    setups = load_setups(tree, rigs, next(iter(profiles), None))
    for setup in setups:
        if setup.hand.profile.name == hand:
            return setup
    known = ", ".join(setup.hand.profile.name for setup in setups)
    raise CalibrationError(f"rig {', '.join(rigs)}: watches {known}, the poses are of {hand!r}: give --rig")


def _write_rrd(
    path: Path, take: Take, batches: Sequence[Poses], setup: RigSetup, progress: Callable[[int, int], None]
) -> None:
    """Write the poses of a hand, one batch or more, with what else was recorded.

    Raises:
        RecordingError: The file cannot be written, or the poses are not of one marker count.
    """
    counts = {one.marker_count for one in batches}
    if len(counts) > 1:
        raise RecordingError(
            f"hand {batches[0].hand!r}: its number of markers changes, {sorted(counts)}: export one part of it, with"
            " --from and --until"
        )
    poses = Poses.joined(batches)
    cameras = {
        name: [setup.own(frame) for frame in frames]
        for name, frames in take.detections().items()
        if name in setup.camera_names
    }
    seen: dict[str, list[Detections]] = {name: frames for name, frames in cameras.items() if frames}
    write_rrd(path, poses, setup, detections=seen, results=_results(take, poses.hand), progress=progress)


def _results(take: Take, hand: str) -> list[ResultMessage]:
    """Objects, contact and gestures of this hand, each in the order of time."""
    out: list[ResultMessage] = [one for one in take.gestures() if one.hand == hand]
    for poses in take.objects():
        out += poses.messages()
    for near in take.contacts():
        if near.hand == hand:
            out += near.messages()
    return out
