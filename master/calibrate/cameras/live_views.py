"""Selection of images of a hand-held board that are worth keeping.

Held still, in focus of the fit, and unlike those kept before.

Cameras that are not synchronised see a moving board in two places, so a view counts only where every camera that
sees the board sees it where it was in the round before. Rounds are a fraction of a second apart and cameras less, so
what moves less than `STILL_PX` between rounds moves far less between cameras.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from common.arrays import Float, Image
from master.calibrate.cameras.boards import Board
from master.calibrate.cameras.coverage import advice_so_far
from master.calibrate.cameras.detect import ImageObservation, find_board
from master.calibrate.cameras.views import BoardViews, View


@dataclass(frozen=True, slots=True)
class Verdict:
    """What became of one round of pictures.

    Attributes:
        kept: Whether it is worth keeping.
        text: For the person who holds the board.
    """

    kept: bool
    text: str


class LiveViews:
    """Push machine for live views.

    It holds the views kept so far and where each camera saw the board in the last round.
    """

    def __init__(self, board: Board, cameras: tuple[str, ...]) -> None:
        """Begin without views."""
        self.board, self.cameras = board, cameras
        self.views: list[View] = []
        self._sizes: dict[str, tuple[int, int]] = {}
        self._last: dict[str, ImageObservation] = {}

    def push(self, images: Mapping[str, Image]) -> Verdict:
        """Judge the pictures (camera -> (H, W) or (H, W, 3)) of one round."""
        found = {name: find_board(self.board, image) for name, image in images.items()}
        seen = {name: observation for name, observation in found.items() if observation is not None}
        last, self._last = self._last, seen
        for name, image in images.items():
            self._sizes[name] = (image.shape[1], image.shape[0])
        if not seen:
            return Verdict(False, "no camera sees the board")
        by = " and ".join(seen)
        moved = {name: _moved(seen[name], last[name]) if name in last else float("inf") for name in seen}
        still_px = 0.5
        if max(moved.values()) > still_px:
            return Verdict(False, f"{by}: hold it still")
        if not self._is_new(seen):
            return Verdict(False, f"{by}: seen there already; move, turn or tilt it")
        self.views.append(View(f"{len(self.views) + 1:03d}", seen))
        return Verdict(True, by)

    def board_views(self) -> BoardViews:
        """What was kept, as the fits take it."""
        return BoardViews(self.board, dict(self._sizes), tuple(self.views))

    def missing(self) -> str:
        """Return the view that would help most now.

        For the camera that needs one most; what to do once none is missing.
        """
        views = self.board_views()
        for name in sorted(self.cameras, key=lambda name: len(views.of(name))):
            if wish := advice_so_far(views, name):
                return f"for {name}, {wish}" if views.of(name) else wish
        alone = [
            name for name in self.cameras if not any({name} < set(view.observations) for view in self.views)
        ]
        if alone and len(self.cameras) > 1:
            return f"show the board to {alone[0]} and another camera at once"
        return "nothing is missing any more; more views make it more certain"

    def _is_new(self, seen: Mapping[str, ImageObservation]) -> bool:
        """Check whether some camera sees the board as in no view before.

        A set of cameras that is new counts as new as well.
        """
        for view in self.views:
            if not set(seen) <= set(view.observations):
                continue
            change = [
                _moved(observation, view.observations[name]) / self._sizes[name][0]
                for name, observation in seen.items()
            ]
            # of the image's width: how far corners must be from where an earlier view had them
            new_share = 0.06
            if max(change) < new_share:
                return False
        return True


def _moved(now: ImageObservation, then: ImageObservation) -> float:
    """Return how far the corners seen both times moved.

    Root mean square [px]; inf where there are none.
    """
    step: Float = now.corners_px - then.corners_px
    both = np.isfinite(step[:, 0])
    return float(np.sqrt((step[both] ** 2).sum(axis=1).mean())) if both.any() else float("inf")
