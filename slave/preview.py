"""Preview images of the camera as small JPEGs.

At most 10 Hz, and nothing at all when there was no recent request.

The loop only offers its frames: one comparison when nobody looks, otherwise a reference is left behind ten times
a second. A thread of its own shrinks, encodes and publishes; while it is busy the newest frame replaces the
waiting one, so a slow bus costs pictures and never a measurement. A *still*, one whole frame on request, goes the
same way: cameras are calibrated from stills.

Who looks may wish to see which pixels are in the range of a marker, and what was found: that is drawn on the same
thread. Of several who look, each sees what all have wished for in the last three seconds.
"""

import logging
import threading
from collections import deque

import cv2
import numpy as np

from common.arrays import Image
from common.bus.bus import Bus
from common.clock import Clock
from common.errors import BusError, CalibrationError
from common.messages import MAX_PREVIEW_BYTES, MAX_STILL_BYTES, Preview, Still
from common.messages.preview_wish import PreviewWish
from slave.failures import Failures
from slave.overlay import MarkerOverlay, WristOverlay
from slave.sources import Frame

PERIOD_NS = 100_000_000
POLL_NS = 3_000_000_000
FOUND = ""  # stands beside the names of markers for the wish to see what was found
STILL_QUALITIES = (95, 90, 80, 60, 30)  # the first whose file fits into a message
_LOG = logging.getLogger(__name__)


class Gate:
    """Gate that decides which frames are shown.

    At least 100 ms apart, until 3 s after the last request.

    Holds the end of the looking and the earliest time of the next frame.
    """

    def __init__(self) -> None:
        """Nobody looks yet."""
        never_ns = -(2**63)
        self._end_ns = never_ns
        self._next_ns = never_ns

    def ask(self, now_ns: int) -> None:
        """Somebody looks at `now_ns` [ns], same clock as the frames."""
        self._end_ns = now_ns + POLL_NS

    def wants(self, t_ns: int) -> bool:
        """Whether the frame taken at `t_ns` [ns] is to be shown; a yes counts as shown."""
        if t_ns > self._end_ns:
            return False
        if t_ns < self._next_ns:
            return False
        self._next_ns = t_ns + PERIOD_NS
        return True


class Previews:
    """Publisher of the previews of one camera.

    On stream "preview" while somebody looks, and on "still" when one is asked for.

    Holds the gate, what is wished to be drawn, the newest frames that wait, those shown last, the bus while there is
    one, and how many pictures went out.
    """

    def __init__(
        self, camera: str, clock: Clock, overlay: MarkerOverlay | WristOverlay | None = None
    ) -> None:
        """Start the thread; nothing is published before `use` and `ask`.

        Args:
            camera: Name of the camera.
            clock: Clock of the frames' times.
            overlay: Draws what is wished for; None: nothing is sought, so there is nothing to draw.
        """
        self._camera, self._overlay = camera, overlay
        self._wishes: dict[str, int] = {}  # what -> until when [ns]
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
        """Show the camera for the next 3 s because somebody looks.

        With what the body, a `PreviewWish`, asks for. Never waits.

        Raises:
            CalibrationError: The body is none, or names a marker that is not sought.
        """
        wish = PreviewWish.of(body)
        known = () if self._overlay is None else self._overlay.markers
        if strange := [name for name in wish.mask if name not in known]:
            raise CalibrationError(
                f"preview: mask: camera {self._camera!r} does not look for {', '.join(strange)}; it looks for "
                f"{', '.join(known) or 'no markers'}"
            )
        now_ns = self._clock.now_ns()
        until = dict.fromkeys((*wish.mask, *((FOUND,) if wish.found else ())), now_ns + POLL_NS)
        self._wishes = {what: end for what, end in self._wishes.items() if end >= now_ns} | until
        self._gate.ask(now_ns)

    def shown(self, t_ns: int) -> Frame | None:
        """Return the frame of that time [ns] if it was shown within the last second.

        From any thread.
        """
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
        """Publish on `bus` from now on, or on none.

        Waits until the present image is out.
        """
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
        """The JPEG file of a frame, with what is wished for."""
        wishes = [what for what, end in self._wishes.items() if end >= frame.t_ns]
        if self._overlay is None or not wishes:
            return small_jpeg(frame.image)
        mask = [what for what in wishes if what != FOUND]
        return _within(self._overlay.draw(_half(frame.image), frame, mask, FOUND in wishes))

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
    """Return a JPEG file of `image` in its full size.

    `image` is (H, W, 3) BGR or (H, W) grey; the quality is as good as fits into a message.

    None: not even the worst does, which are tens of megapixels, or noise.
    """
    for quality in STILL_QUALITIES:
        data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
        if len(data) <= MAX_STILL_BYTES:
            return data
    return None


def small_jpeg(image: Image) -> bytes:
    """Return a JPEG file of `image` at half its width and height.

    `image` is (H, W, 3) BGR or (H, W) grey; it is smaller still if it must be.
    """
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
