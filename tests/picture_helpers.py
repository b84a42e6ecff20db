"""Pictures that claim to be what they are not."""

import cv2
import msgspec
import numpy as np

from common.messages import Preview, Still

TINY = cv2.imencode(".jpg", np.full((16, 16, 3), 90, np.uint8))[1].tobytes()  # about 630 bytes


def claiming(width: int, height: int, jpeg: bytes = TINY) -> bytes:
    """A JPEG whose frame header (SOF0) claims another size than it has."""
    at = jpeg.index(b"\xff\xc0") + 5
    return jpeg[:at] + height.to_bytes(2, "big") + width.to_bytes(2, "big") + jpeg[at + 4 :]


def many_scans(width: int, height: int, scans: int) -> bytes:
    """A progressive JPEG that repeats its last scan."""
    flat = np.full((height, width, 3), 90, np.uint8)
    jpeg = cv2.imencode(".jpg", flat, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    last = jpeg[jpeg.rindex(b"\xff\xda") : -2]
    return jpeg[:-2] + last * scans + jpeg[-2:]


def hostile(message: Preview | Still, jpeg: bytes) -> Preview | Still:
    """The message as a sender makes it that checks nothing."""
    msgspec.structs.force_setattr(message, "jpeg", jpeg)
    return message
