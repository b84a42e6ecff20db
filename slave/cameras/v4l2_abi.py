"""Declare the kernel's V4L2 interface as far as a camera needs it.

Layouts and numbers are those of linux/videodev2.h on 64-bit machines, where x86-64 and aarch64 agree; the tests hold
them against sizes and numbers that a C compiler gave. Only single-planar memory-mapped capture is here. No library is
used: OpenCV's own V4L2 capture hides the frame number, the source of the time stamp and whether a setting was taken.
"""

import ctypes as c
import errno
import fcntl
import mmap
import os
import select
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple


class V4l2(NamedTuple):
    """Numbers of the kernel's interface (linux/videodev2.h)."""

    capture: int = 1  # V4L2_BUF_TYPE_VIDEO_CAPTURE
    mmap: int = 1  # V4L2_MEMORY_MMAP
    field_any: int = 0
    field_none: int = 1
    cap_capture: int = 0x1
    cap_streaming: int = 0x0400_0000
    cap_device_caps: int = 0x8000_0000
    discrete: int = 1  # V4L2_FRMSIZE_TYPE_DISCRETE, V4L2_FRMIVAL_TYPE_DISCRETE
    # V4L2_QUANTIZATION_DEFAULT, of YUV the full range where the colorspace is JPEG
    default_range: int = 0
    full_range: int = 1
    colorspace_jpeg: int = 7
    buf_error: int = 0x40
    stamp_clock: int = 0xE000
    stamp_monotonic: int = 0x2000
    stamp_source: int = 0x7_0000
    stamp_start_of_exposure: int = 0x1_0000
    ctrl_disabled: int = 0x1
    ctrl_grabbed: int = 0x2
    ctrl_read_only: int = 0x4
    ctrl_inactive: int = 0x10
    ctrl_write_only: int = 0x40
    ctrl_has_payload: int = 0x100
    ctrl_next: int = 0x8000_0000
    type_integer: int = 1
    type_boolean: int = 2
    type_menu: int = 3
    type_integer64: int = 5
    type_bitmask: int = 8
    type_integer_menu: int = 9


V4L2 = V4l2()


def _words(*names: str) -> list[tuple[str, type[c.c_uint32]]]:
    return [(name, c.c_uint32) for name in names]


class Capability(c.Structure):
    """struct v4l2_capability."""

    _fields_ = [
        ("driver", c.c_char * 16),
        ("card", c.c_char * 32),
        ("bus_info", c.c_char * 32),
        *_words("version", "capabilities", "device_caps"),
        ("reserved", c.c_uint32 * 3),
    ]


class FormatDescription(c.Structure):
    """struct v4l2_fmtdesc."""

    _fields_ = [
        *_words("index", "type", "flags"),
        ("description", c.c_char * 32),
        ("pixelformat", c.c_uint32),
        ("mbus_code", c.c_uint32),
        ("reserved", c.c_uint32 * 3),
    ]


class FrameSizes(c.Structure):
    """struct v4l2_frmsizeenum; width, height, or min, max, step of each."""

    _fields_ = [
        *_words("index", "pixel_format", "type"),
        ("size", c.c_uint32 * 6),
        ("reserved", c.c_uint32 * 2),
    ]


class FrameIntervals(c.Structure):
    """struct v4l2_frmivalenum; `interval` is one fraction [s], or min, max and step."""

    _fields_ = [
        *_words("index", "pixel_format", "width", "height", "type"),
        ("interval", c.c_uint32 * 6),
        ("reserved", c.c_uint32 * 2),
    ]


class PixelFormat(c.Structure):
    """struct v4l2_pix_format."""

    _fields_ = _words(
        *("width", "height", "pixelformat", "field", "bytesperline", "sizeimage"),
        *("colorspace", "priv", "flags", "ycbcr_enc", "quantization", "xfer_func"),
    )


class _FormatUnion(c.Union):
    _fields_ = [("pix", PixelFormat), ("raw", c.c_uint8 * 200), ("pointer", c.c_void_p)]


class Format(c.Structure):
    """struct v4l2_format; the union holds pointers, so it begins at 8."""

    _fields_ = [("type", c.c_uint32), ("fmt", _FormatUnion)]


class StreamParameters(c.Structure):
    """struct v4l2_streamparm with struct v4l2_captureparm."""

    _fields_ = [
        *_words("type", "capability", "capturemode", "numerator", "denominator"),
        ("rest", c.c_uint8 * 184),
    ]


class RequestBuffers(c.Structure):
    """struct v4l2_requestbuffers."""

    _fields_ = [
        *_words("count", "type", "memory", "capabilities"),
        ("flags", c.c_uint8),
        ("reserved", c.c_uint8 * 3),
    ]


class Buffer(c.Structure):
    """struct v4l2_buffer; `offset` is of the union m, which is a pointer wide."""

    _fields_ = [
        *_words("index", "type", "bytesused", "flags", "field"),
        ("tv_sec", c.c_int64),
        ("tv_usec", c.c_int64),
        ("timecode", c.c_uint8 * 16),
        *_words("sequence", "memory", "offset", "m_rest", "length", "reserved2"),
        ("request_fd", c.c_int32),
    ]


class QueryControl(c.Structure):
    """struct v4l2_query_ext_ctrl."""

    _fields_ = [
        ("id", c.c_uint32),
        ("type", c.c_uint32),
        ("name", c.c_char * 32),
        ("minimum", c.c_int64),
        ("maximum", c.c_int64),
        ("step", c.c_uint64),
        ("default_value", c.c_int64),
        *_words("flags", "elem_size", "elems", "nr_of_dims"),
        ("dims", c.c_uint32 * 4),
        ("reserved", c.c_uint32 * 32),
    ]


