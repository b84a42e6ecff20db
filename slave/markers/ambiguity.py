"""Counts of things beside the hand that have the colour of a marker.

They are counted so that somebody removes them.

The detector finds the hand among them while it can; each is one more way to be wrong, above all when the hand comes
back. What counts has at least `LEAST` px^2 and a share of the marker's own area, does not touch the marker, and is no
rim between two other colours.
"""

from collections.abc import Mapping, Sequence
from typing import Protocol

from slave.markers.blobs import SCALE, Blob
from slave.markers.group import on_fringe

LEAST = 40.0  # px^2: specks come and go in every picture


class ColourAmbiguityMonitor:
    """Push machine that counts things in the colour of a marker.

    Holds in how many frames each marker had such things beside it, and where they were last.

    Attributes:
        frames: Marker -> how many frames.
        places: Marker -> (u, v) [px] of the largest thing in the last such frame.
    """

    def __init__(self, names: Sequence[str]) -> None:
        """Count for these markers."""
        self._names = tuple(names)
        self.frames = dict.fromkeys(self._names, 0)
        self.places: dict[str, tuple[float, float]] = {}

    def push(self, blobs: Sequence[Sequence[Blob]], chosen: Mapping[int, Blob]) -> None:
        """Look at one frame.

        Args:
            blobs: Of each marker's colour, the largest first.
            chosen: Row of a marker -> the blob that it is taken for.
        """
        if not chosen:
            return  # no hand to be beside of
        for m, options in enumerate(blobs):
            own = chosen.get(m)
            if len(options) <= (own is not None):
                continue
            share = 0.3  # of the marker's area
            least = LEAST if own is None else max(LEAST, share * own.area)
            rims = [blob for n, blob in chosen.items() if n != m]
            for blob in options:
                if blob.area < least:
                    break
                if (own is None or _far(blob, own)) and not on_fringe(blob, rims) and _whole(blob, rims):
                    name = self._names[m]
                    self.frames[name] += 1
                    self.places[name] = blob.u, blob.v
                    break


def _far(blob: Blob, own: Blob) -> bool:
    """Whether the boxes lie further apart than the marker is large."""
    apart = 1.0  # of the marker's size between the two: what is nearer may be a piece of it
    gap = apart * max(own.right - own.left, own.bottom - own.top)
    return (
        blob.left > own.right + gap
        or blob.right < own.left - gap
        or blob.top > own.bottom + gap
        or blob.bottom < own.top - gap
    )


def _whole(blob: Blob, others: Sequence[Blob]) -> bool:
    """Return whether a blob is a thing of its own.

    It is neither around nor within a marker of another colour.
    """
    return not any(
        blob.left - SCALE <= other.u <= blob.right + SCALE
        and blob.top - SCALE <= other.v <= blob.bottom + SCALE
        for other in others
    )


class MarkerSource(Protocol):
    """What sees things beside the hand; a `MarkerDetector`."""

    ambiguity: ColourAmbiguityMonitor


def ambiguity_counts(detector: MarkerSource | None) -> dict[str, int]:
    """Return the ambiguity counts of `Health`.

    ambiguous.<marker>, frames with something else in its colour.
    """
    return (
        {} if detector is None else {f"ambiguous.{name}": n for name, n in detector.ambiguity.frames.items()}
    )


def ambiguity_metrics(detector: MarkerSource | None) -> dict[str, float]:
    """Return the ambiguity metrics of `Health`.

    ambiguous.<marker>.u and .v, where the other thing was last [px].
    """
    if detector is None:
        return {}
    places = list(detector.ambiguity.places.items())  # the loop may add one
    return {
        f"ambiguous.{name}.{axis}": value for name, at in places for axis, value in zip("uv", at, strict=True)
    }
