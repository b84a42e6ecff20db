"""Change how the camera of a running slave is set: on command, or because its files were changed. No restart.

    settings    say what the camera has
    set         other exposure or gains (body: `common.camera_settings.CameraSettings`)
    load        another content of the camera file (body: the file): exposure, gains and the colours of the markers
    save        write the content in use to the slave's own camera file

Everything is checked before anything is changed. What the camera did not take is given back, and the answer is an
error that names it. The camera loop is never waited for by this, nor does it wait: the settings are read back from
the frames that it reads, and the new colours take over between two frames.
"""

import logging
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load, parse, save
from common.camera_settings import WANTED, CameraSettings, figures
from common.errors import CalibrationError, PhalanxError
from common.object_profile import ObjectProfile
from common.watching import WatchedFiles
from slave.cameras.settings import Tunable

_LOG = logging.getLogger(__name__)
NEEDS_RESTART = ("name", "width_px", "height_px", "frame_rate_hz", "focus_m")


@dataclass(frozen=True, slots=True)
class CameraFiles:
    """Which files a slave was started with, and what they said.

    Attributes:
        camera_path, rig_path: The camera file and the rig file.
        camera, rig: Their content.
        hand_path, hand: The same of the hand, of which only the slave of a wrist device needs to know; else None.
        objects: Content of the files of the rig's objects, which lie beside it.
    """

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
        """The same files, as they are now.

        Raises:
            CalibrationError: One is broken or gone.
        """
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


class CameraTuning:
    """Answers commands about the camera, and follows its files.

    Holds the content in use, that which the files had when last read, and how often a change of them was applied and
    refused. Its methods are called on several threads and take turns.
    """

    def __init__(
        self,
        files: CameraFiles,
        source: object,
        prepare: Prepare | None,
        running: Callable[[], bool],
    ) -> None:
        """Tune a camera.

        Args:
            files: What the slave was started with.
            source: The camera; a `Tunable`, or nothing can be changed but what senses.
            prepare: Makes what senses for other files; None: nobody senses.
            running: Whether frames are read: before, no change can be verified.
        """
        self._used = self._on_disk = files
        self._source = source if isinstance(source, Tunable) else None
        self._prepare, self._running = prepare, running
        self._turn = threading.Lock()
        self._watched = WatchedFiles()
        self._applied = self._refused = 0

    def commands(self) -> dict[str, Callable[[str], Mapping[str, float]]]:
        """Verb -> what to do with its body; the gauges of the answer.

        Each raises `PhalanxError` where the body is wrong, or the camera did not take it.
        """
        return {"settings": self._settings, "set": self._set, "load": self._load, "save": self._save}

    def counts(self) -> dict[str, int]:
        """`reload.applied`, `reload.refused`: changed files; and the events of the camera."""
        own = {"reload.applied": self._applied, "reload.refused": self._refused}
        return own if self._source is None else own | self._source.counts()

    def figures(self) -> dict[str, float]:
        """What the camera has and does now."""
        return {} if self._source is None else self._source.figures()

    def look(self) -> None:
        """Apply the files if they were changed; where that fails, say so once and go on as before."""
        with self._turn:
            if not self._running() or not self._watched.changed(self._used.paths):
                return
            try:
                was, self._on_disk = self._on_disk, self._used.read_again()
                # Only what the file has changed: what a command has changed meanwhile stays.
                kept = self._on_disk.camera == was.camera
                if self._apply(replace(self._on_disk, camera=self._used.camera) if kept else self._on_disk):
                    self._applied += 1
                    _LOG.info("%s: changed, in use now", ", ".join(map(str, self._used.paths)))
            except PhalanxError as error:
                self._refused += 1
                _LOG.warning("changed, but not used: %s", error)

    def _settings(self, body: str) -> dict[str, float]:
        if body:
            raise CalibrationError("settings: takes no body")
        wanted = {WANTED + name: value for name, value in figures(self._used.camera).items()}
        return self.figures() | wanted

    def _set(self, body: str) -> dict[str, float]:
        with self._turn:
            wanted = parse(body.encode(), CameraSettings, "set")
            self._apply(replace(self._used, camera=wanted.over(self._used.camera)))
        return self._settings("")

    def _load(self, body: str) -> dict[str, float]:
        with self._turn:
            self._apply(replace(self._used, camera=parse(body.encode(), CameraCalibration, "load")))
        return self._settings("")

    def _save(self, body: str) -> dict[str, float]:
        if body:
            raise CalibrationError("save: takes no body; what is in use is saved")
        with self._turn:
            save(self._used.camera_path, self._used.camera)
            self._on_disk = replace(self._on_disk, camera=self._used.camera)
            _LOG.info("%s: saved as in use", self._used.camera_path)
        return self._settings("")

    def _apply(self, new: CameraFiles) -> bool:
        """Have these files in use, wholly or not at all; False if they are.

        Raises:
            CalibrationError: They need a restart, or lack colours.
            CameraError: The camera did not take its settings.
        """
        old = self._used
        _refuse_restart(old, new)
        switch = None if self._prepare is None else self._prepare(old, new)
        if switch is None and new.camera == old.camera:
            self._used = new
            return False
        exposed = CameraSettings.of(new.camera), new.camera.row_time_us
        if exposed != (CameraSettings.of(old.camera), old.camera.row_time_us):
            if self._source is None:
                raise CalibrationError(f"camera {new.camera.name!r}: its driver can change no settings")
            self._source.tune(new.camera)
        if switch is not None:
            switch()
        self._used = new
        return True


def _refuse_restart(old: CameraFiles, new: CameraFiles) -> None:
    for key in NEEDS_RESTART:
        before, after = getattr(old.camera, key), getattr(new.camera, key)
        if before != after:
            raise CalibrationError(
                f"camera {old.camera.name!r}: {key}: {before} cannot become {after} while it runs: restart the slave"
            )
    if old.rig.kind != new.rig.kind:
        raise CalibrationError(
            f"rig {new.rig.name!r}: kind: {old.rig.kind} cannot become {new.rig.kind} while it runs: restart all "
            "processes of the rig"
        )
    if old.hand_path is not None and old.rig.hand != new.rig.hand:
        raise CalibrationError(
            f"rig {new.rig.name!r}: hand: {old.rig.hand} cannot become {new.rig.hand} while it runs: restart all "
            "processes of the rig"
        )
    if old.rig.strobe != new.rig.strobe:
        raise CalibrationError(
            f"rig {new.rig.name!r}: strobe: the limits of laser and LEDs cannot change while they are switched: restart"
            " the slave"
        )
    if old.rig.markers != new.rig.markers:
        raise CalibrationError(
            f"rig {new.rig.name!r}: markers: {', '.join(old.rig.markers)} cannot become "
            f"{', '.join(new.rig.markers)} while it runs: restart all processes of the rig"
        )
