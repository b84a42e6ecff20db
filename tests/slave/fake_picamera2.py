"""A stand-in for the Pi's picamera2 and libcamera, with the behaviour that their sources have.

Names, signatures and effects follow picamera2 0.3.38 (picamera2.py, request.py, controls.py) and libcamera's
Raspberry Pi pipeline: controls that a camera lacks are refused, modes are chosen by the closest size, values are
rounded down to rows and gain codes, metadata show them some frames late, requests are a pool that must be given back,
a capture that timed out stays queued and blocks `close`. `test_picamera2.py` compares the signatures with the real
library where it is installed.
"""

import inspect
import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

from tests.slave.recorded_lists import OV5647, Mode, Recorded

STRIDE = 64


@dataclass
class Sensor:
    """The camera that the fake library finds, and what goes wrong with it.

    Attributes:
        delay: Frames until metadata show what was asked for.
        tamper: Changes the metadata of frame k.
        lost_after: From this frame on no frame comes.
        frozen_after: From this frame on it sends the picture of this one.
        breaks_at: Frame numbers at which the library raises what it never says that it does.
        dropped: Frames that never reach the application.
        sync_ready_at: Frame from which on the cameras are in step; None: never.
        loses: Writings of controls that come while a request is recycled, and are lost.
        fails: Methods of a request that raise, by name.
        pi_5: Whether raw words have the sensor's bits on top, and no padding after 8 of them.
        start_ns: Time of frame 0. Frames come as fast as they are asked for, so the first one is 4.5 s old.
    """

    model: str = "ov5647"
    modes: tuple[Mode, ...] = OV5647
    gain_code: float = 1.0 / 16.0
    gains: tuple[float, float] = (1.0, 63.9375)
    focus: bool = False
    monochrome: bool = False
    sync: bool = True
    delay: int = 4
    tamper: Callable[[int, dict[str, Any]], None] = lambda _k, _metadata: None
    lost_after: int | None = None
    frozen_after: int | None = None
    breaks_at: frozenset[int] = frozenset()
    dropped: frozenset[int] = frozenset()
    sync_ready_at: int | None = 30
    sync_received_at: int = 10
    adjust: Callable[[dict[str, Any]], None] = lambda _configuration: None
    loses: int = 0
    fails: frozenset[str] = frozenset()
    busy: bool = False
    pi_5: bool = False
    start_ns: int = field(default_factory=lambda: time.monotonic_ns() - 4_500_000_000)
    opened: list["Picamera2"] = field(default_factory=list["Picamera2"])

    @classmethod
    def of(cls, listed: Recorded) -> "Sensor":
        """The sensor of a recorded list."""
        return cls(
            model=listed.model,
            modes=listed.modes,
            gains=listed.gains,
            focus=listed.focus,
            monochrome=not listed.colours,
        )


