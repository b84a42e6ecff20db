"""What real cameras say of themselves, as they were recorded by others: golden data of the stand-ins and of the tests.

Pi cameras: the text of `rpicam-hello --list-cameras`. Sources: OV5647 raspberrypi/linux issue 5309 (58.92 Hz), and
Raspberry Pi OS of 2026 (62.50 Hz: the kernel states the pixel rate that the sensor always had); IMX219
raspberrypi/linux issue 5438, and Raspberry Pi OS since kernel 6.6 (8 bits at 83.70 Hz); IMX708 and IMX708 wide:
indi-allsky wiki, page of camera facts; IMX296 AllskyTeam/allsky issue 3632 and, monochrome, the same wiki; OV9281
raspberrypi/libcamera issue 126 (Pi 5). OV7251: no list was found; the mode is that of the kernel's driver.

Row times: line length over pixel rate in raspberrypi/linux drivers/media/i2c/, and for the OV5647 at 58.92 Hz what its
driver believes. Gains: the same lists (IMX708, IMX296), else the drivers' registers.

USB cameras: `v4l2-ctl --list-formats-ext`, size -> rates. C930e: ros-drivers/usb_cam issue 287; "USB Camera":
ihrapsa/OctoWrt issue 8; Spinel OV9281: PhotonVision issue 1219. Only what these excerpts show.
"""

import math
import re
from dataclasses import dataclass
from typing import Any

Mode = dict[str, Any]  # an entry of picamera2's `sensor_modes`; `_row_us` is for the stand-in alone


@dataclass(frozen=True)
class Recorded:
    """One sensor: the text, row times [us] by size and bits, gains, and whether it has colours and a focus motor."""

    text: str
    row_us: dict[tuple[int, int, int], float]
    gains: tuple[float, float]
    colours: bool = True
    focus: bool = False

    @property
    def model(self) -> str:
        found = re.search(r"^0 : (\w+) \[", self.text, re.MULTILINE)
        assert found is not None
        return found[1]

    @property
    def modes(self) -> tuple[Mode, ...]:
        raw, modes = "", list[Mode]()
        for line in self.text.splitlines():
            if (name := re.search(r"'(\w+)'", line)) is not None:
                raw = name[1]
            shape = re.search(r"(\d+)x(\d+) \[([\d.]+) fps - \((\d+), (\d+)\)/(\d+)x(\d+) crop\]", line)
            if shape is not None:
                width, height, x, y, wide, high = (int(shape[k]) for k in (1, 2, 4, 5, 6, 7))
                bits = int(re.sub(r"\D", "", raw.partition("_")[0]))
                row_us = self.row_us[width, height, bits]
                modes.append(mode((width, height), float(shape[3]), (x, y, wide, high), row_us, raw))
        return tuple(modes)


def mode(
    size: tuple[int, int],
    fps: float,
    crop: tuple[int, int, int, int],
    row_us: float,
    raw: str = "SBGGR10_CSI2P",
) -> Mode:
    """One entry of `sensor_modes`."""
    unpacked = raw.partition("_")[0]
    return {
        "format": raw,
        "unpacked": unpacked,
        "bit_depth": int(unpacked.lstrip("SRGB")),
        "size": size,
        "fps": fps,
        "crop_limits": crop,
        "exposure_limits": (math.ceil(row_us), 10_000_000, 20_000),
        "_row_us": row_us,
    }


_OV5647_ROWS = {(1296, 972, 10): 21.67, (1920, 1080, 10): 27.61, (2592, 1944, 10): 32.5}
_IMX219_ROWS = {(640, 480): 9.45, (1640, 1232): 18.9, (1920, 1080): 18.9, (3280, 2464): 18.9}
_IMX708_ROWS = {(1536, 864, 10): 9.209, (2304, 1296, 10): 13.361, (4608, 2592, 10): 26.29}

