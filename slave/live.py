"""A live slave: detector, settings, previews and reports around one camera, and the loop, until it is told to stop."""

import gc
import logging
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

from common.calibration import CameraCalibration, RigCalibration
from common.clock import Clock
from common.hand_model import FINGERS
from common.keys import Access
from common.zenoh_bus import ZenohBus
from slave.app import run, run_wrist, wait_for_start
from slave.colour_sampler import ColourSampler
from slave.counters import Counters
from slave.light_report import LightReport
from slave.markers.ambiguity import told_frames, told_places
from slave.markers.calibrated import CalibratedDetector
from slave.markers.detector import MarkerDetector
from slave.markers.engine import Engine
from slave.markers.light_adaptive import can_adapt, detector_for
from slave.markers.null_detector import NullDetector
from slave.markers.reloadable import AnyDetector, ReloadableDetector, marker_changes
from slave.markers.scan_choice import Scan, ScanChoice
from slave.overlay import MarkerOverlay, WristOverlay
from slave.preview import Previews
from slave.raw import RawFrames, RawSettings
from slave.report import Numbers, Reporter
from slave.service import Service
from slave.sources import FrameSource
from slave.tags.live import LiveTags, finder_of
from slave.tuning import CameraFiles, CameraTuning, Prepare
from slave.uplink import Uplink
from slave.wrist.detector import WristDetector
from slave.wrist.engine import Engine as WristEngine
from slave.wrist.null_detector import NullWristDetector
from slave.wrist.reloadable import view_of, wrist_changes

Colours = Literal["follow", "fixed", "none"]
NO_REFERENCE = (
    "{}: markers: no reference_bgr_linear, so the colours do not follow the light; calibrate again with "
    "`phalanx-slave colours`, or say --colours fixed"
)
NO_COLOUR = (
    "{}: markers: no colour for {} yet, which cannot be seen: pick them in the console, or calibrate them with "
    "`phalanx-slave colours`"
)
_LOG = logging.getLogger(__name__)


def run_live(
    name: str,
    files: CameraFiles,
    source: FrameSource,
    uplink: Uplink,
    clock: Clock,
    colours: Colours,
    scan: Scan,
    engine: Engine | WristEngine,
    stop: threading.Event,
    notify: Callable[[str], None],
    service: Service,
    access: Access,
    raw_frames: RawSettings | None = None,
) -> None:
    """Wait for the master, then detect and send until `stop` is set or the source ends; closes source and uplink.

    Args:
        name: Camera, a member of the rig.
        files: Its file and the rig's; followed when they change.
        source: The open camera.
        uplink: Where detections go.
        clock: The slave's clock.
        colours: Whether those of markers follow the light, stay fixed, or nothing is detected at all.
        scan: Whether whole frames are scanned for markers, or windows (`scan_choice`).
        engine: What scans and measures for markers, or what does the inner loops before a wrist device.
        stop: Set by a signal handler, or by the command "stop" on the bus.
        say: Told one line when it is ready, and one at the end.
        service: Told what it does, for the system's service manager.
        access: How it comes to the master's bus.
        raw_frames: Where raw frames go when somebody asks for them; None: nowhere.

    Raises:
        CalibrationError: Something of a wrist device is not calibrated.
        CameraError: The camera is gone.
    """
    workers = ThreadPoolExecutor(1, thread_name_prefix=f"{name} colours")
    raw = RawFrames(name, raw_frames, lambda: tuning.files, clock, lambda: uplink.started)
    read = raw.reading(source)
    if isinstance(engine, WristEngine):
        line = _wrist_line(name, files, read, uplink, clock, colours, engine, stop, service)
    else:
        line = _marker_line(name, files, read, uplink, clock, colours, scan, engine, stop, workers, service)
    tuning = CameraTuning(
        files, source, line.prepare, lambda: line.numbers.counts()["frames"] > 0, line.sampler
    )
    reporter = Reporter(
        name,
        uplink,
        line.numbers,
        clock,
        lambda endpoint: ZenohBus(None, endpoint, access),
        stop.set,
        shown=line.previews,
        camera=tuning,
        raw=raw,
    )
    try:
        gc.collect()
        gc.freeze()  # what lives until the end is never walked again: no pause in the loop
        notify("ready, waiting for the master")
        service.ready(lambda: uplink.started)
        if wait_for_start(uplink, stop, service.waiting):
            line.run()
    finally:
        service.stopping()
        reporter.close()
        line.previews.close()
        uplink.close()
        source.close()
        raw.close()
        workers.shutdown(cancel_futures=True)
    notify(f"{line.numbers.counts()['frames']} frames, sent {uplink.counts['sent']}")


