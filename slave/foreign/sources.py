"""Which camera a video or a folder of pictures is of."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from common.calibration import RigCalibration, load
from common.errors import RecordingError
from common.recording.video import ENDINGS as VIDEOS

PICTURES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True, slots=True)
class Source:
    """What one camera took.

    Attributes:
        camera: Its name in the rig.
        path: A video, or a folder of pictures.
    """

    camera: str
    path: Path

    @property
    def is_video(self) -> bool:
        """Whether it is a video."""
        return self.path.is_file()


def natural(path: Path) -> tuple[tuple[int, str], ...]:
    """Order in which 2 comes before 10."""
    parts = re.split(r"(\d+)", path.name)
    return tuple((int(part), "") if part.isdigit() else (-1, part) for part in parts if part)


def pictures_in(folder: Path) -> list[Path]:
    """The pictures of a folder, in the order of their numbers."""
    return sorted(_with(folder, PICTURES), key=natural)


def found_in(paths: Sequence[Path]) -> list[Path]:
    """Find videos and folders of pictures.

    They are those that are named, or that are in a folder that is named.

    Raises:
        RecordingError: One is neither, or holds both; the text names it.
    """
    found: list[Path] = []
    for path in paths:
        if path.is_file():
            if path.suffix.lower() not in VIDEOS:
                raise RecordingError(f"{path}: is no video ({', '.join(VIDEOS)}), nor a folder of pictures")
            found.append(path)
            continue
        if not path.is_dir():
            raise RecordingError(f"{path}: no such file or folder")
        videos, own = _with(path, VIDEOS), pictures_in(path)
        folders = [sub for sub in path.iterdir() if sub.is_dir() and pictures_in(sub)]
        kinds = [kind for kind in (videos, [path] if own else [], folders) if kind]
        if len(kinds) != 1:
            what = (
                "videos and pictures side by side" if kinds else "no recording.json, no video and no picture"
            )
            raise RecordingError(
                f"{path}: {what}; give a recording, a video or a folder of pictures for each camera, or a folder with"
                " one of these for each"
            )
        found += sorted(kinds[0], key=natural)
    return found


def sources_of(paths: Sequence[Path], rig: RigCalibration, notify: Callable[[str], None]) -> list[Source]:
    """Assign a camera to each video or folder of pictures.

    It is the camera of its name, or, where no name is a camera's, the next in the order of the rig.

    Raises:
        RecordingError: Some names are cameras and some are not, or there are not as many as cameras.
    """
    known = [path for path in paths if path.stem in rig.cameras]
    fix = "say whose they are: --camera NAME=PATH for each"
    if len(known) == len(paths):
        named = [Source(path.stem, path) for path in paths]
        if len({one.camera for one in named}) < len(named):
            raise RecordingError(f"{', '.join(map(str, paths))}: two are of one camera; {fix}")
        return named
    cameras = ", ".join(rig.cameras)
    if known:
        strange = next(path for path in paths if path not in known)
        raise RecordingError(
            f"{strange}: rig {rig.name!r} has no camera {strange.stem!r}, but {cameras}; {fix}"
        )
    if len(paths) != len(rig.cameras):
        raise RecordingError(
            f"{len(paths)} videos or folders, none named as a camera, for the {len(rig.cameras)} cameras of rig"
            f" {rig.name!r} ({cameras}); {fix}"
        )
    found = [Source(camera, path) for camera, path in zip(rig.cameras, paths, strict=True)]
    notify(
        "no name is that of a camera; in the order of the rig: "
        + ", ".join(f"{s.camera} = {s.path}" for s in found)
    )
    return found


def rig_for(
    calibration: Path, name: str | None, paths: Sequence[Path], named: Mapping[str, Path]
) -> RigCalibration:
    """Return the rig called `name`, or the one that fits the cameras.

    `name` None: the one marker rig that has these cameras, and no other.

    Raises:
        RecordingError: There is none, or several could be meant.
        CalibrationError: A file is broken.
    """
    folder = calibration / "rigs"
    if name is not None:
        return load(folder / f"{name}.json", RigCalibration)
    rigs = [load(path, RigCalibration) for path in sorted(folder.glob("*.json"))]
    rigs = [rig for rig in rigs if rig.kind == "markers"]
    if not rigs:
        raise RecordingError(
            f"{folder}: no rig of marker cameras; `phalanx calibrate cameras stereo` makes one"
        )
    wanted = {*named, *(path.stem for path in paths)}
    for fits in (
        [rig for rig in rigs if wanted == set(rig.cameras)],
        [rig for rig in rigs if wanted < set(rig.cameras)],
        rigs,
    ):
        if len(fits) == 1:
            return fits[0]
        if fits:
            raise RecordingError(f"{folder}: which rig? --rig {' or '.join(rig.name for rig in fits)}")
    raise AssertionError("there are rigs")


def _with(folder: Path, endings: Sequence[str]) -> list[Path]:
    return [
        file
        for file in folder.iterdir()
        if file.suffix.lower() in endings and file.is_file() and not file.name.startswith(".")
    ]
