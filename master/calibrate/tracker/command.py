"""Register a tracker: guide its user, fit and save.

A motion that cameras and tracking system both see enters, live on a running master or as a file;
T_rig_tracking goes into the rig's file, T_object_tracker and stamp_offset_us into the object's. `Session`
counts, `guide` talks: every second it reports what was seen so far and what is still missing.
"""

from argparse import Namespace
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from common.arrays import Float
from common.calibration import RigCalibration, load
from common.calibration.object_profile import ObjectProfile
from common.clock import Clock, SystemClock
from common.command_line import echo
from common.errors import CalibrationError, FitError, RecordingError
from common.messages import ObjectPose, ObjectSource, TrackerPose
from common.recording.recorded_files import read_npz, write_npz
from master.calibrate.tracker.fit import first_lag
from master.calibrate.tracker.registration import MOTION, Registration, documented, register
from master.calibrate.tracker.tracks import Coverage, coverage_of, object_track, tracker_track
from master.calibrate.tree_files import (
    load_marker_rig,
    print_lines,
    refusals_named,
    rig_in_tree,
    write_object,
    write_rig,
)
from master.commands.summary import write_summary
from master.run.process import join_bus

SILENT_S = 3.0

Receive = Callable[[float], ObjectPose | TrackerPose | None]


class Session:
    """Push machine of the guided motion.

    State: all poses of the motion, and the lag once known.
    """

    def __init__(self) -> None:
        self.objects: list[ObjectPose] = []
        self.tracked: list[TrackerPose] = []
        self._lag_s: float | None = None

    def push(self, message: ObjectPose | TrackerPose) -> None:
        """Take one pose, of the object by cameras or of the device."""
        if isinstance(message, TrackerPose):
            self.tracked.append(message)
        elif message.tracked and message.source in (ObjectSource.MARKERS, ObjectSource.TAGS):
            self.objects.append(message)

    def coverage(self) -> Coverage | None:
        """The coverage so far; None: one side has sent nothing yet."""
        if not (self.objects and self.tracked):
            return None
        zero_ns = min(self.objects[0].t_ns, self.tracked[0].t_ns)
        seen, device = object_track(self.objects, zero_ns), tracker_track(self.tracked, zero_ns)
        if len(seen) < 2 or len(device) < 2:
            return None
        found = coverage_of(seen, device, self._lag_s or 0.0)
        if self._lag_s is None and found.shared_s > 5.0:
            self._lag_s = first_lag(seen, device)
        return found

    def silent(self, now_ns: int) -> str:
        """The side that sends nothing just now, and what to look at; empty: both send."""
        if not _recent([one.t_ns for one in self.tracked[-1:]], now_ns):
            return "no tracker data received: is `phalanx-slave run --tracker` running, and does the master know it?"
        if not np.isfinite([one.position_m for one in self.tracked[-20:]]).any():
            return "the tracker does not know where it is: let it see a base station"
        if not _recent([one.t_ns for one in self.objects[-1:]], now_ns):
            return "the cameras do not see the object: markers or tags to the cameras"
        return ""


def guide(receive: Receive, clock: Clock, notify: Callable[[str], None], longest_s: float) -> Session:
    """Lead a person through the motion until it is enough, or the time is over.

    `receive` gives the next pose of object or device, waiting at most so long [s]; `notify` is called with
    one line at a time.

    Raises:
        FitError: Nothing was received from the cameras or the tracker all the time.
    """
    session = Session()
    notify(MOTION)
    begin_ns = printed_ns = clock.now_ns()
    enough = False
    while not enough and clock.now_ns() - begin_ns < longest_s * 1e9:
        message = receive(0.02)
        if message is not None:
            session.push(message)
        now_ns = clock.now_ns()
        if now_ns - printed_ns < 1_000_000_000:
            continue
        printed_ns = now_ns
        coverage, silent = session.coverage(), ""
        if now_ns - begin_ns > SILENT_S * 1e9:
            silent = session.silent(now_ns)
        if coverage is None:
            notify(silent or "waiting for cameras and tracker")
            continue
        enough_s = 15.0  # of both, when all turns are there: more of it makes the result surer
        enough = not coverage.missing and coverage.shared_s >= enough_s
        hint = silent or (
            coverage.missing[0] if coverage.missing else "go on like this" if not enough else "done"
        )
        notify(f"{100 * coverage.share:3.0f} %  {coverage.line()}. {hint}")
    if not (session.objects and session.tracked):
        raise FitError(session.silent(clock.now_ns()) or f"nothing was seen: {MOTION}")
    return session


