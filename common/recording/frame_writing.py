"""Writer of raw frame recordings that stay readable after any interruption.

The order is the guarantee: first the manifest, then for every frame its file, whole, and only then its row. A step
that fails takes back what it left half done. So no row ever stands without its complete file, whether the disk is
full, a limit is met or the process is killed.
"""

import csv
import io
from contextlib import suppress
from pathlib import Path

import cv2

from common.arrays import Image
from common.calibration import save
from common.errors import CalibrationError, RecordingError
from common.recording.frame_recording import (
    COLUMNS,
    FRAMES,
    MANIFEST,
    FrameRow,
    Illumination,
    Manifest,
    check_manifest,
)

# The noise of a sensor never repeats, so the search for repeats (LZ77) costs time and finds nothing: Huffman codes of
# the differences between neighbours (OpenCV's choice where only the strategy is given) are faster *and* smaller.
_PNG = (cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY)


def encode_png(image: Image) -> bytes:
    """Encode BGR (H, W, 3) or grey (H, W) uint8 losslessly; any thread may call it."""
    try:
        done, data = cv2.imencode(".png", image, _PNG)
    except cv2.error as error:
        raise RecordingError(f"a frame cannot be encoded as PNG: {error}") from error
    if not done:
        raise RecordingError("a frame cannot be encoded as PNG")
    return data.tobytes()


def refuse_occupied(folder: Path) -> None:
    """Refuse a folder that is a file, or holds something already (RecordingError)."""
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise RecordingError(f"{folder}: holds something already; give a new or an empty folder")
    except OSError as error:
        raise RecordingError(f"{folder}: cannot read: {error.strerror}") from error


class RecordingWriter:
    """A recording being written. Not for several threads at once."""

    def __init__(self, folder: Path, manifest: Manifest) -> None:
        """Make the folder, which must be new or empty, its manifest and an empty table.

        Raises:
            RecordingError: The folder holds something, or cannot be written; the manifest contradicts itself.
        """
        refuse_occupied(folder)
        self._folder = folder
        self._known = frozenset(manifest.cameras)
        self._made = not folder.exists()
        self._counts: dict[str, int] = {}
        self._length = 0
        try:
            check_manifest(manifest, str(folder / MANIFEST))
            folder.mkdir(parents=True, exist_ok=True)
            save(folder / MANIFEST, manifest)
            self._table = (folder / FRAMES).open("ab", buffering=0)
        except CalibrationError as error:
            self._remove()
            raise RecordingError(str(error)) from error
        except OSError as error:
            self._remove()
            raise RecordingError(f"{folder}: cannot write: {error.strerror}") from error
        try:
            self._append(COLUMNS)
        except OSError as error:
            self.discard()
            raise RecordingError(f"{folder / FRAMES}: cannot write: {error.strerror}") from error

    def add(self, camera: str, seq: int, t_ns: int, illumination: Illumination, png: bytes) -> FrameRow:
        """Write one frame: its PNG file, then its row; after an error it leaves no trace.

        `t_ns`: middle of the exposure of row 0 [ns].

        Raises:
            RecordingError: The disk is full or gone, or a limit is met; the text names the file.
            ValueError: The manifest has no such camera.
        """
        if camera not in self._known:
            raise ValueError(f"camera {camera!r} is not in the manifest")
        count = self._counts.get(camera, 0)
        row = FrameRow(camera, seq, t_ns, illumination, f"{camera}/{count:06d}.png")
        path = self._folder / row.file
        at = path
        try:
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(png)
            at = self._folder / FRAMES
            self._append((camera, seq, t_ns, illumination.value, row.file))
        except OSError as error:
            with suppress(OSError):
                path.unlink(missing_ok=True)
            raise RecordingError(f"{at}: cannot write: {error.strerror}") from error
        self._counts[camera] = count + 1
        return row

    def refer(self, row: FrameRow) -> None:
        """Write the row of a frame whose file, or video, is in the folder already.

        Raises:
            RecordingError: The disk is full or gone, or a limit is met.
        """
        try:
            self._append((row.camera, row.seq, row.t_ns, row.illumination.value, row.file))
        except OSError as error:
            raise RecordingError(f"{self._folder / FRAMES}: cannot write: {error.strerror}") from error
        self._counts[row.camera] = self._counts.get(row.camera, 0) + 1

    def close(self) -> None:
        """End the recording. Safe to call twice."""
        self._table.close()

    def discard(self) -> None:
        """End the recording, and take it away where it has no frame. Safe to call twice."""
        self.close()
        if not self._counts:
            self._remove()

    def _append(self, values: tuple[object, ...]) -> None:
        """Add one line to the table, whole or not at all (OSError)."""
        text = io.StringIO(newline="")
        csv.writer(text, lineterminator="\n").writerow(values)
        line = text.getvalue().encode()
        try:
            rest = line
            while rest:  # a full disk takes a part first and reports it only the next time
                rest = rest[self._table.write(rest) :]
        except OSError:
            with suppress(OSError):  # where even this fails, the reader leaves the cut line out
                self._table.truncate(self._length)
            raise
        self._length += len(line)

    def _remove(self) -> None:
        with suppress(OSError):
            (self._folder / FRAMES).unlink(missing_ok=True)
            (self._folder / MANIFEST).unlink(missing_ok=True)
            for camera in self._known:
                if (self._folder / camera).is_dir():
                    (self._folder / camera).rmdir()
            if self._made:
                self._folder.rmdir()
