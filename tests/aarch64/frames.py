"""The frames that are counted on, as files: written once by `tests.aarch64.scene`, read on both architectures."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import msgspec
import numpy as np

from common.arrays import Image
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load

FRAME_NS = 16_666_667
SIX, WRIST = "six", "wrist"


class MarkedFrames(NamedTuple):
    """Frames (H, W, 3) BGR of one camera, its calibration, and its markers in the order of the rig."""

    camera: CameraCalibration
    names: tuple[str, ...]
    images: list[Image]

    def image(self, k: int) -> Image:
        """Frame `k` of the endless sequence forth and back, in which no marker ever jumps."""
        return self.images[forth_and_back(k, len(self.images))]


def forth_and_back(k: int, count: int) -> int:
    """Index of step `k` along `count` >= 2 items that are walked forth and back; the period is 2 (count - 1)."""
    period = 2 * (count - 1)
    return min(k % period, period - k % period)


class StrobedFrames(NamedTuple):
    """Frames (H, W) of a wrist camera, ambient, laser, LED in turn, in whole triples; rig, camera and hand."""

    rig: RigCalibration
    camera: CameraCalibration
    hand: HandProfile
    images: list[Image]

    def cycle(self, k: int) -> list[Image]:
        """Triple `k` of the endless sequence forth and back."""
        first = 3 * forth_and_back(k, len(self.images) // 3)
        return self.images[first : first + 3]

    def t_ns(self, seq: int) -> int:
        """Time of frame `seq` of that sequence."""
        return round(1e9 * seq / self.camera.frame_rate_hz)


def write(place: Path, frames: MarkedFrames) -> None:
    """Write to the folder `place`: camera.json, names.json, and the frames as PNG."""
    place.mkdir(parents=True, exist_ok=True)
    (place / "camera.json").write_bytes(msgspec.json.encode(frames.camera))
    (place / "names.json").write_bytes(msgspec.json.encode(frames.names))
    _write_images(place, frames.images)


def read(place: Path) -> MarkedFrames:
    """Read what `write` left in the folder `place`; FileNotFoundError: there are no frames."""
    images = _read_images(place, cv2.IMREAD_COLOR)
    names = msgspec.json.decode((place / "names.json").read_bytes(), type=tuple[str, ...])
    return MarkedFrames(load(place / "camera.json", CameraCalibration), names, images)


def write_strobed(place: Path, frames: StrobedFrames) -> None:
    """Write to the folder `place`: rig.json, camera.json, hand.json, and the frames as PNG."""
    place.mkdir(parents=True, exist_ok=True)
    for name in ("rig", "camera", "hand"):
        (place / f"{name}.json").write_bytes(msgspec.json.encode(getattr(frames, name)))
    _write_images(place, frames.images)


def read_strobed(place: Path) -> StrobedFrames:
    """Read what `write_strobed` left in the folder `place`; FileNotFoundError: there are no frames."""
    images = _read_images(place, cv2.IMREAD_GRAYSCALE)
    rig, hand = load(place / "rig.json", RigCalibration), load(place / "hand.json", HandProfile)
    return StrobedFrames(rig, load(place / "camera.json", CameraCalibration), hand, images)


def _write_images(place: Path, images: Sequence[Image]) -> None:
    for k, image in enumerate(images):
        if not cv2.imwrite(str(place / f"{k:02d}.png"), image):
            raise OSError(f"{place}: cannot write frame {k}")


def _read_images(place: Path, kind: int) -> list[Image]:
    files = sorted(place.glob("*.png"))
    if not files:
        raise FileNotFoundError(f"{place}: no frames")
    return [np.asarray(cv2.imread(str(file), kind), np.uint8) for file in files]