@dataclass(frozen=True, slots=True)
class _Line:
    """What a slave does with its frames.

    Attributes:
        run: The loop; returns at the end.
        numbers: What it counts.
        previews: Who shows them.
        prepare: How changed files reach it; None: it uses none of them.
        sampler: Who makes a colour of a click; None: it uses none.
    """

    run: Callable[[], None]
    numbers: Numbers
    previews: Previews
    prepare: Prepare | None
    sampler: ColourSampler | None = None


def _marker_line(
    name: str,
    files: CameraFiles,
    source: FrameSource,
    uplink: Uplink,
    clock: Clock,
    colours: Colours,
    scan: Scan,
    engine: Engine,
    stop: threading.Event,
    workers: ThreadPoolExecutor,
    service: Service,
) -> _Line:
    rig, alive = files.rig, service.working
    tags = LiveTags(files.camera, files.objects)
    if colours == "none":
        null_detector, counters = NullDetector(len(rig.markers)), Counters(rig.markers, tags.counts)
        plain = Previews(name, clock)
        return _Line(
            lambda: run(source, null_detector, uplink, name, counters, stop, plain.offer, alive=alive),
            counters,
            plain,
            None,
        )
    make = _maker(files, colours, engine, workers)
    choice = ScanChoice(scan, files.camera)
    detector = ReloadableDetector(make(files.camera, rig), choice)
    counters = Counters(
        rig.markers,
        lambda: (
            tags.counts()
            | _uncalibrated(detector.missing)
            | {"windows": choice.frames}
            | told_frames(detector.plain)
        ),
        lambda: told_places(detector.plain),
    )
    previews = Previews(name, clock, MarkerOverlay(detector, rig.markers))
    numbers, seen = counters, previews.offer
    if colours == "follow":
        numbers = LightReport(name, detector, counters, rig.markers, previews.offer)
        seen = numbers.offer
    return _Line(
        lambda: run(source, detector, uplink, name, counters, stop, seen, tags, alive),
        numbers,
        previews,
        _both(marker_changes(detector, make), _tag_changes(tags)),
        ColourSampler(detector, previews.shown, rig.markers),
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
    clock: Clock,
    colours: Colours,
    engine: WristEngine,
    stop: threading.Event,
    service: Service,
) -> _Line:
    alive = service.working
    if colours == "none":
        counters, plain = Counters(()), Previews(name, clock)
        return _Line(
            lambda: run_wrist(source, NullWristDetector(), uplink, name, counters, stop, plain.offer, alive),
            counters,
            plain,
            None,
        )
    detector = WristDetector(view_of(files), files.camera.frame_rate_hz, engine=engine)
    names = tuple(f"{what}.{finger}" for what in ("laser", "tip") for finger in FINGERS)
    counters = Counters(names, lambda: {f"strobe.{event}": count for event, count in detector.counts.items()})
    previews = Previews(name, clock, WristOverlay(detector))
    return _Line(
        lambda: run_wrist(source, detector, uplink, name, counters, stop, previews.offer, alive),
        counters,
        previews,
        wrist_changes(detector),
    )


def _uncalibrated(missing: Sequence[str]) -> dict[str, int]:
    """What `Health` says of markers without a colour."""
    return {"uncalibrated": int(bool(missing))} | {f"uncalibrated.{name}": 1 for name in missing}


def _maker(
    files: CameraFiles, colours: Colours, engine: Engine, workers: ThreadPoolExecutor
) -> Callable[[CameraCalibration, RigCalibration], AnyDetector]:
    """What makes a detector for given content of the files, now and whenever it changes."""

    def make(camera: CameraCalibration, rig: RigCalibration) -> AnyDetector:
        if missing := [name for name in rig.markers if name not in (camera.markers or {})]:
            _LOG.warning("%s", NO_COLOUR.format(files.camera_path, ", ".join(missing)))
            return CalibratedDetector(camera, rig.markers, engine, rig.free_markers)
        if colours == "follow":
            if not can_adapt(camera, rig.markers):
                _LOG.warning("%s", NO_REFERENCE.format(files.camera_path))
            return detector_for(camera, rig.markers, workers, engine=engine, free=rig.free_markers)
        return MarkerDetector(camera, rig.markers, engine=engine, free=rig.free_markers)

    return make
