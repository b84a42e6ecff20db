"""No picture is decoded that claims another size than it may have; no bytes raise anything but a `PictureError`."""

import os
import re
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.errors import MessageError, PhalanxError, PictureError
from common.messages import MAX_PREVIEW_BYTES, MAX_STILL_BYTES, Preview, Still, decode, encode
from common.messages.picture_size import MAX_SCANS, MAX_SIDE_PX, jpeg_size, size_of
from common.recording.pictures import decode as picture
from common.recording.pictures import decode_file, read_picture
from master.calibrate.cameras.views import image_sets
from slave.cameras.replay import read_png
from tests.picture_helpers import TINY, claiming, hostile, many_scans, tiled

ROOT = Path(__file__).resolve().parents[3]
SIGNATURES = (
    b"",
    b"\xff\xd8",
    b"\xff\xd8\xff\xc0\0\x11",
    b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR",
    b"BM",
    b"II*\0",
    b"MM\0*",
)
REAL = {
    kind: cv2.imencode(f".{kind}", np.random.default_rng(3).integers(0, 255, (24, 32, 3), np.uint8))[
        1
    ].tobytes()
    for kind in ("jpg", "png", "bmp", "tiff")
}
OURS = ("jpg", "png")  # what a device or a recording of ours may have


@pytest.mark.parametrize("kind", REAL)
@pytest.mark.parametrize("shape", [(1, 1), (240, 320), (121, 77, 3), (544, 728, 3)])
def test_the_size_of_what_opencv_writes(kind: str, shape: tuple[int, ...]) -> None:
    data = cv2.imencode(f".{kind}", np.full(shape, 90, np.uint8))[1].tobytes()
    assert size_of(data) == (shape[1], shape[0])
    if kind in OURS:
        assert picture(data, (shape[1], shape[0])).shape == (*shape[:2], 3)
    else:
        with pytest.raises(PictureError, match="is no JPEG or PNG"):
            picture(data, (shape[1], shape[0]))
    assert decode_file(data, grey=True).shape == shape[:2]


@pytest.mark.parametrize("flags", [[cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 4]])
def test_the_size_of_every_jpeg_and_of_none_that_is_cut(flags: list[int]) -> None:
    data = cv2.imencode(".jpg", np.full((121, 77, 3), 90, np.uint8), flags)[1].tobytes()
    frame = min(at for at in (data.find(b"\xff\xc0"), data.find(b"\xff\xc2")) if at >= 0)
    assert jpeg_size(data) == (77, 121)
    assert jpeg_size(data[:2] + b"\xff\xfe\0\x04hi" + b"\xff" * 5 + data[2:]) == (
        77,
        121,
    )  # comment, fill bytes
    for cut in range(frame + 9):
        with pytest.raises(PictureError, match=r"no JPEG|cut or odd"):
            jpeg_size(data[:cut])


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"", "no JPEG, PNG, BMP or TIFF"),
        (b"GIF89a" + b"\1" * 20, "no JPEG, PNG, BMP or TIFF"),
        (b"\xff\xd8junk", "cut or odd"),
        (b"\xff\xd8" + b"\xff" * 100_000, "cut or odd"),
        (b"\xff\xd8" + b"\xff\xfe\0\2" * 100_000, "cut or odd"),
        (b"\xff\xd8\xff\xda\0\2" + TINY[2:], "cut or odd"),  # a scan before any frame header
        (claiming(0, 16), r"claims 0 x 16 px"),
        (claiming(16, 0), r"claims 16 x 0 px"),  # DNL would say it behind the first scan
        (claiming(30_000, 30_000), r"claims 30000 x 30000 px; a side has 1 to 16384"),
        (many_scans(16, 16, MAX_SCANS), "more than 64 scans"),
        (REAL["bmp"][:18] + b"\xff" * 8 + REAL["bmp"][26:], r"claims -1 x 1 px"),
        (REAL["png"][:16] + b"\x7f\xff\xff\xff" + REAL["png"][20:], r"claims 2147483647 x 24 px"),
        (b"II*\0\xff\xff\xff\xff", "TIFF whose header is cut"),
    ],
)
def test_what_is_no_picture_or_an_absurd_one_is_refused(data: bytes, expected: str) -> None:
    with pytest.raises(PictureError, match=expected):
        size_of(data)
    with pytest.raises(PictureError, match=expected):
        decode_file(data)
    with pytest.raises(PictureError, match=f"{expected}|is no JPEG or PNG"):
        picture(data, (16, 16))


