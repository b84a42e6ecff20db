"""Choose whole frames or windows: by name, or by what whole frames cost.

What counts is the processor time of the detection, of which a busy machine takes nothing away, against the time between
two frames of the camera's file. Windows are for where a whole frame does not fit; from time to time one frame is
scanned whole then, so that it shows when they fit again.
"""

import logging
from statistics import median
from typing import Literal, TypeAlias

from common.calibration import CameraCalibration
from slave.drivers import SCANS

Scan: TypeAlias = Literal["auto", "full", "windows"]
JUDGED = 30  # whole frames whose median is judged
PROBE_EVERY = 600  # frames, 10 s at 60 Hz: one of so many is scanned whole while windows are chosen
PROBES = 3  # of them whose median is judged then
_LOG = logging.getLogger(__name__)


class ScanChoice:
    """Push machine. Holds the choice, and what whole frames of late cost.

    Attributes:
        frames: Frames that were scanned in windows only.
    """

    def __init__(self, scan: Scan, camera: CameraCalibration) -> None:
        """Choose for the frames of `camera`; "auto" begins with whole frames.

        Raises:
            ValueError: No such name.
        """
        if scan not in SCANS:
            raise ValueError(f"scan {scan!r}, not one of {', '.join(SCANS)}")
        self._scan, self._name = scan, camera.name
        self._windows = scan == "windows"
        self._costs: list[int] = []  # of whole frames [ns], until enough are there to be judged
        self._since = 0  # frames since one was scanned whole
        self.frames = 0
        self.tune(camera)

    def tune(self, camera: CameraCalibration) -> None:
        """The camera has another rate. From any thread."""
        self._period_ns = 1e9 / camera.frame_rate_hz

    @property
    def windows(self) -> bool:
        """Whether only windows are scanned in the next frame."""
        return self._windows and not self._probes

    @property
    def _probes(self) -> bool:
        return self._scan == "auto" and self._since >= PROBE_EVERY

    def push(self, spent_ns: int) -> None:
        """Record the processor time [ns] of a frame scanned as `windows` specified."""
        if self.windows:
            self.frames += 1
            self._since += 1
            return
        self._since = 0
        if self._scan != "auto":
            return
        self._costs.append(spent_ns)
        if len(self._costs) < (PROBES if self._windows else JUDGED):
            return
        full_share = 0.9  # of the time between two frames: where whole frames take more, they do not fit
        fits_share = 0.7  # and where they take less again, they do
        cost_ns, share = median(self._costs), fits_share if self._windows else full_share
        self._costs.clear()
        if (cost_ns > share * self._period_ns) != self._windows:
            self._switch(cost_ns)

    def _switch(self, cost_ns: float) -> None:
        self._windows = not self._windows
        took = f"to scan a whole frame takes {cost_ns * 1e-6:.1f} ms of the {self._period_ns * 1e-6:.1f} ms of a frame"
        if self._windows:
            _LOG.warning(
                "%s: %s: from now on only windows about the markers are scanned, and a lost marker is sought strip by "
                "strip (--scan auto, docs/cameras.md)",
                self._name,
                took,
            )
        else:
            _LOG.warning("%s: %s again: from now on whole frames are scanned", self._name, took)
