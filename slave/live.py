"""Send what a camera shows: detector, settings, previews and light around it.

A device that is gone raises `CameraError`; a wrist device that is not calibrated `CalibrationError`.
"""

import logging
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

import numpy as np
from msgspec.structs import replace

from common.arrays import Image
from common.calibration import CameraCalibration, RigCalibration
from common.calibration.camera_settings import ColourPick
from common.calibration.rig import painted_alike
from common.errors import CameraError
from common.hand.model import FINGERS
from slave.markers.colours import SampledColours
from slave.markers.detector import Detections, MarkerDetector, ambiguity_counts, ambiguity_metrics
from slave.markers.engine import Engine
from slave.markers.reloadable import (
    AnyDetector,
    CalibratedDetector,
    ReloadableDetector,
    can_adapt,
    detector_for,
    marker_changes,
)
from slave.markers.scan import Scan, ScanChoice
from slave.preview import MarkerOverlay, Previews, WristOverlay
from slave.raw import RawFrames, RawProbe, RawSettings
from slave.report import DetectionCounters
from slave.sender import MarkerPipeline, Sender, WristPipeline
from slave.shared import FrameServer
from slave.sources import Frame, FrameSource, Reporting
from slave.tags.offline import LiveTags, finder_of
from slave.tuning import CameraFiles, CameraTuning, Prepare, Sample
from slave.wrist.detector import WristDetector, view_of, wrist_changes
from slave.wrist.engine import Engine as WristEngine


class ColourSampler:
    """Samples marker colours from clicks. Its callers take turns."""

    def __init__(
        self, detector: ReloadableDetector, shown: Callable[[int], Frame | None], markers: tuple[str, ...]
    ) -> None:
        """Pick the rig's `markers`; `shown` has the frame of a preview's time [ns]."""
        self._detector, self._shown, self._markers = detector, shown, markers
        self._picked = SampledColours()

    def pick(
        self, request: ColourPick, camera: CameraCalibration
    ) -> tuple[CameraCalibration, Mapping[str, float]]:
        """The camera file with the clicked colour; its pixels and what its range holds."""
        every = camera.markers or {}
        first = painted_alike(
            (request.marker, *self._markers)
        )  # hands are painted alike: one is picked for all
        ranges = {name: every[name] for name in self._markers if name in every and first[name] == name}
        adaptive = self._detector.adaptive
        light = np.zeros(3) if adaptive is None else adaptive.log_gains
        made, row = self._picked.sample(self._image(request.t_ns), light, request.marker, request.uv, ranges)
        report = {
            "pick.pixels": float(row.pixels),
            "pick.own_share": row.own,
            "pick.skin_share": row.skin,
            "pick.background_px": row.background_px,
        }
        made |= {name: made[one] for name, one in first.items() if one in made}
        return replace(camera, markers=every | made), report

    def _image(self, t_ns: int | None) -> Image:
        """The picture that was clicked on, or else the newest one."""
        if t_ns is not None and (frame := self._shown(t_ns)) is not None:
            return frame.image
        newest = self._detector.newest
        if newest is None:
            raise CameraError(
                "pick: no frame was read yet: the camera is away, or the slave waits for a master"
            )
        return newest[0]


ALL = "light"  # the subject of what concerns every marker
_LOG = logging.getLogger(__name__)


class LightReport(Reporting):
    """Counts and logs how the light affects colours."""

    def __init__(self, name: str, detector: ReloadableDetector, markers: tuple[str, ...]) -> None:
        self._name, self._detector = name, detector
        self._warned = dict.fromkeys((ALL, *markers), 0)
        self._now: set[str] = set()
        self._logged_ns: dict[str, int] = {}

    def offer(self, frame: Frame) -> None:
        """Take note of the warnings after a frame."""
        adaptive = self._detector.adaptive
        warnings = [] if adaptive is None else adaptive.warnings
        if not warnings and not self._now:
            return
        now = {ALL if warning.marker is None else warning.marker for warning in warnings}
        for subject in now - self._now:
            self._warned[subject] += 1
        self._now = now
        for warning in warnings:
            subject = ALL if warning.marker is None else warning.marker
            last_ns = self._logged_ns.get(subject)
            if last_ns is None or frame.t_ns - last_ns >= 10_000_000_000:  # the same one no more often
                self._logged_ns[subject] = frame.t_ns
                _LOG.warning("%s: %s", self._name, warning.text)

    def counts(self) -> dict[str, int]:
        """warnings.light, warnings.<marker>, refused.light, colour_tables."""
        warned = {f"warnings.{subject}": count for subject, count in self._warned.items()}
        adaptive = self._detector.adaptive
        refused, tables = (0, 0) if adaptive is None else (adaptive.refused, adaptive.tables)
        return warned | {"refused.light": refused, "colour_tables": tables}

    def metrics(self) -> dict[str, float]:
        """light_red, light_blue by green; alike.<one>..<other>; {}: none adapts."""
        adaptive = self._detector.adaptive
        if adaptive is None:
            return {}
        blue, green, red = np.exp(adaptive.log_gains).tolist()
        # A name in `Health` has 64 characters
        alike = {
            f"alike.{one.marker}..{one.ambiguous}"[:64]: one.hues
            for one in adaptive.warnings
            if one.ambiguous is not None
        }
        return {"light_red": red / green, "light_blue": blue / green, "light_exposure": green} | alike


