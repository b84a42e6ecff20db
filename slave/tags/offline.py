"""Find tags of objects in live or recorded frames.

Live, after the markers of a frame are sent, as time allows; recorded, in every frame, into one file per camera.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from common.arrays import Float, Ids, Image, Int
from common.calibration import CameraCalibration, RigCalibration, load
from common.calibration.object_profile import ObjectProfile
from common.errors import CalibrationError
from common.messages import TagDetections
from common.recording.frame_recording import FrameRow
from slave.sources import Frame

if TYPE_CHECKING:
    from slave.tags.finder import FoundTags, TagFinder

SHARE = 0.8  # of the time between two frames that markers and tags together may take


class SearchBudget:
    """Grants searches out of the time that frames leave.

    What a frame leaves of its share of the time since the frame before is saved until a search fits into it, and no
    more than one search is saved up: so a machine that is too slow for tags in every frame looks at every second or
    fifth. One whose markers take all the time there is looks four times a second all the same.
    """

    def __init__(self, rate_hz: float) -> None:
        """For a camera of this rate; `takes_ns`: what a search takes of late [ns]."""
        self._period_ns = 1e9 / rate_hz
        self._left_ns = self.takes_ns = 0.0
        self._frame_ns: int | None = None
        self._sought_ns: int | None = None

    def grants(self, t_ns: int, spent_ns: int) -> bool:
        """Whether tags may be searched in a frame whose markers took `spent_ns`."""
        since_ns = self._period_ns
        if self._frame_ns is not None:
            since_ns = max(float(t_ns - self._frame_ns), since_ns)
        self._frame_ns = t_ns
        most = max(self.takes_ns, SHARE * self._period_ns)
        self._left_ns = min(max(self._left_ns + SHARE * since_ns - spent_ns, -most), most)
        longest_ns = 250_000_000  # without a search: half of what an object is held for without its tags
        late = self._sought_ns is None or t_ns - self._sought_ns >= longest_ns
        granted = late or self._left_ns >= self.takes_ns
        if granted:
            self._sought_ns = t_ns
        return granted

    def took(self, spent_ns: int) -> None:
        """A search took so long."""
        self._left_ns -= spent_ns
        newest = 0.2 if self.takes_ns > 0.0 else 1.0  # weight in what a search is expected to take
        self.takes_ns += (spent_ns - self.takes_ns) * newest


class LiveTags:
    """Finds the tags of frames. Holds the finder in use, if any, budget and counts."""

    def __init__(self, camera: CameraCalibration, objects: Sequence[ObjectProfile]) -> None:
        """Seek the tags of `objects`, of which none may have any; raises as `TagFinder`."""
        self._camera = camera.name
        self._budget = SearchBudget(camera.frame_rate_hz)
        self._finder = finder_of(camera, objects)
        self._searched = self._skipped = self._found = 0

    def push(self, frame: Frame, session: int, spent_ns: int) -> TagDetections | None:
        """Tags of a frame whose markers took `spent_ns`; None: not searched."""
        finder = self._finder
        if finder is None:
            return None
        if not self._budget.grants(frame.t_ns, spent_ns):
            self._skipped += 1
            return None
        began_ns = time.perf_counter_ns()
        found = finder.push(frame.image, frame.t_ns)
        when = frame.seq, frame.t_ns, frame.ready_t_ns
        seen = found.ids, found.uv, found.sigma_px
        message = TagDetections(self._camera, session, *when, *seen, frame.t_sigma_ns)
        self._budget.took(time.perf_counter_ns() - began_ns)
        self._searched += 1
        self._found += len(found.ids)
        return message

    def replace(self, finder: "TagFinder | None") -> None:
        """Go on with another finder; None: no object has tags any more."""
        self._finder = finder

    def counts(self) -> dict[str, int]:
        """`tags.searched`, `tags.skipped` frames, `tags.found`; none without tags."""
        if self._finder is None and not self._searched:
            return {}
        return {
            "tags.searched": self._searched,
            "tags.skipped": self._skipped,
            "tags.found": self._found,
            "tags.search_us": round(self._budget.takes_ns * 1e-3),
        }


def finder_of(camera: CameraCalibration, objects: Sequence[ObjectProfile]) -> "TagFinder | None":
    """A finder of the tags of `objects`; None: none has any; raises as `TagFinder`."""
    if all(profile.tags is None for profile in objects):
        return None
    from slave.tags.finder import TagFinder  # seldom needed: it takes a third of a second to load

    return TagFinder(camera, objects)


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
        """Seek the tags of `objects`, as `TagFinder`; `continuous`: with tracks."""
        from slave.tags.finder import TagFinder

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
    """Objects of a rig that have tags, as in `calibration`/objects, or as recorded.

    Raises CalibrationError: a file is broken, or an object of the rig is nowhere.
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
