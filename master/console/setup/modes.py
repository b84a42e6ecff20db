"""Sensors and modes that a camera may have.

Each comes with all that a camera file needs to begin with. docs/cameras.md gives the reasons.

Row times are those of the sensors' Linux drivers, line length over pixel rate, times the rows that are added up to one
of the picture. Exposure and gains are where to start from: a bright room, markers well exposed and little smeared.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from msgspec.structs import replace

from common.calibration import CameraCalibration, load

Kind = Literal["simulated", "usb", "pi"]

KINDS: dict[Kind, str] = {
    "simulated": "Simulated (no hardware)",
    "usb": "USB camera on this computer",
    "pi": "Camera of a Raspberry Pi",
}


@dataclass(frozen=True, slots=True)
class Mode:
    """One mode of one sensor.

    Attributes:
        title: For the list.
        size_px: Width and height of the picture.
        rate_hz: Frames a second.
        row_time_us: From one row to the next; 0: all at once, or not known.
        view: How much of the lens's full view is in the picture.
        exposure_us, gain, colour_gains: Where to start from.
        focus_m: Of a lens with a motor.
    """

    title: str
    size_px: tuple[int, int]
    rate_hz: float
    row_time_us: float
    view: str
    exposure_us: float = 5000.0
    gain: float = 2.0
    colour_gains: tuple[float, float] = (1.5, 1.5)
    focus_m: float | None = None

    def file(self, name: str) -> CameraCalibration:
        """A camera file of this mode, without lens and colours."""
        return CameraCalibration(
            version=1,
            name=name,
            width_px=self.size_px[0],
            height_px=self.size_px[1],
            frame_rate_hz=self.rate_hz,
            exposure_us=self.exposure_us,
            analogue_gain=self.gain,
            colour_gains=self.colour_gains,
            row_time_us=self.row_time_us,
            focus_m=self.focus_m,
        )


_GLOBAL = "all rows at once"
MODES: dict[Kind, dict[str, Mode]] = {
    "simulated": {},
    "pi": {
        "ov5647": Mode("Camera Module 1 (OV5647)", (640, 480), 58.0, 33.7, "full view"),
        "imx219": Mode("Camera Module 2 (IMX219)", (820, 616), 40.0, 37.8, "full view"),
        "imx219-fast": Mode("Camera Module 2 (IMX219), fast", (640, 480), 90.0, 18.9, "26° of the centre"),
        "imx708": Mode("Camera Module 3 (IMX708)", (1152, 648), 55.0, 26.7, "full view", focus_m=0.6),
        "imx708-fast": Mode(
            "Camera Module 3 (IMX708), fast", (768, 432), 115.0, 18.4, "two thirds of the width", focus_m=0.6
        ),
        "imx296": Mode("Global Shutter Camera (IMX296)", (728, 544), 60.0, 0.0, f"full view, {_GLOBAL}"),
    },
    "usb": {
        "vga60": Mode(
            "640 x 480 at 60 Hz", (640, 480), 60.0, 0.0, "row time not known", colour_gains=(1.0, 1.0)
        ),
        "vga30": Mode(
            "640 x 480 at 30 Hz", (640, 480), 30.0, 0.0, "row time not known", colour_gains=(1.0, 1.0)
        ),
        "hd30": Mode(
            "1280 x 720 at 30 Hz", (1280, 720), 30.0, 0.0, "row time not known", colour_gains=(1.0, 1.0)
        ),
        "hd60": Mode(
            "1280 x 720 at 60 Hz", (1280, 720), 60.0, 0.0, "row time not known", colour_gains=(1.0, 1.0)
        ),
    },
}
SIMULATED = "as-simulated"


def modes_of(kind: Kind) -> dict[str, str]:
    """What can be chosen for a camera of this kind: key -> text."""
    if kind == "simulated":
        return {SIMULATED: "Simulated sensor, as its world has it"}
    return {
        key: f"{mode.title}: {mode.size_px[0]} x {mode.size_px[1]} at {mode.rate_hz:g} Hz, {mode.view}"
        if kind == "pi"
        else f"{mode.title} ({mode.view})"
        for key, mode in MODES[kind].items()
    }


def new_file(kind: Kind, mode: str, name: str, truth: Path) -> CameraCalibration:
    """Return the initial file of a camera that was chosen on the page.

    It has the chosen mode, no lens and no colours.

    Args:
        kind: Of the camera.
        mode: A key of `modes_of(kind)`.
        name: Of the camera.
        truth: Tree of the simulated world, whose cameras a simulated one is like.

    Raises:
        CalibrationError: The simulated world has no such camera.
    """
    if kind == "simulated":
        true = load(truth / "cameras" / f"{name}.json", CameraCalibration)
        return replace(true, intrinsics=None, markers=None, provenance={})
    return MODES[kind][mode].file(name)
