"""Typed files of cameras: mode, exposure, optics and the colours of the markers."""

from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta

from common.calibration.files import Part, Provenance, read_json
from common.errors import CalibrationError
from common.geometry.lens import Lens, fold_of
from common.messages import Name

Hsv = tuple[
    Annotated[int, Meta(ge=0, le=179)], Annotated[int, Meta(ge=0, le=255)], Annotated[int, Meta(ge=0, le=255)]
]
RoiMargin = Annotated[float, Meta(ge=0.01, le=0.5)]

# From a time-lapse of one picture in 10 s to a high-speed camera.
FrameRate = Annotated[float, Meta(ge=0.1, le=10_000.0)]
Exposure = Annotated[float, Meta(ge=0.01, le=1e7)]  # [us] from a gated sensor to one picture in 10 s
AnalogueGain = Annotated[float, Meta(ge=0.01, le=10_000.0)]  # cameras of machine vision reach 48 dB, 251
ColourGain = Annotated[float, Meta(ge=0.01, le=100.0)]  # libcamera allows 32
RowTime = Annotated[float, Meta(ge=0.0, le=1e5)]  # [us] 16 rows of a picture that is read in 1.6 s
Focus = Annotated[float, Meta(ge=1e-3, le=1e6)]  # [m] from a macro lens to infinity
Size = Annotated[int, Meta(ge=16, le=16384)]  # [px] from a thermal array to 150 megapixels
Offset = Annotated[int, Meta(ge=0, le=16384)]  # [px] on a pixel array
ViewAngle = Annotated[float, Meta(ge=0.06, le=170.0)]  # [deg]
Pixel = Annotated[float, Meta(ge=-0.5, le=16384.0)]  # of a picture
Focal = Annotated[float, Meta(ge=1.0, le=1e7)]  # [px] check_camera compares it with the picture, too
Principal = Annotated[float, Meta(ge=-32768.0, le=32768.0)]  # [px]
# At normalised radius r k_i acts by k_i r^(2i): those of a telephoto lens (r = 0.05) are large, their effect is not.
Radial = Annotated[float, Meta(ge=-1e6, le=1e6)]
Tangential = Annotated[float, Meta(ge=-10.0, le=10.0)]
LinearLight = Annotated[float, Meta(ge=1e-6, le=1.0)]  # far below one step of a picture of 16 bits


class Intrinsics(Part, frozen=True):
    """Pinhole and distortion, OpenCV's convention; distortion = k1, k2, p1, p2, k3."""

    fx_px: Focal
    fy_px: Focal
    cx_px: Principal
    cy_px: Principal
    distortion: tuple[Radial, Radial, Tangential, Tangential, Radial] = (0.0, 0.0, 0.0, 0.0, 0.0)


class Sensor(Part, frozen=True):
    """What is known of sensor and lens before anything is measured.

    Attributes:
        title: What it is sold as.
        model: Its name in `rpicam-hello --list-cameras`; of a USB camera its class.
        driver: What opens it.
        shutter: Rolling with a `row_time_us` of 0: not known.
        colours: Whether it has colour filters.
        mode_px: Width and height of what the sensor delivers; the picture is scaled from it.
        bits: Of the mode; 0: the camera's own business.
        max_rate_hz: Highest rate of the mode.
        crop_px: What the picture shows of the pixel array: x, y, width, height.
        view_deg: Angle of the picture, across and down, by the lens `nominal`.
        nominal: Lens of focal length and pixel pitch, no measurement: `intrinsics` of the file are absent beside it.
        focal_share: Standard deviation of its focal length, as a share.
        exposure_us: Shortest and longest exposure at the rate of this file.
        sync: How two of them are exposed together.
        sources: Fact -> where it is from.
    """

    title: str
    model: Name
    driver: Literal["picamera2", "v4l2"]
    shutter: Literal["rolling", "global"]
    colours: bool
    mode_px: tuple[Size, Size]
    bits: Annotated[int, Meta(ge=0, le=16)]
    max_rate_hz: FrameRate
    crop_px: tuple[Offset, Offset, Size, Size]
    view_deg: tuple[ViewAngle, ViewAngle]
    nominal: Intrinsics
    focal_share: Annotated[float, Meta(ge=0.001, le=1.0)]
    exposure_us: tuple[Exposure, Exposure]
    sync: str
    sources: dict[str, str]

    def fits(self, model: str) -> bool:
        """Whether `model` is one of these, with or without infrared filter."""
        return model.removesuffix("_noir") == self.model


