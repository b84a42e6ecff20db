"""What the cameras saw of a board: the observations of all fits of cameras."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

from common.arrays import Image
from common.errors import CalibrationError, FitError
from master.calibrate.cameras.boards import Board, Charuco, Checkerboard
from master.calibrate.cameras.detect import ImageObservation, find_board

ImageSet = Mapping[str, Callable[[], Image]]
"""Images taken at one time: camera -> how to load its image."""


@dataclass(frozen=True, slots=True)
class View:
    """Board in one place, as seen by one or more cameras at the same epoch.

    Attributes:
        name: How the view is called in reports, such as "07".
        observations: Camera -> the board in its image; a camera that did not see it is absent.
    """

    name: str
    observations: Mapping[str, ImageObservation]


@dataclass(frozen=True, slots=True)
class BoardViews:
    """All views of one board.

    Attributes:
        board: The board.
        sizes_px: Camera -> width and height of its images.
        views: The views in which at least one camera saw the board.
        unseen: "view camera" of each image without the board.
    """

    board: Board
    sizes_px: Mapping[str, tuple[int, int]]
    views: tuple[View, ...]
    unseen: tuple[str, ...] = ()

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(self.sizes_px)

    def of(self, camera: str) -> tuple[tuple[str, ImageObservation], ...]:
        """Return the name and observation of every view that `camera` has."""
        return tuple(
            (view.name, view.observations[camera]) for view in self.views if camera in view.observations
        )


def look(
    board: Board,
    sets: Iterable[tuple[str, ImageSet]],
    progress: Callable[[str], None] = lambda _: None,
) -> BoardViews:
    """Find the board in all images.

    Args:
        board: The board to look for.
        sets: Name of each view and its images.
        progress: Called after each image with "view camera".

    Raises:
        FitError: There is no image, images of one camera differ in size, or the board is in none of them; then the
            message states which board was looked for, and which one is there instead, if one was recognised.
    """
    sizes: dict[str, tuple[int, int]] = {}
    views: list[View] = []
    unseen: list[str] = []
    first: list[Image] = []
    for name, images in sets:
        observations: dict[str, ImageObservation] = {}
        for camera, load in images.items():
            image = load()
            size = (image.shape[1], image.shape[0])
            if sizes.setdefault(camera, size) != size:
                raise FitError(
                    f"camera {camera!r}: view {name} is {size[0]} x {size[1]} px, the views before it"
                    f" {sizes[camera][0]} x {sizes[camera][1]}: take all images of a camera in one mode"
                )
            if (observation := find_board(board, image)) is None:
                unseen.append(f"{name} {camera}")
                if len(first) < 4:
                    first.append(image)
            else:
                observations[camera] = observation
            progress(f"{name} {camera}")
        if observations:
            views.append(View(name, observations))
    if not sizes:
        raise FitError("there is no image")
    if not views:
        raise FitError(f"no {board} in any of {len(unseen)} images: {_advice(board, first)}")
    return BoardViews(board, sizes, tuple(views), tuple(unseen))


def _advice(board: Board, images: list[Image]) -> str:
    for other in _likely_mistakes(board):
        if any(find_board(other, image) is not None for image in images):
            return f"they show a {other}"
    if isinstance(board, Checkerboard):
        return "count the inner corners (squares less one), show all of them with a white margin, well lit and sharp"
    return (
        "check columns, rows, sizes and dictionary against what is printed on the board, light and sharpness"
    )


def _likely_mistakes(board: Board) -> Iterator[Board]:
    """Yield boards that a user may mean who asked for `board`.

    Squares counted for corners, sides swapped, another family.
    """
    c, r = board.columns, board.rows
    if isinstance(board, Checkerboard):
        # The larger first: a part of a board can be taken for a smaller one.
        sizes = ((c + 1, r + 1), (c, r + 1), (c + 1, r), (c, r - 1), (c - 1, r), (c - 1, r - 1))
        for columns, rows in sizes:
            if min(columns, rows) >= 3:
                yield Checkerboard(columns, rows, board.square_m)
        return
    grids = [(r, c), (c + 1, r + 1), (c - 1, r - 1)]
    others = [(columns, rows, board.dictionary) for columns, rows in grids if (columns, rows) != (c, r)]
    others += [(c, r, f"{bits}_1000") for bits in ("4X4", "5X5", "6X6", "7X7")]
    for columns, rows, dictionary in others:
        try:
            yield Charuco(columns, rows, board.square_m, board.marker_m, dictionary)
        except CalibrationError:  # such a board cannot exist: too small, or more markers than the family has
            continue
