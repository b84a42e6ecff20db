"""Small videos and pictures of a bright square on its way, and a calibration tree for them."""

import json
from pathlib import Path

import cv2
import numpy as np

from common.arrays import Image

SIZE = (96, 64)  # width, height [px]
COUNT = 12


def picture(number: int) -> Image:
    """Frame `number` (64, 96, 3): its square stands 6 px further right than in the frame before."""
    image = np.full((SIZE[1], SIZE[0], 3), 30, np.uint8)
    image[24:40, 6 * number : 6 * number + 16] = (40, 200, 240)
    return image


def number_of(image: Image) -> int:
    """The number of the frame that an image shows."""
    bright = np.flatnonzero(image[32, :, 1] > 110)
    return round((float(bright.mean()) - 7.5) / 6.0)


def write_video(path: Path, rate_hz: float = 25.0, size: tuple[int, int] = SIZE, count: int = COUNT) -> Path:
    """A video by the codec that goes with its name: MJPEG in AVI and MKV, MPEG-4 in MP4."""
    codec = "mp4v" if path.suffix == ".mp4" else "MJPG"
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), rate_hz, size)
    assert writer.isOpened()
    for number in range(count):
        writer.write(cv2.resize(picture(number), size))
    writer.release()
    return path


def write_pictures(folder: Path, ending: str = ".png") -> Path:
    """A folder of pictures that are named without leading zeros."""
    folder.mkdir(parents=True)
    for number in range(COUNT):
        cv2.imwrite(str(folder / f"frame{number}{ending}"), picture(number))
    return folder


def break_frame(path: Path, number: int) -> None:
    """Overwrite the data of one frame of an MJPEG AVI by zeros."""
    data = bytearray(path.read_bytes())
    starts: list[int] = []
    at = data.find(b"movi")
    while (at := data.find(b"00dc", at + 4)) >= 0:
        starts.append(at)
    length = int.from_bytes(data[starts[number] + 4 : starts[number] + 8], "little")
    data[starts[number] + 8 : starts[number] + 8 + length] = bytes(length)
    path.write_bytes(data)


def write_tree(folder: Path, cameras: tuple[str, ...] = ("left", "right"), rig: str = "desk") -> Path:
    """A calib_json tree with a rig of cameras of 96 x 64 px, without colours."""
    (folder / "cameras").mkdir(parents=True, exist_ok=True)
    (folder / "rigs").mkdir(exist_ok=True)
    places = {name: np.eye(4).tolist() for name in cameras}
    for i, name in enumerate(cameras):
        places[name][0][3] = 0.08 * i
        camera = {
            "version": 1,
            "name": name,
            "width_px": SIZE[0],
            "height_px": SIZE[1],
            "frame_rate_hz": 50.0,
            "exposure_us": 5000,
            "analogue_gain": 1.0,
            "colour_gains": [1.0, 1.0],
            "row_time_us": 0.0,
            "intrinsics": {
                "fx_px": 80.0,
                "fy_px": 80.0,
                "cx_px": 47.5,
                "cy_px": 31.5,
                "distortion": [0.0] * 5,
            },
        }
        (folder / "cameras" / f"{name}.json").write_text(json.dumps(camera))
    content = {
        "version": 1,
        "name": rig,
        "kind": "markers",
        "cameras": list(cameras),
        "hand": "default-right",
        "markers": ["thumb", "index"],
        "T_rig_camera": places,
        "depth_model": "stereo",
    }
    (folder / "rigs" / f"{rig}.json").write_text(json.dumps(content))
    return folder
