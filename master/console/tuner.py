"""Tuner tries settings of cameras and filters, then saves them to files.

Camera settings as the page tunes them.

They are what was read back and what it was when the tuning began, with a way back to that.

Every method asks the slave over the bus and waits for its answer: never on the thread of the page.

Copy of a camera's file on this machine, updated after its slave saved.

The master and the wizards read this copy.

A slave of this machine has written the very file; one of another machine has written its own, and only what its answer
contains can be copied: settings and colour ranges, not the calibration.

Trial of a rig's 1 € filter on a running master, then saved to the rig's file.

It blocks, so do not call it on the page's thread.
"""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import nan
from pathlib import Path

import msgspec

from common.calibration import CameraCalibration, FilterCalibration, RigCalibration, load, save
from common.calibration.camera_settings import WANTED, CameraSettings, ColourPick
from common.errors import BusError, CalibrationError
from common.messages import Command, Health
from common.messages.streams import MASTER
from master.calibrate.tree_files import provenance

MARKER = "marker."
_CHANNELS = ("h", "s", "v")
PLAIN = ("exposure_us", "analogue_gain", "frame_rate_hz", "roi_margin")
GAINS = ("red_gain", "blue_gain")


@dataclass(frozen=True, slots=True)
class Range:
    """Marker colour range in OpenCV's HSV (H 0-179).

    If low[0] is above high[0], the range wraps through red.
    """

    low: tuple[int, int, int]
    high: tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class InUse:
    """Settings and colours in use, as a slave's answer reports them.

    Attributes:
        wanted: Setting -> what its camera file in use states, by the names of metrics.
        read: Setting -> what was read back from the camera; absent where it does not report it.
        markers: Marker -> its colours in use; absent: it has none.
    """

    wanted: Mapping[str, float] = field(default_factory=dict[str, float])
    read: Mapping[str, float] = field(default_factory=dict[str, float])
    markers: Mapping[str, Range] = field(default_factory=dict[str, Range])

    @classmethod
    def of(cls, health: Health) -> "InUse":
        """Read an answer."""
        names = (*PLAIN, *GAINS)
        metrics = health.metrics
        read = {name: metrics[name] for name in names if name in metrics}
        wanted = {name: metrics.get(WANTED + name, metrics.get(name, nan)) for name in names}
        markers: dict[str, Range] = {}
        for metric in metrics:
            name = metric.removeprefix(MARKER).removesuffix(".h_low")
            if metric == f"{MARKER}{name}.h_low":
                markers[name] = _range(metrics, name)
        known = {name: value for name, value in wanted.items() if value == value}
        return cls(known, read, markers)

    def body(self) -> dict[str, object]:
        """The body of the command "set" that brings all this back."""
        out: dict[str, object] = {name: self.wanted[name] for name in PLAIN if name in self.wanted}
        if all(name in self.wanted for name in GAINS):
            out["colour_gains"] = [self.wanted[name] for name in GAINS]
        if self.markers:
            out["markers"] = markers_over(self, ())
        return out


def markers_over(used: InUse, known: Iterable[str]) -> dict[str, object]:
    """Return the part `markers` of the command "set" that restores `used`.

    After it those of `used` hold and no other of `known`.
    """
    out: dict[str, object] = {}
    out.update(dict.fromkeys(sorted(set(known) - used.markers.keys())))
    out.update({name: colour_body(colour) for name, colour in used.markers.items()})
    return out


def colour_body(colour: Range) -> dict[str, list[int]]:
    """A colour as the command "set" has it."""
    return {"hsv_low": list(colour.low), "hsv_high": list(colour.high)}


