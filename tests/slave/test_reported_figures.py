"""All that the checklist of a master judges a slave by is in what the slave says of itself."""

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import cast

from common.bus.keys import Access
from common.calibration.camera_settings import WANTED, figures
from common.clock import SystemClock
from common.messages import Command, Health, MarkerDetections, decode, encode
from master.checklist.slave_rules import AMBIGUOUS, COLOUR, OFF, OVERLAP, SEEN, UNCOLOURED
from slave import live
from slave.markers.engine import NUMPY
from slave.report import Reporter
from slave.sender import Sender
from slave.service import Service
from slave.tuning import CameraTuning
from slave.uplink import Uplink
from tests.memory_bus import LoopbackBus
from tests.network_helpers import until
from tests.slave.stand_ins import Wire
from tests.slave.test_tuning import FILE, RIG, Knobs, tree

METRICS = {
    *(WANTED + setting for setting in OFF),
    *OFF,
    *(COLOUR + marker for marker in RIG.markers),
    *("width_px", "height_px", "light_exposure", "disk_free_mb"),
}
COUNTS = {"frames", "uncalibrated", *(kind + marker for kind in (SEEN, AMBIGUOUS) for marker in RIG.markers)}


class Camera(Knobs):
    """It has what it was told."""

    def metrics(self) -> dict[str, float]:
        return figures((self.tuned or [FILE])[-1])


def test_a_slave_reports_what_the_checklist_judges(tmp_path: Path) -> None:
    files, clock, stop = tree(tmp_path), SystemClock(), threading.Event()
    uplink = cast(Uplink, Wire(MarkerDetections))
    sender = Sender("left", uplink, clock, stop, lambda _line: None, Service({}), cast(Access, None))
    with ThreadPoolExecutor(1) as workers:
        line = live._marker_line(sender, files, "follow", "full", NUMPY, workers)
    tuning = CameraTuning(files, Camera(), line.prepare, lambda: True, line.sample)
    reporter = Reporter(
        "left",
        uplink,
        line.pipeline.counters,
        clock,
        lambda _: LoopbackBus(),
        stop.set,
        0.01,
        parts=(tuning,),
    )

    def ask(verb: str, body: str = "") -> Health:
        answer = decode(encode(reporter.answer(Command("left", verb, body))))
        assert isinstance(answer, Health)
        return answer

    try:
        assert until(lambda: "disk_free_mb" in ask("report").metrics)
        health = ask("report")
        assert not METRICS - health.metrics.keys()
        assert not COUNTS - health.counts.keys()
        assert not [name for name in health.metrics if name.startswith(OVERLAP)]
        ask(
            "set",
            '{"markers": {"back": {"hsv_low": [50, 60, 60], "hsv_high": [65, 255, 255]}, "ring": null}}',
        )
        assert until(lambda: OVERLAP + "index..back" in ask("report").metrics)
        health = ask("report")
        assert health.metrics[COLOUR + "back"] != 0.0
        assert COLOUR + "ring" not in health.metrics
        assert health.counts[UNCOLOURED + "ring"] == health.counts["uncalibrated"] == 1
    finally:
        reporter.close()
        line.previews.close()
