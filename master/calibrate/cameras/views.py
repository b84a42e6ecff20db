"""A view is one board seen by several cameras at once, loaded from images.

Sources: a folder of files, or a folder per camera.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from common.arrays import Image
from common.errors import CalibrationError, FitError, PictureError, RecordingError
from common.recording.pictures import decode_file, read_picture
from master.calibrate.cameras.boards import (
    Board,
    Charuco,
    Checkerboard,
    ImageObservation,
    board_corners,
    find_board,
)

ImageSet = Mapping[str, Callable[[], Image]]
"""Images taken at one time: camera -> how to load its image."""


@dataclass(frozen=True, slots=True)
class View:
    """Board in one place, as seen by one or more cameras at the same epoch."""

    name: str  # how the view is called in reports, such as "07"
    # camera -> the board in its image; a camera that did not see it is absent
    observations: Mapping[str, ImageObservation]


@dataclass(frozen=True, slots=True)
class BoardViews:
    """All views of one board."""

    board: Board
    sizes_px: Mapping[str, tuple[int, int]]  # camera -> width and height of its images
    views: tuple[View, ...]  # the views in which at least one camera saw the board
    unseen: tuple[str, ...] = ()  # "view camera" of each image without the board

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(self.sizes_px)

    def of(self, camera: str) -> tuple[tuple[str, ImageObservation], ...]:
        """Name and observation of every view that `camera` has."""
        return tuple(
            (view.name, view.observations[camera]) for view in self.views if camera in view.observations
        )


def look(
    board: Board, sets: Sequence[tuple[str, ImageSet]], progress: Callable[[str], None] = lambda _: None
) -> BoardViews:
    """Find the board in all images of `sets`: name of each view and its images.

    A ChArUco board of another layout, or white on black, is recognised: `BoardViews.board` is then that.
    `progress` is called after each image with "view camera".

    Raises:
        FitError: There is no image, images of one camera differ in size, or the board is in none of them;
            then the message states which board was looked for, and which one is there instead.
    """
    sizes: dict[str, tuple[int, int]] = {}
    views: list[View] = []
    unseen: list[str] = []
    finder = Finder(board)
    for name, images in sets:
        observations: dict[str, ImageObservation] = {}
        for camera, load in images.items():
            image = load()
            check_alike(sizes, camera, name, image)
            if (observation := finder.find(image)) is None:
                unseen.append(f"{name} {camera}")
            else:
                observations[camera] = observation
            progress(f"{name} {camera}")
        if observations:
            views.append(View(name, observations))
    if not sizes:
        raise FitError("there is no image")
    if not views:
        raise FitError(f"no {board} in any of {len(unseen)} images: {finder.advice()}")
    return BoardViews(finder.board, sizes, tuple(views), tuple(unseen))


def check_alike(sizes: dict[str, tuple[int, int]], camera: str, name: str, image: Image) -> None:
    """Refuse images of one camera that differ in size; `sizes` keeps the first.

    A lens holds for one mode.
    """
    size = (image.shape[1], image.shape[0])
    if sizes.setdefault(camera, size) != size:
        raise FitError(
            f"camera {camera!r}: view {name} is {size[0]} x {size[1]} px, the views before it"
            f" {sizes[camera][0]} x {sizes[camera][1]}: take all images of a camera in one mode"
        )


class Finder:
    """Finds a board in images; of a ChArUco board the layout in which one shows it.

    State: the board as it is printed, once an image has shown it, and some images without it.
    """

    def __init__(self, board: Board) -> None:
        self.board = board
        self._known = not isinstance(board, Charuco)
        self._unseen, self._without = 0, list[Image]()

    def find(self, image: Image) -> ImageObservation | None:
        """The board in an image (H, W) or (H, W, 3) BGR; None: not found."""
        found = find_board(self.board, image)
        often, seldom = 12, 4  # images that are searched for all layouts; then every so many
        if found is None and not self._known and (self._unseen < often or self._unseen % seldom == 0):
            for other in self.board.layouts() if isinstance(self.board, Charuco) else ():
                if (found := find_board(other, image)) is not None:
                    self.board = other
                    break
        if found is not None:
            self._known = True
            return found
        self._unseen += 1
        if self._unseen & (self._unseen - 1) == 0:  # 1, 2, 4, ...: early ones may show nothing
            self._without = [*self._without, image][-4:]
        return None

    def advice(self) -> str:
        """What to do about a board that was found in no image."""
        if any(find_board(self.board, np.ascontiguousarray(image[:, ::-1])) for image in self._without):
            return "the pictures are mirrored, as a webcam shows them to its user: turn that off"
        likely = list(_likely_mistakes(self.board))
        likely += [other for board in likely if isinstance(board, Charuco) for other in board.layouts()]
        best, shown = 0.0, ""
        for other in likely:  # of a larger one a part would be seen, of a smaller one less
            seen = [found.seen for image in self._without if (found := find_board(other, image)) is not None]
            if (score := max(seen, default=0) ** 2 / len(board_corners(other))) > best:
                best, shown = score, f"they show a {other}"
        if shown:
            return shown
        if not isinstance(self.board, Charuco):
            what = "inner corners (squares less one)" if isinstance(self.board, Checkerboard) else "circles"
            return f"count the {what}, show all with a white margin, well lit and sharp"
        return "check columns, rows, sizes and dictionary against what is printed on the board, light and sharpness"


def moved_px(now: ImageObservation, then: ImageObservation) -> float:
    """Rms motion [px] of the corners seen both times; inf: there are none."""
    step = now.corners_px - then.corners_px
    both = np.isfinite(step[:, 0])
    return float(np.sqrt((step[both] ** 2).sum(axis=1).mean())) if both.any() else float("inf")


def is_new(
    seen: Mapping[str, ImageObservation],
    views: list[View],
    sizes_px: Mapping[str, tuple[int, int]],
    share: float,
) -> bool:
    """Whether a camera sees the board as in no view, or the set of cameras is new.

    `share` of the image's width is how far corners must be from where a view has them.
    """
    for view in views:
        if set(seen) <= set(view.observations):
            moved = (moved_px(now, view.observations[name]) / sizes_px[name][0] for name, now in seen.items())
            if max(moved) < share:
                return False
    return True


def _likely_mistakes(board: Board) -> Iterator[Board]:
    """Boards that a user may mean: squares counted, sides swapped, other family."""
    c, r = board.columns, board.rows
    if not isinstance(board, Charuco):
        # The larger first: a part of a board can be taken for a smaller one.
        sizes = ((c + 1, r + 1), (c, r + 1), (c + 1, r), (c, r - 1), (c - 1, r), (c - 1, r - 1))
        for columns, rows in sizes:
            if min(columns, rows) >= 3:
                yield replace(board, columns=columns, rows=rows)
        return
    grids = [(r, c), (c + 1, r + 1), (c - 1, r - 1), (c + 1, r), (c - 1, r)]
    others = [(columns, rows, board.dictionary) for columns, rows in grids if (columns, rows) != (c, r)]
    others += [(c, r, f"{bits}_1000") for bits in ("4X4", "5X5", "6X6", "7X7")]
    for columns, rows, dictionary in others:
        try:
            yield Charuco(columns, rows, board.square_m, board.marker_m, dictionary)
        except CalibrationError:  # such a board cannot exist: too small, or more markers than the family has
            continue


ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_NUMBER = re.compile(r"[-_ .]?\d+$")
MOST_VIEWS = 60  # of a recording: more of the same motion adds time, not knowledge


def image_sets(folder: Path, cameras: Sequence[str] = ()) -> list[tuple[str, ImageSet]]:
    """The views of a folder by name: images of all cameras taken at one epoch.

    Args:
        folder: Holds one sub-folder of images per camera, views matched by file name; or images named
            CAMERA*.png|jpg|…, matched by the rest of the name (left01.jpg, right01.jpg).
        cameras: Those wanted; none: those the folder has, a name being what stands before the number.

    Raises:
        RecordingError: No folder, no image in it, or none of a requested camera.
    """
    if not folder.is_dir():
        raise RecordingError(f"{folder}: is not a folder")
    files = files_in(folder, ENDINGS)
    if files:
        return _matched(folder, _by_prefix(folder, files, cameras))
    nested = files_by_folder(folder, ENDINGS)
    if not nested:
        raise RecordingError(f"{folder}: no images here, nor in a folder per camera ({', '.join(ENDINGS)})")
    if missing := [camera for camera in cameras if camera not in nested]:
        raise RecordingError(
            f"{folder}: no folder of images for {missing[0]!r}; there are {', '.join(nested)}"
        )
    return _matched(
        folder, {camera: {file.stem: file for file in nested[camera]} for camera in cameras or tuple(nested)}
    )


def files_in(folder: Path, endings: Sequence[str]) -> list[Path]:
    """The files of a folder with one of these endings, by name."""
    return sorted(
        file
        for file in folder.iterdir()
        if file.suffix.lower() in endings and file.is_file() and not file.name.startswith(".")
    )


def files_by_folder(folder: Path, endings: Sequence[str]) -> dict[str, list[Path]]:
    """Name of each folder below that has such files -> its files."""
    below = {sub.name: files_in(sub, endings) for sub in sorted(folder.iterdir()) if sub.is_dir()}
    return {name: found for name, found in below.items() if found}


def _by_prefix(folder: Path, files: list[Path], cameras: Sequence[str]) -> dict[str, dict[str, Path]]:
    """Camera -> rest of the name -> file; files of other cameras are ignored."""
    prefixes = sorted({_NUMBER.sub("", file.stem) for file in files} - {""})
    names = list(cameras) or prefixes
    if len(names) == 1 and not any(file.stem.startswith(names[0]) for file in files) and len(prefixes) <= 1:
        return {names[0]: {file.stem: file for file in files}}  # one camera's folder need not repeat its name
    found: dict[str, dict[str, Path]] = {name: {} for name in names}
    longest_first = sorted(names, key=len, reverse=True)
    for file in files:
        owner = next((name for name in longest_first if file.stem.startswith(name)), None)
        if owner is not None:
            found[owner][file.stem[len(owner) :].strip("-_ .") or "0"] = file
    for name, own in found.items():
        if not own:
            raise RecordingError(
                f"{folder}: no image is named {name}*; the names begin with {', '.join(prefixes) or 'numbers'}"
            )
    if not found:
        raise RecordingError(f"{folder}: the images are numbered only: name their camera with --camera NAME")
    return found


def _matched(folder: Path, files: dict[str, dict[str, Path]]) -> list[tuple[str, ImageSet]]:
    names = sorted(set[str]().union(*files.values()), key=natural)
    return [
        (name, {camera: partial(load_image, own[name]) for camera, own in files.items() if name in own})
        for name in names
    ]


def natural(name: str) -> tuple[tuple[int, str], ...]:
    """Order in which 2 comes before 10."""
    return tuple(
        (int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name) if part
    )


def load_image(file: Path, *, grey: bool = False) -> Image:
    """An image (H, W, 3), or (H, W) if grey, 8 bits.

    Raises:
        RecordingError: The file cannot be read, or is no image.
    """
    try:
        return decode_file(read_picture(file), grey=grey)
    except OSError as error:
        raise RecordingError(f"{file}: cannot read: {error.strerror}") from error
    except PictureError as error:
        raise RecordingError(f"{file}: is no image: it {error}") from error
