"""A live slave: detector, settings, previews and reports around one camera, and the loop, until it is told to stop."""

import gc
import logging
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Literal

from common.calibration import CameraCalibration, RigCalibration
from common.clock import Clock
from common.zenoh_bus import ZenohBus
from slave.app import run, wait_for_start
from slave.cameras.source import FrameSource
from slave.light_report import LightReport
from slave.markers.blind import BlindDetector
from slave.markers.changing import Changeable, ChangingDetector, marker_changes
from slave.markers.detector import MarkerDetector
from slave.markers.engine import Engine
from slave.markers.following import detector_for
from slave.preview import Previews
from slave.report import Reporter
from slave.tally import Tally
from slave.tuning import CameraFiles, CameraTuning
from slave.uplink import Uplink

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
    engine: Engine,
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
        colours: Whether they follow the light, stay fixed, or nothing is detected.
        engine: What scans and measures.
        stop: Set by a signal handler, or by the command "stop" on the bus.
        say: Told one line when it is ready, and one at the end.

    Raises:
        CalibrationError: A marker has no colour.
        CameraError: The camera is gone.
    """
    rig = files.rig
    workers = ThreadPoolExecutor(1, thread_name_prefix=f"{name} colours")
    make = _maker(colours, engine, workers)
    changing = None if colours == "none" else ChangingDetector(make(files.camera, rig))
    detector = BlindDetector(len(rig.markers)) if changing is None else changing
    tally = Tally(rig.markers)
    changes = None if changing is None else marker_changes(changing, make)
    tuning = CameraTuning(files, source, changes, lambda: tally.counts()["frames"] > 0)
    previews = Previews(name, clock)
    numbers, show = tally, previews.offer
    if changing is not None and changing.follows:
        numbers = LightReport(name, changing, tally, rig.markers, previews.offer)
        show = numbers.offer
    elif colours == "follow":
        _LOG.warning("%s", NO_REFERENCE.format(files.camera_path))
    reporter = Reporter(
        name,
        uplink,
        numbers,
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
            run(source, detector, uplink, name, tally, stop, show)
    finally:
        reporter.close()
        previews.close()
        uplink.close()
        source.close()
        workers.shutdown(cancel_futures=True)
    say(f"{tally.counts()['frames']} frames, sent {uplink.counts['sent']}")


def _maker(
    colours: Colours, engine: Engine, workers: ThreadPoolExecutor
) -> Callable[[CameraCalibration, RigCalibration], Changeable]:
    """What makes a detector for given files, now and whenever they change."""

    def make(camera: CameraCalibration, rig: RigCalibration) -> Changeable:
        if colours == "follow":
            return detector_for(camera, rig.markers, workers, engine=engine, free=rig.free_markers)
        return MarkerDetector(camera, rig.markers, engine=engine, free=rig.free_markers)

    return make
