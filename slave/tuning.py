"""Change the camera settings of a running slave without a restart.

    settings    report what the camera has, and which colours are in use
    set         other exposure, gains, rate, margin, colours (body: `common.calibration.camera_settings.CameraSettings`)
    pick        the colour of a marker, from a pixel on it (body: `common.calibration.camera_settings.ColourPick`)
    load        another content of the camera file (body: the file): exposure, gains, rate, colours of the markers
    save        write the content in use to the slave's own camera file

Changed files are applied as well. Everything is checked before anything is changed; what the camera did not take is
given back, and the answer is an error that names it. The camera loop is never waited for, nor does it wait: settings
are read back from the frames that it reads, and new colours take over between two frames. What is wrong or needs a
restart raises `CalibrationError`.
"""

import logging
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import TypeAlias
from zlib import crc32

import msgspec
from msgspec import structs

from common.calibration import CameraCalibration, HandProfile, HsvRange, RigCalibration, load, parse, save
from common.calibration.camera_settings import (
    WANTED,
    CameraSettings,
    ColourPick,
    figures,
    range_figures,
    refuse_strange,
    same_exposed,
)
from common.calibration.files import MonitoredFiles, Provenance, date_now
from common.calibration.object_profile import ObjectProfile
from common.calibration.rig import unsided
from common.errors import CalibrationError, PhalanxError
from slave.sources import Reporting, Tunable

_NAME = 64  # characters of a name in `Health`


def in_use(camera: CameraCalibration, markers: tuple[str, ...]) -> dict[str, float]:
    """Metrics of the camera file in use, for the rig's `markers`.

    width_px, height_px; colour.<marker>, another number for another range; overlap.<one>..<other> [hues].
    """
    ranges = {name: colour for name in markers if (colour := (camera.markers or {}).get(name)) is not None}
    found = {"width_px": float(camera.width_px), "height_px": float(camera.height_px)}
    found |= {f"colour.{name}"[:_NAME]: _number(colour) for name, colour in ranges.items()}
    for (one, first), (other, second) in combinations(ranges.items(), 2):
        alike = unsided(one) == unsided(other) and _number(first) == _number(second)  # of two hands
        if not alike and (hues := overlap(first, second)):
            found[f"overlap.{one}..{other}"[:_NAME]] = float(hues)
    return found


def overlap(one: HsvRange, other: HsvRange) -> int:
    """How many hues two ranges share; 0 where saturations or values have none."""
    for axis in (1, 2):
        if one.hsv_low[axis] > other.hsv_high[axis] or other.hsv_low[axis] > one.hsv_high[axis]:
            return 0
    return len(_hues(one) & _hues(other))


def _hues(colour: HsvRange) -> set[int]:
    """The hues of a range, which may wrap through 0."""
    low, high = colour.hsv_low[0], colour.hsv_high[0]
    hues = 180
    return {hue % hues for hue in range(low, high + 1 + (hues if high < low else 0))}


def _number(colour: HsvRange) -> float:
    return float(crc32(msgspec.json.encode((colour.hsv_low, colour.hsv_high))))


_ALL = "give all processes of the rig the same files, then restart them"
_LOG = logging.getLogger(__name__)
NEEDS_RESTART = ("name", "width_px", "height_px", "focus_m")
# What "set" sets, and the colours.
SETTINGS = ("exposure_us", "analogue_gain", "colour_gains", "frame_rate_hz", "roi_margin")
MARKERS = "markers"


@dataclass(frozen=True, slots=True)
class CameraFiles:
    """Files a slave was started with, their content, and that of the rig's objects."""

    camera_path: Path
    rig_path: Path
    camera: CameraCalibration
    rig: RigCalibration
    hand_path: Path | None = None
    hand: HandProfile | None = None
    objects: tuple[ObjectProfile, ...] = ()

    @property
    def paths(self) -> tuple[Path, ...]:
        """All of them."""
        hand = () if self.hand_path is None else (self.hand_path,)
        return (self.camera_path, self.rig_path, *hand, *object_paths(self.rig_path, self.rig))

    def read_again(self) -> "CameraFiles":
        """The same files, as they are now; `CalibrationError`: one is broken or gone."""
        rig = load(self.rig_path, RigCalibration)
        return replace(
            self,
            camera=load(self.camera_path, CameraCalibration),
            rig=rig,
            hand=None if self.hand_path is None else load(self.hand_path, HandProfile),
            objects=tuple(load(path, ObjectProfile) for path in object_paths(self.rig_path, rig)),
        )


