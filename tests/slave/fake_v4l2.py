"""A USB camera as the kernel shows it, answering ioctls from a list of controls and formats.

It behaves as the kernel documents: enumerations end with EINVAL, S_FMT and S_PARM take the nearest they have, a value
that an automatic owns cannot be kept, buffers go round between driver and program, DQBUF without a filled buffer
is EAGAIN and without a device ENODEV.
"""

import ctypes as c
import errno
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from slave.cameras import v4l2_abi as abi
from slave.cameras.grey import GREY_FORMATS

MANUAL = 1


@dataclass
class Knob:
    """One control: its number, name, kind, range and present value."""

    number: int
    name: str
    kind: int
    low: int
    high: int
    step: int
    value: int
    menu: dict[int, str] = field(default_factory=dict[int, str])
    flags: int = 0


def webcam_knobs() -> list[Knob]:
    """Controls of a common UVC camera, named as kernel 6 does; the last one is of a kernel before 5.10."""
    off_on = (abi.V4L2.type_boolean, 0, 1, 1)
    return [
        Knob(0x00980001, "User Controls", 6, 0, 0, 0, 0, flags=abi.V4L2.ctrl_read_only),
        Knob(0x00980900, "Brightness", abi.V4L2.type_integer, -64, 64, 1, 0),
        Knob(0x0098090C, "White Balance, Automatic", *off_on, 1),
        Knob(0x00980913, "Gain", abi.V4L2.type_integer, 0, 100, 1, 17),
        Knob(
            0x00980918,
            "Power Line Frequency",
            abi.V4L2.type_menu,
            0,
            2,
            1,
            1,
            {0: "Disabled", 1: "50 Hz", 2: "60 Hz"},
        ),
        Knob(0x0098091A, "White Balance Temperature", abi.V4L2.type_integer, 2800, 6500, 10, 4600),
        Knob(
            0x009A0901,
            "Exposure, Auto",
            abi.V4L2.type_menu,
            0,
            3,
            1,
            3,
            {1: "Manual Mode", 3: "Aperture Priority Mode"},
        ),
        Knob(0x009A0902, "Exposure Time, Absolute", abi.V4L2.type_integer, 1, 5000, 1, 157),
        Knob(0x009A0903, "Exposure, Dynamic Framerate", *off_on, 1),
    ]


@dataclass
class Camera:
    """The camera behind the device, and what goes wrong with it.

    Attributes:
        formats: Four letters -> size [px] -> rates [Hz].
        keeps: What a written value becomes, by control name.
        resets: Control name -> value it falls back to when the stream starts.
        real_rate_hz: At which frames really come, if not as set.
        keeps_rate: It sets no rate while it streams, as uvcvideo.
        queue: Frames ready at each wait (1: the program keeps up).
        skip: Frame numbers the camera lost.
        damaged: Frame numbers that arrive with the error flag.
        cut: Frame numbers whose bytes end early.
        low_words: Its words of 16 bits hold 10, at their low ends.
        pictures: What it sees, frame by frame, (H, W) grey, sent as Y10.
        frozen_after: From this frame on it sends the picture of this one.
        fails_at: Frame numbers before which its driver raises something of its own.
        gone_after: From this frame on the device is unplugged; `silent_after`: it just sends nothing.
    """

    knobs: list[Knob] = field(default_factory=webcam_knobs)
    formats: dict[str, dict[tuple[int, int], tuple[float, ...]]] = field(
        default_factory=lambda: {
            "YUYV": {(640, 480): (30.0, 15.0), (1280, 720): (10.0,)},
            "MJPG": {(640, 480): (60.0, 30.0), (1280, 720): (60.0, 30.0)},
        }
    )
    keeps: Callable[[str, int], int] = lambda _name, value: value
    resets: dict[str, int] = field(default_factory=dict[str, int])
    refuses: dict[str, int] = field(default_factory=dict[str, int])
    real_rate_hz: float | None = None
    keeps_rate: bool = False
    stepwise: tuple[int, int, int, int, int, int] | None = None
    capabilities: int = abi.V4L2.cap_capture | abi.V4L2.cap_streaming
    stamp_flags: int = abi.V4L2.stamp_monotonic | abi.V4L2.stamp_start_of_exposure
    stamp_zero_ns: int = field(default_factory=lambda: time.monotonic_ns() - 2_000_000_000)
    counts: bool = True
    queue: int = 1
    padding: int = 0
    quantization: int = abi.V4L2.default_range
    low_words: bool = False
    pictures: Sequence[np.ndarray] = ()
    skip: frozenset[int] = frozenset()
    damaged: frozenset[int] = frozenset()
    cut: frozenset[int] = frozenset()
    frozen_after: int | None = None
    fails_at: frozenset[int] = frozenset()
    gone_after: int | None = None
    silent_after: int | None = None
    writes: list[tuple[str, int]] = field(default_factory=list[tuple[str, int]])
    closed: int = 0

    def knob(self, name: str) -> Knob:
        """The control whose kernel name begins so."""
        return next(knob for knob in self.knobs if knob.name.startswith(name))


