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
from dataclasses import dataclass
from pathlib import Path

from common.calibration import CameraCalibration, RigCalibration, load, parse, save
from common.camera_settings import WANTED, CameraSettings, figures
from common.errors import CalibrationError, PhalanxError
from common.watching import WatchedFiles
from slave.cameras.settings import Tunable
from slave.markers.changing import Changeable, ChangingDetector

_LOG = logging.getLogger(__name__)
NEEDS_RESTART = ("name", "width_px", "height_px", "frame_rate_hz", "focus_m")


@dataclass(frozen=True, slots=True)
class CameraFiles:
    """Which files a slave was started with, and what they said.

    Attributes:
        camera_path, rig_path: The camera file and the rig file.
        camera, rig: Their content.
    """

    camera_path: Path
    rig_path: Path
    camera: CameraCalibration
    rig: RigCalibration


class CameraTuning:
    """Answers commands about the camera, and follows its files.

    Holds the content in use, that which the files had when last read, and how often a change of them was applied and
    refused. Its methods are called on several threads and take turns.
    """

    def __init__(
        self,
        files: CameraFiles,
        source: object,
        detector: ChangingDetector | None,
        make: Callable[[CameraCalibration, RigCalibration], Changeable],
        running: Callable[[], bool],
    ) -> None:
        """Tune a camera.

        Args:
            files: What the slave was started with.
            source: The camera; a `Tunable`, or nothing can be changed but colours.
            detector: Finds the markers; None: nobody does.
            make: Makes a detector for other files, some tenths of a second.
            running: Whether frames are read: before, no change can be verified.
        """
        self._paths = (files.camera_path, files.rig_path)
        self._camera, self._rig = files.camera, files.rig
        self._on_disk = files.camera, files.rig
        self._source = source if isinstance(source, Tunable) else None
        self._detector, self._make, self._running = detector, make, running
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
            if not self._running() or not self._watched.changed(self._paths):
                return
            try:
                camera, rig = load(self._paths[0], CameraCalibration), load(self._paths[1], RigCalibration)
                was, self._on_disk = self._on_disk, (camera, rig)
                # Only what the file has changed: what a command has changed meanwhile stays.
                if self._apply(self._camera if camera == was[0] else camera, rig):
                    self._applied += 1
                    _LOG.info("%s, %s: changed, in use now", *self._paths)
            except PhalanxError as error:
                self._refused += 1
                _LOG.warning("changed, but not used: %s", error)

    def _settings(self, body: str) -> dict[str, float]:
        if body:
            raise CalibrationError("settings: takes no body")
        wanted = {WANTED + name: value for name, value in figures(self._camera).items()}
        return self.figures() | wanted

    def _set(self, body: str) -> dict[str, float]:
        with self._turn:
            self._apply(parse(body.encode(), CameraSettings, "set").over(self._camera), self._rig)
        return self._settings("")

    def _load(self, body: str) -> dict[str, float]:
        with self._turn:
            self._apply(parse(body.encode(), CameraCalibration, "load"), self._rig)
        return self._settings("")

    def _save(self, body: str) -> dict[str, float]:
        if body:
            raise CalibrationError("save: takes no body; what is in use is saved")
        with self._turn:
            save(self._paths[0], self._camera)
            self._on_disk = self._camera, self._on_disk[1]
            _LOG.info("%s: saved as in use", self._paths[0])
        return self._settings("")

    def _apply(self, camera: CameraCalibration, rig: RigCalibration) -> bool:
        """Have these files in use, wholly or not at all; False if they are.

        Raises:
            CalibrationError: They need a restart, or lack colours.
            CameraError: The camera did not take its settings.
        """
        old, old_rig = self._camera, self._rig
        if (camera, rig.markers, rig.free_markers) == (old, old_rig.markers, old_rig.free_markers):
            self._rig = rig
            return False
        _refuse_restart(old, camera, old_rig, rig)
        made = None
        if self._detector is not None and (camera.markers, rig.free_markers) != (
            old.markers,
            old_rig.free_markers,
        ):
            made = self._make(camera, rig)
            _refuse_other_kind(self._detector, made)
        exposed = CameraSettings.of(camera), camera.row_time_us
        if exposed != (CameraSettings.of(old), old.row_time_us):
            if self._source is None:
                raise CalibrationError(f"camera {camera.name!r}: its driver can change no settings")
            self._source.tune(camera)
        if self._detector is not None:
            if made is not None:
                self._detector.replace(made)
            self._detector.expose(camera.exposure_us)
        self._camera, self._rig = camera, rig
        return True


def _refuse_restart(
    old: CameraCalibration, new: CameraCalibration, old_rig: RigCalibration, new_rig: RigCalibration
) -> None:
    for key in NEEDS_RESTART:
        if getattr(old, key) != getattr(new, key):
            raise CalibrationError(
                f"camera {old.name!r}: {key}: {getattr(old, key)} cannot become {getattr(new, key)} while it runs: "
                "restart the slave"
            )
    if old_rig.markers != new_rig.markers:
        raise CalibrationError(
            f"rig {new_rig.name!r}: markers: {', '.join(old_rig.markers)} cannot become "
            f"{', '.join(new_rig.markers)} while it runs: restart all processes of the rig"
        )


def _refuse_other_kind(old: ChangingDetector, made: Changeable) -> None:
    if type(made) is not old.kind:
        change = "have" if old.follows else "did not have"
        raise CalibrationError(
            f"markers: reference_bgr_linear: the colours in use {change} it for every marker, and the light is "
            f"{'followed' if old.follows else 'not followed'}: restart the slave to change that"
        )
