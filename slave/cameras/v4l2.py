"""USB camera, or any other single-planar V4L2 camera, stamped by the kernel.

Frames come in four mapped buffers. Each is decoded into an image of its own before its buffer goes back, so nobody
writes to a frame that was handed over. A slave that is late takes the newest frame and leaves the others; one that
did not read at all (while it waited for the master) finds all buffers full of old frames, which are thrown away.

The kernel stamps each buffer and states on which clock and at which event: the start of the exposure (USB: reckoned
from the camera's own clock where it has one), or the end of the frame, that is the last row's read-out. From there it
is half an exposure forward, or all rows and half an exposure back. `sequence` counts every frame of the camera, so a
gap in it is a dropped one; a frame that arrived damaged is one, too.

Scatter of a stamp: a driver that stamps in its interrupt 50 us, the latency of an interrupt under load. uvcvideo
reads the clock when it sees the first packet, and it sees packets when their transfer is over: of up to 32
microframes of 125 us, so anywhere within 4 ms, 1.2 ms as standard deviation. With `hwtimestamps=1` it follows the
camera's own clock by USB's frame numbers, one per ms: 0.3 ms. How late *all* frames are, by exposure and by what the
camera keeps, is no scatter and unknown here: `phalanx calibrate time` measures it. Whatever fails raises
`CameraError`, which states what to do; its settings are in `v4l2_controls`.
"""

import ctypes as c
import errno
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from statistics import median

from msgspec import structs

from common.arrays import Image
from common.calibration import CameraCalibration
from common.calibration.camera_settings import same_exposed
from common.clock import Clock
from common.errors import CameraError
from slave.cameras import v4l2_abi as abi
from slave.cameras.grey import Pixels
from slave.cameras.settings import FrameObserver, change
from slave.cameras.v4l2_controls import SETTLE_FRAMES, TIMEOUT_S, V4l2Settings
from slave.cameras.v4l2_formats import Layout, Offer, choose_offer, read_offers, set_format
from slave.clocks import ForeignClock, clock_of, system_clock
from slave.sources import Frame, Tunable

BUFFERS = 4
# a camera that halves its rate for the light is out by 1/2; USB jitter of a median is far below
RATE_SHARE = 0.1
USB_CLOCK = Path("/sys/module/uvcvideo/parameters/hwtimestamps")
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class V4l2Options:
    """What is not in the camera file."""

    # device; a path below /dev/v4l/by-id stays the same when the camera is plugged in anew
    path: Path = Path("/dev/video0")
    # control -> value, in codes of the maker
    controls: Mapping[str, int] = field(default_factory=dict[str, int])
    allow_missing: tuple[str, ...] = ()  # which of exposure, gain, white_balance the camera may lack
    pixels: Pixels = Pixels.COLOUR


def device_path(place: str) -> Path:
    """The device of a number or a path; empty: the first one."""
    return Path(f"/dev/video{place or '0'}" if place.isdecimal() or not place else place)


