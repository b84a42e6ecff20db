"""Strobed views of a thing held still.

The frames of one moment by what lit them, from a recording or from images.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from common.arrays import Image
from common.errors import PictureError, RecordingError
from common.recording.frame_recording import MANIFEST, FrameRow, Illumination, open_recording
from common.recording.pictures import decode_file, read_picture

_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_NAMED = re.compile(r"(.*?)[-_ .]?(ambient|laser|led)", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class LitView:
    """The frames of one moment.

    Attributes:
        name: How the view is called in reports: the number of its first frame, or what its files have in common.
        frames: What lit it -> how to load the frame (H, W), 8 bits.
    """

    name: str
    frames: Mapping[Illumination, Callable[[], Image]]

    def load(self, lit: Illumination) -> Image | None:
        """One of its frames; None where there is none of this kind.

        Raises:
            RecordingError: The file cannot be read, or is no image.
        """
        return self.frames[lit]() if lit in self.frames else None


def lit_views(folder: Path, camera: str, needed: Illumination) -> tuple[LitView, ...]:
    """Return views with an ambient frame and one lit by `needed`.

    Evenly over the source, at most 60.

    Args:
        folder: A recording whose frames.csv names the light of each frame, or images VIEW_ambient.png, VIEW_laser.png,
            VIEW_led.png.
        camera: Camera of the recording.
        needed: Laser or LED.

    Raises:
        RecordingError: No such folder, or no such frames; the text states what is expected.
    """
    if not folder.is_dir():
        raise RecordingError(f"{folder}: is not a folder")
    views = _recorded(folder, camera) if (folder / MANIFEST).is_file() else _named(folder)
    whole = [view for view in views if {Illumination.AMBIENT, needed} <= view.frames.keys()]
    if not whole:
        raise RecordingError(
            f"{folder}: no frame lit by the {needed} with an ambient one beside it: a recording states in frames.csv"
            f" what lit each frame; images are named VIEW_ambient.png, VIEW_{needed}.png"
        )
    most_views = 60  # more of the same motion adds time, not knowledge
    chosen = np.unique(np.linspace(0, len(whole) - 1, min(most_views, len(whole))).round().astype(int))
    return tuple(whole[int(i)] for i in chosen)


def _recorded(folder: Path, camera: str) -> list[LitView]:
    """Return one view for each ambient frame.

    With the frames lit otherwise that follow within a strobe cycle.
    """
    rows = open_recording(folder).frames_of(camera)
    if not rows:
        raise RecordingError(f"{folder}: camera {camera!r} has no frame")
    views: list[LitView] = []
    for i, row in enumerate(rows):
        if row.illumination is not Illumination.AMBIENT:
            continue
        cycle: dict[Illumination, FrameRow] = {row.illumination: row}
        apart = 2  # rows: frames of one strobe cycle
        for near in rows[i + 1 : i + 1 + apart]:
            if near.illumination is Illumination.AMBIENT or near.seq - row.seq > apart:
                break
            cycle.setdefault(near.illumination, near)
        views.append(
            LitView(str(row.seq), {lit: partial(load_grey, folder / one.file) for lit, one in cycle.items()})
        )
    return views


def _named(folder: Path) -> list[LitView]:
    """Images by their names."""
    found: dict[str, dict[Illumination, Callable[[], Image]]] = {}
    for file in sorted(folder.iterdir()):
        match = _NAMED.fullmatch(file.stem)
        if match is not None and file.suffix.lower() in _ENDINGS:
            found.setdefault(match[1], {})[Illumination(match[2].lower())] = partial(load_grey, file)
    return [LitView(name or "0", frames) for name, frames in found.items()]


def grouped_by_reason(refused: Mapping[str, str]) -> list[str]:
    """Format the refused views (name -> reason) as lines grouped by reason.

    Lines for a person: each reason once, after the views it is of; of many views the first.
    """
    views: dict[str, list[str]] = {}
    for name, reason in refused.items():
        views.setdefault(reason, []).append(name)
    lines: list[str] = []
    for reason, names in views.items():
        most_named = 6  # views named with a reason
        more = f" and {len(names) - most_named} more" if len(names) > most_named else ""
        lines.append(f"view{'s'[: len(names) > 1]} {', '.join(names[:most_named])}{more}: {reason}")
    return lines


def load_grey(file: Path) -> Image:
    """An image (H, W), 8 bits.

    Raises:
        RecordingError: The file cannot be read, or is no image.
    """
    try:
        return decode_file(read_picture(file), grey=True)
    except OSError as error:
        raise RecordingError(f"{file}: cannot read: {error.strerror}") from error
    except PictureError as error:
        raise RecordingError(f"{file}: is no image: it {error}") from error