Colours = Literal["follow", "fixed", "none"]
NO_REFERENCE = (
    "{}: markers: no reference_bgr_linear, so the colours do not follow the light; calibrate again with "
    "`phalanx-slave colours`, or give --colours fixed"
)
NO_COLOUR = (
    "{}: markers: no colour for {} yet, which cannot be seen: pick them in the console, or calibrate them with "
    "`phalanx-slave colours`"
)


def send_detections(
    sender: Sender,
    files: CameraFiles,
    source: FrameSource,
    colours: Colours,
    scan: Scan,
    engine: Engine | WristEngine,
    raw_frames: RawSettings | None,
    opened: dict[str, str],
    skewed: str,
) -> None:
    """Detect in the frames of a camera and send until stopped.

    `colours`: those of markers follow the light, stay fixed, or nothing is detected; `scan` as of `ScanChoice`;
    `engine` is that of markers or of a wrist device; `raw_frames`: where raw frames go when somebody asks for them;
    `opened`: options that opened the camera; `skewed`: how the slave's clock differs from the machine's.
    """
    workers = ThreadPoolExecutor(1, thread_name_prefix=f"{sender.name} colours")
    raw = RawFrames(
        sender.name, raw_frames, lambda: tuning.files, sender.clock, lambda: sender.uplink.started
    )
    shared = FrameServer(sender.name, opened, lambda: tuning.files.camera, lambda: raw.manifest(skewed))
    probe = RawProbe(source, raw.offer, shared.offer)
    if isinstance(engine, WristEngine):
        line = _wrist_line(sender, files, colours, engine)
    else:
        line = _marker_line(sender, files, colours, scan, engine, workers)
    counters = line.pipeline.counters
    tuning = CameraTuning(files, source, line.prepare, lambda: counters.total > 0, line.sample)
    sender.send(
        probe,
        line.pipeline,
        skips=shared.wanted,
        previews=line.previews,
        parts=(tuning, raw),
        close=(probe.flush, shared.close, raw.close, lambda: workers.shutdown(cancel_futures=True)),
    )


@dataclass(frozen=True, slots=True)
class _Line:
    """What a slave does with its frames; None: not at all, or as usual."""

    pipeline: MarkerPipeline | WristPipeline
    previews: Previews
    prepare: Prepare | None = None
    sample: Sample | None = None


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
        nothing, previews = Detections.none(len(rig.markers)), Previews(name, sender.clock)
        counters = DetectionCounters(rig.markers, tags.counts)
        wire = uplink.session, uplink.send
        pipeline = MarkerPipeline(name, *wire, lambda _image, _t_ns: nothing, counters, previews.offer)
        return _Line(pipeline, previews)
    make = _maker(files, colours, engine, workers)
    choice = ScanChoice(scan, files.camera)
    detector = ReloadableDetector(make(files.camera, rig), choice)
    previews = Previews(name, sender.clock, MarkerOverlay(detector, rig.markers))
    light = LightReport(name, detector, rig.markers) if colours == "follow" else None

    def counts() -> dict[str, int]:
        found = tags.counts() | {"uncalibrated": int(bool(detector.missing))}
        found |= {f"uncalibrated.{marker}": 1 for marker in detector.missing}
        found |= {"windows": choice.frames} | ambiguity_counts(detector.plain)
        return found if light is None else found | light.counts()

    def metrics() -> dict[str, float]:
        found = ambiguity_metrics(detector.plain)
        return found if light is None else found | light.metrics()

    def show(frame: Frame) -> None:
        previews.offer(frame)
        if light is not None:
            light.offer(frame)

    counters = DetectionCounters(rig.markers, counts, metrics)
    return _Line(
        MarkerPipeline(name, uplink.session, uplink.send, detector.push, counters, show, tags.push),
        previews,
        _both(marker_changes(detector, make), _tag_changes(tags)),
        ColourSampler(detector, previews.shown, rig.markers).pick,
    )


def _wrist_line(sender: Sender, files: CameraFiles, colours: Colours, engine: WristEngine) -> _Line:
    name, uplink = sender.name, sender.uplink
    if colours == "none":
        counters, previews = DetectionCounters(()), Previews(name, sender.clock)
        return _Line(
            WristPipeline(name, uplink.session, uplink.send, lambda _: None, counters, previews.offer),
            previews,
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

    def prepare(old: CameraFiles, new: CameraFiles) -> Callable[[], None] | None:
        switches = [made for one in (first, second) if (made := one(old, new)) is not None]
        if not switches:
            return None

        def switch() -> None:
            for made in switches:
                made()

        return switch

    return prepare


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
