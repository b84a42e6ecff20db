"""Decoders read a recording's pictures from image files and videos.

A decoder allocates what a header claims, so 600 bytes can cost gigabytes: the size is read from the header of a JPEG,
PNG, BMP or TIFF first, and compared with the one that it may have. The walk through a JPEG accepts less than decoders
do (nothing between two segments but fill bytes, a frame header with both sizes), so the first frame header that it
finds is the first one that a decoder finds, too. A row of frames.csv names a picture, `left/000007.png`, or a video
and the number of a frame in it, `left.mp4/000007`. Frames that do not decode have numbers, too, and are skipped. Only
files that begin as a known container are opened: the decoder would follow a playlist wherever it leads.
"""

import re
import stat
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import cv2
import numpy as np

from common.arrays import Image, Int
from common.errors import PictureError, RecordingError
from common.messages.picture_size import Size, is_jpeg_or_png, size_of
from common.recording.recorded_files import refuse_links

MAX_FILE_BYTES = 256 << 20  # of one picture: 64 megapixels of 32 bits, not packed


def decode(data: bytes, size: Size, *, grey: bool = False) -> Image:
    """Decode the JPEG or PNG of a device as (H, W, 3) BGR or (H, W), uint8.

    The image is as the sensor has it; `size` is that of the camera file [px].

    Raises:
        PictureError: It has another size, is of another kind, or no whole picture. Another size costs no memory.
    """
    if not is_jpeg_or_png(data):  # of other kinds more than their size would have to be looked at
        raise PictureError("is no JPEG or PNG")
    found = size_of(data)
    if found != size:
        raise PictureError(f"is {found[0]}x{found[1]} px, the camera file says {size[0]}x{size[1]}")
    kind = cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR
    image = _decoded(data, kind | cv2.IMREAD_IGNORE_ORIENTATION)
    if image.shape[1::-1] != size:  # of a JPEG with two frame headers, should a decoder ever take the second
        raise PictureError(f"is not of the size {size[0]}x{size[1]} that it claims")
    return image


def read_picture(path: Path) -> bytes:
    """The bytes of a file of a picture, before anybody knows what is in it.

    Raises:
        OSError: It cannot be read.
        PictureError: It is no plain file, or too large: a file may claim any size and take no room on the disk.
    """
    about = path.stat()
    if not stat.S_ISREG(about.st_mode):
        raise PictureError("is no plain file")
    if about.st_size > MAX_FILE_BYTES:
        raise PictureError(f"has {about.st_size} bytes, at most {MAX_FILE_BYTES}")
    return path.read_bytes()


def decode_file(data: bytes, *, grey: bool = False) -> Image:
    """Decode a picture of up to 16384 x 16384 px as (H, W, 3) BGR or (H, W), uint8.

    Raises:
        PictureError: It is larger, of another kind than JPEG, PNG, BMP and TIFF, or no whole picture.
    """
    size_of(data)
    return _decoded(data, cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR)


def _decoded(data: bytes, flags: int) -> Image:
    try:
        # None where the end is missing (OpenCV 4.12 and 5.0).
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise PictureError(f"cannot be decoded: {error.err}") from error
    if image is None:
        raise PictureError("is cut or broken")
    return np.asarray(image, np.uint8)


ENDINGS = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm")
_MATROSKA = b"\x1a\x45\xdf\xa3"  # EBML, RFC 8794


@dataclass(frozen=True, slots=True, eq=False)
class VideoTimes:
    """Times that one pass over a video measures.

    Attributes:
        number: (T,) numbers of the frames that decode.
        t_ns: (T,) when each is shown, by the container, from its first frame [ns].
        rate_hz: Frames per second that the container states; 0: it does not.
        stamped: The times rise from frame to frame; False: the container has none, and `t_ns` is of no use.
        broken: Frames between these that do not decode.
        missing: Frames that the container counts after the last one that decodes.
    """

    number: Int
    t_ns: Int
    rate_hz: float
    stamped: bool
    broken: int
    missing: int


