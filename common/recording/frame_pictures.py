"""Reader of a recording's pictures in the order in which they are requested.

Each is a file of its own, or a frame of a video.

A row of frames.csv names the file of a picture, `left/000007.png`, or a video in the recording's folder and the number
of a frame in it, `left.mp4/000007`.
"""

import re
from pathlib import Path, PurePosixPath

from common.arrays import Image
from common.errors import PictureError, RecordingError
from common.recording.pictures import decode, read_picture
from common.recording.recorded_files import refuse_links
from common.recording.video import ENDINGS, VideoFrames

_NUMBER = re.compile(r"[0-9]{1,9}")


def frame_name(video: str, number: int) -> str:
    """How frames.csv names a frame of a video."""
    return f"{video}/{number:06d}"


class FramePictures:
    """The pictures of one camera of a recording. Holds the video that is open."""

    def __init__(self, folder: Path, size_px: tuple[int, int], *, grey: bool = False) -> None:
        """Nothing is opened yet.

        Args:
            folder: The recording.
            size_px: Width and height by the camera file.
            grey: Whether one channel is wanted.
        """
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
