"""Decode pictures that come from elsewhere, never larger than they may be.

This is the only place that calls a decoder of pictures; that of videos is in `common.recording.video`.
"""

import stat
from pathlib import Path

import cv2
import numpy as np

from common.arrays import Image
from common.errors import PictureError
from common.recording.picture_size import Size, is_jpeg_or_png, size_of

MAX_FILE_BYTES = 256 << 20  # of one picture: 64 megapixels of 32 bits, not packed


def decode(data: bytes, size: Size, *, grey: bool = False) -> Image:
    """Decode the picture of a device, whose size is known.

    JPEG or PNG, as our own programs write them; returns (H, W, 3) BGR or (H, W), uint8, as the sensor has it.

    Args:
        data: A whole file.
        size: Width and height [px] that it must have: those of the camera file.
        grey: Whether one channel is wanted.

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
    """Decode a picture that a person keeps on a disk.

    Of any size up to 16384 x 16384 px; returns (H, W, 3) BGR or (H, W), uint8.

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