class VideoFrames:
    """The frames of one video file, by number; going back decodes from the beginning."""

    def __init__(self, path: Path) -> None:
        """Open the file.

        Raises:
            PictureError: It is no video that can be decoded; the text is to follow the file's name.
            OSError: It cannot be read.
        """
        self._path = path
        with path.open("rb") as file:
            head = file.read(12)
        if not (
            head[4:8] == b"ftyp" or (head[:4] == b"RIFF" and head[8:12] == b"AVI ") or head[:4] == _MATROSKA
        ):
            raise PictureError(
                f"is no video in MP4, MOV, AVI, Matroska or WebM{' (it is empty)' * (not head)}"
            )
        self._open()

    def _open(self) -> None:
        self._capture = cv2.VideoCapture(str(self._path), cv2.CAP_FFMPEG)
        self._number, self._decoded = -1, False
        if not self._capture.isOpened():
            raise PictureError(
                "cannot be decoded: its end or its index is missing, or its codec is unknown"
                " (convert it: ffmpeg -i IN -c:v libx264 -crf 12 OUT.mp4)"
            )
        width, height = (
            round(self._capture.get(k)) for k in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
        )
        self.size_px = (width, height)
        self.rate_hz = max(float(self._capture.get(cv2.CAP_PROP_FPS)), 0.0)
        self.count = max(round(self._capture.get(cv2.CAP_PROP_FRAME_COUNT)), 0)

    def _step(self) -> None:
        self._decoded = self._capture.grab()
        self._number += 1

    def image(self, number: int) -> Image:
        """Frame `number` (H, W, 3) BGR uint8, or PictureError."""
        if number < self._number:
            self.close()
            self._open()
        while self._number < number:
            self._step()
        if not self._decoded:
            raise PictureError(f"has no frame {number} that can be decoded")
        done, image = self._capture.retrieve()
        if not done:
            raise PictureError(f"frame {number} cannot be decoded")
        return np.asarray(image, np.uint8)

    def times(self) -> VideoTimes:
        """Decode the file from here to its end; PictureError if not one frame decodes."""
        number: list[int] = []
        shown_ms: list[float] = []
        failed = 0
        give_up = 50  # frames in a row that do not decode, where the container does not state how many it has
        while failed < give_up:
            self._step()
            if self._decoded:
                number.append(self._number)
                shown_ms.append(self._capture.get(cv2.CAP_PROP_POS_MSEC))
                failed = 0
            else:
                failed += 1
                if self._number + 1 >= self.count > 0:
                    break
        if not number:
            raise PictureError("has no frame that can be decoded")
        t_ns = np.round(1e6 * (np.array(shown_ms) - shown_ms[0])).astype(np.int64)
        last = number[-1] + 1
        return VideoTimes(
            number=np.array(number, np.int64),
            t_ns=t_ns,
            rate_hz=self.rate_hz,
            stamped=len(t_ns) > 1 and bool((np.diff(t_ns) > 0).all()),
            broken=last - len(number),
            missing=max(self.count - last, 0),
        )

    def close(self) -> None:
        """Give the decoder back."""
        self._capture.release()


_NUMBER = re.compile(r"[0-9]{1,9}")


def frame_name(video: str, number: int) -> str:
    """How frames.csv names a frame of a video."""
    return f"{video}/{number:06d}"


class FramePictures:
    """The pictures of one camera of a recording. Holds the videos that are open."""

    def __init__(self, folder: Path, size_px: tuple[int, int], *, grey: bool = False) -> None:
        """Of the recording `folder`, sizes of the camera file; nothing is opened yet."""
        self._folder, self._size_px, self._grey = folder, size_px, grey
        self._videos: dict[str, VideoFrames] = {}

    def read(self, file: str) -> Image:
        """The picture that a row names, (H, W, 3) BGR or (H, W) uint8.

        Raises:
            RecordingError: Missing, no picture, or of another size; the text names the file.
        """
        path = self._folder / file
        name = PurePosixPath(file)
        try:
            if name.parent.suffix.lower() not in ENDINGS:
                return decode(read_picture(path), self._size_px, grey=self._grey)
            if not _NUMBER.fullmatch(name.name):
                raise PictureError("must be VIDEO/NUMBER, a number from 0")
            path = path.parent
            return self._frame(str(name.parent), int(name.name))
        except OSError as error:
            raise RecordingError(f"{path}: cannot read: {error.strerror}") from error
        except PictureError as error:
            raise RecordingError(
                f"{path}: {error}; record again, or remove its line from frames.csv"
            ) from error

    def _frame(self, video: str, number: int) -> Image:
        if self._grey:
            raise PictureError("is a video, and frames of a wrist device must be pictures")
        if video not in self._videos:
            refuse_links(self._folder, [video])
            self._videos[video] = VideoFrames(self._folder / video)
        frames = self._videos[video]
        if frames.size_px != self._size_px:
            raise PictureError(
                "is of {}x{} px, the camera file says {}x{}".format(*frames.size_px, *self._size_px)
            )
        return frames.image(number)
