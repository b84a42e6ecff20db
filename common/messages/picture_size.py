"""Read the size in the header of a JPEG, PNG, BMP or TIFF, without a decoder.

A decoder allocates what a header claims, so 600 bytes can cost gigabytes. The walk through a JPEG accepts less than
decoders do: nothing between two segments but fill bytes, and few scans.
"""

from common.errors import PictureError

MAX_SIDE_PX = 16384  # of any picture: several times the largest sensor
MAX_PIXELS = 2**26  # of a picture in a message: 64 megapixels, 200 MB in colour
MAX_SCANS = 64  # of a JPEG: libjpeg writes 10 at most, and each one costs a pass over the whole picture

Size = tuple[int, int]  # width, height [px]

_JPEG, _PNG, _BMP = b"\xff\xd8", b"\x89PNG\r\n\x1a\n", b"BM"
_TIFF = {b"II*\0": "little", b"MM\0*": "big"}
_TABLES = (0xC4, 0xC8, 0xCC)  # in the range of frame headers, but none
_ALONE = (0x00, 0x01, *range(0xD0, 0xDB))  # without a length, or past the header: SOI, EOI, SOS
_TIFF_BYTES = {3: 2, 4: 4}  # SHORT, LONG: the kinds that a size may have


def is_jpeg_or_png(data: bytes) -> bool:
    """Whether a file is JPEG or PNG, the kinds that our own programs write."""
    return data.startswith((_JPEG, _PNG))


def size_of(data: bytes) -> Size:
    """Width and height [px] that a file of a picture claims.

    Raises:
        PictureError: It is none of the four kinds, its header is cut or odd, or a side is not 1 to 16384 px.
    """
    if data.startswith(_JPEG):
        return jpeg_size(data)
    if data.startswith(_PNG):
        return _checked(_png_size(data))
    if data.startswith(_BMP):
        return _checked(_bmp_size(data))
    if data[:4] in _TIFF:
        return _checked(_tiff_size(data))
    raise PictureError("is no JPEG, PNG, BMP or TIFF")


def jpeg_size(data: bytes) -> Size:
    """Width and height [px] in the frame header of a JPEG (ITU-T T.81, B.2.2).

    Raises:
        PictureError: It is no JPEG, its header is cut or odd, a side is not 1 to 16384 px, or it has too many scans.
    """
    if not data.startswith(_JPEG):
        raise PictureError("is no JPEG")
    at = 2
    max_segments = 512  # before the frame header; a file with an ICC profile of 255 parts has fewer
    for _ in range(max_segments):
        head = data[at : at + 9]
        if len(head) < 9 or head[0] != 0xFF:
            break
        if head[1] == 0xFF:  # a fill byte
            at += 1
            continue
        length = int.from_bytes(head[2:4], "big")
        if head[1] in _ALONE or length < 2:
            break
        if 0xC0 <= head[1] <= 0xCF and head[1] not in _TABLES:
            if data.count(b"\xff\xda") > MAX_SCANS:
                raise PictureError(f"is a JPEG of more than {MAX_SCANS} scans")
            return _checked((int.from_bytes(head[7:9], "big"), int.from_bytes(head[5:7], "big")))
        at += 2 + length
    raise PictureError("is a JPEG whose header is cut or odd")


def _checked(size: Size) -> Size:
    if not all(0 < side <= MAX_SIDE_PX for side in size):
        raise PictureError(f"claims {size[0]} x {size[1]} px; a side has 1 to {MAX_SIDE_PX}")
    return size


def _png_size(data: bytes) -> Size:
    """From IHDR, which comes first (PNG, 11.2.1)."""
    if len(data) < 24 or data[8:16] != b"\0\0\0\x0dIHDR":
        raise PictureError("is a PNG whose header is cut or odd")
    return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")


def _bmp_size(data: bytes) -> Size:
    """From the information header; a height below 0 is of rows from the top."""
    if len(data) < 26:
        raise PictureError("is a BMP whose header is cut")
    if int.from_bytes(data[14:18], "little") == 12:  # that of OS/2
        return int.from_bytes(data[18:20], "little"), int.from_bytes(data[20:22], "little")
    width, height = (int.from_bytes(data[at : at + 4], "little", signed=True) for at in (18, 22))
    return width, abs(height)


def _tiff_size(data: bytes) -> Size:
    """From the first directory (TIFF 6.0, section 2); tiles are decoded as a whole."""
    order = "little" if data[:2] == b"II" else "big"

    def number(at: int, count: int) -> int:
        return int.from_bytes(data[at : at + count], order)

    directory = number(4, 4)
    found = dict[int, int]()
    tiff_width, tiff_height, tile_width, tile_height = 256, 257, 322, 323
    for at in range(directory + 2, directory + 2 + 12 * number(directory, 2), 12):
        tag, width = number(at, 2), _TIFF_BYTES.get(number(at + 2, 2))
        if tag in (tiff_width, tiff_height, tile_width, tile_height) and tag not in found:
            if width is None:
                raise PictureError("is a TIFF whose header is cut or odd")
            found[tag] = number(at + 8, width)
    if not {tiff_width, tiff_height} <= found.keys():
        raise PictureError("is a TIFF whose header is cut or odd")
    size = found[tiff_width], found[tiff_height]
    tile = found.get(tile_width, 0), found.get(tile_height, 0)
    tile_px = 1024  # a tile may be larger than a small picture, up to this
    if any(of_tile > max(of_all + 15, tile_px) for of_tile, of_all in zip(tile, size, strict=True)):
        raise PictureError(f"is a TIFF of {size[0]}x{size[1]} px in tiles of {tile[0]}x{tile[1]}")
    return size
