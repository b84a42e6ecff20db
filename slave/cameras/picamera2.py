"""A Raspberry Pi camera: everything fixed before the start, read back from captured frames, compared.

Settings are part of the configuration, so the first frames already have them. libcamera takes some frames until what
it reports is what was asked for; then exposure, gains, frame duration and focus of three frames in a row must be
those of the camera file. Image and metadata always come from the same captured request, which is released whatever
happens.

When a frame was taken. libcamera documents `SensorTimestamp` as the time at which row 0 is exposed, on the boot clock.
The kernel's receivers (bcm2835-unicam, rp1-cfe) take it, with `ktime_get_ns`, the monotonic clock, when the first byte
of the frame arrives: a row is read out when its exposure *ends* (picamera2 issue 821; picamera2's own `flush` subtracts
the exposure). So the middle of the exposure of row 0 is `SensorTimestamp` - `ExposureTime` / 2. `FrameWallClock` is the
same moment after a regression from the boot clock to the wall clock (libcamera's ClockRecovery); it follows a stepped
wall clock only slowly. It is what two machines can compare, so it is reported when they run in step, and frames are
stamped with it only where there is no `SensorTimestamp`.
"""

import contextlib
import logging
import math
import threading
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from common.arrays import Image
from common.calibration import CameraCalibration
from common.clock import Clock
from common.errors import CameraError
from slave.cameras.picamera2_library import Enums, Request, open_library
from slave.cameras.picamera2_modes import choose_mode, read_modes, view_text
from slave.cameras.picamera2_settings import Picamera2Options, check_ranges, controls, wanted_settings
from slave.cameras.settings import demand, differences
from slave.cameras.source import Frame
from slave.cameras.stamps import ForeignClock, clock_of, system_clock

BUFFERS = 6  # picamera2's own number for video: the pipeline never starves while one frame is held
TIMEOUT_S = 2.0  # libcamera itself gives a silent sensor up after 1 s
SETTLE_FRAMES = 60  # sensors apply exposure and gain 2-3 frames late, the pipeline adds its own depth: ample
GOOD_FRAMES = 3
SYNC_MARGIN = 1.05  # a client catches up by shorter frames, so the mode must be faster than the rig
PROGRESS_FRAMES = 120
GIVE_BACK_S = 5.0
MICROSECONDS_BELOW = 10**17  # wall clock: such a number of ns would be 1973, so it is in us
_LOG = logging.getLogger(__name__)


