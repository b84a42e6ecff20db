"""Send small JPEGs of the camera, with the detections drawn over them.

At most 10 Hz, and nothing without a recent request: the loop only offers its frames. A thread of its own shrinks,
draws, encodes and publishes; while it is busy the newest frame replaces the waiting one, so a slow bus costs pictures
and never a measurement. A *still*, one whole frame on request, goes the same way: cameras are calibrated from stills.
Of several who look, each sees what all have requested in the last three seconds.
"""

import logging
import threading
from collections import deque
from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from common.arrays import Float, Image
from common.bus.bus import Bus
from common.calibration import HsvRange
from common.clock import Clock
from common.errors import BusError, CalibrationError
from common.messages import MAX_PREVIEW_BYTES, MAX_STILL_BYTES, Preview, Still
from common.messages.command_bodies import PreviewRequest
from slave.markers.classify import HUES
from slave.markers.reloadable import ReloadableDetector
from slave.sources import Failures, Frame
from slave.wrist.detector import WristDetector

TINT = 0.7  # of the tint in a tinted pixel: what lies below stays to be seen
SEVERAL = (255, 255, 255)  # a pixel in the ranges of several markers: they collide
ARM_PX = 6, 9  # of a cross, from and to; its middle is left free, for a far marker is as small
WHITE, BLACK = (255, 255, 255), (0, 0, 0)
LASER, TIP = (60, 60, 255), (80, 255, 80)


class MarkerOverlay:
    """Overlay of a camera that looks for markers, by the detector in use."""

    def __init__(self, detector: ReloadableDetector, markers: tuple[str, ...]) -> None:
        self._detector, self.markers = detector, markers

    def draw(self, small: Image, frame: Frame, mask: Sequence[str], found: bool) -> Image:
        """New image of `small`, (h, w, 3) or (h, w), with tinted markers and crosses.

        Tinted by the colour table in use, which follows the light.
        """
        drawn, plain = small.copy(), self._detector.plain
        if mask and plain is not None:
            height, width = small.shape[:2]
            points = cv2.resize(frame.image, (width, height), interpolation=cv2.INTER_NEAREST)
            codes = plain.table.codes(np.asarray(points, np.uint8))
            bits = dict(zip(plain.markers, plain.table.bits, strict=True))
            _tint(drawn, {name: codes & bits[name] != 0 for name in mask if name in bits}, plain.ranges)
        if found and (uv := self._detector.found(frame.t_ns)) is not None:
            _cross(drawn, uv, frame.image, WHITE)
        return drawn


class WristOverlay:
    """Overlay of the camera of a wrist device, which looks for fingers."""

    markers: tuple[str, ...] = ()

    def __init__(self, detector: WristDetector) -> None:
        self._detector = detector

    def draw(self, small: Image, frame: Frame, mask: Sequence[str], found: bool) -> Image:
        """New image with crosses at laser points (red) and tips (green)."""
        del mask
        drawn = (
            np.asarray(cv2.cvtColor(small, cv2.COLOR_GRAY2BGR), np.uint8) if small.ndim == 2 else small.copy()
        )
        if found and (both := self._detector.found(frame.t_ns)) is not None:
            for uv, colour in zip(both, (LASER, TIP), strict=True):
                _cross(drawn, uv, frame.image, colour)
        return drawn


