"""A Raspberry Pi camera: everything fixed before the start, read back from captured frames, compared.

Settings are part of the configuration, so the first frames already have them. libcamera takes some frames until what
it reports is what was asked for; then exposure, gains, frame duration and focus of three frames in a row must be
those of the camera file. Image and metadata always come from the same captured request, which is released whatever
happens. When a frame was taken, and its number, are in `picamera2_frames`.
"""

import contextlib
import logging
import threading
from typing import Any

import numpy as np

from common.arrays import Image
from common.calibration import CameraCalibration
from common.clock import Clock
from common.errors import CameraError
from slave.cameras.picamera2_frames import Timeline, without_padding
from slave.cameras.picamera2_library import Enums, Request, open_library
from slave.cameras.picamera2_modes import choose_mode, read_modes, view_text
from slave.cameras.picamera2_settings import Picamera2Options, check_ranges, controls, wanted_settings
from slave.cameras.settings import demand, differences
from slave.cameras.source import Frame

BUFFERS = 6  # picamera2's own number for video: the pipeline never starves while one frame is held
TIMEOUT_S = 2.0  # libcamera itself gives a silent sensor up after 1 s
SETTLE_FRAMES = 60  # sensors apply exposure and gain 2-3 frames late, the pipeline adds its own depth: ample
GOOD_FRAMES = 3
SYNC_MARGIN = 1.05  # a client catches up by shorter frames, so the mode must be faster than the rig
PROGRESS_FRAMES = 120
GIVE_BACK_S = 5.0
_LOG = logging.getLogger(__name__)


class Picamera2Camera:
    """A `FrameSource`. Holds the open camera, the timeline of its frames, and the small image of the last one."""

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
        self._timeline = Timeline(calibration.frame_rate_hz, clock)
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
            try:
                place = self._timeline.place(metadata)
            except CameraError as error:
                raise CameraError(f"{self._where}: {error}") from error
            if place is None:
                continue
            self._lores = lores
            return Frame(*place, self._clock.now_ns(), image)
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