def object_paths(rig_path: Path, rig: RigCalibration) -> tuple[Path, ...]:
    """The files of a rig's objects: DIR/objects/<name>.json of DIR/rigs/<rig>.json."""
    return tuple(rig_path.parent.parent / "objects" / f"{name}.json" for name in rig.objects)


# Makes what senses with other files (those in use, those to come), some tenths of a second, and returns what puts it
# in use; None: nothing that it uses was changed. Raises `CalibrationError` where they need a restart.
Prepare: TypeAlias = Callable[[CameraFiles, CameraFiles], Callable[[], None] | None]


# Makes the colour that a click shows: the camera file with it, and how good it is. Raises `PhalanxError`.
Sample: TypeAlias = Callable[[ColourPick, CameraCalibration], tuple[CameraCalibration, Mapping[str, float]]]


class CameraTuning(Reporting):
    """Answers commands about the camera, and follows its files; from any thread."""

    def __init__(
        self,
        files: CameraFiles,
        source: object,
        prepare: Prepare | None,
        running: Callable[[], bool],
        sample: Sample | None = None,
    ) -> None:
        """Tune a camera; a `source` that is no `Tunable` keeps its settings.

        `running`: whether frames are read, as before no change can be verified; without `prepare` nothing senses,
        without `sample` no markers are sought.
        """
        self._used = self._on_disk = files
        self._source = source if isinstance(source, Tunable) else None
        self._prepare, self._running, self._sample = prepare, running, sample
        self._lock = threading.Lock()
        self._monitored = MonitoredFiles()
        self._applied = self._refused = 0

    @property
    def files(self) -> CameraFiles:
        """The files in use, with what was set and not saved."""
        return self._used

    def commands(self) -> dict[str, Callable[[str], Mapping[str, float]]]:
        """Verb -> handler: takes the body, returns metrics, may raise `PhalanxError`."""
        return {
            "settings": self._settings,
            "set": self._set,
            "load": self._load,
            "save": self._save,
            "pick": self._pick,
        }

    def counts(self) -> dict[str, int]:
        """`reload.applied`, `reload.refused` of changed files; events of the camera."""
        own = {"reload.applied": self._applied, "reload.refused": self._refused}
        return own if self._source is None else {**own, **self._source.counts()}

    def metrics(self) -> dict[str, float]:
        """What the camera has and does now, and what the content in use specifies."""
        used = self._used
        stated = {WANTED + name: value for name, value in figures(used.camera).items()}
        stated |= in_use(used.camera, used.rig.markers)
        return stated if self._source is None else {**self._source.metrics(), **stated}

    def look(self) -> None:
        """Apply the files if they were changed; if that fails, log so once and go on."""
        with self._lock:
            if not self._running() or not self._monitored.changed(self._used.paths):
                return
            try:
                was, self._on_disk = self._on_disk, self._used.read_again()
                camera = _merged(was.camera, self._on_disk.camera, self._used.camera)
                if self._apply(replace(self._on_disk, camera=camera)):
                    self._applied += 1
                    _LOG.info("%s: changed, in use now", ", ".join(map(str, self._used.paths)))
            except PhalanxError as error:
                self._refused += 1
                _LOG.warning("changed, but not used: %s", error)

    def _settings(self, body: str) -> dict[str, float]:
        if body:
            raise CalibrationError("settings: takes no body")
        used = self._used
        return self.metrics() | range_figures(used.camera, used.rig.markers)

    def _set(self, body: str) -> dict[str, float]:
        with self._lock:
            wanted = parse(body.encode(), CameraSettings, "set")
            camera = wanted.over(self._used.camera)
            if wanted.markers is not None:
                refuse_strange(wanted.markers, self._used.rig.markers, "set: markers")
                camera = _with_provenance(camera, "set", wanted.markers)
            self._apply(replace(self._used, camera=camera), forget=True)
        return self._settings("")

    def _pick(self, body: str) -> dict[str, float]:
        with self._lock:
            request = parse(body.encode(), ColourPick, "pick")
            if self._sample is None:
                raise CalibrationError(
                    "pick: this slave seeks no markers: the camera of a wrist device, or started with --colours none"
                )
            refuse_strange((request.marker,), self._used.rig.markers, "pick: marker")
            camera, report = self._sample(request, self._used.camera)
            self._apply(replace(self._used, camera=_with_provenance(camera, "pick", (request.marker,))))
        return self._settings("") | dict(report)

    def _load(self, body: str) -> dict[str, float]:
        with self._lock:
            self._apply(replace(self._used, camera=parse(body.encode(), CameraCalibration, "load")))
        return self._settings("")

    def _save(self, body: str) -> dict[str, float]:
        if body:
            raise CalibrationError("save: takes no body; what is in use is saved")
        with self._lock:
            path = self._used.camera_path
            camera = self._used.camera
            if path.exists():  # what somebody else has written there stays: a lens is calibrated elsewhere
                camera = _merged(self._on_disk.camera, load(path, CameraCalibration), camera)
                self._apply(replace(self._used, camera=camera))
            _make_folder(path.parent)
            save(path, camera)
            self._on_disk = replace(self._on_disk, camera=camera)
            _LOG.info("%s: saved as in use", path)
        return self._settings("")

    def _apply(self, new: CameraFiles, *, forget: bool = False) -> bool:
        """Put these files in use, wholly or not at all; False if they are in use.

        Only to `forget` may they lack colours.
        """
        old = self._used
        _refuse_restart(old, new)
        if self._prepare is not None and not forget:
            _refuse_lost(old, new)
        switch = None if self._prepare is None else self._prepare(old, new)
        if switch is None and new.camera == old.camera:
            self._used = new
            return False
        if not same_exposed(old.camera, new.camera):
            if self._source is None:
                raise CalibrationError(f"camera {new.camera.name!r}: its driver can change no settings")
            self._source.tune(new.camera)
        if switch is not None:
            switch()
        self._used = new
        return True


