"""Set and read back the controls of an open V4L2 camera by name.

Every automatic is switched off, every value written, read back and compared. Names are those of v4l2-ctl and current
kernels; standard controls are recognised by their number, since kernels have renamed them. Only exposure has a
physical unit (100 us), and only it changes while frames are read. Gain, colour balance and focus are codes of the
maker: where the camera has such a control its value must be given (`--control gain=32`), because whatever an
automatic left there would otherwise be kept. A setting of the camera file that it lacks must be allowed
(`--allow-missing gain`). What is unknown, refused, out of range or not taken raises `CameraError`, which states what
to write; a device that is gone, at the start, `OSError`.
"""

import ctypes as c
import errno
import re
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TypeVar

from common.calibration import CameraCalibration
from common.errors import CameraError
from slave.cameras import v4l2_abi as abi
from slave.cameras.grey import Pixels
from slave.cameras.settings import FrameObserver, Setting, demand, differences

EXPOSURE = "exposure_time_absolute"
EXPOSURE_UNIT_US = 100.0
# Numbers of linux/v4l2-controls.h -> name in current kernels.
NAMES = {
    0x009A0901: "auto_exposure",
    0x009A0902: EXPOSURE,
    0x009A0903: "exposure_dynamic_framerate",
    0x009A090A: "focus_absolute",
    0x009A090C: "focus_automatic_continuous",
    0x009A0914: "white_balance_auto_preset",
    0x009A0915: "wide_dynamic_range",
    0x009A0916: "image_stabilization",
    0x009A0918: "iso_sensitivity_auto",
    0x0098090C: "white_balance_automatic",
    0x0098090E: "red_balance",
    0x0098090F: "blue_balance",
    0x00980911: "exposure",
    0x00980912: "gain_automatic",
    0x00980913: "gain",
    0x00980918: "power_line_frequency",
    0x00980919: "hue_automatic",
    0x0098091A: "white_balance_temperature",
    0x00980920: "brightness_automatic",
    0x009E0903: "analogue_gain",
}
# What thinks for itself, and the value that stops it: V4L2_EXPOSURE_MANUAL is 1, off is 0 everywhere else.
AUTOMATICS = {
    "auto_exposure": 1,
    "exposure_dynamic_framerate": 0,
    "white_balance_automatic": 0,
    "white_balance_auto_preset": 0,
    "gain_automatic": 0,
    "focus_automatic_continuous": 0,
    "hue_automatic": 0,
    "brightness_automatic": 0,
    "wide_dynamic_range": 0,
    "image_stabilization": 0,
    "iso_sensitivity_auto": 0,
    "power_line_frequency": 0,
}
# What the camera file wants -> ways to have it, each a set of controls.
NEEDS: dict[str, tuple[tuple[str, ...], ...]] = {
    "exposure": ((EXPOSURE,), ("exposure",)),
    "gain": (("gain",), ("analogue_gain",)),
    "white_balance": (("white_balance_temperature",), ("red_balance", "blue_balance")),
}
FILE_KEYS = {"exposure": "exposure_us", "gain": "analogue_gain", "white_balance": "colour_gains"}
_V = abi.V4L2
_MENUS = {_V.type_menu, _V.type_integer_menu}
NUMERIC = {_V.type_integer, _V.type_boolean, _V.type_integer64, _V.type_bitmask, *_MENUS}
_USELESS = _V.ctrl_disabled | _V.ctrl_read_only | _V.ctrl_write_only | _V.ctrl_has_payload


@dataclass(frozen=True, slots=True)
class Control:
    """One control of the camera."""

    number: int  # its id in the kernel
    name: str  # as v4l2-ctl calls it
    type: int  # one of `NUMERIC`
    low: int
    high: int
    step: int  # distance of allowed values, at least 1
    menu: Mapping[int, str] | None = None  # value -> its name, for a menu; menus have holes

    def text(self) -> str:
        """Name and range in words."""
        if self.menu is None:
            return f"{self.name} ({self.low} to {self.high} step {self.step})"
        return f"{self.name} ({', '.join(f'{value} = {name}' for value, name in self.menu.items())})"

    def allows(self, value: int) -> bool:
        """Whether the value is on the menu, or in range and on a step."""
        if self.menu is not None:
            return value in self.menu
        return self.low <= value <= self.high and (value - self.low) % self.step == 0

    def nearest(self, value: float) -> int:
        """The allowed value nearest to `value`."""
        steps = (min(max(value, self.low), self.high) - self.low) / self.step
        return self.low + round(steps) * self.step


def read_controls(device: abi.KernelDevice) -> dict[str, Control]:
    """All controls with a number that can be written and read back, by name."""
    found: dict[str, Control] = {}
    number = 0
    while True:
        query = abi.QueryControl(id=number | abi.V4L2.ctrl_next)
        try:
            device.ioctl(abi.QUERY_EXT_CTRL, query)
        except OSError as error:
            if error.errno in (errno.EINVAL, errno.ENOTTY):
                return found
            raise
        number = int(query.id)
        if query.type in NUMERIC and not query.flags & _USELESS:
            name = NAMES.get(number) or plain_name(query.name.decode("ascii", "replace"))
            menu = _menu(device, query) if query.type in _MENUS else None
            low, high, step = int(query.minimum), int(query.maximum), max(int(query.step), 1)
            found[name] = Control(number, name, int(query.type), low, high, step, menu)