def test_the_picture_of_a_device_has_the_size_of_its_camera_or_is_not_decoded() -> None:
    with pytest.raises(PictureError, match="is 32x24 px, the camera file says 24x32"):
        picture(REAL["jpg"], (24, 32))
    with pytest.raises(PictureError, match="is cut or broken"):
        picture(REAL["jpg"][:-100], (32, 24))
    rotated = REAL["jpg"][:2] + EXIF_ROTATED + REAL["jpg"][2:]
    assert picture(rotated, (32, 24)).shape == (24, 32, 3), "as the sensor has it, whatever its notes say"


EXIF_ROTATED = b"\xff\xe1\0\x22Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"


@given(st.sampled_from(SIGNATURES), st.binary(max_size=300))
def test_random_bytes_have_a_size_or_are_refused(head: bytes, tail: bytes) -> None:
    try:
        width, height = size_of(head + tail)
    except PictureError:
        return
    assert 1 <= width <= MAX_SIDE_PX
    assert 1 <= height <= MAX_SIDE_PX


@given(st.sampled_from(OURS), st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 255)), max_size=6))
def test_changed_bytes_never_give_another_size_or_another_error(
    kind: str, changes: list[tuple[int, int]]
) -> None:
    data = bytearray(REAL[kind])
    for at, value in changes:
        data[at % len(data)] = value
    try:
        image = picture(bytes(data), (32, 24))
    except PictureError:
        return
    assert (image.shape, image.dtype) == ((24, 32, 3), np.uint8)


READERS: dict[str, Callable[[Path], object]] = {
    "any": read_picture,
    "frame": lambda path: read_png(path, (480, 640)),
    "file": lambda path: [load() for _, one in image_sets(path.parent, ["left"]) for load in one.values()],
}


@pytest.mark.parametrize("reader", READERS)
def test_a_file_that_claims_a_terabyte_is_not_read(reader: str, tmp_path: Path) -> None:
    path = tmp_path / "left.png"
    path.touch()
    os.truncate(path, 1 << 40)  # takes no room on the disk
    with pytest.raises(PhalanxError, match="has 1099511627776 bytes, at most 268435456"):
        READERS[reader](path)


@pytest.mark.parametrize("reader", ["any", "frame"])
def test_a_pipe_is_no_picture_and_is_not_waited_for(reader: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "left.png")
    with pytest.raises(PhalanxError, match="is no plain file"):
        READERS[reader](tmp_path / "left.png")


TILE = 16_384


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("tile", [(TILE, TILE - 16), (TILE, 16), (16, TILE), (1040, 1024), (2**31, 2**31)])
def test_a_tile_larger_than_the_picture_is_refused(tile: tuple[int, int], order: str) -> None:
    data = tiled((640, 480), tile, b"", order)
    with pytest.raises(PictureError, match=f"TIFF of 640x480 px in tiles of {tile[0]}x{tile[1]}"):
        decode_file(data)
    with pytest.raises(PictureError, match="is no JPEG or PNG"):
        picture(data, (640, 480))


@pytest.mark.parametrize("tile", [(16, 16), (256, 256), (1024, 1024)])
def test_a_tiff_of_tiles_is_read(tile: tuple[int, int]) -> None:
    side = max(tile)
    assert decode_file(tiled((side - 3, side - 5), tile), grey=True).shape == (side - 5, side - 3)


def test_a_tile_whose_size_is_of_an_odd_kind_is_refused() -> None:
    data = tiled((640, 480), (TILE, TILE), b"", kind=16)  # LONG8, which libtiff takes
    with pytest.raises(PictureError, match="TIFF whose header is cut or odd"):
        decode_file(data)


@pytest.mark.parametrize("make", [lambda: Preview("left", 5, TINY), lambda: Still("left", 1, 5, TINY)])
@pytest.mark.parametrize(
    "jpeg", [claiming(30_000, 30_000), claiming(16_384, 4097), many_scans(16, 16, 100), TINY[:20]]
)
def test_no_message_carries_an_absurd_picture(make: Callable[[], Preview | Still], jpeg: bytes) -> None:
    assert decode(encode(make())).jpeg == TINY  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(MessageError, match="jpeg: "):
        decode(encode(hostile(make(), jpeg)))


