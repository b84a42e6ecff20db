"""Camera settings that can change while the camera runs.

Bodies of the commands "set" and "pick". A slave answers every command about its camera with a `Health` whose metrics
are what the camera has now, read back, by the names of `figures`, and, with the prefix `WANTED`, values of the camera
file in use; beside them the colour ranges in use, by `range_figures`.
"""

from collections.abc import Iterable

import msgspec
from msgspec import Struct

from common.calibration import CameraCalibration, HsvRange, RoiMargin, check
from common.calibration.camera import AnalogueGain, ColourGain, Exposure, FrameRate, Pixel
from common.errors import CalibrationError
from common.messages import Name

WANTED = "wanted."
ROI_LEAST, ROI_MOST = 0.01, 0.5  # of `roi_margin`
_OF_CAMERA = ("exposure_us", "analogue_gain", "colour_gains", "frame_rate_hz", "row_time_us")


class CameraSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True):
    """Body of the command "set", keys and units of the camera file, else unchanged.

    Of `markers` those that are named are replaced; null forgets a colour. A range without `reference_bgr_linear` keeps
    the one that the marker has.
    """

    exposure_us: Exposure | None = None
    analogue_gain: AnalogueGain | None = None
    colour_gains: tuple[ColourGain, ColourGain] | None = None
    frame_rate_hz: FrameRate | None = None
    roi_margin: RoiMargin | None = None
    markers: dict[Name, HsvRange | None] | None = None

    def over(self, camera: CameraCalibration) -> CameraCalibration:
        """The camera file with these settings; CalibrationError for a bad range."""
        given = {name: value for name, value in msgspec.structs.asdict(self).items() if value is not None}
        if self.markers is not None:
            given["markers"] = self._ranges(camera.markers or {}) or None
        new = msgspec.structs.replace(camera, **given)
        check(new, "set")
        return new

    def _ranges(self, ranges: dict[str, HsvRange]) -> dict[str, HsvRange]:
        merged = dict(ranges)
        for name, colour in (self.markers or {}).items():
            if colour is None:
                merged.pop(name, None)
                continue
            before = ranges.get(name)
            if colour.reference_bgr_linear is None and before is not None:
                colour = msgspec.structs.replace(colour, reference_bgr_linear=before.reference_bgr_linear)
            merged[name] = colour
        return merged


class ColourPick(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True):
    """Body of the command "pick": the marker, and a pixel of its colour.

    Attributes:
        uv: Pixel [px] of the whole frame.
        t_ns: Time of the preview clicked on [ns], by its stamp; the frame is kept for a second. Without it, or
            later, the newest frame is taken, in which a moving hand is elsewhere.
    """

    marker: Name
    uv: tuple[Pixel, Pixel]
    t_ns: int | None = None


def same_exposed(a: CameraCalibration, b: CameraCalibration) -> bool:
    """Whether two camera files ask the same of the camera itself."""
    return all(getattr(a, key) == getattr(b, key) for key in _OF_CAMERA)


def figures(camera: CameraCalibration) -> dict[str, float]:
    """Settings of a camera file by names of metrics; gains relative to green."""
    red, blue = camera.colour_gains
    return {
        "exposure_us": camera.exposure_us,
        "analogue_gain": camera.analogue_gain,
        "red_gain": red,
        "blue_gain": blue,
        "frame_rate_hz": camera.frame_rate_hz,
    }


def range_figures(camera: CameraCalibration, markers: Iterable[str]) -> dict[str, float]:
    """`roi_margin` and HSV bounds of markers: `marker.NAME.h_low` ... `.v_high`."""
    found = {"roi_margin": camera.roi_margin}
    for name in markers:
        if (colour := (camera.markers or {}).get(name)) is not None:
            for end, values in (("low", colour.hsv_low), ("high", colour.hsv_high)):
                found |= {f"marker.{name}.{h}_{end}": float(v) for h, v in zip("hsv", values, strict=True)}
    return found


def refuse_strange(markers: Iterable[str], known: Iterable[str], where: str) -> None:
    """Refuse markers that the rig has not: CalibrationError with `where`."""
    there = tuple(known)
    if strange := [name for name in markers if name not in there]:
        raise CalibrationError(f"{where}: the rig has no {', '.join(strange)}; it has {', '.join(there)}")
