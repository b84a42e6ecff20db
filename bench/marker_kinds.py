"""The kinds of frames on which marker detectors are measured: one table, each row says what differs."""

from dataclasses import dataclass
from typing import Final

import msgspec

from bench.marker_colours import camera_file, marker_rgb
from common.calibration import CameraCalibration


@dataclass(frozen=True, slots=True)
class Kind:
    """What the frames of one kind show; lengths are for 640 px of image width and scale with it.

    Attributes:
        name: Its name.
        finger: Caps at finger ends with a highlight; else matt ones on skin, on its edge, on the bare table.
        clicked: A user has said which blob is which marker in the first frame: a cap on a bare table looks
            like any object of its colour.
        blur_px: Way during the exposure.
        hidden: Share of the paint that an edge hides, in the frames after `whole_frames`.
        noise: Times the usual noise.
        objects: Things of the markers' colours on the table: mugs and pens.
        count: Markers.
        size: Width, height [px].
        whole_frames: Frames before those that are judged.
        frames: Judged frames of one sequence.
    """

    name: str
    finger: bool = True
    clicked: bool = False
    blur_px: float = 0.0
    hidden: float = 0.0
    noise: float = 1.0
    objects: int = 0
    count: int = 6
    size: tuple[int, int] = (640, 480)
    whole_frames: int = 0
    frames: int = 4

    @property
    def camera(self) -> CameraCalibration:
        """The camera file of these frames."""
        still = camera_file(self.count, self.size)
        # Blurred caps move by the way of one frame: such a camera exposes from frame to frame.
        return (
            msgspec.structs.replace(still, exposure_us=1e6 / still.frame_rate_hz) if self.blur_px else still
        )

    @property
    def names(self) -> tuple[str, ...]:
        """The markers, in the order of every array."""
        return tuple(marker_rgb(self.count))

    @property
    def scale(self) -> float:
        """Of all lengths."""
        return self.size[0] / 640.0


KINDS: Final = {
    kind.name: kind
    for kind in (
        Kind("base", finger=False, clicked=True),
        Kind("finger_end"),
        Kind("blur3", blur_px=3.0),
        Kind("blur6", blur_px=6.0),
        Kind("occluded15", hidden=0.15, whole_frames=6, frames=2),
        Kind("noise", finger=False, clicked=True, noise=2.0),
        Kind("clutter", objects=3),
        Kind("twelve", count=12),
        Kind("twentyfour", count=24),
        Kind("320x240", size=(320, 240)),
        Kind("1280x960", size=(1280, 960)),
        Kind("1456x1088", size=(1456, 1088)),
    )
}
