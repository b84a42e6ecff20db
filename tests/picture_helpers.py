"""Pictures that claim to be what they are not."""

import struct
import zlib

import cv2
import msgspec
import numpy as np

from common.arrays import Float
from common.messages import Preview, Still

TINY = cv2.imencode(".jpg", np.full((16, 16, 3), 90, np.uint8))[1].tobytes()  # about 630 bytes


def mirrored(uv: Float, *_: object) -> Float:
    """Pixels (n, 2) as a camera of 640 px sees them that shows its pictures mirrored."""
    return np.stack([639.0 - uv[:, 0], uv[:, 1]], axis=1)


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


def tiled(
    size: tuple[int, int],
    tile: tuple[int, int],
    packed: bytes | None = None,
    order: str = "<",
    kind: int = 4,
) -> bytes:
    """A grey TIFF of one tile, deflated; its width and height are of a kind (4: LONG)."""
    data = zlib.compress(bytes(tile[0] * tile[1])) if packed is None else packed
    data += bytes(len(data) % 2)
    rows = [(256, 4, size[0]), (257, 4, size[1]), (258, 3, 8), (259, 3, 8), (262, 3, 1), (277, 3, 1)]
    rows += [(322, kind, tile[0]), (323, kind, tile[1]), (324, 4, 8), (325, 4, len(data))]
    directory = struct.pack(f"{order}H", len(rows))
    for tag, of_kind, value in rows:
        content = struct.pack(f"{order}HH", value, 0) if of_kind == 3 else struct.pack(f"{order}I", value)
        directory += struct.pack(f"{order}HHI", tag, of_kind, 1) + content
    head = b"II*\0" if order == "<" else b"MM\0*"
    return head + struct.pack(f"{order}I", 8 + len(data)) + data + directory + bytes(4)


def hostile(message: Preview | Still, jpeg: bytes) -> Preview | Still:
    """The message as a sender makes it that checks nothing."""
    msgspec.structs.force_setattr(message, "jpeg", jpeg)
    return message