class Picamera2:
    """`picamera2.Picamera2`, as far as a slave uses it."""

    sensor: ClassVar[Sensor]

    @staticmethod
    def global_camera_info() -> list[dict[str, Any]]:
        sensor = Picamera2.sensor
        return [
            {
                "Model": sensor.model,
                "Location": 2,
                "Rotation": 180,
                "Id": f"/base/{sensor.model}@36",
                "Num": 0,
            }
        ]

    def __init__(
        self, camera_num: int = 0, verbose_console: Any = None, tuning: Any = None, allocator: Any = None
    ):
        self._sensor = type(self).sensor
        if self._sensor.busy:
            raise RuntimeError("Camera __init__ sequence did not complete.")
        self._mode = self._sensor.modes[-1]
        self._config: dict[str, Any] = {}
        self._frame = 0
        self._changes: list[tuple[int, dict[str, Any]]] = []  # from which frame on
        self._out: set[int] = set()
        self._stuck = False
        self._flushed = threading.Event()
        self.started = self.closed = False
        self.released = 0
        self._sensor.opened.append(self)

    @property
    def camera_properties(self) -> dict[str, Any]:
        return {"Model": self._sensor.model, "PixelArraySize": (3280, 2464)}

    @property
    def sensor_modes(self) -> list[Mode]:
        self._mode = self._sensor.modes[-1]  # each mode in turn is configured; the last one stays
        return [{k: v for k, v in entry.items() if not k.startswith("_")} for entry in self._sensor.modes]

    @property
    def camera_controls(self) -> dict[str, tuple[Any, Any, Any]]:
        shortest = math.ceil(1e6 / self._mode["fps"] - 1e-6)
        have: dict[str, tuple[Any, Any, Any]] = {
            "AeEnable": (False, True, True),
            "ExposureTime": (math.ceil(self._mode["_row_us"]), shortest * 100, 20_000),
            "AnalogueGain": (*self._sensor.gains, 1.0),
            "FrameDurationLimits": (shortest, 10_000_000, 33_333),
            "NoiseReductionMode": (0, 4, 0),
            "ScalerCrop": ((0, 0, 64, 64), self._mode["crop_limits"], self._mode["crop_limits"]),
        }
        if not self._sensor.monochrome:
            have |= {"AwbEnable": (False, True, None), "ColourGains": (0.0, 32.0, None)}
        if self._sensor.focus:
            have |= {"AfMode": (0, 2, 0), "LensPosition": (0.0, 15.0, 1.0)}
        if self._sensor.sync:
            have |= {"SyncMode": (0, 2, 0), "SyncFrames": (1, 1_000_000, 100)}
        return have

    def create_video_configuration(
        self,
        main: Any = {},  # noqa: B006
        lores: Any = None,
        raw: Any = {},  # noqa: B006
        transform: Any = None,
        colour_space: Any = None,
        buffer_count: Any = 6,
        controls: Any = {},  # noqa: B006
        display: Any = "main",
        encode: Any = "main",
        queue: Any = True,
        sensor: Any = {},  # noqa: B006
        use_case: Any = "video",
    ) -> dict[str, Any]:
        def stream(first: dict[str, Any], updates: Any) -> Any:
            if updates is None:
                return None
            wrong = set(updates) - {"format", "size", "stride", "preserve_ar"}
            if wrong:
                raise ValueError(f"Bad key {wrong!r}: valid stream configuration keys are ...")
            merged = first | updates
            width, height = merged["size"]
            return merged | {"size": (width - width % 2, height - height % 2)}

        main = stream({"format": "XBGR8888", "size": (1280, 720), "preserve_ar": True}, main)
        return {
            "use_case": use_case,
            "transform": transform,
            "colour_space": colour_space,
            "buffer_count": buffer_count,
            "queue": queue,
            "main": main,
            "lores": stream({"format": "YUV420", "size": main["size"], "preserve_ar": False}, lores),
            "raw": stream({"format": "SBGGR10", "size": main["size"]}, raw),
            "controls": {"NoiseReductionMode": 1, "FrameDurationLimits": (33333, 33333)} | controls,
            "sensor": sensor,
            "display": display,
            "encode": encode,
        }

    def configure(self, camera_config: Any = None) -> None:
        if self.started:
            raise RuntimeError("Camera must be stopped before configuring")
        config: dict[str, Any] = {k: dict(v) if isinstance(v, dict) else v for k, v in camera_config.items()}
        wrong = set(config["sensor"]) - {"bit_depth", "output_size"}
        if wrong:
            raise RuntimeError(f"Unexpected keys {wrong} in sensor configuration")
        if config["lores"] is not None and config["lores"]["size"][0] > config["main"]["size"][0]:
            raise RuntimeError("lores stream dimensions may not exceed main stream")
        for name, value in config["controls"].items():
            if name not in self.camera_controls:
                raise RuntimeError(f"Control {name} is not advertised by libcamera")
            if name == "FrameDurationLimits" and not all(isinstance(limit, int) for limit in value):
                raise TypeError(f"Control {name} takes integers")
        size = config["sensor"].get("output_size", config["main"]["size"])
        self._mode = min(
            self._sensor.modes,
            key=lambda m: (
                abs(m["size"][0] - size[0]) + abs(m["size"][1] - size[1]),
                abs(m["bit_depth"] - config["sensor"].get("bit_depth", m["bit_depth"])),
            ),
        )
        for name in ("main", "lores"):
            if config[name] is not None:
                width = config[name]["size"][0] * (3 if config[name]["format"] == "RGB888" else 1)
                config[name]["stride"] = -(-width // STRIDE) * STRIDE
        if config["raw"] is not None:
            raw = config["raw"]
            if raw["format"] != self._mode["unpacked"]:
                raise RuntimeError(f"Unrecognised raw format {raw['format']}")
            raw["size"] = self._mode["size"]
            if self._sensor.pi_5 and raw["format"] != "R8":
                raw["format"] = "R16"
            width = raw["size"][0] * (1 if raw["format"] == "R8" else 2)
            raw["stride"] = -(-width // STRIDE) * STRIDE + (STRIDE if raw["format"] == "R10" else 0)
        self._sensor.adjust(config)
        self._config = config

    def camera_configuration(self) -> dict[str, Any]:
        return self._config

    def start(self, config: Any = None, show_preview: Any = False) -> None:
        if not self._config:
            raise RuntimeError("Camera has not been configured")
        self.started = True

    def set_controls(self, controls: Any) -> None:
        for name in controls:
            if name not in self.camera_controls:
                raise RuntimeError(f"Control {name} is not advertised by libcamera")
        if self._sensor.loses > 0:
            self._sensor.loses -= 1
            return
        self._changes.append((self._frame + self._sensor.delay, dict(controls)))

    def capture_request(
        self, wait: Any = None, signal_function: Any = None, flush: Any = None
    ) -> "CompletedRequest":
        sensor = self._sensor
        lost = sensor.lost_after is not None and self._frame >= sensor.lost_after
        if not self.started or lost or len(self._out) >= self._config["buffer_count"]:
            assert isinstance(wait, float), "a capture without a time limit would never end here"
            self._stuck = True
            raise TimeoutError
        while self._frame in sensor.dropped:
            self._frame += 1
        number, self._frame = self._frame, self._frame + 1
        if number in sensor.breaks_at:
            raise ZeroDivisionError("a fault in the library")
        self._out.add(number)
        return CompletedRequest(self, number)

    def cancel_all_and_flush(self) -> None:
        self._stuck = False
        self._flushed.set()

    def stop(self) -> None:
        if self._stuck:
            self._flushed.wait()  # a job behind one that never ends
        self.started = False

    def close(self) -> None:
        self.stop()
        self.closed = True

    def metadata_of(self, number: int) -> dict[str, Any]:
        """What libcamera says of frame `number`."""
        row_us = self._mode["_row_us"]
        asked = dict(self._config["controls"])
        for since, changed in self._changes:
            if number >= since:
                asked |= changed
        late = number < self._sensor.delay
        period_us = math.floor(asked["FrameDurationLimits"][0] / row_us) * row_us
        exposure = 20_000 if late else int(math.floor(asked["ExposureTime"] / row_us) * row_us)
        code = self._sensor.gain_code
        gain = 1.0 if late else math.floor(asked["AnalogueGain"] / code + 1e-9) * code
        stamp_ns = self._sensor.start_ns + round(number * period_us * 1e3)
        found: dict[str, Any] = {
            "SensorTimestamp": stamp_ns,
            "FrameWallClock": stamp_ns + time.time_ns() - time.monotonic_ns(),
            "ExposureTime": exposure,
            "AnalogueGain": gain,
            "DigitalGain": 1.0 if late else asked["ExposureTime"] * asked["AnalogueGain"] / (exposure * gain),
            "FrameDuration": int(period_us),
            "ScalerCrop": self._view(),
        }
        if "ColourGains" in asked:
            found["ColourGains"] = tuple(float(np.float32(gain)) for gain in asked["ColourGains"])
        if "LensPosition" in asked:
            found["LensPosition"] = asked["LensPosition"]
        if asked.get("SyncMode", 0):
            found |= self._sync_of(number, client=asked["SyncMode"] == 2)
        self._sensor.tamper(number, found)
        return found

    def _view(self) -> tuple[int, int, int, int]:
        """The largest middle part of the mode that has the shape of `main`, as libcamera takes it."""
        x, y, width, height = self._mode["crop_limits"]
        shape = self._config["main"]["size"][0] / self._config["main"]["size"][1]
        wide, high = min(width, round(height * shape)), min(height, round(width / shape))
        return x + (width - wide) // 2, y + (height - high) // 2, wide, high

    def _sync_of(self, number: int, client: bool) -> dict[str, Any]:
        ready_at = self._sensor.sync_ready_at
        found: dict[str, Any] = {"SyncReady": ready_at is not None and number >= ready_at}
        if not client or (ready_at is not None and number >= self._sensor.sync_received_at):
            found["SyncTimer"] = ((ready_at or 10**6) - number) * 16_667 - 37
        return found

    def back(self, number: int) -> None:
        """A request was released."""
        self._out.remove(number)
        self.released += 1

    @property
    def outstanding(self) -> int:
        """Requests that were not released."""
        return len(self._out)

    @property
    def config(self) -> Mapping[str, Any]:
        """Configuration in use."""
        return self._config


class CompletedRequest:
    """`picamera2.request.CompletedRequest`: usable until its last release."""

    def __init__(self, request: Picamera2, picam2: int):
        self._camera, self._number, self._uses = request, picam2, 1

    def make_array(self, name: str) -> np.ndarray:
        self._check("make_array")
        config = self._camera.config.get(name)
        if config is None:
            raise RuntimeError(f"Stream {name!r} is not defined")
        width, height = config["size"]
        if config["format"] == "RGB888":
            image = np.zeros((height, width, 3), np.uint8)
            image[..., 0], image[..., 1], image[..., 2] = 200, 100, self._number % 256  # blue, green, red
            return image
        if name == "raw":
            return self._raw(config)
        padded = np.full((height * 3 // 2, config["stride"]), 255, np.uint8)
        padded[:height, :width] = np.arange(width) % 128
        chroma = padded[height:].reshape(height, config["stride"] // 2)
        chroma[: height // 2, : width // 2] = 130  # U
        chroma[height // 2 :, : width // 2] = 140  # V
        return padded

    def _raw(self, config: Mapping[str, Any]) -> np.ndarray:
        """(H, stride) bytes with the padding: 10 bits, in column 0 four times the frame's number, rising by one."""
        width, height = config["size"]
        frozen = self._camera._sensor.frozen_after
        number = self._number if frozen is None else min(self._number, frozen)
        tens = np.minimum(4 * (number % 256) + np.arange(width), 1023)
        words = {
            "R8": (tens >> 2).astype(np.uint8),
            "R10": tens.astype("<u2"),
            "R16": (tens << 6).astype("<u2"),
        }
        rows = np.full((height, config["stride"]), 0xAA, np.uint8)
        used = words[config["format"]].view(np.uint8)
        rows[:, : len(used)] = used
        return rows

    def get_metadata(self) -> dict[str, Any]:
        self._check("get_metadata")
        return self._camera.metadata_of(self._number)

    def release(self) -> None:
        self._uses -= 1
        if self._uses < 0:
            raise RuntimeError("CompletedRequest: lock now has negative ref_count")
        self._camera.back(self._number)

    def _check(self, method: str) -> None:
        if self._uses <= 0:
            raise AssertionError(f"{method} of a released request")
        if method in self._camera._sensor.fails:
            raise RuntimeError(f"{method} failed")


def install(monkeypatch: pytest.MonkeyPatch, sensor: Sensor, with_sync: bool = True) -> Sensor:
    """Let `import picamera2` and `import libcamera` find this file, with `sensor` plugged in."""
    monkeypatch.setattr(Picamera2, "sensor", sensor, raising=False)
    library = ModuleType("picamera2")
    library.Picamera2 = Picamera2  # pyright: ignore[reportAttributeAccessIssue]
    system = ModuleType("libcamera")
    sync = SimpleNamespace(SyncModeEnum=SimpleNamespace(Off=0, Server=1, Client=2))
    system.controls = SimpleNamespace(  # pyright: ignore[reportAttributeAccessIssue]
        draft=SimpleNamespace(NoiseReductionModeEnum=SimpleNamespace(Off=0, Fast=1, HighQuality=2)),
        AfModeEnum=SimpleNamespace(Manual=0, Auto=1, Continuous=2),
        rpi=sync if with_sync else SimpleNamespace(),
    )
    monkeypatch.setitem(__import__("sys").modules, "picamera2", library)
    monkeypatch.setitem(__import__("sys").modules, "libcamera", system)
    return sensor


def parameters(method: Callable[..., object]) -> list[str]:
    """Names of the parameters of a method, to compare with the real library."""
    return [name for name in inspect.signature(method).parameters if name != "self"]
