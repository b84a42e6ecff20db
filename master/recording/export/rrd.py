"""Export of a source as an .rrd for the Rerun viewer.

It is drawn as the running viewer draws it: hand, cameras, objects, plots.
"""

from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from common.errors import CalibrationError, PhalanxError, RecordingError
from common.messages import Detections, ResultMessage
from master.evaluation.run_results import contact_row, object_row
from master.outputs.poses import Poses
from master.outputs.rerun import write_rrd
from master.recording.export.take import Take
from master.rig.setup import RigSetup, load_setups


def setup_of(hand: str, tree: Path, rigs: Sequence[str], profiles: Sequence[Path]) -> RigSetup:
    """What watched a hand.

    Args:
        hand: Its name.
        tree: Calibration with the rigs.
        rigs: Names of rigs, of this hand and others.
        profiles: A file of the hand in place of that which the rigs name; at most one.

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
    """Write the poses of a hand with what else was recorded.

    Args:
        path: The file; replaced only by a complete one.
        take: The source: objects, contact, gestures and what cameras saw.
        batches: The poses, one batch or more.
        setup: What watched the hand.
        progress: Called with how many poses of how many are written.

    Raises:
        RecordingError: The file cannot be written, or the poses are not of one marker count.
    """
    poses = _joined(batches)
    cameras = {
        name: [setup.own(frame) for frame in frames]
        for name, frames in take.detections().items()
        if name in setup.camera_names
    }
    seen: dict[str, list[Detections]] = {name: frames for name, frames in cameras.items() if frames}
    write_rrd(path, poses, setup, detections=seen, results=_results(take, poses.hand), progress=progress)


def _joined(batches: Sequence[Poses]) -> Poses:
    counts = {one.marker_count for one in batches}
    if len(counts) > 1:
        raise RecordingError(
            f"hand {batches[0].hand!r}: its number of markers changes, {sorted(counts)}: export one part of it, with"
            " --from and --until"
        )
    arrays: dict[str, Any] = {
        one.name: np.concatenate([getattr(batch, one.name) for batch in batches])
        for one in fields(Poses)
        if one.name != "hand"
    }
    return Poses(hand=batches[0].hand, **arrays)


def _results(take: Take, hand: str) -> list[ResultMessage]:
    """Objects, contact and gestures of this hand, each in the order of time."""
    out: list[ResultMessage] = [one for one in take.gestures() if one.hand == hand]
    for poses in take.objects():
        out += [object_row(poses, row) for row in range(len(poses))]
    for near in take.contacts():
        if near.hand == hand:
            out += [contact_row(near, row) for row in range(len(near))]
    return out