def _recent(t_ns: list[int], now_ns: int) -> bool:
    return bool(t_ns) and now_ns - t_ns[0] < SILENT_S * 1e9


def observe_live(
    bus: str, profile: ObjectProfile, longest_s: float, notify: Callable[[str], None]
) -> Session:
    """Lead the user through the motion, on the bus of a running master.

    Raises:
        BusError: Nobody listens there.
        FitError: Nothing was received from the cameras or the tracker.
    """
    link = join_bus(bus)
    try:
        depth = 1024  # poses that may wait while a line is printed
        objects = link.subscribe("object", profile.name, depth)
        devices = link.subscribe("device", profile.tracker or profile.name, depth)

        def receive(timeout_s: float) -> ObjectPose | TrackerPose | None:
            message = objects.get(0.0) or devices.get(timeout_s)
            return message if isinstance(message, ObjectPose | TrackerPose) else None

        return guide(receive, SystemClock(), notify, longest_s)
    finally:
        link.close()


_KEYS = {"t_ns": (), "position_m": (3,), "orientation_wxyz": (4,)}
_FIX = "it needs t_ns, position_m and orientation_wxyz, each with object_ and tracker_ before it (docs/tracker.md)"


def write_motion(path: Path, objects: Sequence[ObjectPose], tracked: Sequence[TrackerPose]) -> None:
    """Save the poses of a motion as an .npz file that `read_motion` reads.

    Raises:
        RecordingError: The file cannot be written.
    """
    own = [one for one in objects if one.tracked]
    arrays = {
        "object_t_ns": np.array([one.t_ns for one in own], np.int64),
        "object_position_m": np.array([one.position_m for one in own]).reshape(-1, 3),
        "object_orientation_wxyz": np.array([one.orientation_wxyz for one in own]).reshape(-1, 4),
        "object_cov": np.array([one.cov for one in own]).reshape(-1, 6, 6),
        "object_source": np.array([one.source for one in own], np.uint8),
        "tracker_t_ns": np.array([one.t_ns for one in tracked], np.int64),
        "tracker_position_m": np.array([one.position_m for one in tracked]).reshape(-1, 3),
        "tracker_orientation_wxyz": np.array([one.orientation_wxyz for one in tracked]).reshape(-1, 4),
    }
    try:
        write_npz(path, arrays)
    except OSError as error:
        raise RecordingError(f"{path}: cannot write: {error.strerror}") from error


def read_motion(path: Path, profile: ObjectProfile) -> tuple[list[ObjectPose], list[TrackerPose]]:
    """Read poses of one object from cameras and tracker, on one clock; NaN: lost.

    Raises:
        RecordingError: The file is missing or broken, or lacks a key; the text states which.
    """
    names = [f"{who}_{key}" for who in ("object", "tracker") for key in _KEYS]
    arrays = read_npz(path, names, _FIX, also=("object_cov", "object_source"))
    sizes = {who: _checked(path, arrays, who) for who in ("object", "tracker")}
    cov = arrays.get("object_cov", np.full((sizes["object"], 6, 6), np.nan))
    source = arrays.get("object_source", np.full(sizes["object"], ObjectSource.TAGS))
    if cov.shape != (sizes["object"], 6, 6) or source.shape != (sizes["object"],):
        raise RecordingError(f"{path}: object_cov, object_source: not one for each of object_t_ns")
    try:
        objects = [
            ObjectPose(
                profile.name, int(t), p, q, c, float("nan"), int(s), bool(np.isfinite(p).all()), 1, 1, False
            )
            for t, p, q, c, s in zip(*(arrays[f"object_{key}"] for key in _KEYS), cov, source, strict=True)
        ]
        name = profile.tracker or profile.name
        tracked = [
            TrackerPose(name, 0, k, int(t), p, q)
            for k, (t, p, q) in enumerate(zip(*(arrays[f"tracker_{key}"] for key in _KEYS), strict=True))
        ]
    except (ValueError, TypeError) as error:
        raise RecordingError(f"{path}: {error}") from error
    return objects, tracked


