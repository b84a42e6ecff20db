"""The tags of a live slave: sought once a frame's markers are sent, as often as time allows, and replaced with files.

Nothing of it is loaded where no object has tags.
"""

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from common.calibration import CameraCalibration
from common.messages import TagDetections
from common.object_profile import ObjectProfile
from slave.sources import Frame
from slave.tags.pace import Pace

if TYPE_CHECKING:
    from slave.tags.finder import TagFinder


class LiveTags:
    """Finds the tags of frames. Holds the finder in use, if any, its pace and counts."""

    def __init__(self, camera: CameraCalibration, objects: Sequence[ObjectProfile]) -> None:
        """Seek the tags of `objects`, of which none may have any.

        Raises:
            CalibrationError: As of `TagFinder`.
        """
        self._camera = camera.name
        self._pace = Pace(camera.frame_rate_hz)
        self._finder = finder_of(camera, objects)
        self._searched = self._skipped = self._found = 0

    def push(self, frame: Frame, session: int, spent_ns: int) -> TagDetections | None:
        """Tags of a frame whose markers took `spent_ns`; None: not searched."""
        finder = self._finder
        if finder is None:
            return None
        if not self._pace.grants(frame.t_ns, spent_ns):
            self._skipped += 1
            return None
        began_ns = time.perf_counter_ns()
        found = finder.push(frame.image, frame.t_ns)
        message = TagDetections(
            self._camera,
            session,
            frame.seq,
            frame.t_ns,
            frame.ready_t_ns,
            found.ids,
            found.uv,
            found.sigma_px,
            frame.t_sigma_ns,
        )
        self._pace.took(time.perf_counter_ns() - began_ns)
        self._searched += 1
        self._found += len(found.ids)
        return message

    def replace(self, finder: "TagFinder | None") -> None:
        """Go on with another finder; None: no object has tags any more."""
        self._finder = finder

    def counts(self) -> dict[str, int]:
        """`tags.searched`, `tags.skipped` frames, `tags.found` in all; nothing where there are no tags."""
        if self._finder is None and not self._searched:
            return {}
        return {
            "tags.searched": self._searched,
            "tags.skipped": self._skipped,
            "tags.found": self._found,
            "tags.search_us": round(self._pace.takes_ns * 1e-3),
        }


def finder_of(camera: CameraCalibration, objects: Sequence[ObjectProfile]) -> "TagFinder | None":
    """A finder of the tags of `objects`; None: none has any.

    Raises:
        CalibrationError: As of `TagFinder`.
    """
    if all(profile.tags is None for profile in objects):
        return None
    from slave.tags.finder import TagFinder

    return TagFinder(camera, objects)
