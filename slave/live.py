"""A live slave: detector, settings, previews and reports around one camera, and the loop, until it is told to stop."""

import gc
import logging
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

from common.calibration import CameraCalibration, RigCalibration
from common.clock import Clock
from common.hand_model import FINGERS
from common.zenoh_bus import ZenohBus
from slave.app import run, run_wrist, wait_for_start
from slave.cameras.source import Frame, FrameSource
from slave.light_report import LightReport
from slave.markers.blind import BlindDetector
from slave.markers.changing import Changeable, ChangingDetector, marker_changes
from slave.markers.detector import MarkerDetector
from slave.markers.engine import Engine
from slave.markers.following import detector_for
from slave.preview import Previews
from slave.report import Numbers, Reporter
from slave.tags.live import LiveTags, finder_of
from slave.tally import Tally
from slave.tuning import CameraFiles, CameraTuning, Prepare
from slave.uplink import Uplink
from slave.wrist.blind import BlindWrist
from slave.wrist.changing import view_of, wrist_changes
from slave.wrist.detector import WristDetector
from slave.wrist.engine import Engine as WristEngine

Colours = Literal["follow", "fixed", "none"]
NO_REFERENCE = (
    "{}: markers: no reference_bgr_linear, so the colours do not follow the light; calibrate again with "
    "`phalanx-slave colours`, or say --colours fixed"
)
_LOG = logging.getLogger(__name__)


def run_live(
    name: str,
    files: CameraFiles,
    source: FrameSource,
    uplink: Uplink,
    clock: Clock,
    colours: Colours,
    engine: Engine | WristEngine,
    stop: threading.Event,
    say: Callable[[str], None],
) -> None:
    """Wait for the master, then detect and send until `stop` is set or the source ends; closes source and uplink.

    Args:
        name: Camera, a member of the rig.
        files: Its file and the rig's; followed when they change.
        source: The open camera.
        uplink: Where detections go.
        clock: The slave's clock.
        colours: Whether those of markers follow the light, stay fixed, or nothing is detected at all.
        engine: What scans and measures for markers, or what does the inner loops before a wrist device.
        stop: Set by a signal handler, or by the command "stop" on the bus.
        say: Told one line when it is ready, and one at the end.

    Raises:
        CalibrationError: A marker has no colour, or something of a wrist device is not calibrated.
        CameraError: The camera is gone.
    """
    previews = Previews(name, clock)
    workers = ThreadPoolExecutor(1, thread_name_prefix=f"{name} colours")
    if isinstance(engine, WristEngine):
        line = _wrist_line(name, files, source, uplink, colours, engine, stop, previews.offer)
    else:
        line = _marker_line(name, files, source, uplink, colours, engine, stop, previews.offer, workers)
    tuning = CameraTuning(files, source, line.prepare, lambda: line.numbers.counts()["frames"] > 0)
    reporter = Reporter(
        name,
        uplink,
        line.numbers,
        clock,
        lambda endpoint: ZenohBus(None, endpoint),
        stop.set,
        shown=previews,
        camera=tuning,
    )
    try:
        gc.collect()
        gc.freeze()  # what lives until the end is never walked again: no pause in the loop
        say("ready, waiting for the master")
        if wait_for_start(uplink, stop):
            line.run()
    finally:
        reporter.close()
        previews.close()
        uplink.close()
        source.close()
        workers.shutdown(cancel_futures=True)
    say(f"{line.numbers.counts()['frames']} frames, sent {uplink.counts['sent']}")


@dataclass(frozen=True, slots=True)
class _Line:
    """What a slave does with its frames.

    Attributes:
        run: The loop; returns at the end.
        numbers: What it counts.
        prepare: How changed files reach it; None: it uses none of them.
    """

    run: Callable[[], None]
    numbers: Numbers
    prepare: Prepare | None


def _marker_line(
    name: str,
    files: CameraFiles,
    source: FrameSource,
    uplink: Uplink,
    colours: Colours,
    engine: Engine,
    stop: threading.Event,
    show: Callable[[Frame], None],
    workers: ThreadPoolExecutor,
) -> _Line:
    rig = files.rig
    tags = LiveTags(files.camera, files.objects)
    tally = Tally(rig.markers, tags.counts)
    if colours == "none":
        blind = BlindDetector(len(rig.markers))
        return _Line(lambda: run(source, blind, uplink, name, tally, stop, show), tally, None)
    make = _maker(colours, engine, workers)
    detector = ChangingDetector(make(files.camera, rig))
    numbers, seen = tally, show
    if detector.follows:
        numbers = LightReport(name, detector, tally, rig.markers, show)
        seen = numbers.offer
    elif colours == "follow":
        _LOG.warning("%s", NO_REFERENCE.format(files.camera_path))
    return _Line(
        lambda: run(source, detector, uplink, name, tally, stop, seen, tags),
        numbers,
        _both(marker_changes(detector, make), _tag_changes(tags)),
    )


def _tag_changes(tags: LiveTags) -> Prepare:
    """How changed object files, or another lens, reach what finds tags."""

    def prepare(old: CameraFiles, new: CameraFiles) -> Callable[[], None] | None:
        if (new.objects, new.camera.intrinsics) == (old.objects, old.camera.intrinsics):
            return None
        finder = finder_of(new.camera, new.objects)
        return lambda: tags.replace(finder)

    return prepare


def _both(first: Prepare, second: Prepare) -> Prepare:
    """What two that use the same files make of a change."""

    def prepare(old: CameraFiles, new: CameraFiles) -> Callable[[], None] | None:
        switches = [made for one in (first, second) if (made := one(old, new)) is not None]
        if not switches:
            return None

        def switch() -> None:
            for made in switches:
                made()

        return switch

    return prepare


def _wrist_line(
    name: str,
    files: CameraFiles,
    source: FrameSource,
    uplink: Uplink,
    colours: Colours,
    engine: WristEngine,
    stop: threading.Event,
    show: Callable[[Frame], None],
) -> _Line:
    if colours == "none":
        tally = Tally(())
        return _Line(lambda: run_wrist(source, BlindWrist(), uplink, name, tally, stop, show), tally, None)
    detector = WristDetector(view_of(files), files.camera.frame_rate_hz, engine=engine)
    names = tuple(f"{what}.{finger}" for what in ("laser", "tip") for finger in FINGERS)
    tally = Tally(names, lambda: {f"strobe.{event}": count for event, count in detector.counts.items()})
    return _Line(
        lambda: run_wrist(source, detector, uplink, name, tally, stop, show),
        tally,
        wrist_changes(detector),
    )


def _maker(
    colours: Colours, engine: Engine, workers: ThreadPoolExecutor
) -> Callable[[CameraCalibration, RigCalibration], Changeable]:
    """What makes a detector for given files, now and whenever they change."""

    def make(camera: CameraCalibration, rig: RigCalibration) -> Changeable:
        if colours == "follow":
            return detector_for(camera, rig.markers, workers, engine=engine, free=rig.free_markers)
        return MarkerDetector(camera, rig.markers, engine=engine, free=rig.free_markers)

    return make
