"""Send what a camera shows: detector, settings and previews around it."""

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

from common.calibration import CameraCalibration, RigCalibration
from common.hand.model import FINGERS
from slave.colour_sampler import ColourSampler
from slave.counters import DetectionCounters
from slave.light_report import LightReport
from slave.markers.ambiguity import ambiguity_counts, ambiguity_metrics
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
from slave.sender import MarkerPipeline, Sender, WristPipeline
from slave.sources import FrameSource
from slave.tags.live import LiveTags, finder_of
from slave.tuning import CameraFiles, CameraTuning, Prepare, Sample
from slave.wrist.detector import WristDetector
from slave.wrist.engine import Engine as WristEngine
from slave.wrist.null_detector import NullWristDetector
from slave.wrist.reloadable import view_of, wrist_changes

Colours = Literal["follow", "fixed", "none"]
NO_REFERENCE = (
    "{}: markers: no reference_bgr_linear, so the colours do not follow the light; calibrate again with "
    "`phalanx-slave colours`, or give --colours fixed"
)
NO_COLOUR = (
    "{}: markers: no colour for {} yet, which cannot be seen: pick them in the console, or calibrate them with "
    "`phalanx-slave colours`"
)
_LOG = logging.getLogger(__name__)


def send_detections(
    sender: Sender,
    files: CameraFiles,
    source: FrameSource,
    colours: Colours,
    scan: Scan,
    engine: Engine | WristEngine,
    raw_frames: RawSettings | None = None,
) -> None:
    """Detect in the frames of a camera and send until stopped.

    Args:
        sender: The process; its name is that of the camera.
        files: The camera's file and the rig's; monitored for changes.
        source: The open camera.
        colours: Whether those of markers follow the light, stay fixed, or nothing is detected at all.
        scan: Whether whole frames are scanned for markers, or windows (`scan_choice`).
        engine: What scans and measures for markers, or what does the inner loops before a wrist device.
        raw_frames: Where raw frames go when somebody asks for them; None: nowhere.

    Raises:
        CalibrationError: Something of a wrist device is not calibrated.
        CameraError: The camera is gone.
    """
    workers = ThreadPoolExecutor(1, thread_name_prefix=f"{sender.name} colours")
    raw = RawFrames(
        sender.name, raw_frames, lambda: tuning.files, sender.clock, lambda: sender.uplink.started
    )
    if isinstance(engine, WristEngine):
        line = _wrist_line(sender, files, colours, engine)
    else:
        line = _marker_line(sender, files, colours, scan, engine, workers)
    counters = line.pipeline.counters
    tuning = CameraTuning(files, source, line.prepare, lambda: counters.total > 0, line.sample)
    sender.send(
        raw.reading(source),
        line.pipeline,
        reported=line.reported,
        previews=line.previews,
        parts=(tuning, raw),
        close=(raw.close, lambda: workers.shutdown(cancel_futures=True)),
    )


@dataclass(frozen=True, slots=True)
class _Line:
    """What a slave does with its frames.

    Attributes:
        pipeline: Detects in a frame and sends.
        previews: Shows them.
        prepare: How changed files reach it; None: it uses none of them.
        sample: Makes a colour of a click; None: it uses none.
        reported: What the reports have in place of the counters; None: those.
    """

    pipeline: MarkerPipeline | WristPipeline
    previews: Previews
    prepare: Prepare | None = None
    sample: Sample | None = None
    reported: LightReport | None = None


def _marker_line(
    sender: Sender,
    files: CameraFiles,
    colours: Colours,
    scan: Scan,
    engine: Engine,
    workers: ThreadPoolExecutor,
) -> _Line:
    rig, name, uplink = files.rig, sender.name, sender.uplink
    tags = LiveTags(files.camera, files.objects)
    if colours == "none":
        null, counters = NullDetector(len(rig.markers)), DetectionCounters(rig.markers, tags.counts)
        previews = Previews(name, sender.clock)
        pipeline = MarkerPipeline(name, uplink.session, uplink.send, null.push, counters, previews.offer)
        return _Line(pipeline, previews)
    make = _maker(files, colours, engine, workers)
    choice = ScanChoice(scan, files.camera)
    detector = ReloadableDetector(make(files.camera, rig), choice)
    counters = DetectionCounters(
        rig.markers,
        lambda: (
            tags.counts()
            | _uncalibrated(detector.missing)
            | {"windows": choice.frames}
            | ambiguity_counts(detector.plain)
        ),
        lambda: ambiguity_metrics(detector.plain),
    )
    previews = Previews(name, sender.clock, MarkerOverlay(detector, rig.markers))
    light = show = None
    if colours == "follow":
        light = LightReport(name, detector, counters, rig.markers, previews.offer)
        show = light.offer
    show = show or previews.offer
    return _Line(
        MarkerPipeline(name, uplink.session, uplink.send, detector.push, counters, show, tags.push),
        previews,
        _both(marker_changes(detector, make), _tag_changes(tags)),
        ColourSampler(detector, previews.shown, rig.markers).pick,
        light,
    )


def _wrist_line(sender: Sender, files: CameraFiles, colours: Colours, engine: WristEngine) -> _Line:
    name, uplink = sender.name, sender.uplink
    if colours == "none":
        counters, previews = DetectionCounters(()), Previews(name, sender.clock)
        detect = NullWristDetector().push
        return _Line(
            WristPipeline(name, uplink.session, uplink.send, detect, counters, previews.offer), previews
        )
    detector = WristDetector(view_of(files), files.camera.frame_rate_hz, engine=engine)
    names = tuple(f"{what}.{finger}" for what in ("laser", "tip") for finger in FINGERS)
    counters = DetectionCounters(
        names, lambda: {f"strobe.{event}": count for event, count in detector.counts.items()}
    )
    previews = Previews(name, sender.clock, WristOverlay(detector))
    return _Line(
        WristPipeline(name, uplink.session, uplink.send, detector.push, counters, previews.offer),
        previews,
        wrist_changes(detector),
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


def _uncalibrated(missing: Sequence[str]) -> dict[str, int]:
    """Return what `Health` reports of markers without a colour."""
    return {"uncalibrated": int(bool(missing))} | {f"uncalibrated.{name}": 1 for name in missing}


def _maker(
    files: CameraFiles, colours: Colours, engine: Engine, workers: ThreadPoolExecutor
) -> Callable[[CameraCalibration, RigCalibration], AnyDetector]:
    """What makes a detector for the content of files, now and when it changes."""

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
