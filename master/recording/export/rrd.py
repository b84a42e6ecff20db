"""Export of a source as an .rrd for the Rerun viewer.

It is drawn as the running viewer draws it: hand, cameras, objects, plots.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

from common.errors import CalibrationError, PhalanxError, RecordingError
from common.messages import Detections, ResultMessage
from master.outputs.poses import Poses
from master.outputs.rerun import write_rrd
from master.recording.export.take import Take
from master.rig.setup import RigSetup, load_setups


def setup_of(hand: str, tree: Path, rigs: Sequence[str], profiles: Sequence[Path]) -> RigSetup:
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


def write_take(
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
