"""Raspberry Pi camera: settings are read back from captured frames and compared.

Settings are part of the configuration, so the first frames already have them; exposure, gains, frame duration and
focus of three frames in a row must be those of the camera file. Image and metadata come from the same captured
request, which is released whatever happens. Later, another thread may write exposure, gains and rate, and watches the
metadata of the frames that the loop reads. The mode stays, so a rate may not be above what that can do; cameras that
run in step keep their rate. Whatever fails raises `CameraError`, which states what to do.
"""

import contextlib
import logging
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, TypeVar

from common.arrays import Image
from common.calibration import CameraCalibration
from common.clock import Clock
from common.errors import CameraError
from slave.cameras.grey import Pixels
from slave.cameras.picamera2_settings import (
    LIVE_CONTROLS,
    RATE_CONTROL,
    Picamera2Options,
    Request,
    check_ranges,
    controls,
    open_library,
    read_figures,
    wanted_settings,
)
from slave.cameras.picamera2_streams import (
    SensorMode,
    Streams,
    check_model,
    choose_mode,
    choose_raw_mode,
    read_modes,
)
from slave.cameras.picamera2_timing import SyncMonitor, Timeline, wait_in_step
from slave.cameras.settings import FrameObserver, as_values, change, demand, differences
from slave.sources import Frame, Tunable

BUFFERS = 6  # picamera2's own number for video: the pipeline never starves while one frame is held
TIMEOUT_S = 2.0  # libcamera itself gives a silent sensor up after 1 s
SETTLE_FRAMES = 60  # sensors apply exposure and gain 2-3 frames late, the pipeline adds its own depth: ample
_LOG = logging.getLogger(__name__)
T = TypeVar("T")


def offered(index: int) -> tuple[str, tuple[SensorMode, ...]]:
    """Model and modes of a camera that nobody has open."""
    library, _ = open_library(index)
    try:
        return str(library.camera_properties.get("Model", "unknown model")), read_modes(library.sensor_modes)
    finally:
        library.close()