class Picamera2Camera:
    """A `FrameSource`. Holds the open camera, the number and time of the last frame and its small image."""

    def __init__(
        self,
        calibration: CameraCalibration,
        options: Picamera2Options,
        clock: Clock,
        stop: threading.Event | None = None,
    ) -> None:
        """Open, configure, start, check what the camera really does and wait for synchronisation.

        Args:
            calibration: The camera file: mode, exposure, gains.
            options: The rest.
            clock: The slave's clock.
            stop: Set when the slave is to end, which also ends the wait for synchronisation.

        Raises:
            CameraError: No picamera2, no such camera or mode, a setting was refused or not taken, no frames, or
                nobody to synchronise with. The text names what is wrong and what to do.
        """
        self._calibration, self._options, self._clock = calibration, options, clock
        self._where = f"camera {calibration.name!r} (picamera2:{options.index})"
        self._stamps: tuple[str, ForeignClock] | None = None
        self._last: tuple[int, int] | None = None  # seq, t_ns
        self._lores: Image | None = None
        self._closed = self._lost = False
        self._library, enums = open_library(options.index)
        try:
            self._start(enums)
            self._check_settings()
            if options.sync != "off":
                self._synchronise(stop)
        except BaseException:
            with contextlib.suppress(CameraError):  # the first error is the one to read
                self.close()
            raise

    @property
    def lores(self) -> Image | None:
        """Small image of the frame read last: (3 h / 2, w) planar YUV420 (I420), or None where not asked for."""
        return self._lores

    def read(self) -> Frame | None:
        """Wait for the next frame; None once closed.

        Raises:
            CameraError: No frame for 2 s (cable, power), or the library failed.
        """
        while not self._closed:
            metadata, image, lores = self._capture(with_image=True)
            t_ns = self._row_zero_ns(metadata)
            if t_ns is None:
                continue
            self._lores = lores
            seq = self._number(t_ns, metadata)
            self._last = (seq, t_ns)
            return Frame(seq, t_ns, self._clock.now_ns(), image)
        return None

    def close(self) -> None:
        """Give the camera back. Safe to call twice.

        Raises:
            CameraError: libcamera does not let the camera go; only a new process can open it again.
        """
        if self._closed:
            return
        self._closed = True
        if self._lost:
            self._library.cancel_all_and_flush()  # else `close` queues behind a capture that never ends
        failure: list[Exception] = []

        def give_back() -> None:
            try:
                self._library.close()
            except Exception as error:  # noqa: BLE001 - of a foreign library, in a thread; raised below
                failure.append(error)

        # In a thread, because a camera whose cable is loose can block `close` for ever (picamera2 issue 1264).
        thread = threading.Thread(target=give_back, name="camera close", daemon=True)
        thread.start()
        thread.join(GIVE_BACK_S)
        if thread.is_alive():
            raise CameraError(f"{self._where}: libcamera does not let it go; restart the slave")
        if failure:
            raise CameraError(f"{self._where}: could not be closed: {failure[0]}") from failure[0]

    def _start(self, enums: Enums) -> None:
        camera, library = self._calibration, self._library
        size = (camera.width_px, camera.height_px)
        need_hz = camera.frame_rate_hz * (1.0 if self._options.sync == "off" else SYNC_MARGIN)
        try:
            modes = read_modes(library.sensor_modes)
            mode = choose_mode(modes, need_hz, size)
            asked = controls(camera, self._options, enums, library.camera_controls)
            parts: dict[str, Any] = {
                "main": {
                    "size": size,
                    "format": "RGB888",
                },  # named from the low byte up in a word: B, G, R in memory
                "raw": None,
                "sensor": {"output_size": mode.size, "bit_depth": mode.bit_depth},
                "controls": asked,
                "buffer_count": BUFFERS,
            }
            if self._options.lores is not None:
                parts["lores"] = {"size": self._options.lores, "format": "YUV420"}
            library.configure(library.create_video_configuration(**parts))
            self._check_streams(size)
            check_ranges(asked, library.camera_controls)  # of the mode just configured
            library.start()
        except CameraError as error:
            raise CameraError(f"{self._where}: {error}") from error
        except (RuntimeError, ValueError) as error:
            raise CameraError(f"{self._where}: cannot be started: {error}") from error
        model = library.camera_properties.get("Model", "unknown model")
        _LOG.info("%s: %s, mode %s", self._where, model, view_text(mode, modes))

    def _check_streams(self, size: tuple[int, int]) -> None:
        """libcamera adjusts what it cannot do; a frame of another size or format is not what was calibrated."""
        taken = self._library.camera_configuration()
        expected = {"main": (size, "RGB888")}
        if self._options.lores is not None:
            expected["lores"] = (self._options.lores, "YUV420")
        for name, (asked, image_format) in expected.items():
            got = (tuple(taken[name]["size"]), taken[name]["format"])
            if got != (asked, image_format):
                raise CameraError(
                    f"stream {name}: wanted {asked[0]}x{asked[1]} {image_format}, the camera makes "
                    f"{got[0][0]}x{got[0][1]} {got[1]} of it; use a size with even width and height"
                )

    def _check_settings(self) -> None:
        """Wait until some frames in a row have every setting.

        Raises:
            CameraError: They do not; every setting that differs is named.
        """
        wanted = wanted_settings(self._calibration, self._options, self._library.camera_controls)
        good, metadata = 0, dict[str, object]()
        for _ in range(SETTLE_FRAMES):
            metadata = self._capture(with_image=False)[0]
            good = 0 if differences(wanted, metadata) else good + 1
            if good == GOOD_FRAMES:
                _LOG.info("%s: settings checked, view %s", self._where, metadata.get("ScalerCrop", "unknown"))
                return
        fix = "Change the camera file to what the camera can do, and see that no other program controls it."
        demand(self._where, wanted, metadata, fix)
        raise CameraError(
            f"{self._where}: its settings do not stay: they were right, but not {GOOD_FRAMES} frames long"
        )

    def _synchronise(self, stop: threading.Event | None) -> None:
        """Read frames until libcamera says that those of all cameras are in step.

        Raises:
            CameraError: It did not within the time, or before the slave was to stop.
        """
        role = self._options.sync
        other = "clients" if role == "server" else "the server"
        end_ns = self._clock.now_ns() + round(self._options.sync_timeout_s * 1e9)
        count = 0
        while True:
            metadata = self._capture(with_image=False)[0]
            timer = metadata.get(
                "SyncTimer"
            )  # us until the agreed moment; a client that heard no server has none
            if metadata.get("SyncReady"):
                wall = metadata.get("FrameWallClock", "unknown")
                _LOG.info("%s: in step, %s us off; first frame at wall clock %s ns", self._where, timer, wall)
                return
            if stop is not None and stop.is_set():
                raise CameraError(f"{self._where}: stopped while it waited for {other}")
            if self._clock.now_ns() > end_ns:
                heard = "no server was heard" if timer is None else f"{timer} us were left"
                raise CameraError(
                    f"{self._where}: --sync {role}: not in step after {self._options.sync_timeout_s:g} s, {heard}. "
                    "Exactly one camera of the rig is the server, all have the same frame_rate_hz, clients start "
                    "first, and UDP multicast 239.255.255.250:10000 must pass between the machines"
                )
            if count % PROGRESS_FRAMES == 0:
                _LOG.info("%s: --sync %s: waiting for %s, timer %s us", self._where, role, other, timer)
            count += 1

    def _capture(self, with_image: bool) -> tuple[dict[str, object], Image, Image | None]:
        """Metadata, image (H, W, 3) BGR and small image of one request; empty images where not asked for.

        Raises:
            CameraError: No frame came, or the library failed.
        """
        empty = np.empty((0, 0, 3), np.uint8)
        try:
            request = self._library.capture_request(wait=TIMEOUT_S)
            try:
                metadata = dict(request.get_metadata())
                if not with_image:
                    return metadata, empty, None
                return metadata, self._image(request), self._small(request)
            finally:
                request.release()
        except TimeoutError as error:
            self._lost = True
            raise CameraError(
                f"{self._where}: no frame for {TIMEOUT_S:g} s; check its cable and power"
            ) from error
        except (RuntimeError, OSError, AssertionError) as error:
            self._lost = True
            raise CameraError(f"{self._where}: failed: {error}") from error

    def _image(self, request: Request) -> Image:
        image = np.asarray(request.make_array("main"))
        shape = (self._calibration.height_px, self._calibration.width_px, 3)
        if image.shape != shape or image.dtype != np.uint8:
            raise RuntimeError(f"a frame is {image.shape} {image.dtype}, not {shape} uint8")
        return image

    def _small(self, request: Request) -> Image | None:
        if self._options.lores is None:
            return None
        return without_padding(request.make_array("lores"), *self._options.lores)

    def _row_zero_ns(self, metadata: Mapping[str, object]) -> int | None:
        """Middle of the exposure of row 0 [ns], slave's clock; None for a frame without a time.

        Raises:
            CameraError: Its time is on no known clock.
        """
        key = "SensorTimestamp" if "SensorTimestamp" in metadata else "FrameWallClock"
        stamp, exposure = metadata.get(key), metadata.get("ExposureTime")
        # Under load the receiver of Pi 4 and older can deliver a frame with time 0 (raspberrypi/linux 5118).
        if not isinstance(stamp, int) or stamp <= 0 or not isinstance(exposure, (int, float)):
            return None
        if key == "FrameWallClock" and stamp < MICROSECONDS_BELOW:
            stamp *= 1000
        if self._stamps is None or self._stamps[0] != key:
            name = clock_of(stamp)
            if name is None:
                raise CameraError(f"{self._where}: {key} {stamp} ns is on no clock of this machine")
            self._stamps = (key, ForeignClock(self._clock, system_clock(name)))
        return self._stamps[1].to_own(stamp) - round(exposure * 500.0)

    def _number(self, t_ns: int, metadata: Mapping[str, object]) -> int:
        """Number of the frame taken at `t_ns`: as many further as whole frame durations have passed."""
        if self._last is None:
            return 0
        seq, before_ns = self._last
        duration = metadata.get("FrameDuration")
        nominal_us = 1e6 / self._calibration.frame_rate_hz
        period_us = float(duration) if isinstance(duration, (int, float)) and duration > 0 else nominal_us
        return seq + max(1, math.floor((t_ns - before_ns) / (period_us * 1e3) + 0.5))


def without_padding(image: npt.NDArray[Any], width: int, height: int) -> Image:
    """Planar YUV420 (3 height / 2, width) uint8 from an array whose rows are padded to the stride.

    picamera2 hands out (3 height / 2, stride): rows of Y, then those of U and of V, two of which lie in one row of
    the array, each half a stride long (`CompletedRequest.save` in picamera2 0.3.38).
    """
    stride = image.shape[1]
    if image.shape[0] != height * 3 // 2 or stride < width or stride % 2:
        raise RuntimeError(f"a small frame is {image.shape}, not ({height * 3 // 2}, at least {width})")
    luma = image[:height, :width]
    chroma = image[height:].reshape(height, stride // 2)[:, : width // 2]
    return (
        np.concatenate([luma.ravel(), chroma.ravel()])
        .reshape(height * 3 // 2, width)
        .astype(np.uint8, copy=False)
    )
