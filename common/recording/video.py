"""Video files, decoded frame by frame.

They were recorded by other people's cameras and programs.

A frame is known by its number in the file, from 0. One that cannot be decoded has a number, too, and is skipped, so
that the same frame has the same number however often the file is read. Frames come in the order of the file: going
forward costs what lies between, going back begins anew.

Only files that begin as one of the known containers are opened: the decoder would follow a playlist wherever it leads.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from common.arrays import Image, Int
from common.errors import PictureError

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
    """The frames of one video file.

    Holds the decoder, the number of the frame it stands at, and whether that one decoded.
    """

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
        """Frame `number` (H, W, 3) BGR uint8.

        Raises:
            PictureError: There is no such frame, or it does not decode.
        """
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
        """Decode the file from here to its end.

        Raises:
            PictureError: Not one frame decodes.
        """
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
