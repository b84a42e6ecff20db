"""Send what a device measures: one loop for cameras, IMUs and trackers.

    Source ── item ──▶ pipeline: detect or orient, send, count ──▶ uplink

A camera that looks for markers sends of every frame, the camera of a wrist device of every strobe cycle, an IMU and a
tracker every sample and pose. Whatever a pipeline raises costs its item alone; where all items fail, the watchdog is
not fed, and the process begins anew. A device that is gone raises its `PhalanxError`.
"""

import gc
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np
from msgspec.structs import replace

from common.arrays import Image
from common.bus.keys import Access
from common.bus.zenoh_bus import ZenohBus
from common.clock import Clock
from common.imu.fusion import OrientationFilter
from common.messages import ImuSample, MarkerDetections, Message, TagDetections, TrackerPose
from slave.report import Counters, DetectionCounters, Reporter, imu_counters, pose_counters
from slave.service import Service
from slave.sources import Frame, ImuSource, Source, TrackerSource
from slave.uplink import Uplink

if TYPE_CHECKING:  # of cameras alone: the slave of an IMU starts without them
    from slave.markers.detector import Detections
    from slave.preview import Previews
    from slave.raw import RawFrames
    from slave.tuning import CameraTuning
    from slave.wrist.detector import WristFound

ItemT = TypeVar("ItemT", Frame, ImuSample, TrackerPose)
Send = Callable[[Message], None]
DARK_AFTER = 9  # frames without a strobe cycle, 0.1 s at 90 Hz: then every frame is shown, lit or not


def nothing(*_arguments: object) -> None:
    """Do nothing: placeholder callback where nobody needs to be notified."""


class Pipeline(Generic[ItemT]):
    """What is done with an item: detect or orient, send, count."""

    def __init__(self, session: int, send: Send, counters: Counters) -> None:
        """Send in the name of the process with id `session`; `send` never waits."""
        self._session, self._send, self.counters = session, send, counters

    def push(self, item: ItemT) -> None:
        """Take the next item."""
        raise NotImplementedError

    def skip(self, item: ItemT) -> None:
        """Take an item that came before the start of the master and is not sent."""


class MarkerPipeline(Pipeline[Frame]):
    """Detects the markers of a frame and sends them, if any, then its tags."""

    def __init__(
        self,
        camera: str,
        session: int,
        send: Send,
        detect: "Callable[[Image, int], Detections]",
        counters: DetectionCounters,
        show: Callable[[Frame], None] = nothing,
        tags: Callable[[Frame, int, int], TagDetections | None] | None = None,
    ) -> None:
        """Detect in the frames of one camera.

        `show` is offered every frame after that, and must not wait; `tags` takes a frame, the session and how long
        its markers took [ns].
        """
        super().__init__(session, send, counters)
        self._camera, self._detect, self._detections = camera, detect, counters
        self._show, self._tags = show, tags

    def push(self, item: Frame) -> None:
        """Detect in a frame, and send."""
        began_ns = time.perf_counter_ns()
        found = self._detect(item.image, item.t_ns)
        detect_ns = time.perf_counter_ns() - began_ns
        message = MarkerDetections(
            self._camera,
            self._session,
            item.seq,
            item.t_ns,
            item.ready_t_ns,
            found.uv,
            found.area,
            found.quality,
            found.sigma_px,
            found.alt_uv,
            item.t_sigma_ns,
        )
        self._send(message)
        self._detections.frame(item.seq, detect_ns, found.uv)
        if self._tags is not None:
            tags = self._tags(item, self._session, detect_ns)
            if tags is not None:
                self._send(tags)
        self._show(item)


class WristPipeline(Pipeline[Frame]):
    """Detects fingers where a frame completes a strobe cycle, and sends them, if any."""

    def __init__(
        self,
        camera: str,
        session: int,
        send: Send,
        detect: "Callable[[Frame], WristFound | None]",
        counters: DetectionCounters,
        show: Callable[[Frame], None] = nothing,
    ) -> None:
        """Show the frame under the LEDs of every cycle; every frame while there are none."""
        super().__init__(session, send, counters)
        self._camera, self._detect, self._detections, self._show = camera, detect, counters, show
        # of frames that may be a cycle; those before are none of it
        self._took_ns: deque[int] = deque(maxlen=3)
        self._parts = 0

    def push(self, item: Frame) -> None:
        """Detect in a frame, and send where it completes a cycle."""
        began_ns = time.perf_counter_ns()
        found = self._detect(item)
        self._took_ns.append(time.perf_counter_ns() - began_ns)
        if found is None:
            self.counters.item(item.seq)
            self._parts += 1
            if self._parts > DARK_AFTER:
                self._show(item)
            return
        self._send(found.message(self._camera, self._session))
        uv = np.vstack([found.laser.uv, found.tips.uv])
        self._detections.frame(item.seq, sum(self._took_ns), uv)
        self._parts = 0
        self._show(found.cycle.led)


