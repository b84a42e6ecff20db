"""Choice of the markers whose outline is sought in a frame.

An outline costs as much as a frame of clear markers.

Where the contrast is low, the surroundings may be the marker as well. Where it is clear, only an outline decides:
a large marker is looked at when it is found, from time to time, and as long as it has one that holds more than its
colour.
"""

import math
from collections.abc import Collection, Mapping

from common.arrays import Image
from slave.markers.centroid import Measured
from slave.markers.outline import Outline, outline_of
from slave.markers.quality import CLEAR_CONTRAST


class Outlines:
    """Frame count, and markers whose outline holds more than their colour."""

    def __init__(self) -> None:
        """No marker has one."""
        self._frame = 0
        self._outlined: set[int] = set()

    def push(
        self, image: Image, seen_as: Mapping[int, Measured], reset: Collection[int]
    ) -> dict[int, Outline]:
        """Seek the outlines of one frame, those of the largest first.

        Args:
            image: (H, W, 3) BGR.
            seen_as: Marker row -> its measurement by colour.
            anew: Rows of those that were not tracked.

        Returns:
            Marker row -> its outline, where it has one that is to be used rather than its colour.
        """
        self._frame += 1
        sought: list[tuple[float, int]] = []
        for m, seen in seen_as.items():
            least_px2 = 60.0  # from which an outline can be distinguished from its pixels
            if seen.area < least_px2 or seen.cut or seen.thin:
                continue
            rarely = 120  # in one frame of so many while its colour fills it,
            due = m in self._outlined or m in reset or self._frame % rarely == m % rarely
            large_px2 = 500.0  # from which the outline of one of clear contrast is looked at,
            if seen.contrast < CLEAR_CONTRAST or (seen.area >= large_px2 and due):
                sought.append((seen.area, m))
        found: dict[int, Outline] = {}
        most = 2  # that are sought in one frame
        for _, m in sorted(sought, reverse=True)[:most]:
            outline = outline_of(image, seen_as[m])
            if outline is not None and _holds_more(outline, seen_as[m]):
                found[m] = outline
                self._outlined.add(m)
            else:
                self._outlined.discard(m)
        return found


def _holds_more(outline: Outline, seen: Measured) -> bool:
    """Return whether the outline is to be used.

    Beside a clear contrast it is used only if it is sure, and larger than the colour.
    """
    if seen.contrast < CLEAR_CONTRAST:
        return True
    sure = 0.8  # and taken with an edge in this share of the directions,
    fuller = 1.08  # and so many times the colour's area
    return outline.support >= sure and math.pi * outline.radius**2 >= fuller * seen.area