def colour(number: int) -> tuple[int, int, int]:
    """Blue, green and red of frame `number`: plain, so that it survives YUV and JPEG."""
    return (40 + 8 * (number % 20), 90, 200)


class FakeDevice(abi.KernelDevice):
    """A device without a kernel."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.frame = 0
        self._size, self._format, self._rate_hz, self._stride = (0, 0), "", 30.0, 0
        self._bytes = 0
        self._memory: list[bytearray] = []
        self._empty: list[int] = []
        self._full: list[tuple[int, int, int]] = []  # index, frame, bytes
        self._streaming = self._closed = False
        self.mapped = 0

    def ioctl(self, request: int, argument: c.Structure | c.c_int) -> None:
        if self._gone():
            raise _error(errno.ENODEV)
        answers: dict[int, Callable[..., None]] = {
            abi.QUERYCAP: self._querycap,
            abi.ENUM_FMT: self._enum_fmt,
            abi.ENUM_FRAMESIZES: self._enum_sizes,
            abi.ENUM_FRAMEINTERVALS: self._enum_intervals,
            abi.S_FMT: self._s_fmt,
            abi.S_PARM: self._s_parm,
            abi.QUERY_EXT_CTRL: self._query_control,
            abi.QUERYMENU: self._query_menu,
            abi.S_EXT_CTRLS: self._set_control,
            abi.G_EXT_CTRLS: self._get_control,
            abi.REQBUFS: self._reqbufs,
            abi.QUERYBUF: self._querybuf,
            abi.QBUF: self._qbuf,
            abi.DQBUF: self._dqbuf,
            abi.STREAMON: self._streamon,
            abi.STREAMOFF: self._streamoff,
        }
        answers[request](argument)

    def map(self, length: int, offset: int) -> memoryview:
        index = offset // 0x100000
        assert len(self._memory[index]) == length
        self.mapped += 1
        return memoryview(self._memory[index]).toreadonly()

    def wait(self, timeout_s: float) -> bool:
        assert timeout_s > 0.0
        if self._gone():
            return True  # POLLERR
        if self.frame in self.camera.fails_at:
            raise ZeroDivisionError("a fault in the driver")
        if self.camera.silent_after is not None and self.frame >= self.camera.silent_after:
            return False
        for _ in range(self.camera.queue):
            self._expose()
        return bool(self._full)

    def close(self) -> None:
        assert not self._closed
        self._closed = True
        self.camera.closed += 1

    def _gone(self) -> bool:
        return self.camera.gone_after is not None and self.frame >= self.camera.gone_after

    def _expose(self) -> None:
        """The camera makes one frame; without an empty buffer it is lost."""
        camera = self.camera
        while self.frame in camera.skip:
            self.frame += 1
        number, self.frame = self.frame, self.frame + 1
        if not self._empty or not self._streaming:
            return
        index = self._empty.pop(0)
        name = "Y10" if camera.low_words else self._format
        picture = number if camera.frozen_after is None else min(number, camera.frozen_after)
        if camera.pictures:
            data = as_y10(camera.pictures[picture % len(camera.pictures)], self._stride)
        else:
            data = encode(name, self._size, self._stride, picture)
        if number in camera.cut:
            data = data[: len(data) // 2]
        self._memory[index][: len(data)] = data
        self._full.append((index, number, len(data)))

    def _querycap(self, found: abi.Capability) -> None:
        found.card, found.driver = b"Fake Cam", b"uvcvideo"
        found.capabilities = abi.V4L2.cap_device_caps | abi.V4L2.cap_capture | abi.V4L2.cap_streaming
        found.device_caps = self.camera.capabilities

    def _enum_fmt(self, entry: abi.FormatDescription) -> None:
        names = list(self.camera.formats)
        entry.pixelformat = abi.fourcc(_nth(names, entry.index))

    def _enum_sizes(self, entry: abi.FrameSizes) -> None:
        if self.camera.stepwise is not None:
            _nth([0], entry.index)
            entry.type = 3
            entry.size[:] = self.camera.stepwise
            return
        size = _nth(list(self.camera.formats[abi.fourcc_text(entry.pixel_format)]), entry.index)
        entry.type = abi.V4L2.discrete
        entry.size[0], entry.size[1] = size

    def _enum_intervals(self, entry: abi.FrameIntervals) -> None:
        sizes = self.camera.formats[abi.fourcc_text(entry.pixel_format)]
        rates = next(iter(sizes.values())) if self.camera.stepwise else sizes[entry.width, entry.height]
        if self.camera.stepwise is not None:
            _nth([0], entry.index)
            entry.type = 2
            entry.interval[:] = (1, round(max(rates)), 1, round(min(rates)), 1, 1)
            return
        entry.type = abi.V4L2.discrete
        entry.interval[0], entry.interval[1] = 1000, round(1000 * _nth(list(rates), entry.index))

    def _s_fmt(self, asked: abi.Format) -> None:
        pix = asked.fmt.pix
        self._format, self._size = abi.fourcc_text(pix.pixelformat), (pix.width, pix.height)
        width = row_bytes(self._format, pix.width)
        self._stride = width + self.camera.padding if width else 0
        pix.bytesperline = self._stride
        pix.quantization = self.camera.quantization
        self._bytes = self._stride * pix.height * (3 if self._format == "NV12" else 2) // 2 or 500_000
        pix.sizeimage = self._bytes

    def _s_parm(self, asked: abi.StreamParameters) -> None:
        if self.camera.keeps_rate and self._streaming:
            raise _error(errno.EBUSY)
        sizes = self.camera.formats[self._format]
        wanted = asked.denominator / asked.numerator
        rates = next(iter(sizes.values())) if self.camera.stepwise else sizes[self._size]
        self._rate_hz = wanted if self.camera.stepwise else min(rates, key=lambda rate: abs(rate - wanted))
        asked.numerator, asked.denominator = round(1e7 / self._rate_hz), 10_000_000  # UVC counts 100 ns

    def _query_control(self, query: abi.QueryControl) -> None:
        assert query.id & abi.V4L2.ctrl_next
        after = query.id & ~abi.V4L2.ctrl_next
        knob = _nth(
            [knob for knob in sorted(self.camera.knobs, key=lambda k: k.number) if knob.number > after], 0
        )
        query.id, query.type, query.flags = knob.number, knob.kind, knob.flags
        query.name = knob.name.encode()
        query.minimum, query.maximum, query.step = knob.low, knob.high, knob.step

    def _query_menu(self, query: abi.QueryMenu) -> None:
        menu = self._knob(query.id).menu
        if query.index not in menu:
            raise _error(errno.EINVAL)
        query.name = menu[query.index].encode()

    def _set_control(self, values: abi.ControlValues) -> None:
        assert (values.count, values.which) == (1, 0)
        one = values.controls[0]
        knob = self._knob(one.id)
        if knob.name in self.camera.refuses:
            raise _error(self.camera.refuses[knob.name])
        if not knob.low <= one.of.value <= knob.high:
            raise _error(errno.ERANGE)
        self.camera.writes.append((knob.name, one.of.value))
        automatic = self.camera.knob("Exposure, Auto").value != MANUAL
        if not (knob.name.startswith("Exposure Time") and automatic):  # else the automatic owns it
            knob.value = self.camera.keeps(knob.name, one.of.value)

    def _get_control(self, values: abi.ControlValues) -> None:
        one = values.controls[0]
        one.of.value = self._knob(one.id).value

    def _knob(self, number: int) -> Knob:
        return next(knob for knob in self.camera.knobs if knob.number == number)

    def _reqbufs(self, request: abi.RequestBuffers) -> None:
        self._memory = [bytearray(self._bytes) for _ in range(request.count)]

    def _querybuf(self, buffer: abi.Buffer) -> None:
        buffer.length, buffer.offset = len(self._memory[buffer.index]), buffer.index * 0x100000

    def _qbuf(self, buffer: abi.Buffer) -> None:
        assert buffer.index not in self._empty, "queued twice"
        self._memory[buffer.index][:] = b"\x55" * len(self._memory[buffer.index])  # the driver may write now
        self._empty.append(buffer.index)

    def _dqbuf(self, buffer: abi.Buffer) -> None:
        if not self._full:
            raise _error(errno.EAGAIN)
        index, number, used = self._full.pop(0)
        exposure = self.camera.knob("Exposure Time").value  # 100 us: no frame is shorter
        rate_hz = self.camera.real_rate_hz or min(self._rate_hz, 1e4 / exposure)
        stamp_us = (self.camera.stamp_zero_ns + round(number * 1e9 / rate_hz)) // 1000
        buffer.index, buffer.bytesused = index, used
        buffer.sequence = number if self.camera.counts else 0
        buffer.tv_sec, buffer.tv_usec = divmod(stamp_us, 1_000_000)
        buffer.flags = self.camera.stamp_flags | (abi.V4L2.buf_error if number in self.camera.damaged else 0)

    def _streamon(self, _kind: c.c_int) -> None:
        self._streaming = True
        for name, value in self.camera.resets.items():
            self.camera.knob(name).value = value

    def _streamoff(self, _kind: c.c_int) -> None:
        self._streaming = False


def level(number: int) -> int:
    """Grey of frame `number` at its left edge, of 10 bits; it rises by one from pixel to pixel, up to the end."""
    return 64 + 16 * (number % 20)


def row_bytes(name: str, width: int) -> int:
    """Bytes of a row without padding; 0 of JPEG."""
    groups = {"Y10P": (5, 4), "Y12P": (3, 2)}
    if name in groups:
        size, pixels = groups[name]
        return -(-width // pixels) * size
    return {"MJPG": 0, "BGR3": 3, "RGB3": 3, "GREY": 1, "NV12": 1, "BA81": 1}.get(name, 2) * width


def encode_grey(name: str, width: int, number: int) -> np.ndarray:
    """One row (bytes,) of a monochrome sensor of 10 bits, bit by bit as the kernel documents the format."""
    tens = np.minimum(level(number) + np.arange(width), 1023)
    words = {"Y10": tens, "Y12": tens << 2, "Y16": tens << 6}
    if name in words:
        return words[name].astype("<u2").view(np.uint8)
    if name == "GREY":
        return (tens >> 2).astype(np.uint8)
    out = bytearray()
    per = 4 if name == "Y10P" else 2
    for begin in range(0, width, per):
        group = [int(value) for value in tens[begin : begin + per]] + [0] * (
            per - len(tens[begin : begin + per])
        )
        if name == "Y10P":
            out += bytes(value >> 2 for value in group)
            out.append(sum((value & 3) << 2 * place for place, value in enumerate(group)))
        else:
            twelve = [value << 2 for value in group]
            out += bytes(value >> 4 for value in twelve)
            out.append((twelve[0] & 15) | (twelve[1] & 15) << 4)
    return np.frombuffer(bytes(out), np.uint8)


def as_y10(image: np.ndarray, stride: int) -> bytes:
    """A picture (H, W) of 8 bits as words of 10, with padding."""
    rows = np.full((image.shape[0], stride), 0x55, np.uint8)
    rows[:, : 2 * image.shape[1]] = (image.astype("<u2") << 2 | 1).view(np.uint8)
    return rows.tobytes()


def encode(name: str, size: tuple[int, int], stride: int, number: int) -> bytes:
    """A plain frame in the camera's format, its rows padded to the stride."""
    width, height = size
    rows = np.zeros((height, stride), np.uint8)
    if name in GREY_FORMATS:
        rows[:, : row_bytes(name, width)] = encode_grey(name, width, number)
        return rows.tobytes()
    image = np.full((height, width, 3), colour(number), np.uint8)
    if name == "MJPG":
        return cv2.imencode(".jpg", image)[1].tobytes() + b"\0\0"  # cameras pad
    if name == "RGB3":
        image = image[..., ::-1]
    if name in ("YUYV", "UYVY", "NV12"):
        y, cr, cb = cv2.split(cv2.cvtColor(image[:1, :1], cv2.COLOR_BGR2YCrCb))
        luma, u, v = (round(16 + float(y[0, 0]) * 219 / 255), *_narrow(cb[0, 0], cr[0, 0]))
        if name == "NV12":
            rows[:, :width] = luma
            return rows.tobytes() + np.tile(np.array([u, v], np.uint8), height // 2 * stride // 2).tobytes()
        pair = [luma, u, luma, v] if name == "YUYV" else [u, luma, v, luma]
        image = np.tile(np.array(pair, np.uint8), (height, width // 2))
    rows[:, : image.reshape(height, -1).shape[1]] = image.reshape(height, -1)
    return rows.tobytes()


def _narrow(cb: int, cr: int) -> tuple[int, int]:
    """Chroma of full range as studio range (BT.601)."""
    return round(128 + (float(cb) - 128) * 224 / 255), round(128 + (float(cr) - 128) * 224 / 255)


def _nth(items: list, index: int):  # pyright: ignore[reportMissingTypeArgument,reportUnknownParameterType]
    if index >= len(items):
        raise _error(errno.EINVAL)
    return items[index]


def _error(number: int) -> OSError:
    return OSError(number, os.strerror(number))