class Tuner:
    """Tuner of one camera.

    It holds what was in use when the tuning began or was saved last.
    """

    def __init__(self, camera: str, ask: Callable[[Command], Health]) -> None:
        """Nothing was asked yet; `ask` sends a command and waits."""
        self.camera = camera
        self._ask = ask
        self._begun: InUse | None = None

    @property
    def begun(self) -> InUse | None:
        """What `revert` goes back to; None: the slave has never answered."""
        return self._begun

    def refresh(self) -> InUse:
        """What is in use now.

        Raises:
            BusError: The slave does not answer, or refuses; as all methods here.
        """
        now = self._send("settings", "")
        if self._begun is None:
            self._begun = now
        return now

    def set(self, change: Mapping[str, object]) -> InUse:
        """Use other settings at once: keys and units of the command "set"."""
        self._begin()
        return self._send("set", json.dumps(change))

    def pick(self, marker: str, uv: Sequence[float], t_ns: int | None = None) -> InUse:
        """Sample a marker's colour around a pixel of the whole frame.

        The frame is the one taken at `t_ns` [ns], if that is known.
        """
        self._begin()
        pick = ColourPick(marker=marker, uv=(round(float(uv[0]), 2), round(float(uv[1]), 2)), t_ns=t_ns)
        return self._send("pick", msgspec.json.encode(pick).decode())

    def forget(self, marker: str) -> InUse:
        """Use no colour for a marker: it is looked for no more."""
        return self.set({"markers": {marker: None}})

    def save(self) -> InUse:
        """Write what is in use to the slave's own camera file."""
        self._begun = self._send("save", "")
        return self._begun

    def revert(self) -> InUse:
        """Use again what was in use when the tuning began, or was saved last."""
        if self._begun is None:
            raise BusError(f"{self.camera!r} has not answered yet: there is nothing to go back to")
        markers = markers_over(self._begun, self.refresh().markers)
        return self._send("set", json.dumps(self._begun.body() | {"markers": markers}))

    def _begin(self) -> None:
        if self._begun is None:
            self.refresh()

    def _send(self, verb: str, body: str) -> InUse:
        return InUse.of(self._ask(Command(self.camera, verb, body)))


def _range(metrics: Mapping[str, float], name: str) -> Range:
    low, high = (
        tuple(round(metrics.get(f"{MARKER}{name}.{channel}_{end}", 0.0)) for channel in _CHANNELS)
        for end in ("low", "high")
    )
    return Range((low[0], low[1], low[2]), (high[0], high[1], high[2]))


def update_copy(path: Path, saved: InUse) -> bool:
    """Bring the file to what the slave saved. Whether anything differed.

    Raises:
        CalibrationError: The file is missing, broken or read-only, or the slave has what a file must not contain.
    """
    camera = load(path, CameraCalibration)
    body = saved.body() | {"markers": markers_over(saved, camera.markers or {})}
    try:
        new = msgspec.convert(body, CameraSettings).over(camera)
    except msgspec.ValidationError as error:
        raise CalibrationError(f"{path}: what {camera.name} saved cannot be copied: {error}") from error
    if new == camera:
        return False
    made = provenance("console", (), {}, "as the slave saved it")
    save(path, msgspec.structs.replace(new, provenance=camera.provenance | {"markers": made}))
    return True


NAMES = ("min_cutoff_hz", "beta", "d_cutoff_hz", "jitter_m")


def saved_filter(rig_path: Path) -> FilterCalibration:
    """Return the filter settings stored in the rig's file.

    Raises:
        CalibrationError: It is missing or broken.
    """
    return load(rig_path, RigCalibration).filter


def try_filter(ask: Callable[[Command], Health], rig: str, values: Mapping[str, float]) -> None:
    """Let the master use other parameters at once; its file stays as it is.

    Raises:
        BusError: No master answers, or it refuses.
    """
    ask(Command(MASTER, "filter", json.dumps({"rig": rig, "filter": dict(values)})))


def save_filter(rig_path: Path, values: Mapping[str, float]) -> None:
    """Write the filter settings to the rig's file, with when and by what.

    A running master follows its files.

    Raises:
        CalibrationError: The file is missing, broken or read-only, or a value is out of range.
    """
    rig = load(rig_path, RigCalibration)
    new = msgspec.structs.replace(rig.filter, **values)
    made = provenance("console", (), {}, "tuned by hand")
    save(rig_path, msgspec.structs.replace(rig, filter=new, provenance=rig.provenance | {"filter": made}))