def test_the_largest_camera_fits_into_a_message() -> None:
    limit = claiming(8192, 8192)
    assert Preview("left", 5, limit + b"\0" * (MAX_PREVIEW_BYTES - len(limit))).jpeg.startswith(limit)
    with pytest.raises(ValueError, match=f"jpeg: {MAX_STILL_BYTES + 1} bytes"):
        Still("left", 1, 5, limit + b"\0" * (MAX_STILL_BYTES + 1 - len(limit)))


# What a process has more at its peak than before the first picture, after it was given each through one of the ways
# in: memory [MB]; and processor time [s] of each. "unguarded" is the decoder without any guard, to see that the
# measure can fail.
WAYS = """
import re, sys, time
from pathlib import Path
import cv2, numpy as np
from common.errors import MessageError, PhalanxError
from common.messages import decode
from common.messages.picture_size import size_of
from common.recording.pictures import decode as picture, decode_file
from master.calibrate.cameras.views import load_image
from slave.cameras.grey import Pixels
from slave.cameras.replay import read_png
from slave.cameras.v4l2_formats import Layout
ways = {
    "device": lambda path: picture(path.read_bytes(), (640, 480)),
    "usb": lambda path: Layout(Pixels.COLOUR, "MJPG", (640, 480), 0).image(memoryview(path.read_bytes())),
    "usb grey": lambda path: Layout(Pixels.LUMA, "MJPG", (640, 480), 0).image(memoryview(path.read_bytes())),
    "recording": lambda path: read_png(path, (480, 640)),
    "file": load_image,
    "unguarded": lambda path: cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR),
}
def peak_mb():  # of this program alone: ru_maxrss is also that of the process that was forked to start it
    return int(re.search(r"VmHWM:\\s*(\\d+)", Path("/proc/self/status").read_text())[1]) / 1024
picture(cv2.imencode(".jpg", np.zeros((480, 640, 3), np.uint8))[1].tobytes(), (640, 480))
before_mb = peak_mb()
for way, path in zip(sys.argv[1::2], map(Path, sys.argv[2::2])):
    before_s = time.process_time()
    try:
        ways[way](path)
    except PhalanxError:
        pass
    print(peak_mb() - before_mb, time.process_time() - before_s)
"""
JPEG_WAYS = ("device", "usb", "usb grey", "recording", "file")
TIFF_WAYS = ("device", "recording", "file")


def test_bytes_that_claim_gigabytes_cost_nothing_but_where_nothing_guards(tmp_path: Path) -> None:
    """All ways in within one process of their own, a decoder without a guard as the last."""
    jpeg, tiff, large = (tmp_path / name for name in ("attack.jpg", "attack.tiff", "large.jpg"))
    jpeg.write_bytes(claiming(30_000, 30_000))
    assert jpeg.stat().st_size < 700
    tiff.write_bytes(tiled((640, 480), (TILE, TILE - 16), zlib.compress(bytes(TILE * (TILE - 16)), 9)))
    large.write_bytes(claiming(8000, 8000))
    ways = [(way, jpeg) for way in JPEG_WAYS] + [(way, tiff) for way in TIFF_WAYS]
    ways += [("device", large), ("unguarded", large)]
    words = [str(word) for pair in ways for word in pair]
    done = subprocess.run(
        [sys.executable, "-c", WAYS, *words], cwd=ROOT, capture_output=True, text=True, check=True
    )
    *guarded, unguarded = (tuple(map(float, line.split())) for line in done.stdout.splitlines())
    assert len(guarded) == len(ways) - 1
    for way, (memory_mb, time_s) in zip(ways, guarded, strict=False):
        assert memory_mb < 16.0, way
        assert time_s < 0.2, way
    assert unguarded[0] > 150.0


def decoders(text: str) -> list[str]:
    """Calls of a decoder of pictures."""
    return re.findall(r"\b(?:imdecode|imread|imdecodemulti|VideoCapture)\b", text)


def test_one_file_alone_calls_a_decoder_of_pictures_and_one_of_videos() -> None:
    assert decoders("x = cv2.imdecode(raw, 1)"), "the guard bites"
    files = [
        path for package in ("common", "slave", "master", "deploy") for path in (ROOT / package).rglob("*.py")
    ]
    calling = {path.relative_to(ROOT).as_posix() for path in files if decoders(path.read_text())}
    camera = "slave/cameras/opencv.py"  # opens one by its number, and no file
    assert calling == {"common/recording/pictures.py", camera}
