"""Settings that a camera can change while it runs: what the command "set" says, and by which names a slave answers.

A slave answers every command about its camera with a `Health` whose gauges say what the camera has now, read back, by
the names of `figures`, and, with the prefix `WANTED`, what the camera file in use says.
"""

import msgspec
from msgspec import Struct

from common.calibration import CameraCalibration, Positive

WANTED = "wanted."


class CameraSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True):
    """The body of the command "set": keys and units of the camera file; what is absent stays as it is."""

    exposure_us: Positive | None = None
    analogue_gain: Positive | None = None
    colour_gains: tuple[Positive, Positive] | None = None

    @classmethod
    def of(cls, camera: CameraCalibration) -> "CameraSettings":
        """Those of a camera file."""
        return cls(
            exposure_us=camera.exposure_us,
            analogue_gain=camera.analogue_gain,
            colour_gains=camera.colour_gains,
        )

    def over(self, camera: CameraCalibration) -> CameraCalibration:
        """The camera file with these settings in place of its own."""
        given = {name: value for name, value in msgspec.structs.asdict(self).items() if value is not None}
        return msgspec.structs.replace(camera, **given)


def figures(camera: CameraCalibration) -> dict[str, float]:
    """Settings of a camera file by the names of gauges; the gains of red and blue are relative to green."""
    red, blue = camera.colour_gains
    return {
        "exposure_us": camera.exposure_us,
        "analogue_gain": camera.analogue_gain,
        "red_gain": red,
        "blue_gain": blue,
        "frame_rate_hz": camera.frame_rate_hz,
    }