def _checked(path: Path, arrays: dict[str, Float], who: str) -> int:
    """The number of poses; refuse keys that have another, or no numbers."""
    count = len(arrays[f"{who}_t_ns"]) if arrays[f"{who}_t_ns"].ndim == 1 else -1
    for key, shape in _KEYS.items():
        array = arrays[f"{who}_{key}"]
        if array.shape != (count, *shape) or array.dtype.kind not in "fiu":
            raise RecordingError(f"{path}: {who}_{key}: shape {array.shape}, {_FIX}")
    return count


def write_registration(
    out: Path, rig_name: str, rig: RigCalibration, profile: ObjectProfile, found: Registration, source: str
) -> tuple[Path, Path]:
    """Write rigs/<rig_name>.json and objects/<object>.json of `out`; return paths.

    The files there are kept but for the new keys: T_rig_tracking; T_object_tracker, stamp_offset_us.

    Raises:
        CalibrationError: A file there is broken or cannot be written, or is of other cameras.
    """
    path = out / "objects" / f"{profile.name}.json"
    base = load(path, ObjectProfile) if path.exists() else profile
    base = replace(base, tracker=profile.tracker)
    new_rig, new_object = documented(rig_in_tree(out, rig_name, rig), base, found, source)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)  # both files are written, or neither
    except OSError as error:
        raise CalibrationError(f"--out: cannot make the folder {path.parent}: {error.strerror}") from error
    return write_rig(out, rig_name, new_rig), write_object(out, new_object)


def tracker(options: Namespace) -> None:
    """Register a tracking system (Lighthouse) to the rig and its device to an object."""
    if options.live == (options.motion is not None):
        raise CalibrationError("give --live, or --motion FILE of a motion that was kept")
    used = load_marker_rig(options.calibration, options.rig)
    profile = profile_of(options.calibration, options.name, options.device)
    if options.motion is None:
        session = observe_live(options.bus, profile, options.seconds, echo)
        objects, tracked, source = session.objects, session.tracked, "live"
        if options.keep is not None:
            write_motion(options.keep, objects, tracked)
            echo(f"kept {options.keep}")
    else:
        objects, tracked = read_motion(options.motion, profile)
        source = options.motion.name
    with refusals_named(source):
        found = register(objects, tracked)
    print_lines(found.report)
    if options.picture is not None:
        from master.calibrate.picture import draw_registration

        draw_registration(options.picture, found)
        echo(f"drew {options.picture}")
    written: list[str] = []
    if options.out is None:
        echo("nothing written: give --out DIR")
    else:
        paths = write_registration(options.out, options.rig, used, profile, found, source)
        written = [str(path) for path in paths]
        echo(f"wrote {written[0]}: T_rig_tracking; {written[1]}: T_object_tracker, stamp_offset_us")
    if options.json_file is not None:
        write_summary(options.json_file, summary(found) | {"written": written})


def profile_of(calibration: Path, name: str, device: str | None) -> ObjectProfile:
    """The object, with the name of the device on it.

    Raises:
        CalibrationError: The file is missing or broken, no device is named, or cameras cannot see the object.
    """
    path = calibration / "objects" / f"{name}.json"
    profile = load(path, ObjectProfile)
    if device is not None:
        profile = replace(profile, tracker=device)
    if profile.tracker is None:
        raise CalibrationError(
            f"{path}: tracker: no device is named: write its name there, or give --device NAME"
        )
    if not profile.markers and profile.tags is None:
        raise CalibrationError(
            f"{path}: neither markers nor tags: cameras cannot see where the object is, and nothing else shows where "
            "the tracker sits on it"
        )
    return profile


def summary(found: Registration) -> dict[str, object]:
    """What was measured, as numbers."""
    placed = found.fit.placed
    return {
        "T_rig_tracking": placed.T_rig_tracking.tolist(),
        "T_object_tracker": placed.T_object_tracker.tolist(),
        "late_ms": 1e3 * placed.late_s,
        "instants": len(found.fit.t_s),
        "shared_s": found.coverage.shared_s,
        **found.figures,
    }
