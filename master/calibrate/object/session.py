"""A session guides a person through the object motion on a running master.

Guided object motion with a person.

Every second reports what is seen and what is still missing, until it is enough.

The guided motion with the master that runs: opens its bus.
"""

from collections.abc import Callable, Sequence

import numpy as np

from common.calibration import RigCalibration
from common.clock import Clock, SystemClock
from common.errors import FitError
from common.messages import HandPose
from master.calibrate.object.bundle import Seen, first_body, seen_in, usable
from master.calibrate.object.measure import ENOUGH, ENOUGH_LOOKS, MOTION, looks_of
from master.run.process import join_bus

Receive = Callable[[float], HandPose | None]


def guide(
    receive: Receive,
    rig: RigCalibration,
    names: Sequence[str],
    clock: Clock,
    notify: Callable[[str], None],
    longest_s: float,
) -> Seen:
    """Lead a person through the motion until it is enough, or the time is over.

    Args:
        receive: The next pose of the running master, waiting at most so long [s].
        rig: Of that master.
        names: Of the beads.
        clock: Of this machine.
        notify: Called with one line at a time.
        longest_s: How long the motion may take [s].

    Raises:
        CalibrationError: As `master.calibrate.object.bundle.seen_in`.
        FitError: No pose came.
    """
    poses = list[HandPose]()
    notify(MOTION)
    begin_ns = printed_ns = clock.now_ns()
    while clock.now_ns() - begin_ns < longest_s * 1e9:
        wait_s = 0.05
        pose = receive(wait_s)
        if pose is not None:
            poses.append(pose)
        now_ns = clock.now_ns()
        print_ns = 1_000_000_000
        if now_ns - printed_ns < print_ns:
            continue
        printed_ns = now_ns
        if not poses:
            notify("no pose comes: is `phalanx run` running, on this --bus?")
            continue
        line, enough = progress(seen_in(poses, rig, names))
        notify(line)
        if enough:
            break
    if not poses:
        raise FitError("no pose came: is `phalanx run` running, on this --bus?")
    return seen_in(poses, rig, names)


def progress(seen: Seen) -> tuple[str, bool]:
    """What there is and what is wanting, for a person; whether it is enough."""
    rows = np.flatnonzero(usable(seen))
    whole = int(seen.known.all(axis=1).sum())
    looks = 0
    if len(rows):
        shown = 200  # epochs from which ways of turning are counted while it goes on
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, shown).astype(np.int64))]
        try:
            some = Seen(seen.names, seen.t_s[rows], seen.points_m[rows], seen.cov_m2[rows])
            looks = looks_of(first_body(some)[1])
        except FitError:
            looks = 0
    share = min(whole / ENOUGH, looks / ENOUGH_LOOKS, 1.0)
    recent = seen.known[-30:].mean(axis=0)
    poor = [name for name, part in zip(seen.names, recent, strict=True) if part < 0.5]
    if poor:
        hint = f"not seen by two cameras: {', '.join(poor)}"
    elif share >= 1.0:
        hint = "done"
    elif looks / ENOUGH_LOOKS < whole / ENOUGH:
        hint = "turn it about another axis, and carry it elsewhere"
    else:
        hint = "go on like this"
    return f"{100 * share:3.0f} %  {whole} epochs, {looks} ways of turning and places. {hint}", share >= 1.0


def observe_live(
    bus: str, rig: RigCalibration, names: Sequence[str], longest_s: float, notify: Callable[[str], None]
) -> Seen:
    """Lead the user through the motion.

    Args:
        bus: Endpoint of the running master's bus.
        rig: That it runs.
        names: Of the beads.
        longest_s: How long the motion may take [s].
        notify: Called with one line at a time.

    Raises:
        BusError: Nobody listens there.
        CalibrationError: The master runs another rig.
        FitError: No pose came.
    """
    link = join_bus(bus)
    try:
        depth = 512  # poses that may wait while a line is printed
        poses = link.subscribe("hand", depth=depth)

        def receive(timeout_s: float) -> HandPose | None:
            message = poses.get(timeout_s)
            # A wrist device alone reports hands without markers.
            return message if isinstance(message, HandPose) and len(message.markers_raw_m) else None

        return guide(receive, rig, names, SystemClock(), notify, longest_s)
    finally:
        link.close()