def _menu(device: abi.KernelDevice, query: abi.QueryControl) -> dict[int, str]:
    found: dict[int, str] = {}
    for index in range(int(query.minimum), int(query.maximum) + 1):
        entry = abi.QueryMenu(id=query.id, index=index)
        try:
            device.ioctl(abi.QUERYMENU, entry)
        except OSError as error:
            if error.errno == errno.EINVAL:  # a hole
                continue
            raise
        label = bytes(entry.name)
        if query.type == abi.V4L2.type_integer_menu:
            found[index] = str(int.from_bytes(label[:8], "little", signed=True))
        else:
            found[index] = label.split(b"\0")[0].decode("ascii", "replace")
    return found


def plain_name(name: str) -> str:
    """The control's name as v4l2-ctl writes it: lower case, single underscores."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def plan(
    camera: CameraCalibration,
    controls: Mapping[str, Control],
    given: Mapping[str, int],
    missing: Iterable[str],
    pixels: Pixels = Pixels.COLOUR,
) -> tuple[Setting, ...]:
    """Settings to write, in this order: automatics off, exposure, the `given` ones.

    `given` is control -> value, from the command line; `missing`: which of exposure, gain, white_balance it may lack.
    Without colours it may lack a white balance, but none that it has is left alone.
    """
    allowed = set(missing)
    if wrong := sorted(allowed - set(NEEDS)):
        raise CameraError(f"--allow-missing {wrong[0]}: there are {', '.join(NEEDS)}")
    for name in given:
        if name not in controls:
            known = "; ".join(control.text() for control in controls.values()) or "none"
            raise CameraError(f"--control {name}: it has no such control; it has {known}")
    if EXPOSURE in given:
        raise CameraError("--control exposure_time_absolute: the exposure is exposure_us of the camera file")
    settings: dict[str, Setting] = {}
    for name, off in AUTOMATICS.items():
        if name in controls and name not in given and not controls[name].allows(off):
            raise CameraError(
                f"{name} cannot be switched off: give --control {name}=N, {controls[name].text()}"
            )
        if name in controls:
            settings[name] = Setting(name, (float(off),), 0.0, "", "no automatic")
    if EXPOSURE in controls:
        settings[EXPOSURE] = _exposure(camera, controls[EXPOSURE])
    for name, value in given.items():
        if not controls[name].allows(value):
            raise CameraError(f"--control {name}={value}: out of range; {controls[name].text()}")
        settings[name] = Setting(name, (float(value),), 0.0, "", "--control")
    _check_needs(controls, given, allowed | (set() if pixels is Pixels.COLOUR else {"white_balance"}))
    return tuple(settings.values())


def _exposure(camera: CameraCalibration, control: Control) -> Setting:
    """Exposure in units of 100 us, up to half a step from the camera file."""
    wanted = camera.exposure_us / EXPOSURE_UNIT_US
    if not control.low - 0.5 <= wanted <= control.high + 0.5:
        raise CameraError(
            f"exposure_us {camera.exposure_us:g} is not within {control.low * EXPOSURE_UNIT_US:g} to "
            f"{control.high * EXPOSURE_UNIT_US:g}: change the camera file"
        )
    return Setting(control.name, (wanted,), 0.5 * control.step, "x 100 us", "exposure_us")


def _check_needs(controls: Mapping[str, Control], given: Mapping[str, int], allowed: set[str]) -> None:
    """Refuse what the image depends on and is not known, unless it may be missing."""
    notes: list[str] = []
    for need, ways in NEEDS.items():
        have = [way for way in ways if all(name in controls for name in way)]
        set_already = any(all(name in given or name == EXPOSURE for name in way) for way in have)
        if not have and need not in allowed:
            notes.append(
                f"it has no {need} control for {FILE_KEYS[need]} of the camera file: allow that with "
                f"--allow-missing {need}"
            )
        elif have and not set_already:
            choice = " and ".join(f"--control {name}=N" for name in have[0])
            ranges = ", ".join(controls[name].text() for name in have[0])
            notes.append(f"its {need} is a code of its maker: give {choice}, {ranges}")
    if "focus_absolute" in controls and "focus_absolute" not in given:
        notes.append(
            f"it has a focus motor: give --control focus_absolute=N, {controls['focus_absolute'].text()}"
        )
    if notes:
        raise CameraError("; ".join(notes))


_REFUSED = {
    errno.EBUSY: "another program is using it",
    errno.EACCES: "it is read-only now",
    errno.ERANGE: "out of range",
}


def write(device: abi.KernelDevice, controls: Mapping[str, Control], settings: Iterable[Setting]) -> None:
    """Write all settings, in order."""
    for setting in settings:
        control = controls[setting.name]
        value = control.nearest(setting.wanted[0])
        values, one = _one(control)
        if control.type == abi.V4L2.type_integer64:
            one.of.value64 = value
        else:
            one.of.value = value
        try:
            device.ioctl(abi.S_EXT_CTRLS, values)
        except OSError as error:
            why = _REFUSED.get(error.errno or 0, error.strerror)
            raise CameraError(f"{setting.name}={value} ({setting.source}) was refused: {why}") from error


def read_back(
    device: abi.KernelDevice, controls: Mapping[str, Control], settings: Iterable[Setting]
) -> dict[str, int]:
    """Present values of the controls of `settings`, by name."""
    found: dict[str, int] = {}
    for setting in settings:
        control = controls[setting.name]
        values, one = _one(control)
        device.ioctl(abi.G_EXT_CTRLS, values)
        found[setting.name] = int(one.of.value64 if control.type == abi.V4L2.type_integer64 else one.of.value)
    return found


def _one(control: Control) -> tuple[abi.ControlValues, abi.ControlValue]:
    one = abi.ControlValue(id=control.number)
    return abi.ControlValues(which=0, count=1, controls=c.pointer(one)), one


TIMEOUT_S = 2.0
SETTLE_FRAMES = 12  # UVC cameras apply settings within a few frames, or fall back
FIX = "Take values that the camera keeps, and see that no other program controls it"
T = TypeVar("T")


class V4l2Settings:
    """Controls of the device until `end`, and what they are to be."""

    def __init__(
        self,
        device: abi.KernelDevice,
        camera: CameraCalibration,
        given: Mapping[str, int],
        missing: Iterable[str],
        pixels: Pixels = Pixels.COLOUR,
    ) -> None:
        """Write all settings, before the stream starts; arguments as of `plan`."""
        self._device: abi.KernelDevice | None = device
        self._given, self._missing, self._pixels = given, tuple(missing), pixels
        self._controls = read_controls(device)
        self._wanted = plan(camera, self._controls, given, self._missing, pixels)
        self._asking = threading.Lock()  # the device is not closed while another thread asks it
        write(device, self._controls, self._wanted)

    def __len__(self) -> int:
        return len(self._wanted)

    def check(self, settle: Callable[[], None]) -> None:
        """Compare all settings once the stream runs; one that fell back is written again."""
        assert self._device is not None  # `end` comes later
        if differences(self._wanted, read_back(self._device, self._controls, self._wanted)):
            write(self._device, self._controls, self._wanted)
            settle()
        demand("it", self._wanted, read_back(self._device, self._controls, self._wanted), FIX)

    def refuse_fixed(self, old: CameraCalibration, new: CameraCalibration) -> None:
        """Raise where settings differ that this camera cannot change."""
        fixed = [FILE_KEYS["gain"], FILE_KEYS["white_balance"]]
        if changed := [key for key in fixed if getattr(new, key) != getattr(old, key)]:
            raise CameraError(
                f"{' and '.join(changed)} cannot be changed: with a USB camera they are codes of its maker, fixed at "
                "the start by --control"
            )
        if EXPOSURE not in self._controls and new.exposure_us != old.exposure_us:
            raise CameraError("exposure_us cannot be changed: the camera has no control for it")

    def metrics(self) -> dict[str, float]:
        """Exposure and codes as the camera has them now; nothing where it is gone."""
        shown = [setting for setting in self._wanted if setting.name not in AUTOMATICS]
        try:
            got = self.ask(lambda device: read_back(device, self._controls, shown))
        except CameraError:  # the loop will report it
            return {}
        found = {f"control.{name}"[:64]: float(value) for name, value in got.items() if name != EXPOSURE}
        if EXPOSURE in got:
            found["exposure_us"] = got[EXPOSURE] * EXPOSURE_UNIT_US
        return found

    def end(self) -> None:
        """Ask the device no more; waits for a question under way."""
        with self._asking:
            self._device = None

    def expose(self, camera: CameraCalibration, frames: FrameObserver[tuple[int, int]]) -> None:
        """Change the exposure while the loop reads `frames`; see `Tunable.tune`."""
        controls = self._controls
        wanted = plan(camera, controls, self._given, self._missing, self._pixels)
        exposure = [setting for setting in wanted if setting.name == EXPOSURE]
        self.ask(lambda device: write(device, controls, exposure))
        for _ in frames.following(SETTLE_FRAMES, TIMEOUT_S):
            pass
        demand("it", wanted, self.ask(lambda device: read_back(device, controls, wanted)), FIX)
        self._wanted = wanted

    def ask(self, question: Callable[[abi.KernelDevice], T]) -> T:
        """What the open device answers, from any thread."""
        with self._asking:
            if self._device is None:
                raise CameraError("it was closed meanwhile")
            try:
                return question(self._device)
            except OSError as error:
                raise CameraError(f"it cannot be asked: {error.strerror}") from error