class QueryMenu(c.Structure):
    """struct v4l2_querymenu, packed."""

    _pack_, _layout_ = 1, "ms"
    _fields_ = [("id", c.c_uint32), ("index", c.c_uint32), ("name", c.c_char * 32), ("reserved", c.c_uint32)]


class _ControlValue(c.Union):
    _pack_, _layout_ = 1, "ms"
    _fields_ = [("value", c.c_int32), ("value64", c.c_int64)]


class ControlValue(c.Structure):
    """struct v4l2_ext_control, packed."""

    _pack_, _layout_ = 1, "ms"
    _fields_ = [*_words("id", "size", "reserved2"), ("of", _ControlValue)]


class ControlValues(c.Structure):
    """struct v4l2_ext_controls."""

    _fields_ = [
        *_words("which", "count", "error_idx"),
        ("request_fd", c.c_int32),
        ("reserved", c.c_uint32),
        ("controls", c.POINTER(ControlValue)),
    ]


_READ, _WRITE = 2, 1


def _request(direction: int, number: int, size: int) -> int:
    """_IOC of linux/ioctl.h with type 'V'."""
    return direction << 30 | size << 16 | ord("V") << 8 | number


QUERYCAP = _request(_READ, 0, c.sizeof(Capability))
ENUM_FMT = _request(_READ | _WRITE, 2, c.sizeof(FormatDescription))
S_FMT = _request(_READ | _WRITE, 5, c.sizeof(Format))
REQBUFS = _request(_READ | _WRITE, 8, c.sizeof(RequestBuffers))
QUERYBUF = _request(_READ | _WRITE, 9, c.sizeof(Buffer))
QBUF = _request(_READ | _WRITE, 15, c.sizeof(Buffer))
DQBUF = _request(_READ | _WRITE, 17, c.sizeof(Buffer))
STREAMON = _request(_WRITE, 18, c.sizeof(c.c_int))
STREAMOFF = _request(_WRITE, 19, c.sizeof(c.c_int))
S_PARM = _request(_READ | _WRITE, 22, c.sizeof(StreamParameters))
QUERYMENU = _request(_READ | _WRITE, 37, c.sizeof(QueryMenu))
G_EXT_CTRLS = _request(_READ | _WRITE, 71, c.sizeof(ControlValues))
S_EXT_CTRLS = _request(_READ | _WRITE, 72, c.sizeof(ControlValues))
ENUM_FRAMESIZES = _request(_READ | _WRITE, 74, c.sizeof(FrameSizes))
ENUM_FRAMEINTERVALS = _request(_READ | _WRITE, 75, c.sizeof(FrameIntervals))
QUERY_EXT_CTRL = _request(_READ | _WRITE, 103, c.sizeof(QueryControl))


class KernelDevice:
    """An open video device; all methods raise `OSError` as the kernel does."""

    def __init__(self, path: Path) -> None:
        self._file: int | None = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        self._maps: list[mmap.mmap] = []

    def ioctl(self, request: int, argument: c.Structure | c.c_int) -> None:
        """Do one request; the kernel changes `argument` in place."""
        fcntl.ioctl(self._open(), request, argument)  # Python repeats it after a signal (PEP 475)

    def map(self, length: int, offset: int) -> memoryview:
        """Memory of one buffer."""
        self._maps.append(mmap.mmap(self._open(), length, mmap.MAP_SHARED, mmap.PROT_READ, offset=offset))
        return memoryview(self._maps[-1])

    def wait(self, timeout_s: float) -> bool:
        """Whether a frame (or an error) is there within the time."""
        poll = select.poll()
        poll.register(self._open(), select.POLLIN)
        return bool(poll.poll(timeout_s * 1e3))

    def close(self) -> None:
        """Close; a map goes when nobody looks at it any more. Safe to call twice."""
        self._maps.clear()
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def _open(self) -> int:
        if self._file is None:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        return self._file


def fourcc(text: str) -> int:
    """Code of a pixel format such as "YUYV" or "Y10", whose fourth letter is a space."""
    return int.from_bytes(text.ljust(4).encode("ascii"), "little")


def fourcc_text(number: int) -> str:
    """The four letters of a pixel format."""
    return number.to_bytes(4, "little").decode("ascii", "replace").strip()


def users_of(device: Path) -> str:
    """Which other programs have a device (its name may be a pattern), and what to do.

    By the locks that libcamera has on the media devices it uses (`MediaDevice::lock`), which everybody may read; else
    by who has a device open, of which only root sees all.
    """
    paths = {path.resolve() for path in device.parent.glob(device.name)}
    pids, users = set[str](), list[str]()
    with suppress(OSError):
        locks = [line.split() for line in Path("/proc/locks").read_text().splitlines()]
        inodes = {str(path.stat().st_ino) for path in paths}
        pids = {words[4] for words in locks if words[5].rpartition(":")[2] in inodes}
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has ended, or is somebody else's
            opened = not pids and any(link.resolve() in paths for link in process.glob("fd/*"))
            if (opened or process.name in pids) and process.name != str(os.getpid()):
                words = (process / "cmdline").read_text(errors="replace").replace("\0", " ").strip()
                unit = (process / "cgroup").read_text().strip().rpartition("/")[2]
                users.append(f"`{words[:80]}` (process {process.name} of {unit or 'no service'})")
    if users:
        return f"another program has it: {', '.join(users)}: end that"
    return f"another program may have it: `sudo fuser -v {device}` names it"
