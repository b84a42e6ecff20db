"""`phalanx export SOURCE --compare FILE`: poses against motion capture."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from common.calibration import RigCalibration, load
from common.errors import PhalanxError, RecordingError
from common.hand.model import JOINTS
from master.mocap.align import Alignment, align
from master.mocap.bvh_file import MARKERS, JointMotion, Track, known
from master.mocap.compare import alignment_json, alignment_lines, compare, figures, table_lines
from master.mocap.read import Reading, read_motion
from master.outputs.poses import Poses
from master.recording.export.take import Take, Window, open_take

_SIX = MARKERS[:6]  # the order of a rig's markers, where nothing else is stated


def compare_source(
    source: Path,
    truth: Path,
    reading: Reading,
    window: Window,
    notify: Callable[[str], None],
    *,
    hands: Sequence[str] = (),
    aligned: bool = False,
    calibration: Path,
    rigs: Sequence[str] = (),
) -> dict[str, object]:
    """Compare a source with a motion capture; return all figures, for a program.

    Args:
        source: poses.npz of a run, or an .mcap recording.
        truth: The motion capture.
        reading: How that is to be read.
        notify: Called with a line at a time.
        hands: Name of the hand; none: the only one of the source.
        aligned: The file has the rig's frame, and the clock of the poses or seconds from their beginning.
        calibration: Tree with rigs.
        rigs: Name of the rig whose markers the poses have; none: the default six.

    Raises:
        RecordingError: The source or the motion capture cannot be read, or have no time or point in common.
        CalibrationError: The rig, or the file of names, is missing or broken.
        FitError: They cannot be brought together.
    """
    take = open_take(source, window)
    for remark in take.remarks:
        notify(remark)
    poses = _poses(take, hands, source)
    motion = read_motion(truth, reading)
    for remark in motion.remarks:
        notify(remark)
    names = _marker_names(poses, calibration, rigs)
    ours, theirs = _common(poses, motion, names)
    if aligned:
        alignment, how = _own_clock(take.begin_t_ns, poses, motion)
        notify(how)
    else:
        alignment = align(ours, theirs)
        for line in alignment_lines(alignment):
            notify(line)
    compared = compare(poses, motion, alignment, names)
    found = figures(compared)
    if found["joint_mm"] is None and not np.isfinite(compared.marker_mm).any():
        raise RecordingError(
            f"{truth}: at no time of the poses of {source} does it know a point that they have"
        )
    for line in table_lines(found):
        notify(line)
    fitted = alignment_json(None if aligned else alignment)
    return {"truth": str(truth), "hand": poses.hand, "alignment": fitted, **found}


def _poses(take: Take, hands: Sequence[str], source: Path) -> Poses:
    """All poses of one hand; RecordingError: several and none is named, or none."""
    there = ", ".join(take.hands) or "no hand"
    named = [hand for hand in take.hands if not hands or hand in hands]
    if len(named) != 1 or len(hands) > 1:
        raise RecordingError(f"{source}: has {there}: name one of them with --only")
    name = named[0]
    batches = [batch for batch in take.batches(name) if len(batch)]
    if not batches:
        raise RecordingError(f"{source}: holds no poses of {name}, nothing to compare")
    if len({batch.marker_count for batch in batches}) > 1:
        raise RecordingError(f"{source}: its poses change their markers: compare a part, --from and --until")
    return Poses.joined(batches)


def _marker_names(poses: Poses, calibration: Path, rigs: Sequence[str]) -> tuple[str, ...]:
    """The markers of poses, in their order; none where it is not known."""
    if not rigs:
        return _SIX if poses.marker_count == len(_SIX) else ()
    rig, *others = rigs
    if others:
        raise PhalanxError("--compare: one --rig, whose markers the poses have")
    names = load(calibration / "rigs" / f"{rig}.json", RigCalibration).markers
    if len(names) != poses.marker_count:
        raise PhalanxError(f"--rig {rig}: has {len(names)} markers, the poses {poses.marker_count}")
    return names


def _common(poses: Poses, motion: JointMotion, marker_names: tuple[str, ...]) -> tuple[Track, Track]:
    """The points that both have, in one order; tracked ones where they suffice."""
    valid = poses.valid & known(poses.position_m)
    sure = valid & poses.tracked
    enough = 0.1  # of the valid joints: if more are TRACKED, frame and clock are fitted by these alone
    used = sure if sure.sum() > enough * valid.sum() else valid
    joints = np.where(used[..., None], poses.position_m, np.nan)
    both = [name for name in JOINTS if name in motion.names]
    marked = [name for name in marker_names if name in motion.names]
    if not both and not marked:
        raise RecordingError(f"{motion.source}: has {', '.join(motion.names)}, of which the poses have none")
    ours = [joints[:, JOINTS.index(name)] for name in both]
    ours += [poses.markers_m[:, marker_names.index(name)] for name in marked]
    theirs = [motion.of(name) for name in (*both, *marked)]
    return Track(poses.t_ns, np.stack(ours, axis=1)), Track(motion.t_ns, np.stack(theirs, axis=1))


def _own_clock(begin_t_ns: int, poses: Poses, motion: JointMotion) -> tuple[Alignment, str]:
    """Align clocks only: the poses', or seconds from their begin; most overlap wins."""
    first, last = (int(motion.t_ns[k]) for k in (0, -1))
    shared = {
        offset_ns: min(last + offset_ns, int(poses.t_ns[-1])) - max(first + offset_ns, int(poses.t_ns[0]))
        for offset_ns in (0, begin_t_ns)
    }
    offset_ns = max(shared, key=lambda one: shared[one])
    if shared[offset_ns] < 0:
        raise RecordingError(
            f"{motion.source}: its times, {1e-9 * first:.3f} to {1e-9 * last:.3f} s, are not on the clock of the poses,"
            f" {1e-9 * poses.t_ns[0]:.3f} to {1e-9 * poses.t_ns[-1]:.3f} s, nor seconds from their beginning:"
            " leave --aligned out"
        )
    counted = "seconds from the beginning of the poses' source" if offset_ns else "the clock of the poses"
    return Alignment(np.eye(4), offset_ns), f"frame taken as the rig's, times as {counted} (--aligned)"
