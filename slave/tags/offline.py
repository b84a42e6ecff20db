"""Tags of a whole recording, into one file per camera.

Beside the markers of its frames; deterministic.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.arrays import Float, Ids, Image, Int
from common.calibration import CameraCalibration, RigCalibration, load
from common.calibration.object_profile import ObjectProfile
from common.errors import CalibrationError
from common.recording.frame_recording import FrameRow
from slave.tags.finder import FoundTags, TagFinder


@dataclass(frozen=True, slots=True, eq=False)
class RecordedTags:
    """Content of tags_<camera>.npz: T frames, N tags in all of them, frame by frame.

    Attributes:
        t_ns: (T,) middle of the exposure of row 0 [ns].
        seq: (T,) frame counters.
        ids: (N,) numbers of the tags.
        uv: (N, 4, 2) corners [px], distorted image; of the print top left, top right, bottom right, bottom left.
        sigma_px: (N,) their standard deviation per axis [px].
        row: (N,) which of the frames each tag is of.
    """

    t_ns: Int
    seq: Int
    ids: Ids
    uv: Float
    sigma_px: Float
    row: Int


class TagCollector:
    """Takes the frames of one camera in turn. Holds the finder and what it found."""

    def __init__(
        self, camera: CameraCalibration, objects: Mapping[str, ObjectProfile], continuous: bool = True
    ) -> None:
        """Seek the tags of `objects`; not `continuous`: each frame by itself.

        Raises:
            CalibrationError: As of `TagFinder`.
        """
        self._finder = TagFinder(camera, list(objects.values()))
        self._continuous = continuous
        self._rows: list[FrameRow] = []
        self._found: list[FoundTags] = []

    def push(self, image: Image, row: FrameRow) -> None:
        """Find the tags of one more frame."""
        if self._rows and not self._continuous:
            self._finder = self._finder.fresh()
        self._rows.append(row)
        self._found.append(self._finder.push(image, row.t_ns))

    def all(self) -> RecordedTags:
        """What was found in all frames."""
        found = self._found
        return RecordedTags(
            np.array([row.t_ns for row in self._rows], np.int64),
            np.array([row.seq for row in self._rows], np.int64),
            np.concatenate([np.zeros(0, np.uint16), *(one.ids for one in found)]),
            np.concatenate([np.zeros((0, 4, 2)), *(one.uv for one in found)]),
            np.concatenate([np.zeros(0), *(one.sigma_px for one in found)]),
            np.repeat(np.arange(len(found)), [len(one.ids) for one in found]),
        )


def tagged_objects(
    recorded: Mapping[str, ObjectProfile], rig: RigCalibration, calibration: Path | None
) -> dict[str, ObjectProfile]:
    """Return the objects of a rig that have tags.

    As recorded, or as DIR/objects has them, where `calibration` is given.

    Raises:
        CalibrationError: A file is broken, or an object of the rig is nowhere.
    """
    objects: dict[str, ObjectProfile] = {}
    for name in rig.objects:
        path = None if calibration is None else calibration / "objects" / f"{name}.json"
        if path is not None and (path.is_file() or name not in recorded):
            objects[name] = load(path, ObjectProfile)
        elif name in recorded:
            objects[name] = recorded[name]
        else:
            raise CalibrationError(
                f"recording.json: objects: {name!r} of rig {rig.name!r} is missing; give --calibration DIR with "
                f"DIR/objects/{name}.json"
            )
    return {name: profile for name, profile in objects.items() if profile.tags is not None}