class ImuPipeline(Pipeline[ImuSample]):
    """Sends samples with the orientation of a filter; rates and forces as measured."""

    def __init__(
        self,
        session: int,
        send: Send,
        counters: Counters,
        orient: Callable[[ImuSample], ImuSample] | None = None,
    ) -> None:
        super().__init__(session, send, counters)
        self._orient = orient

    def push(self, item: ImuSample) -> None:
        """Send a sample."""
        oriented = item if self._orient is None else self._orient(item)
        self._send(replace(oriented, session=self._session))
        self.counters.item(item.seq)

    def skip(self, item: ImuSample) -> None:
        """Have the filter see a sample, so that it knows its bias when samples are sent."""
        if self._orient is not None:
            self._orient(item)


class PosePipeline(Pipeline[TrackerPose]):
    """Sends poses."""

    def push(self, item: TrackerPose) -> None:
        """Send a pose."""
        self._send(replace(item, session=self._session))
        self.counters.item(item.seq, bool(np.isfinite(item.position_m).all()))


def wait_for_start(
    started: Callable[[float], bool],
    stop: threading.Event,
    alive: Callable[[], None] = nothing,
    skip: Callable[[], bool] | None = None,
    skips: Callable[[], bool] = lambda: True,
) -> bool:
    """Wait for the master; False if stopped before, or the source has ended.

    `started` waits at most so many seconds for the start; `alive` is called every time round; `skip` reads an item
    and forgets it, False at the end of the stream; where it is None, or `skips` is not true now, nothing is read.
    """
    while not stop.is_set():
        reads = skip is not None and skips()
        if started(0.5e-3 if reads else 0.2):  # between two items
            return True
        if skip is not None and reads and not skip():
            return False
        alive()
    return False


def skip_one(source: Source[ItemT], pipeline: Pipeline[ItemT]) -> bool:
    """Read an item before the start; False at the end of the stream."""
    item = source.read()
    if item is None:
        return False
    try:
        pipeline.skip(item)
    except Exception as error:  # noqa: BLE001 - one item
        pipeline.counters.failed(item.seq, error)
    return True


def run(
    source: Source[ItemT],
    pipeline: Pipeline[ItemT],
    stop: threading.Event,
    alive: Callable[[], None] = nothing,
) -> None:
    """Push every item until the end or `stop`; an error costs that item alone."""
    while not stop.is_set() and (item := source.read()) is not None:
        try:
            pipeline.push(item)
            alive()
        except Exception as error:  # noqa: BLE001 - one item
            pipeline.counters.failed(item.seq, error)


@dataclass(frozen=True, slots=True)
class Sender:
    """One sending process: its name, its link, and who stops and supervises it."""

    name: str  # camera, IMU or tracker, as the rig's files call it
    uplink: Uplink
    clock: Clock
    stop: threading.Event  # set by a signal handler, or by the command "stop" on the bus
    notify: Callable[[str], None]  # called with one line when it is ready, and one at the end
    service: Service  # reports what it does to the system's service manager
    access: Access  # how it comes to the master's bus

    def send(
        self,
        source: Source[ItemT],
        pipeline: Pipeline[ItemT],
        *,
        skips: Callable[[], bool] = lambda: False,
        previews: "Previews | None" = None,
        parts: "Sequence[CameraTuning | RawFrames]" = (),
        close: Sequence[Callable[[], None]] = (),
    ) -> None:
        """Wait for the master, push items until `stop` or their end; close everything.

        While `skips` is true, items are read before the start, so that none grows old in a buffer, or for those who
        read beside it: drivers of cameras throw old frames away themselves; of a recording nothing is to be missed.
        """
        reporter = Reporter(
            self.name,
            self.uplink,
            pipeline.counters,
            self.clock,
            lambda endpoint: ZenohBus(None, endpoint, self.access),
            self.stop.set,
            previews=previews,
            parts=parts,
        )
        try:
            gc.collect()
            gc.freeze()  # what lives until the end is never walked again: no pause in the loop
            self.notify("ready, waiting for the master")
            self.service.ready(lambda: self.uplink.started)
            skip = partial(skip_one, source, pipeline)
            if wait_for_start(self.uplink.wait_for_start, self.stop, self.service.waiting, skip, skips):
                run(source, pipeline, self.stop, self.service.working)
        finally:
            self.service.stopping()
            reporter.close()
            if previews is not None:
                previews.close()
            self.uplink.close()
            source.close()
            for end in close:
                end()
        self.notify(f"{pipeline.counters.summary()}, sent {self.uplink.counts['sent']}")


def send_samples(sender: Sender, source: ImuSource, orientation: OrientationFilter | None) -> None:
    """Send what an IMU measures, with a filter's orientation; None: its own."""
    counters, uplink = imu_counters(source, orientation), sender.uplink
    orient = None if orientation is None else orientation.push
    sender.send(source, ImuPipeline(uplink.session, uplink.send, counters, orient), skips=lambda: True)


def send_poses(sender: Sender, source: TrackerSource, recorded: bool = False) -> None:
    """Send where a tracker is; a `recorded` source begins with the start."""
    uplink = sender.uplink
    pipeline = PosePipeline(uplink.session, uplink.send, pose_counters(source))
    sender.send(source, pipeline, skips=lambda: not recorded)