PI_CAMERAS = {
    "ov5647": Recorded(
        """0 : ov5647 [2592x1944 10-bit GBRG] (/base/soc/i2c0mux/i2c@1/ov5647@36)
    Modes: 'SGBRG10_CSI2P' : 640x480 [58.92 fps - (16, 0)/2560x1920 crop]
                             1296x972 [43.25 fps - (0, 0)/2592x1944 crop]
                             1920x1080 [30.62 fps - (348, 434)/1928x1080 crop]
                             2592x1944 [15.63 fps - (0, 0)/2592x1944 crop]""",
        _OV5647_ROWS | {(640, 480, 10): 33.67, (1296, 972, 10): 23.22, (1920, 1080, 10): 29.58},
        (1.0, 63.9375),
    ),
    "ov5647 of 2026": Recorded(
        """0 : ov5647 [2592x1944 10-bit GBRG] (/base/soc/i2c0mux/i2c@1/ov5647@36)
    Modes: 'SGBRG10_CSI2P' : 640x480 [62.50 fps - (16, 0)/2560x1920 crop]
                             1296x972 [46.34 fps - (0, 0)/2592x1944 crop]
                             1920x1080 [32.81 fps - (348, 434)/1928x1080 crop]
                             2592x1944 [15.63 fps - (0, 0)/2592x1944 crop]""",
        _OV5647_ROWS | {(640, 480, 10): 31.75},
        (1.0, 63.9375),
    ),
    "imx219": Recorded(
        """0 : imx219 [3280x2464] (/base/soc/i2c0mux/i2c@1/imx219@10)
    Modes: 'SRGGB10_CSI2P' : 640x480 [206.65 fps - (1000, 752)/1280x960 crop]
                             1640x1232 [41.85 fps - (0, 0)/3280x2464 crop]
                             1920x1080 [47.57 fps - (680, 692)/1920x1080 crop]
                             3280x2464 [21.19 fps - (0, 0)/3280x2464 crop]""",
        {(*size, 10): row_us for size, row_us in _IMX219_ROWS.items()},
        (1.0, 10.666667),
    ),
    "imx219 since 6.6": Recorded(
        """0 : imx219 [3280x2464 10-bit RGGB] (/base/axi/pcie@120000/rp1/i2c@88000/imx219@10)
    Modes: 'SRGGB10_CSI2P' : 640x480 [206.65 fps - (1000, 752)/1280x960 crop]
                             1640x1232 [41.85 fps - (0, 0)/3280x2464 crop]
                             1920x1080 [47.57 fps - (680, 692)/1920x1080 crop]
                             3280x2464 [21.19 fps - (0, 0)/3280x2464 crop]
           'SRGGB8' : 640x480 [206.65 fps - (1000, 752)/1280x960 crop]
                      1640x1232 [83.70 fps - (0, 0)/3280x2464 crop]
                      1920x1080 [47.57 fps - (680, 692)/1920x1080 crop]
                      3280x2464 [21.19 fps - (0, 0)/3280x2464 crop]""",
        {(*size, bits): row_us for size, row_us in _IMX219_ROWS.items() for bits in (8, 10)}
        | {(1640, 1232, 8): 9.45},
        (1.0, 10.666667),
    ),
    "imx708": Recorded(
        """0 : imx708 [4608x2592 10-bit RGGB] (/base/axi/pcie@1000120000/rp1/i2c@88000/imx708@1a)
    Modes: 'SRGGB10_CSI2P' : 1536x864 [120.13 fps - (768, 432)/3072x1728 crop]
                             2304x1296 [56.03 fps - (0, 0)/4608x2592 crop]
                             4608x2592 [14.35 fps - (0, 0)/4608x2592 crop]""",
        _IMX708_ROWS,
        (1.122807, 16.0),
        focus=True,
    ),
    "imx708_wide": Recorded(
        """0 : imx708_wide_noir [4608x2592 10-bit RGGB] (/base/soc/i2c0mux/i2c@0/imx708@1a)
    Modes: 'SRGGB10_CSI2P' : 1536x864 [120.13 fps - (768, 432)/3072x1728 crop]
                             2304x1296 [56.03 fps - (0, 0)/4608x2592 crop]
                             4608x2592 [14.35 fps - (0, 0)/4608x2592 crop]""",
        _IMX708_ROWS,
        (1.122807, 16.0),
        focus=True,
    ),
    "imx296": Recorded(
        """0 : imx296 [1456x1088 10-bit RGGB] (/base/soc/i2c0mux/i2c@1/imx296@1a)
    Modes: 'SRGGB10_CSI2P' : 1456x1088 [60.38 fps - (0, 0)/1456x1088 crop]""",
        {(1456, 1088, 10): 14.81},
        (1.0, 251.188644),
    ),
    "imx296 mono": Recorded(
        """0 : imx296 [1456x1088 10-bit MONO] (/base/soc/i2c0mux/i2c@1/imx296@1a)
    Modes: 'R10_CSI2P' : 1456x1088 [60.38 fps - (0, 0)/1456x1088 crop]""",
        {(1456, 1088, 10): 14.81},
        (1.0, 251.188644),
        colours=False,
    ),
    "ov9281": Recorded(
        """0 : ov9281 [1280x800 10-bit MONO] (/base/axi/pcie@120000/rp1/i2c@88000/ov9281@60)
    Modes: 'R8' : 640x400 [309.79 fps - (0, 0)/1280x800 crop]
                  1280x720 [171.79 fps - (0, 0)/1280x720 crop]
                  1280x800 [143.66 fps - (0, 0)/1280x800 crop]
           'R10_CSI2P' : 640x400 [247.83 fps - (0, 0)/1280x800 crop]
                         1280x720 [137.42 fps - (0, 0)/1280x720 crop]
                         1280x800 [114.93 fps - (0, 0)/1280x800 crop]""",
        {
            (*size, bits): 1530 / (160.0 if bits == 10 else 200.0)
            for size in ((640, 400), (1280, 720), (1280, 800))
            for bits in (8, 10)
        },
        (1.0, 15.9375),
        colours=False,
    ),
}

IMX219, OV5647, OV9281 = (PI_CAMERAS[name].modes for name in ("imx219", "ov5647", "ov9281"))
OV7251 = tuple(mode((640, 480), 120.0, (0, 0, 640, 480), 16.0, raw) for raw in ("R8", "R10_CSI2P"))

Formats = dict[str, dict[tuple[int, int], tuple[float, ...]]]
_SLOW = (5.0, 10.0, 15.0, 20.0, 25.0, 30.0)
USB_CAMERAS: dict[str, Formats] = {
    "Logitech C930e": {
        "YUYV": {
            (640, 480): (5.0, 10.0, 15.0, 20.0, 25.0, 30.0),
            (640, 360): (30.0,),
            (800, 448): (10.0,),
            (800, 600): (5.0, 10.0, 15.0, 20.0),
            (864, 480): (10.0,),
            (960, 720): (10.0,),
            (1024, 576): (10.0,),
            (1280, 720): (10.0,),
            (1600, 896): (5.0,),
            (1920, 1080): (5.0,),
        }
    },
    "USB Camera": {"MJPG": {(1280, 720): _SLOW, (640, 480): _SLOW, (352, 288): _SLOW}},
    "Spinel OV9281": {
        "MJPG": dict.fromkeys(((1280, 720), (160, 120), (176, 144), (320, 240)), (30.0, 60.0, 120.0))
    },
}
