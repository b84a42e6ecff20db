"""Measure and draw which parts of the image the board has covered.

It also decides which live images of a hand-held board are kept. Cameras that are not synchronised see a
moving board in two places, so a view counts only where every camera that sees the board sees it where it was
in the round before. Rounds are a fraction of a second apart and cameras less, so what is still between rounds
is so between cameras.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from common.arrays import Bool, Float, Image
from master.calibrate.cameras.boards import Board, ImageObservation, board_corners
from master.calibrate.cameras.bundle import guess_lens, place_board, rms
from master.calibrate.cameras.fit import CamerasFit
from master.calibrate.cameras.outliers import corners_seen
from master.calibrate.cameras.views import BoardViews, Finder, View, is_new, moved_px
from master.calibrate.picture import figure_of, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CELLS = (6, 8)  # rows and columns: a cell is about as large as a board's square seen near


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """What the views of one camera cover."""

    cells: Bool  # whether a corner was seen in that part of the image (6, 8), rows from the top
    tilt_deg: Float  # angle [deg] between the board's normal and the camera's axis (V,)
    tilt_spread_deg: float  # largest angle [deg] between two views' normals: what determines the focal length
    across: tuple[float, float]  # spread [deg] of the normals to the sides and up and down
    distance_m: Float  # distance [m] of the board's middle (V,)

    @property
    def share(self) -> float:
        """Share of the image's cells with a corner."""
        return float(self.cells.mean())


def coverage(
    size_px: tuple[int, int], uv: Sequence[Float], T_camera_board: Float, middle_m: Float
) -> Coverage:
    """Coverage of views with corners (n, 2) [px] and board poses (V, 4, 4) [m].

    `middle_m` (3,) [m] is the middle of the board in its frame.
    """
    normals = T_camera_board[:, :3, 2]
    cosines = np.clip(normals @ normals.T, -1.0, 1.0)
    sides = np.degrees(np.arctan2(normals[:, :2], normals[:, 2:]))
    places = T_camera_board[:, :3, :3] @ middle_m + T_camera_board[:, :3, 3]
    return Coverage(
        cells=_cells(size_px, np.concatenate(uv)),
        tilt_deg=np.degrees(np.arccos(np.clip(normals[:, 2], -1.0, 1.0))),
        tilt_spread_deg=float(np.degrees(np.arccos(cosines.min()))),
        across=(float(np.ptp(sides[:, 0])), float(np.ptp(sides[:, 1]))),
        distance_m=np.linalg.norm(places, axis=1),
    )


def _cells(size_px: tuple[int, int], uv: Float) -> Bool:
    """Which of the image's cells (6, 8) hold one of the corners (n, 2) [px]."""
    rows, columns = CELLS
    u = np.clip((uv[:, 0] + 0.5) * columns / size_px[0], 0, columns - 1).astype(int)
    v = np.clip((uv[:, 1] + 0.5) * rows / size_px[1], 0, rows - 1).astype(int)
    cells = np.zeros(CELLS, dtype=np.bool_)
    cells[v, u] = True
    return cells


def advice(covered: Coverage) -> str:
    """The view that would help most, or "" where all is covered."""
    if covered.tilt_spread_deg < 40.0:
        sideways, upright = covered.across
        about = "its upright axis (left edge nearer, then right edge)"
        if upright < sideways:
            about = "its level axis (top edge nearer, then bottom edge)"
        return f"tilt the board 20 to 40° about {about}"
    if covered.share < 0.7:
        return f"show the board {_emptiest(covered.cells)}"
    enough_range = 1.5
    if covered.distance_m.max() < enough_range * covered.distance_m.min():
        near, far = covered.distance_m.max() / enough_range, covered.distance_m.min() * enough_range
        return f"show the board nearer than {near:.2f} m or beyond {far:.2f} m"
    return ""


def advice_so_far(views: BoardViews, camera: str) -> str:
    """`advice` while views are still being taken and no lens is known."""
    drawn = board_corners(views.board)
    seen = [corners_seen(observation) for _, observation in views.of(camera)]
    if not seen:
        return f"show the board to {camera}"
    lens = guess_lens(seen, drawn, views.sizes_px[camera])
    places = np.stack([place_board(drawn[corners], uv, lens)[0] for corners, uv in seen])
    return advice(coverage(views.sizes_px[camera], [uv for _, uv in seen], places, drawn.mean(axis=0)))


