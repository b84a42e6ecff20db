"""The frames that are counted on, as files: written once by `bench.aarch64.scene`, read on both architectures."""

from pathlib import Path
from typing import NamedTuple

import cv2
import msgspec
import numpy as np

from common.arrays import Image
from common.calibration import CameraCalibration, HandProfile, HsvRange, RigCalibration, load

FRAME_NS = 16_666_667
SIX, TWELVE, WRIST = "six", "twelve", "wrist"
STROBED_NS = 11_111_111  # from frame to frame of a wrist camera


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


def without(frames: MarkedFrames, name: str) -> MarkedFrames:
    """The same frames for a detector that seeks the marker `name` in a colour that none of them shows."""
    nowhere = HsvRange(hsv_low=(0, 255, 255), hsv_high=(1, 255, 255))
    ranges = {**(frames.camera.markers or {}), name: nowhere}
    return frames._replace(camera=msgspec.structs.replace(frames.camera, markers=ranges))


class StrobedFrames(NamedTuple):
    """Triples of frames (H, W) of a wrist camera, ambient, laser, LED; rig, camera and hand."""

    rig: RigCalibration
    camera: CameraCalibration
    hand: HandProfile
    triples: list[tuple[Image, ...]]

    def triple(self, k: int) -> tuple[Image, ...]:
        """Triple `k` of the endless sequence forth and back."""
        return self.triples[forth_and_back(k, len(self.triples))]


def write(place: Path, frames: MarkedFrames) -> None:
    """Write to the folder `place`: camera.json, names.json, and the frames as PNG.

    Raises:
        OSError: A file cannot be written.
    """
    place.mkdir(parents=True, exist_ok=True)
    (place / "camera.json").write_bytes(msgspec.json.encode(frames.camera))
    (place / "names.json").write_bytes(msgspec.json.encode(frames.names))
    for k, image in enumerate(frames.images):
        if not cv2.imwrite(str(place / f"{k:02d}.png"), image):
            raise OSError(f"{place}: cannot write frame {k}")


def read(place: Path) -> MarkedFrames:
    """What `write` left in the folder `place`.

    Raises:
        FileNotFoundError: There are no frames.
    """
    files = sorted(place.glob("*.png"))
    if not files:
        raise FileNotFoundError(f"{place}: no frames")
    images = [np.asarray(cv2.imread(str(file), cv2.IMREAD_COLOR), np.uint8) for file in files]
    names = msgspec.json.decode((place / "names.json").read_bytes(), type=tuple[str, ...])
    return MarkedFrames(load(place / "camera.json", CameraCalibration), names, images)


def write_strobed(place: Path, frames: StrobedFrames) -> None:
    """Write to the folder `place`: rig.json, camera.json, hand.json, and the triples as PNG.

    Raises:
        OSError: A file cannot be written.
    """
    place.mkdir(parents=True, exist_ok=True)
    for name in ("rig", "camera", "hand"):
        (place / f"{name}.json").write_bytes(msgspec.json.encode(getattr(frames, name)))
    for k, triple in enumerate(frames.triples):
        for i, image in enumerate(triple):
            if not cv2.imwrite(str(place / f"{k:02d}-{i}.png"), image):
                raise OSError(f"{place}: cannot write frame {k}-{i}")


def read_strobed(place: Path) -> StrobedFrames:
    """What `write_strobed` left in the folder `place`.

    Raises:
        FileNotFoundError: There are no frames.
    """
    files = sorted(place.glob("*.png"))
    if not files:
        raise FileNotFoundError(f"{place}: no frames")
    images = [np.asarray(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), np.uint8) for file in files]
    return StrobedFrames(
        load(place / "rig.json", RigCalibration),
        load(place / "camera.json", CameraCalibration),
        load(place / "hand.json", HandProfile),
        [tuple(images[k : k + 3]) for k in range(0, len(images), 3)],
    )