class HsvRange(Part, frozen=True):
    """Colour range of one marker in OpenCV's HSV (H 0-179).

    hsv_low[0] > hsv_high[0] wraps through 0. `reference_bgr_linear` is the mean marker colour in linear light, blue
    first, 1 = white, at calibration; with it a slave follows changes of the light.
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
    width_px: Size
    height_px: Size
    frame_rate_hz: FrameRate
    exposure_us: Exposure
    analogue_gain: AnalogueGain
    colour_gains: tuple[ColourGain, ColourGain]
    row_time_us: RowTime
    focus_m: Focus | None = None  # of a lens with a motor; the intrinsics are those of this distance
    intrinsics: Intrinsics | None = None
    markers: dict[Name, HsvRange] | None = None
    roi_margin: RoiMargin = 0.0625
    sensor: Sensor | None = None
    provenance: dict[str, Provenance] = {}


def check_camera(camera: CameraCalibration, where: str) -> None:
    """Refuse an empty colour range, and what `check_lens` refuses (CalibrationError)."""
    if camera.intrinsics is not None:
        check_lens(camera.intrinsics, (camera.width_px, camera.height_px), where)
    if camera.sensor is not None:
        check_lens(camera.sensor.nominal, (camera.width_px, camera.height_px), f"{where}: sensor")
        if camera.sensor.shutter == "global" and camera.row_time_us:
            raise CalibrationError(
                f"{where}: row_time_us: {camera.row_time_us:g}, of a global shutter it is 0"
            )
    for name, colour in (camera.markers or {}).items():
        for i, letter in ((1, "S"), (2, "V")):
            if colour.hsv_low[i] > colour.hsv_high[i]:
                raise CalibrationError(
                    f"{where}: markers.{name}: {letter} of hsv_low is above hsv_high (only H may wrap)"
                )


def check_lens(lens: Intrinsics, size_px: tuple[int, int], where: str) -> None:
    """Refuse a lens that cannot be that of a picture of this size.

    Raises:
        CalibrationError: Focal length or principal point do not fit the picture, or the lens folds inside it; with
            `where` and the key.
    """
    width = size_px[0]
    min_focal_per_width, max_focal_per_width = 0.05, 1000.0  # fields of view of 169 and 0.06 degrees
    low, high = min_focal_per_width * width, max_focal_per_width * width
    for axis, focal, principal, side in (
        ("x", lens.fx_px, lens.cx_px, width),
        ("y", lens.fy_px, lens.cy_px, size_px[1]),
    ):
        if not low <= focal <= high:
            raise CalibrationError(
                f"{where}: intrinsics.f{axis}_px: {focal:g}, of a picture {width} px wide it is {low:g} ... {high:g}"
            )
        if not -side <= principal <= 2 * side:
            raise CalibrationError(
                f"{where}: intrinsics.c{axis}_px: {principal:g}, more than one picture outside of it;"
                f" it is {-side} ... {2 * side}"
            )
    fold = fold_of(Lens(size_px, (lens.fx_px, lens.fy_px), (lens.cx_px, lens.cy_px), lens.distortion))
    if fold is not None:
        raise CalibrationError(
            f"{where}: intrinsics.distortion: the lens folds {fold.radius_px:.0f} px from its principal point, inside"
            f" the picture, at pixel ({fold.u:.0f}, {fold.v:.0f}): the distortion is not monotone there, and no ray"
            " belongs to a pixel beyond; calibrate with views that reach the corners of the picture"
        )


def sensor_files(tree: Path) -> dict[str, CameraCalibration]:
    """Sensor files of a calib_json tree: cameras/MODEL-WIDTHxHEIGHT*.json."""
    paths = sorted((tree / "cameras").glob("*-*x*.json"))
    return {
        path.stem: file for path in paths if (file := read_json(path, CameraCalibration)).sensor is not None
    }