def _emptiest(cells: Bool) -> str:
    """The ninth of the image with the fewest cells covered, in words."""
    rows, columns = CELLS
    best, words = 2.0, ""
    for i, level in enumerate(("top", "middle", "bottom")):
        for j, side in enumerate(("left", "middle", "right")):
            part = cells[i * rows // 3 : (i + 1) * rows // 3, j * columns // 3 : (j + 1) * columns // 3]
            if part.mean() < best:
                best = float(part.mean())
                words = (
                    "in the middle of the image" if level == side else f"at the {level} {side} of the image"
                )
                if "middle" in (level, side) and level != side:
                    edge = side if level == "middle" else level
                    words = f"at the {edge} edge of the image"
    return words


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether a round of pictures is kept, and the text for who holds the board."""

    kept: bool
    text: str


class LiveViews:
    """Push machine for live views.

    State: the views kept so far, and where each camera saw the board in the last round.
    """

    def __init__(self, board: Board, cameras: tuple[str, ...]) -> None:
        self._finder, self.cameras = Finder(board), cameras
        self.views: list[View] = []
        self._sizes: dict[str, tuple[int, int]] = {}
        self._last: dict[str, ImageObservation] = {}

    @property
    def board(self) -> Board:
        """The board, as it is printed once an image has shown it."""
        return self._finder.board

    def push(self, images: Mapping[str, Image]) -> Verdict:
        """Judge the pictures (camera -> (H, W) or (H, W, 3)) of one round."""
        found = {name: self._finder.find(image) for name, image in images.items()}
        seen = {name: observation for name, observation in found.items() if observation is not None}
        last, self._last = self._last, seen
        for name, image in images.items():
            self._sizes[name] = (image.shape[1], image.shape[0])
        if not seen:
            return Verdict(False, "no camera sees the board")
        by = " and ".join(seen)
        moved = {name: moved_px(seen[name], last[name]) if name in last else float("inf") for name in seen}
        if max(moved.values()) > 0.5:
            return Verdict(False, f"{by}: hold it still")
        if not is_new(seen, self.views, self._sizes, 0.06):
            return Verdict(False, f"{by}: seen there already; move, turn or tilt it")
        self.views.append(View(f"{len(self.views) + 1:03d}", seen))
        return Verdict(True, by)

    def board_views(self) -> BoardViews:
        """What was kept, as the fits take it."""
        return BoardViews(self.board, dict(self._sizes), tuple(self.views))

    def missing(self) -> str:
        """The view that would help most now, for the camera that needs one most."""
        views = self.board_views()
        for name in sorted(self.cameras, key=lambda name: len(views.of(name))):
            if advised := advice_so_far(views, name):
                return f"for {name}, {advised}" if views.of(name) else advised
        alone = [
            name for name in self.cameras if not any({name} < set(view.observations) for view in self.views)
        ]
        if alone and len(self.cameras) > 1:
            return f"show the board to {alone[0]} and another camera at once"
        return "nothing is missing any more; more views make it more certain"


_BLUE, _ORANGE, _GREY = "#2b6cb0", "#c2571a", "#8a8a8a"


def draw_views(path: Path, fits: Sequence[CamerasFit]) -> None:
    """Draw one row per camera as PNG: corners, enlarged residuals, rms of each view.

    Raises:
        RecordingError: The file cannot be written.
    """
    cameras = [(fit, camera) for fit in fits for camera in fit.views.cameras]
    figure = figure_of((15.0, 0.6 + 3.7 * len(cameras)))
    off = rms([residual for fit in fits for residual in fit.solution.residuals])
    figure.suptitle(f"{fits[0].views.board}: {sum(len(fit.shots) for fit in fits)} images, rms {off:.3f} px")
    axes = figure.subplots(len(cameras), 3, squeeze=False, width_ratios=(1.0, 1.0, 1.1))
    for row, (fit, camera) in zip(axes, cameras, strict=True):
        _corners(row[0], fit, camera)
        _residuals(row[1], fit, camera)
        _bars(row[2], fit, camera)
    save_figure(figure, path)


def _image(axes: "Axes", fit: CamerasFit, camera: str, title: str) -> None:
    width, height = fit.views.sizes_px[camera]
    axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal", title=f"{camera}: {title}")
    axes.tick_params(labelsize=7)


def _corners(axes: "Axes", fit: CamerasFit, camera: str) -> None:
    _image(axes, fit, camera, "corners; shaded: cells without any")
    width, height = fit.views.sizes_px[camera]
    corners = [fit.observations[i].uv for i in fit.of(camera)]
    for uv in corners:
        axes.plot(uv[:, 0], uv[:, 1], ".", markersize=3)
    seen = _cells((width, height), np.concatenate(corners))
    axes.imshow(~seen, extent=(0, width, height, 0), cmap="Greys", alpha=0.25, vmin=0, vmax=1, aspect="equal")


def _residuals(axes: "Axes", fit: CamerasFit, camera: str) -> None:
    own = fit.of(camera)
    uv = np.concatenate([fit.observations[i].uv for i in own])
    off = np.concatenate([fit.solution.residuals[i] for i in own])
    # The usual residual becomes one percent of the image's width.
    times = 0.01 * fit.views.sizes_px[camera][0] / max(rms([off]), 1e-6)
    times = float(f"{times:.0e}")
    _image(axes, fit, camera, f"residuals, {times:g} times enlarged")
    axes.quiver(
        uv[:, 0], uv[:, 1], times * off[:, 0], times * off[:, 1],
        angles="xy", scale_units="xy", scale=1.0, width=0.0018, color=_BLUE,
    )  # fmt: skip


def _bars(axes: "Axes", fit: CamerasFit, camera: str) -> None:
    errors = {fit.shots[i].view: rms([fit.solution.residuals[i]]) for i in fit.of(camera)}
    names = [name for name, _ in fit.views.of(camera)]
    noted = {no.view for no in fit.rejected if no.camera in (camera, "")}
    colours = [_ORANGE if name in noted else _BLUE for name in names]
    axes.bar(range(len(names)), [errors.get(name, 0.0) for name in names], color=colours)
    top = max(errors.values(), default=1.0)
    for x, name in enumerate(names):
        if name not in errors:
            axes.text(
                x, 0.02 * top, "left out", rotation=90, ha="center", va="bottom", color=_ORANGE, fontsize=8
            )
        elif name in noted:
            axes.text(
                x, errors[name], "lens only", rotation=90, ha="center", va="top", color="white", fontsize=7
            )
    axes.axhline(rms([fit.solution.residuals[i] for i in fit.of(camera)]), color=_GREY, linewidth=0.8)
    axes.set(title=f"{camera}: rms of each view [px]", ylim=(0, 1.08 * top))
    axes.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