class Picamera2Camera(Tunable):
    """A `FrameSource` of a Raspberry Pi camera."""

    def __init__(
        self,
        calibration: CameraCalibration,
        options: Picamera2Options,
        clock: Clock,
        stop: threading.Event | None = None,
    ) -> None:
        """Open, configure and start the camera, check its frames, wait to be in step."""
        self._calibration, self._options, self._clock = calibration, options, clock
        self._where = f"camera {calibration.name!r} (picamera2:{options.index})"
        self._timeline = Timeline(calibration.frame_rate_hz, clock)
        self._lores: Image | None = None
        self._closed = self._lost = False
        self._metadata = FrameObserver[Mapping[str, object]]()
        self._sync = (
            SyncMonitor(self._where, client=options.sync == "client") if options.sync != "off" else None
        )
        self._library, self._enums = open_library(options.index)
        try:
            self._start()
            self._settle(calibration, (self._unread() for _ in range(SETTLE_FRAMES)))
            if options.sync != "off":
                wait_in_step(
                    self._unread,
                    self._where,
                    options.sync,
                    options.sync_timeout_s,
                    clock,
                    lambda: stop is not None and stop.is_set(),
                )
        except BaseException:
            with contextlib.suppress(CameraError):  # the first error is the one to read
                self.close()
            raise

    @property
    def lores(self) -> Image | None:
        """Small image of the last frame: (3 h / 2, w) planar YUV420 (I420), if asked for."""
        return self._lores

    def read(self) -> Frame | None:
        """Wait for the next frame; None once closed."""
        while not self._closed:
            metadata, image, lores = self._capture(
                lambda request: (
                    dict(request.get_metadata()),
                    self._streams.image(request),
                    self._streams.small(request),
                )
            )
            self._metadata.put(metadata)
            if self._sync is not None:
                self._sync.push(metadata)
            try:
                place = self._timeline.place(metadata)
            except CameraError as error:
                raise CameraError(f"{self._where}: {error}") from error
            if place is None:
                continue
            self._lores = lores
            exposure = as_values(metadata.get("ExposureTime"))
            return Frame(
                *place,
                self._clock.now_ns(),
                image,
                self._options.pixels.illumination,
                self._timeline.sigma_ns,
                exposure[0] if exposure else 0.0,
            )
        return None

    def close(self) -> None:
        """Give the camera back. Safe to call twice."""
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
        thread.join(5.0)  # seconds: ample for a camera that lets itself be closed
        if thread.is_alive():
            raise CameraError(f"{self._where}: libcamera does not let it go; restart the slave")
        if failure:
            raise CameraError(f"{self._where}: could not be closed: {failure[0]}") from failure[0]

    def tune(self, camera: CameraCalibration) -> None:
        """Change exposure, gains and rate while another thread reads; see `Tunable`."""
        if self._sync is not None and camera.frame_rate_hz != self._calibration.frame_rate_hz:
            raise CameraError(
                f"{self._where}: frame_rate_hz: {self._calibration.frame_rate_hz:g} cannot become "
                f"{camera.frame_rate_hz:g} while it runs in step with others (--sync): save it, and restart the slaves "
                "of all of them"
            )
        change(self._apply, self._calibration, camera)
        self._calibration = camera

    def metrics(self) -> dict[str, float]:
        """The settings in the metadata of the last frame, and whether it is in step."""
        metadata = self._metadata.newest
        found = {} if metadata is None else read_figures(metadata)
        return found if self._sync is None else found | self._sync.metrics()

    def counts(self) -> dict[str, int]:
        """`camera.out_of_step`, where it is to be in step."""
        return {} if self._sync is None else {"camera.out_of_step": self._sync.lost}

    def _apply(self, camera: CameraCalibration) -> None:
        """Write the settings that can change, and wait until the frames show them."""
        available = self._library.camera_controls
        try:
            asked = controls(camera, self._options, self._enums, available)
            names = LIVE_CONTROLS if self._sync is not None else (*LIVE_CONTROLS, RATE_CONTROL)
            live = {name: asked[name] for name in names if name in asked}
            check_ranges(live, available)
        except CameraError as error:
            raise CameraError(f"{self._where}: {error}") from error
        self._settle(camera, self._insist(live))

    def _insist(self, live: Mapping[str, Any]) -> Iterator[Mapping[str, object]]:
        """Write controls every 20 frames; the metadata of the frames meanwhile.

        picamera2 loses controls that another thread writes while it recycles a request (`CompletedRequest.release`
        takes the controls, then makes an empty set of them).
        """
        for count, metadata in enumerate(self._metadata.following(SETTLE_FRAMES, TIMEOUT_S)):
            if count % 20 == 0:  # frames: ample for one writing to show
                try:
                    self._library.set_controls(live)
                except RuntimeError as error:
                    raise CameraError(f"{self._where}: its settings cannot be changed: {error}") from error
            yield metadata

    def _start(self) -> None:
        camera, library = self._calibration, self._library
        size = (camera.width_px, camera.height_px)
        # A client catches up by shorter frames, so the mode must be faster than the rig
        need_hz = camera.frame_rate_hz * (1.0 if self._options.sync == "off" else 1.05)
        try:
            modes = read_modes(library.sensor_modes)
            model = str(library.camera_properties.get("Model", "unknown model"))
            check_model(camera.sensor, model, modes, need_hz)
            if self._options.pixels is Pixels.GREY:
                mode = choose_raw_mode(modes, need_hz, size)
            else:
                mode = choose_mode(modes, need_hz, size, camera.sensor)
            asked = controls(camera, self._options, self._enums, library.camera_controls)
            streams = Streams(self._options.pixels, size, mode, self._options.lores)
            library.configure(
                library.create_video_configuration(**streams.parts(), controls=asked, buffer_count=BUFFERS)
            )
            self._streams = streams.taken(library.camera_configuration())
            check_ranges(asked, library.camera_controls)  # of the mode just configured
            library.start()
        except CameraError as error:
            raise CameraError(f"{self._where}: {error}") from error
        except (RuntimeError, ValueError) as error:
            raise CameraError(f"{self._where}: cannot be started: {error}") from error
        _LOG.info("%s: %s, mode %s", self._where, model, mode.text(modes))

    def _settle(self, camera: CameraCalibration, frames: Iterable[Mapping[str, object]]) -> None:
        """Wait until some `frames` (metadata) in a row have every setting of `camera`."""
        wanted = wanted_settings(camera, self._library.camera_controls, self._options.pixels)
        good, metadata = 0, dict[str, object]()
        good_frames = 3
        for metadata in frames:
            good = 0 if differences(wanted, metadata) else good + 1
            if good == good_frames:
                _LOG.info("%s: settings checked, view %s", self._where, metadata.get("ScalerCrop", "unknown"))
                return
        fix = "Change the camera file to what the camera can do, and see that no other program controls it."
        demand(self._where, wanted, metadata, fix)
        raise CameraError(
            f"{self._where}: its settings do not stay: they were right, but not {good_frames} frames long"
        )

    def _unread(self) -> dict[str, object]:
        """Metadata of the next frame, which is thrown away."""
        return self._capture(lambda request: dict(request.get_metadata()))

    def _capture(self, read: Callable[[Request], T]) -> T:
        """What is read from the next request."""
        try:
            request = self._library.capture_request(wait=TIMEOUT_S)
            try:
                return read(request)
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
