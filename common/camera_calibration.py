"""Typed files of cameras: mode, exposure, optics and the colours of the markers."""

from typing import Annotated, Literal

from msgspec import Meta

from common.calibration_parts import NonNegative, Number, Part, Positive, Provenance
from common.errors import CalibrationError
from common.messages import Name

Hsv = tuple[
    Annotated[int, Meta(ge=0, le=179)], Annotated[int, Meta(ge=0, le=255)], Annotated[int, Meta(ge=0, le=255)]
]
RoiMargin = Annotated[float, Meta(ge=0.01, le=0.5)]
LinearLight = Annotated[float, Meta(gt=0.0, le=1.0)]


class Intrinsics(Part, frozen=True):
    """Pinhole and distortion, OpenCV's convention; distortion = k1, k2, p1, p2, k3."""

    fx_px: Positive
    fy_px: Positive
    cx_px: Number
    cy_px: Number
    distortion: tuple[Number, Number, Number, Number, Number] = (0.0, 0.0, 0.0, 0.0, 0.0)


class HsvRange(Part, frozen=True):
    """Colour of one marker in OpenCV's HSV (H 0-179); hsv_low[0] > hsv_high[0] wraps through 0.

    `reference_bgr_linear` is the mean colour of the paint in linear light, blue first, 1 = white, at calibration; with
    it a slave follows changes of the light.
    """

    hsv_low: Hsv
    hsv_high: Hsv
    reference_bgr_linear: tuple[LinearLight, LinearLight, LinearLight] | None = None


class CameraCalibration(Part, frozen=True):
    """cameras/<name>.json: mode, exposure, optics and marker colours of one camera.

    `roi_margin`: how far from where it is expected a marker is still taken for itself, as a share of the image width
    beside its own size.
    """

    version: Literal[1]
    name: Name
    width_px: Annotated[int, Meta(ge=16, le=16384)]
    height_px: Annotated[int, Meta(ge=16, le=16384)]
    frame_rate_hz: Positive
    exposure_us: Positive
    analogue_gain: Positive
    colour_gains: tuple[Positive, Positive]
    row_time_us: NonNegative
    focus_m: Positive | None = None  # of a lens with a motor; the intrinsics are those of this distance
    intrinsics: Intrinsics | None = None
    markers: dict[Name, HsvRange] | None = None
    roi_margin: RoiMargin = 0.0625
    provenance: dict[str, Provenance] = {}


def check_camera(camera: CameraCalibration, where: str) -> None:
    """Refuse what the types alone cannot.

    Raises:
        CalibrationError: The colours of a marker are an empty range; with `where` and the key.
    """
    for name, colour in (camera.markers or {}).items():
        for i, letter in ((1, "S"), (2, "V")):
            if colour.hsv_low[i] > colour.hsv_high[i]:
                raise CalibrationError(
                    f"{where}: markers.{name}: {letter} of hsv_low is above hsv_high (only H may wrap)"
                )