def _merged(was: CameraCalibration, now: CameraCalibration, used: CameraCalibration) -> CameraCalibration:
    """Merge a file that changed from `was` to `now` into the one in use.

    Settings, or colours, that it left unchanged stay as in use.
    """
    kept: dict[str, object] = {}
    if all(getattr(was, key) == getattr(now, key) for key in SETTINGS):
        kept |= {key: getattr(used, key) for key in SETTINGS}
    if was.markers == now.markers:
        kept[MARKERS] = used.markers
        own = {MARKERS: used.provenance[MARKERS]} if MARKERS in used.provenance else {}
        kept["provenance"] = now.provenance | own
    return structs.replace(now, **kept)


def _with_provenance(camera: CameraCalibration, verb: str, markers: Iterable[str]) -> CameraCalibration:
    """The camera file with a record of when and how its colours were made."""
    note = "picked in the running slave" if verb == "pick" else "ranges set by hand in the running slave"
    tool, before = f"phalanx-slave {verb}", camera.provenance.get(MARKERS)
    others = before.data if before is not None and before.tool == tool else ()
    names = tuple(dict.fromkeys((*others, *markers)))
    origin = Provenance(date=date_now(), tool=tool, data=names, residual={}, note=note)
    return structs.replace(camera, provenance=camera.provenance | {MARKERS: origin})


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CalibrationError(f"{folder}: cannot make the folder: {error.strerror}") from error


def _refuse_lost(old: CameraFiles, new: CameraFiles) -> None:
    was, now = (files.camera.markers or {} for files in (old, new))
    if lost := [name for name in new.rig.markers if name in was and name not in now]:
        raise CalibrationError(
            f"camera {new.camera.name!r}: markers: no HSV range for {', '.join(lost)}, which "
            f"{'has' if len(lost) == 1 else 'have'} one in use"
        )


def _refuse_restart(old: CameraFiles, new: CameraFiles) -> None:
    camera, rig = f"camera {old.camera.name!r}", f"rig {new.rig.name!r}"
    alone, all_of_rig = "it runs: restart the slave", f"it runs: {_ALL}"
    fixed: list[tuple[str, str, object, object, str]] = [
        (camera, key, getattr(old.camera, key), getattr(new.camera, key), alone) for key in NEEDS_RESTART
    ]
    if old.rig.kind == "wrist":
        rates = old.camera.frame_rate_hz, new.camera.frame_rate_hz
        fixed.append((camera, "frame_rate_hz", *rates, "laser and LEDs flash in its time: restart the slave"))
    fixed.append((rig, "kind", old.rig.kind, new.rig.kind, all_of_rig))
    if old.hand_path is not None:
        fixed.append((rig, "hand", old.rig.hand, new.rig.hand, all_of_rig))
    markers = ", ".join(old.rig.markers), ", ".join(new.rig.markers)
    fixed.append((rig, "markers", *markers, all_of_rig))
    for whose, key, before, after, why in fixed:
        if before != after:
            raise CalibrationError(f"{whose}: {key}: {before} cannot become {after} while {why}")
    if old.rig.strobe != new.rig.strobe:
        raise CalibrationError(
            f"{rig}: strobe: the limits of laser and LEDs cannot change while they are switched: restart the slave"
        )