def contrast_of(colour: HsvRange) -> tuple[int, int, int]:
    """Tint (BGR) for the pixels of a marker colour: the hue opposite its middle."""
    low, high = colour.hsv_low[0], colour.hsv_high[0]
    middle = low + (high - low) % HUES // 2
    pixel = np.array([[[(middle + HUES // 2) % HUES, 255, 255]]], np.uint8)
    blue, green, red = cv2.cvtColor(pixel, cv2.COLOR_HSV2BGR)[0, 0].tolist()
    return blue, green, red


def _tint(drawn: Image, inside: Mapping[str, np.ndarray], ranges: Mapping[str, HsvRange]) -> None:
    """Tint the pixels (h, w) of each marker, in place; a dark rim sets each off."""
    count = np.zeros(drawn.shape[:2], np.uint8)
    for name, where in inside.items():
        tint = np.array(contrast_of(ranges[name]), np.float64)
        drawn[where] = np.rint((1.0 - TINT) * drawn[where] + TINT * tint).astype(np.uint8)
        count += where
    drawn[count > 1] = SEVERAL
    tinted = (count > 0).astype(np.uint8)
    drawn[cv2.dilate(tinted, np.ones((3, 3), np.uint8)) != tinted] = BLACK


def _cross(drawn: Image, uv: Float, whole: Image, colour: tuple[int, int, int]) -> None:
    """Draw upright crosses at uv (K, 2) [px of the whole image], in place; NaN: none."""
    scale = np.array([drawn.shape[1] / whole.shape[1], drawn.shape[0] / whole.shape[0]])
    near, far = ARM_PX
    for u, v in np.rint((uv[np.isfinite(uv).all(axis=1)] + 0.5) * scale - 0.5).astype(int).tolist():
        for shade, thickness in ((BLACK, 3), (colour, 1)):
            for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                ends = (u + near * x, v + near * y), (u + far * x, v + far * y)
                cv2.line(drawn, *ends, shade, thickness)


PERIOD_NS = 100_000_000
POLL_NS = 3_000_000_000
FOUND = ""  # stands beside the names of markers for the request to see what was found
STILL_QUALITIES = (95, 90, 80, 60, 30)  # the first whose file fits into a message
_LOG = logging.getLogger(__name__)


class Gate:
    """Decides which frames are shown: 100 ms apart, until 3 s after a request."""

    def __init__(self) -> None:
        never_ns = -(2**63)
        self._end_ns = never_ns
        self._next_ns = never_ns

    def ask(self, now_ns: int) -> None:
        """Somebody looks at `now_ns` [ns], same clock as the frames."""
        self._end_ns = now_ns + POLL_NS

    def wants(self, t_ns: int) -> bool:
        """Whether the frame taken at `t_ns` [ns] is to be shown; a yes counts as shown."""
        if t_ns > self._end_ns or t_ns < self._next_ns:
            return False
        self._next_ns = t_ns + PERIOD_NS
        return True


class Previews:
    """Publisher of the previews of one camera, on streams "preview" and "still"."""

    def __init__(
        self, camera: str, clock: Clock, overlay: MarkerOverlay | WristOverlay | None = None
    ) -> None:
        """Start the thread; nothing is published before `use` and `ask`."""
        self._camera, self._overlay = camera, overlay
        self._requests: dict[str, int] = {}  # what -> until when [ns]
        # The last second, for a click on one of them
        self._shown: deque[Frame] = deque(maxlen=10)
        self._clock = clock
        self._gate = Gate()
        self._waiting: deque[Frame] = deque(maxlen=1)
        self._still_wanted = False
        self._still: deque[Frame] = deque(maxlen=1)
        self._wake = threading.Event()
        self._failures = Failures(f"{camera} preview")
        self._closing = threading.Event()
        self._lock = threading.Lock()  # a bus is never closed while it is published on
        self._bus: Bus | None = None
        self.published = 0
        self._thread = threading.Thread(target=self._work, name=f"{camera} preview", daemon=True)
        self._thread.start()

    def ask(self, body: str = "") -> None:
        """Show the camera for 3 s, as a `PreviewRequest` asks; else `CalibrationError`."""
        request = PreviewRequest.of(body)
        known = () if self._overlay is None else self._overlay.markers
        if strange := [name for name in request.mask if name not in known]:
            raise CalibrationError(
                f"preview: mask: camera {self._camera!r} does not look for {', '.join(strange)}; it looks for "
                f"{', '.join(known) or 'no markers'}"
            )
        now_ns = self._clock.now_ns()
        until = dict.fromkeys((*request.mask, *((FOUND,) if request.found else ())), now_ns + POLL_NS)
        self._requests = {what: end for what, end in self._requests.items() if end >= now_ns} | until
        self._gate.ask(now_ns)

    def shown(self, t_ns: int) -> Frame | None:
        """The frame of that time [ns] if it was shown within the last second."""
        return next((frame for frame in tuple(self._shown) if frame.t_ns == t_ns), None)

    def ask_still(self) -> None:
        """Publish the next frame whole. Never waits."""
        self._still_wanted = True

    def offer(self, frame: Frame) -> None:
        """The loop has a new frame, which nobody will write to any more. Never waits."""
        if self._still_wanted:
            self._still_wanted = False
            self._still.append(frame)
            self._wake.set()
        if self._gate.wants(frame.t_ns):
            self._waiting.append(frame)
            self._wake.set()

    def use(self, bus: Bus | None) -> None:
        """Publish on `bus` from now on, or on none; waits until the present image is out."""
        with self._lock:
            self._bus = bus

    def close(self) -> None:
        """End the thread. Safe to call twice."""
        self._closing.set()
        self._wake.set()
        self._thread.join()

    def _work(self) -> None:
        while not self._closing.is_set():
            if not self._wake.wait(0.5):  # seconds, five pictures
                self._shown.clear()  # nobody looks any more
            self._wake.clear()
            try:
                self._send_waiting()
            except Exception as error:  # noqa: BLE001 - one picture, and whatever it is drawn with
                self._failures.log("a picture is not shown", error)

    def _send_waiting(self) -> None:
        if self._still and not self._closing.is_set():
            self._send_whole(self._still.popleft())
        if self._waiting and not self._closing.is_set():
            frame = self._waiting.popleft()
            self._shown.append(frame)
            self._publish("preview", Preview(self._camera, frame.t_ns, self._picture(frame)))

    def _picture(self, frame: Frame) -> bytes:
        """The JPEG file of a frame, with what is requested."""
        requested = [what for what, end in self._requests.items() if end >= frame.t_ns]
        if self._overlay is None or not requested:
            return small_jpeg(frame.image)
        mask = [what for what in requested if what != FOUND]
        return _within(self._overlay.draw(_half(frame.image), frame, mask, FOUND in requested))

    def _send_whole(self, frame: Frame) -> None:
        data = whole_jpeg(frame.image)
        if data is None:
            height, width = frame.image.shape[:2]
            _LOG.warning(
                "a still of %d x %d px does not fit into a message: take a smaller mode", width, height
            )
            return
        self._publish("still", Still(self._camera, frame.seq, frame.t_ns, data))

    def _publish(self, stream: str, picture: Preview | Still) -> None:
        with self._lock:
            if self._bus is None:
                return
            try:
                self._bus.publish(stream, self._camera, picture)
                self.published += 1
            except BusError:
                return  # the bus has gone; the reporter finds the next one


def whole_jpeg(image: Image) -> bytes | None:
    """JPEG of `image`, (H, W, 3) or (H, W), as good as fits a message, or None."""
    for quality in STILL_QUALITIES:
        data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
        if len(data) <= MAX_STILL_BYTES:
            return data
    return None


def small_jpeg(image: Image) -> bytes:
    """JPEG of `image`, (H, W, 3) BGR or (H, W) grey, at half its size or less."""
    return _within(_half(image))


def _half(image: Image) -> Image:
    height, width = image.shape[:2]
    half = (max(width // 2, 1), max(height // 2, 1))
    return np.asarray(cv2.resize(image, half, interpolation=cv2.INTER_AREA), np.uint8)


def _within(image: Image) -> bytes:
    """JPEG file of `image`, shrunk until it fits into a message."""
    while True:
        data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()
        if len(data) <= MAX_PREVIEW_BYTES:
            return data
        image = _half(image)