class V4l2Camera(Tunable):
    """A `FrameSource` of a V4L2 camera; `broken` counts damaged frames."""

    def __init__(
        self,
        calibration: CameraCalibration,
        options: V4l2Options,
        clock: Clock,
        open_device: Callable[[Path], abi.KernelDevice] = abi.KernelDevice,
    ) -> None:
        """Open and configure the camera, start it and check what it really does."""
        self._calibration, self._options, self._clock = calibration, options, clock
        self._where = f"camera {calibration.name!r} (v4l2:{options.path})"
        self._foreign: ForeignClock | None = None
        self._sigma_ns = 50e3  # see above
        self._buffers: list[memoryview] = []
        self._seq = -1
        self._sequence: int | None = None
        self._layout: Layout | None = None
        self._streaming = False
        self._settings: V4l2Settings | None = None
        self._rate_hz = 0.0
        self._times = FrameObserver[tuple[int, int]]()  # number and time of frames
        self.broken = 0
        self._device: abi.KernelDevice | None = self._open(open_device)
        try:
            self._start(self._device)
        except CameraError as error:
            self.close()
            raise CameraError(f"{self._where}: {error}") from error
        except OSError as error:
            self.close()
            who = f"; {abi.users_of(options.path)}" if error.errno == errno.EBUSY else ""
            raise CameraError(f"{self._where}: cannot be started: {error.strerror}{who}") from error

    def read(self) -> Frame | None:
        """Wait for the newest frame; None once closed."""
        while self._device is not None:
            try:
                image, buffer = self._next(self._device)
                t_ns = self._row_zero_ns(buffer)
            except OSError as error:
                raise CameraError(f"{self._where}: gone: {error.strerror}") from error
            except CameraError as error:
                raise CameraError(f"{self._where}: {error}") from error
            self._count(int(buffer.sequence))
            self._times.put((self._seq, t_ns))
            if image is None:
                self.broken += 1
                continue
            return Frame(
                self._seq,
                t_ns,
                self._clock.now_ns(),
                image,
                self._options.pixels.illumination,
                self._sigma_ns,
                self._calibration.exposure_us,
            )
        return None

    def close(self) -> None:
        """Stop and give the device back. Safe to call twice."""
        device, self._device = self._device, None
        if device is None:
            return
        try:
            if self._streaming:
                device.ioctl(abi.STREAMOFF, c.c_int(abi.V4L2.capture))
        except OSError as error:
            _LOG.info("%s: was gone before it was stopped: %s", self._where, error.strerror)
        self._buffers.clear()
        if self._settings is not None:
            self._settings.end()
        device.close()

    def tune(self, camera: CameraCalibration) -> None:
        """Change exposure and rate while another thread reads frames; see `Tunable`."""
        period_us = 1e6 / camera.frame_rate_hz
        if camera.exposure_us >= period_us:
            raise CameraError(
                f"{self._where}: exposure_us {camera.exposure_us:g} does not fit into a frame of {period_us:.0f} us"
            )
        assert self._settings is not None  # the constructor opened it
        try:
            self._settings.refuse_fixed(self._calibration, camera)
            change(self._apply, self._calibration, camera)
        except CameraError as error:
            raise CameraError(f"{self._where}: {error}") from error

    def _apply(self, camera: CameraCalibration) -> None:
        """Change the rate alone and the exposure alone, in the order that fits."""
        assert self._settings is not None  # the constructor opened it
        for step in _steps(self._calibration, camera):
            # its exposure is in the time of every frame from now on
            before, self._calibration = self._calibration, step
            if step.frame_rate_hz != before.frame_rate_hz:
                self._retime(step)
            else:
                self._settings.expose(step, self._times)

    def metrics(self) -> dict[str, float]:
        """Its settings and the rate measured at the start; nothing where it is gone."""
        found = {} if self._settings is None else self._settings.metrics()
        return found | {"frame_rate_hz": self._rate_hz} if found else found

    def counts(self) -> dict[str, int]:
        """`camera.broken`: frames that arrived damaged."""
        return {"camera.broken": self.broken}

    def _open(self, open_device: Callable[[Path], abi.KernelDevice]) -> abi.KernelDevice:
        try:
            return open_device(self._options.path)
        except OSError as error:
            there = ", ".join(str(path) for path in sorted(Path("/dev").glob("video*"))) or "none"
            fix = {
                errno.ENOENT: f"is it plugged in? Devices here: {there}",
                errno.EACCES: "add the user to group video (`sudo usermod -aG video $USER`, then log in again)",
                errno.EBUSY: "another program has it",
            }.get(error.errno or 0, f"devices here: {there}")
            raise CameraError(f"{self._where}: cannot be opened: {error.strerror}; {fix}") from error

    def _start(self, device: abi.KernelDevice) -> None:
        camera, options = self._calibration, self._options
        name = self._check_capabilities(device)
        size = (camera.width_px, camera.height_px)
        offer = choose_offer(read_offers(device, size), size, camera.frame_rate_hz, options.pixels)
        self._layout = set_format(device, offer, options.pixels)
        self._set_rate(device, camera)
        self._settings = settings = V4l2Settings(
            device, camera, options.controls, options.allow_missing, options.pixels
        )
        self._stream(device)
        self._settle(device)
        settings.check(lambda: self._settle(device))
        _LOG.info("%s: %s, %s, %d settings checked", self._where, name, offer.text(), len(settings))

    def _check_capabilities(self, device: abi.KernelDevice) -> str:
        found = abi.Capability()
        device.ioctl(abi.QUERYCAP, found)
        has = int(found.device_caps if found.capabilities & abi.V4L2.cap_device_caps else found.capabilities)
        name = found.card.decode("utf-8", "replace")
        if found.driver == b"uvcvideo":
            self._sigma_ns = 0.3e6 if _usb_clock_is_used() else 1.2e6  # see above
        if not (has & abi.V4L2.cap_capture and has & abi.V4L2.cap_streaming):
            raise CameraError(
                f"{name} is no single-planar capture device (a USB camera has a second device for metadata; a Pi "
                "camera is opened with --camera picamera2)"
            )
        return name

    def _retime(self, camera: CameraCalibration) -> None:
        """Change the frame rate and check it, while the loop goes on reading."""
        settings = self._settings
        assert settings is not None  # the constructor opened it
        settings.ask(lambda device: self._set_rate(device, camera))
        times = list(self._times.following(SETTLE_FRAMES, TIMEOUT_S))
        self._rate_hz = got_hz = _rate_of(times[len(times) // 3 :])  # the first ones are of the rate before
        if abs(got_hz - camera.frame_rate_hz) > RATE_SHARE * camera.frame_rate_hz:
            raise CameraError(
                f"frame_rate_hz: wanted {camera.frame_rate_hz:g}, frames come at {got_hz:.4g} Hz"
            )

    def _set_rate(self, device: abi.KernelDevice, camera: CameraCalibration) -> None:
        size, rate_hz = (camera.width_px, camera.height_px), camera.frame_rate_hz
        parameters = abi.StreamParameters(
            type=abi.V4L2.capture, numerator=1000, denominator=round(rate_hz * 1000)
        )
        try:
            device.ioctl(abi.S_PARM, parameters)
        except OSError as error:
            if error.errno == errno.EBUSY:
                raise CameraError(
                    f"frame_rate_hz: its driver sets no other rate ({rate_hz:g}) while frames come: write it into the "
                    "camera file, and restart the slave"
                ) from error
            if error.errno not in (errno.EINVAL, errno.ENOTTY):
                raise
            return  # a fixed rate: it is measured below
        got_hz = parameters.denominator / max(parameters.numerator, 1)
        if not Offer(0, size, (got_hz,)).reaches(rate_hz):
            raise CameraError(f"frame_rate_hz: wanted {rate_hz:g}, the driver set {got_hz:.4g}")

    def _stream(self, device: abi.KernelDevice) -> None:
        request = abi.RequestBuffers(count=BUFFERS, type=abi.V4L2.capture, memory=abi.V4L2.mmap)
        device.ioctl(abi.REQBUFS, request)
        for index in range(int(request.count)):
            buffer = abi.Buffer(index=index, type=abi.V4L2.capture, memory=abi.V4L2.mmap)
            device.ioctl(abi.QUERYBUF, buffer)
            self._buffers.append(device.map(int(buffer.length), int(buffer.offset)))
            device.ioctl(abi.QBUF, buffer)
        device.ioctl(abi.STREAMON, c.c_int(abi.V4L2.capture))
        self._streaming = True

    def _settle(self, device: abi.KernelDevice) -> None:
        """Take some frames, and see that they come at the rate that was asked for."""
        times: list[tuple[int, int]] = []
        for _ in range(SETTLE_FRAMES):
            _, buffer = self._next(device)
            times.append((int(buffer.sequence), self._row_zero_ns(buffer)))
        self._rate_hz = got_hz = _rate_of(times)
        rate_hz = self._calibration.frame_rate_hz
        if abs(got_hz - rate_hz) > RATE_SHARE * rate_hz:
            raise CameraError(
                f"frame_rate_hz: wanted {rate_hz:g}, frames come at {got_hz:.4g} Hz; an exposure of "
                f"{self._calibration.exposure_us:g} us may be too long, or the USB port too slow (two on one hub)"
            )

    def _next(self, device: abi.KernelDevice) -> tuple[Image | None, abi.Buffer]:
        """Newest frame (None: damaged) and its buffer, which the driver has back already."""
        layout = self._layout
        assert layout is not None  # the format is set before the stream starts
        while True:
            if not device.wait(TIMEOUT_S):
                raise CameraError(f"no frame for {TIMEOUT_S:g} s; check its cable")
            newest, count = _take(device), 1
            while newest is not None and (later := _take(device)) is not None:
                device.ioctl(abi.QBUF, newest)
                newest, count = later, count + 1
            if newest is None:
                continue
            stale = count >= len(self._buffers)  # the driver had no buffer left: nobody read for a while
            damaged = bool(newest.flags & abi.V4L2.buf_error) or newest.bytesused == 0
            image: Image | None = None
            if not stale and not damaged:
                data = self._buffers[int(newest.index)][: int(newest.bytesused)]
                image = layout.image(data)
            done = abi.Buffer.from_buffer_copy(newest)
            device.ioctl(abi.QBUF, newest)
            if not stale:
                return image, done

    def _count(self, sequence: int) -> None:
        """Update the frame number from the driver's 32-bit number, if it counts."""
        step = 1 if self._sequence is None else (sequence - self._sequence) % 2**32
        # A step of half the 32-bit range or more runs backwards
        self._seq += step if 0 < step < 2**31 else 1
        self._sequence = sequence

    def _row_zero_ns(self, buffer: abi.Buffer) -> int:
        """Middle of the exposure of row 0 [ns], slave's clock."""
        stamp_ns = int(buffer.tv_sec) * 10**9 + int(buffer.tv_usec) * 1000
        if self._foreign is None:
            monotonic = buffer.flags & abi.V4L2.stamp_clock == abi.V4L2.stamp_monotonic
            name = "monotonic" if monotonic else clock_of(stamp_ns)
            if name is None:
                raise CameraError(f"its driver stamps frames with {stamp_ns} ns, on no known clock")
            self._foreign = ForeignClock(self._clock, system_clock(name))
        half_ns = round(self._calibration.exposure_us * 500.0)
        t_ns = self._foreign.to_own(stamp_ns)
        if buffer.flags & abi.V4L2.stamp_source == abi.V4L2.stamp_start_of_exposure:
            return t_ns + half_ns
        return t_ns - round(self._calibration.height_px * self._calibration.row_time_us * 1e3) - half_ns


def _steps(old: CameraCalibration, new: CameraCalibration) -> list[CameraCalibration]:
    """Steps of settings from `old` to `new`: the exposure always fits into a frame."""
    retimed = structs.replace(old, frame_rate_hz=new.frame_rate_hz)
    exposed = structs.replace(new, frame_rate_hz=old.frame_rate_hz)
    if same_exposed(retimed, new) or same_exposed(exposed, new):
        return [new]
    return [exposed if new.exposure_us < old.exposure_us else retimed, new]


def _rate_of(times: Sequence[tuple[int, int]]) -> float:
    """Rate [Hz] of frames by their numbers and times [ns]; 0: there are too few."""
    periods = [(b[1] - a[1]) / max(b[0] - a[0], 1) for a, b in pairwise(times) if b[1] > a[1]]
    return 1e9 / median(periods) if periods else 0.0


def _usb_clock_is_used() -> bool:
    """Whether uvcvideo is configured to stamp by the cameras' own clocks."""
    try:
        return int(USB_CLOCK.read_text()) != 0
    except (OSError, ValueError):
        return False


def _take(device: abi.KernelDevice) -> abi.Buffer | None:
    """Dequeue a filled buffer, or None if there is none."""
    buffer = abi.Buffer(type=abi.V4L2.capture, memory=abi.V4L2.mmap)
    try:
        device.ioctl(abi.DQBUF, buffer)
    except BlockingIOError:
        return None
    return buffer
